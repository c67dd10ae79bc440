"""The fit of one load, given the calibrations of its driver, and its standard errors and tests.

`etid.estimators.maximum_likelihood.load` has the terms and their derivatives. A fit goes to the
minimum at the knots first, and from there with the objective and gradient of all harmonics.
"""

import dataclasses
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float

from etid.circuits.circuit import AbstractCircuit
from etid.estimators.element_prior import ElementPrior
from etid.estimators.estimate import MAX_STEPS, SOLVER, Estimate
from etid.estimators.maximum_likelihood.gain import Gain
from etid.estimators.maximum_likelihood.given_driver import AbstractGiven, combined
from etid.estimators.maximum_likelihood.load import Around, AtKnots, Load
from etid.estimators.maximum_likelihood.terms import (
    LOW,
    excess,
    residual,
    shows_hum,
    stands_out,
    variance,
)
from etid.estimators.sandwich import Linear
from etid.estimators.score_tests import falling_resistance, other_circuit
from etid.estimators.unknowns import LoadUnknowns
from etid.results.fit import Support, complex_rrse
from etid.signals.harmonics import Spectrum, signal_share
from etid.signals.transfer import as_complex, power
from etid.solvers.levenberg_marquardt import LevenbergMarquardt, NormalEquations
from etid.solvers.matrices import inverse_root


class _Some(eqx.Module):
    """Terms at the knots of which some parameters are fixed.

    Attributes:
        terms: The terms.
        free: Which parameters are not fixed.
    """

    terms: AtKnots
    free: Bool[Array, " q"]

    @property
    def gain(self) -> Gain:
        """The gain at the knots."""
        return self.terms.gain

    def __call__(self, q: Float[Array, " q"]) -> Float[Array, " term"]:
        """Terms at `q` and the priors."""
        return self.terms(q)

    def equations(self, q: Float[Array, " q"]) -> NormalEquations:
        """Normal equations of the recording alone."""
        of, free = self.terms.equations(q), self.free
        matrix = jnp.where(free[:, None] & free[None, :], of.matrix, 0.0)
        return NormalEquations(of.objective, jnp.where(free, of.gradient, 0.0), matrix)


def _equations(_, q: Float[Array, " q"], problem: Load | AtKnots | _Some) -> NormalEquations:
    """Normal equations of a load, with the priors."""
    return _with_priors(problem.equations(q), q, problem.gain)


def _with_priors(found: NormalEquations, q: Float[Array, " q"], of: Gain) -> NormalEquations:
    prior = 1 / of.widths(q)
    rest = prior * (q - of.centre(q))
    return NormalEquations(
        found.objective + 0.5 * jnp.dot(rest, rest),
        found.gradient + prior * rest,
        found.matrix + jnp.diag(prior**2),
    ).finite()


class _Evaluated(NormalEquations):
    """Normal equations with what the standard errors and tests need at the same point.

    The last point of a fit then need not be evaluated again.

    Attributes:
        around: The terms, without constants and ρ.
    """

    around: Around

    @classmethod
    def at(cls, _, q: Float[Array, " q"], load: Load) -> "_Evaluated":
        """Evaluate a load with the priors."""
        found, around = load.evaluated(q)
        of = _with_priors(found, q, load.gain)
        around = eqx.tree_at(lambda a: (a.at.gain, a.score), around, (None, None))
        return cls(of.objective, of.gradient, of.matrix, around)

    @classmethod
    def empty(cls, q: Float[Array, " q"], load: Load) -> "_Evaluated":
        """Zeros of the same shapes."""
        shapes = eqx.filter_eval_shape(lambda q: cls.at(None, q, load), q)
        return jax.tree.map(lambda of: jnp.zeros(of.shape, of.dtype), shapes)


# Largest change of W, which is uncertain by 0.1 at 40 dB. At 24 dB one fit of 30 exceeds it. Two of
# 200 fits were wrong by five standard errors; both exceed it.
FAR = 0.5
NO_HUM = 5.0  # standard deviations of a wrong gain, above which it may pass for hum
NEAR = 4.0  # χ² of the likeliest start; below this value the other starts are not tried
# Half a standard error for 3000 terms.
ROUGHLY = LevenbergMarquardt(rtol=1e-2, ftol=1e-3, equations=_equations)
WELL = LevenbergMarquardt(rtol=1e-4, ftol=SOLVER.ftol, equations=_equations)
SETTLED = 0.005  # [standard errors] largest distance from the minimum, for any number of harmonics
BEFORE = 0.05  # [standard errors] the same before the last step of a fit, that of Newton
LAST = 1.0  # [standard errors] longest last step; a fit that stopped farther away did not settle
# Next to a minimum, damping would only hold back what the data hardly determine.
SLIGHT = 1e-9


def refined(
    load: Load | AtKnots | _Some,
    start: Float[Array, " q"],
    solver: LevenbergMarquardt | None = None,
) -> optx.Solution:
    """The minimum over the own parameters, and over z if `start` contains it; `WELL` if no solver.

    The default is looked up here, so that a test of derivatives can ask for more digits.
    """
    with_solver = solver or WELL
    return optx.least_squares(
        lambda q, load: load(q), with_solver, start, args=load, max_steps=MAX_STEPS, throw=False
    )


def _chosen(load: Load, starts: Float[Array, "start q"]) -> Float[Array, " q"]:
    """The likeliest start, which is the last, or the best of all if χ² of the likeliest is large.

    One loop holds the only copy of the terms: each copy compiles for 0.2 s.
    """
    # The minimum does not depend on its start, and a loop of unknown length has no gradient.
    load, starts = jax.lax.stop_gradient((load, starts))
    limit = NEAR * 2 * jnp.sum(load.spectrum.selected, dtype=starts.dtype)
    likeliest = starts.shape[0] - 1

    def goes_on(state: tuple[Array, Array, Array]) -> Bool[Array, ""]:
        number, _, least = state
        return (number >= 0) & ((number != likeliest - 1) | ~(least < limit))

    def tried(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        number, best, least = state
        squares = jnp.sum(load(starts[number]) ** 2)
        squares = jnp.where(jnp.isfinite(squares), squares, jnp.inf)
        better = squares <= least
        return number - 1, jnp.where(better, number, best), jnp.minimum(squares, least)

    first = jnp.array(likeliest), jnp.array(likeliest), jnp.array(jnp.inf, starts.dtype)
    return starts[jax.lax.while_loop(goes_on, tried, first)[1]]


def _near(load: Load, start: Float[Array, " own"], well: LevenbergMarquardt) -> Float[Array, " q"]:
    """The minimum at the knots of `start`: first over the own parameters, then over all."""
    load, start = jax.lax.stop_gradient((load, start))
    terms, owned = Around.of(load, start).at, start.size
    q = jnp.concatenate([start, load.gain.driver.mean])
    # One loop for both, because each loop compiles for half a second.
    fields = [jnp.array([of.rtol, of.ftol, of.damping]) for of in (ROUGHLY, well)]

    def stage(
        q: Float[Array, " q"], of: tuple[Float[Array, "3"], Bool[Array, " q"]]
    ) -> tuple[Float[Array, " q"], None]:
        (rtol, ftol, damping), free = of
        solver = dataclasses.replace(well, rtol=rtol, ftol=ftol, damping=damping)
        return refined(_Some(terms, free), q, solver).value, None

    free = jnp.stack([jnp.arange(q.size) < owned, jnp.ones(q.size, bool)])
    return jax.lax.scan(stage, q, (jnp.stack(fields), free))[0]


def fit_circuit(
    driver: AbstractGiven,
    circuit: AbstractCircuit,
    spectrum: Spectrum,
    sample_rate: Float[Array, ""],
    candidates: LoadUnknowns,
    element_prior: ElementPrior | None = None,
) -> tuple[Estimate, Bool[Array, ""], Bool[Array, ""]]:
    """Identify the load of one recording.

    Args:
        driver: Distribution of Z_th at the harmonics of the recording, or the measured current.
        circuit: Structure of the load.
        spectrum: The recording.
        sample_rate: Its sampling rate [Hz].
        candidates: Starts, stacked; the likeliest is the last. The start that predicts best is
            refined.
        element_prior: Prior of the elements; None without one.

    Returns:
        The estimate, whose parameters are the logarithms of the elements. Whether W is too far from
        W₀ for its linear distribution. Whether the data show another circuit, another gain of
        V_out, or a resistance that falls with its current.
    """
    load = Load.behind(driver, circuit, spectrum, sample_rate, element_prior)
    if element_prior is not None:
        placed = element_prior.placed(candidates.log_elements)
        candidates = LoadUnknowns(placed, candidates.delay_samples)

    # First at the knots of one point, and with Z_th fixed: from a distant start, a joint fit would
    # distort Z_th.
    start = _chosen(load, candidates.vector())
    well = dataclasses.replace(
        WELL, rtol=min(WELL.rtol, SETTLED / math.sqrt(2 * spectrum.x.size)), damping=SLIGHT
    )
    whole = dataclasses.replace(
        well,
        rtol=BEFORE / SETTLED * well.rtol,
        equations=_Evaluated.at,
        empty=_Evaluated.empty,
    )
    solution = refined(load, _near(load, start, well), whole)
    q, last = solution.value, solution.stats["normal_equations"]
    around = eqx.tree_at(
        lambda a: a.at.gain, last.around, load.at_knots(load.knots), is_leaf=lambda a: a is None
    )
    g, known = around.gain, load.known(q)
    part = residual(known, g)
    jacobian = around.jacobian
    prior = 1 / load.gain.widths(q) ** 2
    noise = excess(part, spectrum.selected)[: g.size]
    # Part of the noise that only this trial has: all, or that of V_out if V_th is shared.
    private = jnp.where(
        jnp.any(known.variance_x != spectrum.variance_x),
        spectrum.variance_y / variance(known, g),
        1.0,
    )
    share = signal_share(around.x, known.variance_x)
    mean_share, mean_noise, own_noise = around.mean(jnp.stack([share, noise, private * noise]))
    linear = Linear(jacobian, mean_share, mean_noise, jnp.diag(prior))
    information, count = linear.bread(), load.gain.owned - 1
    elements = information[:count]
    # Standard errors and tests are those of the last point; they do not change in a short step.
    step = jax.lax.stop_gradient(information @ last.gradient)
    gained = jnp.dot(step, last.gradient)
    step, gained = (jnp.where(gained < LAST**2, of, 0.0) for of in (step, gained))
    own, z = load.gain.split(q - step)
    used = spectrum.selected[load.knots.index]
    moved = jnp.sqrt(jnp.max(jnp.where(used, power(around.at.gain.w(z)), 0.0)))
    by_term = elements @ jacobian
    changes = around.by_changes()
    rows = around.at.rows(changes)
    rest = prior * (q - load.gain.centre(q))
    spread = jax.scipy.linalg.block_diag(jnp.diag(prior[: load.gain.owned]), driver.cov)
    found = other_circuit.scores(rows, linear, around.part, rest, spread, information, slice(count))
    other = other_circuit.Scores.of(found, gain=True)
    weight = jnp.where(known.selected, 2 / variance(known, g), 0.0)
    falling = falling_resistance.score(
        around.by_falling(),
        known.y - g * known.x,
        weight,
        share,
        noise,
        around.x,
        around.at.by_unknown(around.slopes),
        load.knots,
        rest,
        spread,
        information,
        count,
    )
    # If a wrong gain explains the excess of the low harmonics, the excess is no hum.
    others = linear.told(rows[-1:])[0] @ information
    gain = changes[-1] - combined(others, around.at.by_unknown(around.slopes))
    explained = as_complex(found.size[-1]) * around.x * load.knots.between(gain)
    unexplained = (0.5 * weight * power(known.y - g * known.x + explained))[:LOW]
    wrong_gain = (jnp.abs(found.z[-1]) > NO_HUM) & ~stands_out(unexplained, known)
    by_own, by_z = load.gain.split(elements)
    of_delay = jnp.outer(by_own.delay_samples, by_own.delay_samples) / driver.delay_width**2
    beside = jnp.zeros(())  # Σ r² of the priors of elements, which a choice of circuits must weigh
    if element_prior is not None:
        beside = jnp.sum(((own.log_elements - element_prior.centre) / element_prior.width) ** 2)
        weighed = by_own.log_elements * element_prior.precision[None, :]
        of_delay = of_delay + weighed @ by_own.log_elements.T
    of_driver = by_z @ driver.cov @ by_z.T
    shared = of_driver + (by_term * (linear.noise - own_noise)[None, :]) @ by_term.T
    # For an element without any effect the matrix product contains only rounding errors.
    unknown = jnp.diagonal(elements)
    unknown = jnp.diag(jnp.where(unknown > 1, unknown, 0.0))
    change = load.gain.split(q)[1] - driver.mean
    # Increase of the Σ r² of the calibrations.
    strain = jnp.sum((change @ inverse_root(driver.cov)) ** 2)
    squares, terms = jnp.sum(part**2), 2 * jnp.sum(spectrum.selected, dtype=q.dtype)
    freedom, deviance = terms - load.gain.owned, squares + strain + beside - gained
    estimate = Estimate(
        parameters=own.log_elements,
        delay_samples=own.delay_samples[None],
        cov=(by_term * own_noise[None, :]) @ by_term.T + of_delay + shared + unknown,
        shared_cov=shared,
        chi2=squares / freedom,
        rrse=complex_rrse(g * spectrum.x, spectrum.y, spectrum.selected),
        result=solution.result,
        steps=solution.stats["num_steps"],
        strain=strain,
        hum=shows_hum(known, g) & ~wrong_gain,
        falls=falling.causes(squares, terms, other.relevant()),
        support=Support(deviance, terms, other.relevant(), *other.spread.possible()),
    )
    return estimate, moved > FAR, other.seen() | other.has_other_gain() | falling.seen()
