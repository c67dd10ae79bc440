"""The paper's baseline: Steiglitz-McBride on the discrete filters, eqs. (1)-(12).

Both stages identify a rational filter N/D with X N/D = W. Both records are prefiltered with the
denominator of the previous iteration. This makes the output error W − X N/D linear in (N, D)
(Steiglitz & McBride 1965),

    minimise  ∮ |X N_i/D_{i−1} − W D_i/D_{i−1}|² dz/z,      D_{−1} = 1          (1), (2)

Iteration 0 alone is the *equation error* estimate. Driver and skin differ only in X and W:

    driver:  X = V_out,          W = R_L (V_th − V_out),   N/D = Z_th      (5), (6)
    skin:    X = V_th − V_out,   W = Z_th V_out,           N/D = Z_bio     (8), (9)

On most recordings the iteration does not converge. Its fixed point is biased by noise, because X
and W share the noise of V_out. The result is the iterate whose *simulated* terminal voltage fits
best (RRSE, eq. 3).

In the periodic steady state, a delay by k samples is a factor z⁻ᵏ. Eqs. (1), (2) become sums over
harmonics of |X N_i − W D_i|² / |D_{i−1}|². No filter runs, so that a step takes a few per cent of
one in time. An unstable D_{i−1} needs no reflected poles, because only |D_{i−1}| counts.
"""

import dataclasses
from collections.abc import Callable
from types import ModuleType

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from etid.circuits.circuit import SkinRC
from etid.precision import array_function, namespace
from etid.results.fit import complex_rrse, rrse
from etid.signals.filtering import from_rest
from etid.signals.harmonics import Spectrum
from etid.signals.transfer import (
    AnyArray,
    Rational,
    add_polynomials,
    as_complex,
    delay_variable,
    is_stable,
    multiply_polynomials,
    power,
    reciprocal,
    reflect_poles,
)

ITERATIONS = 20
SETTLED = 1e-6  # relative change of the coefficients that counts as convergence


class Iterate(eqx.Module):
    """The best iterate of a Steiglitz-McBride run.

    Attributes:
        filter: N/D in z⁻¹.
        rrse: RRSE of the predicted terminal voltage (eq. 3); infinite if it cannot be simulated.
        iteration: Number of its iteration; 0 is equation error.
        converged: Whether the *last* iterations converged.
        stable: Whether N/D itself is stable.
    """

    filter: Rational
    rrse: Float[AnyArray, ""]
    iteration: Int[AnyArray, ""]
    converged: Bool[AnyArray, ""]
    stable: Bool[AnyArray, ""]


def delayed(v: Float[AnyArray, "record time"], lags: range) -> list[AnyArray]:
    """Copies of the records (record time), delayed by each lag."""
    xp, time = namespace(v), v.shape[-1]
    return [xp.pad(v, ((0, 0), (k, 0)))[:, :time] for k in lags]


def check_iterations(iterations: int) -> None:
    """Raise ValueError unless there is an iteration."""
    if iterations < 1:
        raise ValueError(f"iterations is {iterations}; use at least one")


def least_squares(columns: Float[AnyArray, "row column"], poles: int) -> Rational:
    """N/D by linear least squares; NaN if the columns do not determine it.

    Args:
        columns: X z⁻ᵏ for each coefficient of N, −W z⁻ᵏ for those of D but the first, and W.
        poles: Order of D.
    """
    xp = namespace(columns)
    length = xp.linalg.norm(columns[:, :-1], axis=0)
    length = xp.where(length > 0, length, 1.0)
    # The last column of R holds Qᵀ W; to compute Q itself would double the time.
    scaled = xp.concatenate([columns[:, :-1] / length[None, :], columns[:, -1:]], axis=1)
    r = xp.linalg.qr(scaled, mode="r")[:-1]
    square = xp.where((r[:, :-1] == 0) & np.eye(len(r), dtype=bool), np.nan, r[:, :-1])
    coefficients = xp.linalg.solve(square, r[:, -1:])[:, 0] / length
    one = xp.ones(1, columns.dtype)
    return Rational(coefficients[:-poles], xp.concatenate([one, coefficients[-poles:]]))


_Carry = tuple[Iterate, Float[AnyArray, " a"]]


def iterate(
    solve: Callable[[Float[AnyArray, " a"]], Rational],
    zeros: int,
    first: Float[AnyArray, " a"],
    assess: Callable[[Rational], Float[AnyArray, ""]],
    iterations: int = ITERATIONS,
) -> Iterate:
    """Fit N/D with X N/D = W over one or several records (eqs. 1, 2).

    Args:
        solve: Function that returns N_i/D_i, given D_{i−1}.
        zeros: Order of N.
        first: D₋₁.
        assess: Function that returns the RRSE of the voltage that a candidate predicts; infinite
            if its closed loop is unstable.
        iterations: Number of iterations; 1 is equation error.
    """
    xp = namespace(first)

    def step(carry: _Carry, iteration: Int[AnyArray, ""]) -> tuple[_Carry, Float[AnyArray, ""]]:
        best, previous = carry
        candidate = solve(previous)
        error = assess(candidate)
        change = xp.linalg.norm(candidate.den - previous) / xp.linalg.norm(candidate.den)
        stable = is_stable(candidate.den)
        current = Iterate(candidate, error, iteration, change < SETTLED, stable)
        # While no iterate can be simulated, keep the latest.
        better = (error < best.rrse) | ~xp.isfinite(best.rrse)
        best = jax.tree.map(lambda new, old: xp.where(better, new, old), current, best)
        finite = xp.isfinite(candidate.den).all()
        return (best, xp.where(finite, candidate.den, previous)), change

    no = xp.asarray(False)
    nothing = Iterate(
        Rational(xp.zeros(zeros + 1), first), xp.asarray(np.inf), xp.asarray(0), no, no
    )
    carry, change = (nothing, first), xp.asarray(np.inf)
    if xp is np:
        for number in range(iterations):
            carry, change = step(carry, np.asarray(number))
    else:
        carry, changes = jax.lax.scan(step, carry, jnp.arange(iterations))
        change = changes[-1]
    return dataclasses.replace(carry[0], converged=change < SETTLED)


def no_poles(xp: ModuleType, order: int) -> Float[AnyArray, " order1"]:
    """D = 1."""
    return xp.asarray(np.eye(order + 1)[0])


def in_time(
    x: Float[AnyArray, "record time"], w: Float[AnyArray, "record time"], zeros: int, poles: int
) -> Callable[[Float[AnyArray, " a"]], Rational]:
    """The step of the iteration for records X and W."""
    xp = namespace(x)
    one = xp.ones(1, x.dtype)

    def solve(previous: Float[AnyArray, " a"]) -> Rational:
        # A prefilter must be stable. Reflected poles give the same magnitude response.
        prefilter = xp.where(is_stable(previous), previous, reflect_poles(previous))
        xf, wf = xp.split(from_rest(one, prefilter, xp.concatenate([x, w])), 2)
        columns = [*delayed(xf, range(zeros + 1)), *delayed(-wf, range(1, poles + 1)), wf]
        return least_squares(xp.stack(columns).reshape(len(columns), -1).T, poles)

    return solve


def terminal_voltage(
    z_th: Rational, z_load: Rational, v_th: Float[AnyArray, " time"]
) -> tuple[Float[AnyArray, " time"], Bool[AnyArray, ""]]:
    """Predicted V_out = V_th · Z_L / (Z_L + Z_th), and whether the closed loop is stable.

    The closed loop is N_L D_th / (N_L D_th + N_th D_L). It can be unstable even if Z_th is stable.
    """
    forward, closed, stable = _closed_loop(z_th, z_load)
    return from_rest(forward, closed, v_th), stable


def _closed_loop(
    z_th: Rational, z_load: Rational
) -> tuple[Float[AnyArray, " f"], Float[AnyArray, " c"], Bool[AnyArray, ""]]:
    """Numerator and denominator of V_out/V_th, which is 1 if not stable; and whether it is."""
    forward = multiply_polynomials(z_load.num, z_th.den)
    closed = add_polynomials(forward, multiply_polynomials(z_th.num, z_load.den))
    stable = is_stable(closed)
    one = np.arange(closed.shape[0]) == 0
    return forward, namespace(closed).where(stable, closed, 1.0 * one), stable


def with_slopes(
    z_th: Rational, z_load: Rational, v_th: Float[AnyArray, " time"], of_load: bool
) -> tuple[Float[AnyArray, " time"], Float[AnyArray, "coefficient time"]]:
    """`terminal_voltage`, and its derivatives by the coefficients of Z_L or of Z_th.

    With N_L D_th = F and F + N_th D_L = C,

        ∂V/∂N_L = D_th/C (V_th − V),   ∂V/∂D_L = −N_th/C V,
        ∂V/∂N_th = −D_L/C V,           ∂V/∂D_th = N_L/C (V_th − V),

    each delayed by the power of its coefficient; D has no derivative by its first one, 1.
    """
    forward, closed, _ = _closed_loop(z_th, z_load)
    v = from_rest(forward, closed, v_th)
    if of_load:
        by_num = from_rest(z_th.den, closed, v_th - v)
        by_den = -from_rest(z_th.num, closed, v)
    else:
        by_num = -from_rest(z_load.den, closed, v)
        by_den = from_rest(z_load.num, closed, v_th - v)
    of = z_load if of_load else z_th
    parts = [*delayed(by_num[None], range(of.num.shape[0])),
             *delayed(by_den[None], range(1, of.den.shape[0]))]  # fmt: skip
    return v, namespace(v).concatenate(parts)


def _or_infinite(error: Float[AnyArray, ""], stable: Bool[AnyArray, ""]) -> Float[AnyArray, ""]:
    """The error; infinite if it is not finite or the loop is unstable."""
    xp = namespace(error)
    return xp.where(stable & xp.isfinite(error), error, np.inf)


@array_function
def driver_filter(
    v_th: Float[AnyArray, "record time"],
    v_out: Float[AnyArray, "record time"],
    r_load: Float[AnyArray, " record"],
    order: int,
    iterations: int = ITERATIONS,
) -> Iterate:
    """Identify the discrete Z_th from records with known resistors (paper, eqs. 4-6).

    Z_th = (α₀ + … + α₄ z⁻⁴) / (1 + β₁ z⁻¹ + … + β₅ z⁻⁵)                (4)
    """
    xp = namespace(v_th)

    def assess(candidate: Rational) -> Float[AnyArray, ""]:
        errors = []
        for number in range(r_load.shape[0]):
            of = candidate, resistor(r_load[number]), v_th[number]
            predicted, stable = terminal_voltage(*of)
            errors.append(_or_infinite(rrse(predicted, v_out[number]), stable))
        return xp.stack(errors).max()

    w = r_load[:, None] * (v_th - v_out)
    solve = in_time(v_out, w, order - 1, order)
    return iterate(solve, order - 1, no_poles(xp, order), assess, iterations)


def resistor(r: Float[AnyArray, ""]) -> Rational:
    """A resistor as a filter."""
    return Rational(r[None], namespace(r).ones(1))


@array_function
def periodic_driver_filter(
    spectra: Spectrum,
    r_load: Float[AnyArray, " record"],
    sample_rate: Float[AnyArray, ""],
    order: int,
) -> Iterate:
    """`driver_filter` from harmonics of the records, stacked."""
    xp = namespace(spectra.x)
    x, y = (xp.where(spectra.selected, of, 0.0) for of in (spectra.x, spectra.y))
    r = as_complex(r_load)[:, None]
    w = r * (x - y)
    z = delay_variable(spectra.frequency, sample_rate)
    powers = [xp.ones_like(z)]
    while len(powers) <= order:
        powers.append(powers[-1] * z)
    delays = xp.stack(powers)
    rows = xp.concatenate([delays[:-1] * y[None], -delays[1:] * w[None], w[None]])
    rows = rows.reshape(2 * order + 1, -1)
    parts = xp.stack([rows.real, rows.imag], axis=1)

    def solve(previous: Float[AnyArray, " a"]) -> Rational:
        den = xp.tensordot(as_complex(previous), delays, 1).ravel()
        weighted = parts / xp.sqrt(power(den))[None, None, :]
        return least_squares(weighted.reshape(parts.shape[0], -1).T, order)

    def assess(candidate: Rational) -> Float[AnyArray, ""]:
        num = xp.tensordot(as_complex(candidate.num), delays[:-1], 1)
        forward = r * xp.tensordot(as_complex(candidate.den), delays, 1)
        predicted = forward * reciprocal(forward + num) * x
        closed = [add_polynomials(of * candidate.den, candidate.num) for of in r_load]
        stable = xp.stack([is_stable(one) for one in closed]).all()
        return _or_infinite(complex_rrse(predicted, y).max(), stable)

    return iterate(solve, order - 1, no_poles(xp, order), assess)


@array_function
def skin_filter(
    v_th: Float[AnyArray, " time"],
    v_out: Float[AnyArray, " time"],
    z_th: Rational,
    iterations: int = ITERATIONS,
) -> Iterate:
    """Identify the discrete first-order Z_bio (paper, eqs. 7-9)."""

    def assess(candidate: Rational) -> Float[AnyArray, ""]:
        predicted, stable = terminal_voltage(z_th, candidate, v_th)
        return _or_infinite(rrse(predicted, v_out), stable)

    w = from_rest(z_th.num, z_th.den, v_out)
    solve = in_time((v_th - v_out)[None], w[None], 1, 1)
    return iterate(solve, 1, no_poles(namespace(v_th), 1), assess, iterations)


def skin_elements(z_bio: Rational, sample_rate: Float[AnyArray, ""] | float) -> SkinRC:
    """Elements of the first-order discrete Z_bio under the bilinear map (paper, eqs. 10-12).

    R_s = Z(∞),   R_p = Z(0) − R_s,   C_p from |Z(j/(R_p C_p))| = √((R_s+R_p)² + R_s²) / √2

    The paper prints the last magnitude as (2 R_s + R_p)/√2, which overestimates C_p (by 38 % for
    dry skin, 88 % for damp) and has no root for R_s/R_p > 1/√2. If the filter is no circuit, its
    elements are negative or NaN; they are not corrected.

    Args:
        z_bio: Discrete impedance, a rational function of z⁻¹.
        sample_rate: Sampling rate [Hz].
    """
    n, d = z_bio.num, z_bio.den
    r_s = (n[0] - n[1]) / (d[0] - d[1])  # s = ∞ is z = −1, eq. (10)
    total = (n[0] + n[1]) / (d[0] + d[1])  # s = 0 is z = 1, eq. (11)
    r_p = total - r_s
    tau = (d[0] - d[1]) / (d[0] + d[1]) / (2 * sample_rate)  # the pole, s = −1/(R_p C_p), eq. (12)
    return SkinRC.of_fit((r_s, r_p, tau / r_p))
