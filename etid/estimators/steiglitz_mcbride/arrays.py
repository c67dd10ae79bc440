"""Steiglitz-McBride on arrays: a filter from any input and output."""

from jaxtyping import Float

from etid.circuits.discrete import Filter
from etid.estimators.steiglitz_mcbride.iteration import (
    ITERATIONS,
    check_iterations,
    in_time,
    iterate,
    no_poles,
)
from etid.precision import array_function, in_float64, namespace, unmasked
from etid.printing import several
from etid.results.fit import rrse
from etid.signals.filtering import from_rest
from etid.signals.transfer import AnyArray, Rational


@in_float64
@array_function
def steiglitz_mcbride(
    x: Float[AnyArray, "*record time"],
    y: Float[AnyArray, "..."],
    order: int,
    *,
    zeros: int | None = None,
    sample_rate: float = 1.0,
    iterations: int = ITERATIONS,
) -> Filter:
    """The filter that makes the output of the input, by Steiglitz and McBride (1965).

        minimise  Σ |N_i/D_{i−1} x − D_i/D_{i−1} y|²,      D_{−1} = 1        (eqs. 1, 2)

    Its first iteration is an equation error (ARX) fit. The result is the iterate whose simulated
    output is nearest to y. Noise of x biases it; how far it is from y says
    `filter.simulate(x)`. Records begin at rest: subtract what is constant.

    Args:
        x: Input; leading axes are further records of the same filter.
        y: Output, of the same shape.
        order: Number of poles.
        zeros: Order of the numerator; `order` if not given.
        sample_rate: Samples per second [Hz].
        iterations: Number of iterations; 1 is equation error.

    Returns:
        The filter; its numbers are NaN if the records do not determine it.

    Raises:
        ValueError: x and y have different shapes, a number is not positive, or the records are
            shorter than the filter.
    """
    x, y = map(unmasked, (x, y))
    xp = namespace(x, y)
    x, y = (xp.asarray(of, float) for of in (x, y))
    zeros = order if zeros is None else zeros
    if x.shape != y.shape:
        raise ValueError(f"x has the shape {x.shape} and y {y.shape}; give records of one shape")
    if order < 1 or zeros < 0:
        raise ValueError(f"order is {order} and zeros {zeros}; a filter has a pole at least")
    if x.size < order + zeros + 1:
        raise ValueError(
            f"x and y have {several(x.size, 'sample')} for {order + zeros + 1} coefficients; "
            "record more, or lower the order"
        )
    check_iterations(iterations)
    x, y = (of.reshape(-1, of.shape[-1]) for of in (x, y))

    def assess(candidate: Rational) -> Float[AnyArray, ""]:
        made = from_rest(candidate.num, candidate.den, x)
        error = rrse(made.ravel(), y.ravel())
        return xp.where(xp.isfinite(error), error, xp.inf)

    found = iterate(in_time(x, y, zeros, order), zeros, no_poles(xp, order), assess, iterations)
    return Filter.of(found.filter.num, found.filter.den, sample_rate)
