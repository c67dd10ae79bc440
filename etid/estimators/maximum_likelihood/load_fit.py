"""The fit of one load, given the calibrations of its driver, and its standard errors and tests.

`etid.estimators.maximum_likelihood.load` has the likelihood. A fit goes to the minimum at the knots
first, and from there with the objective and gradient of all harmonics.
"""

import dataclasses
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float

from etid.circuits.circuit import AbstractCircuit
from etid.estimators.element_limits import Limits
from etid.estimators.estimate import MAX_STEPS, SOLVER, Estimate
from etid.estimators.judgement import judged, unless
from etid.estimators.maximum_likelihood.condensed import means
from etid.estimators.maximum_likelihood.load import AtKnots, Load, Near, by_falling, changes
from etid.estimators.sandwich import Linear
from etid.estimators.score_tests import falling_resistance, other_circuit
from etid.estimators.unknowns import LoadUnknowns
from etid.results.fit import Fit, Support
from etid.results.verdicts import RESULTS
from etid.signals.harmonics import signal_share
from etid.signals.transfer import as_complex, combined, power
from etid.solvers.least_squares import least_squares
from etid.solvers.levenberg_marquardt import LevenbergMarquardt, NormalEquations
from etid.solvers.matrices import inverse_root


def _equations(_, q: Float[Array, " q"], problem: Load | AtKnots) -> NormalEquations:
    """Normal equations of a load, with the priors."""
    return _with_priors(problem.equations(q), q, problem)


def _with_priors(
    found: NormalEquations, q: Float[Array, " q"], of: Load | AtKnots
) -> NormalEquations:
    prior = 1 / of.gains.widths(q)
    rest = prior * (q - of.gains.centre(q))
    return NormalEquations(
        found.objective + 0.5 * jnp.dot(rest, rest),
        found.gradient + prior * rest,
        found.matrix + jnp.diag(prior**2),
    ).finite()


class _Evaluated(NormalEquations):
    """Normal equations with the load near the same point, for standard errors and tests.

    The last point of a fit then need not be evaluated again.
    """

    near: Near

    @classmethod
    def at(cls, _, q: Float[Array, " q"], load: Load) -> "_Evaluated":
        """Evaluate a load with the priors."""
        found, near = load.evaluated(q)
        of = _with_priors(found, q, load)
        return cls(of.objective, of.gradient, of.matrix, near)


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
    load: Load | AtKnots,
    start: Float[Array, " q"],
    solver: LevenbergMarquardt | None = None,
) -> optx.Solution:
    """The minimum over the own parameters, and over z if `start` contains it; `WELL` if no solver.

    The default is looked up here, so that a test of derivatives can ask for more digits.
    """
    with_solver = solver or WELL
    return least_squares(lambda q, load: load(q), with_solver, start, load, MAX_STEPS)


def _chosen(load: Load, starts: Float[Array, "start q"]) -> Float[Array, " q"]:
    """The likeliest start, which is the last, or the best of all if χ² of the likeliest is large.

    One loop holds the only copy of the terms: each copy compiles for 0.2 s.
    """
    # The minimum does not depend on its start, and a loop of unknown length has no gradient.
    load, starts = jax.lax.stop_gradient((load, starts))
    limit = NEAR * load.terms
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
    q, gains = jnp.concatenate([start, load.gains.driver.mean]), load.gains.at(load.knots)
    near = load.near(q)
    # One loop for both, because each loop compiles for half a second.
    fields = [jnp.array([of.rtol, of.ftol, of.damping]) for of in (ROUGHLY, well)]

    def stage(
        q: Float[Array, " q"], of: tuple[Float[Array, "3"], Bool[Array, " q"]]
    ) -> tuple[Float[Array, " q"], None]:
        (rtol, ftol, damping), free = of
        solver = dataclasses.replace(well, rtol=rtol, ftol=ftol, damping=damping)
        return refined(AtKnots(gains, near, free), q, solver).value, None

    free = jnp.stack([jnp.arange(q.size) < start.size, jnp.ones(q.size, bool)])
    return jax.lax.scan(stage, q, (jnp.stack(fields), free))[0]


class Found(NamedTuple):
    """An estimate of a load, and what its data contradict.

    Attributes:
        estimate: The estimate; its parameters are the logarithms of the elements.
        far: Whether W is too far from W₀ for its linear distribution.
        other: Whether the data show another circuit, another gain of V_out, or a resistance that
            falls with its current.
        inconsistent: Whether the scale of an output, such as a current, contradicts the driver.
    """

    estimate: Estimate
    far: Bool[Array, ""]
    other: Bool[Array, ""]
    inconsistent: Bool[Array, ""]

    def judged(
        self, circuit: AbstractCircuit, driver_result: RESULTS, method: str, bounds: Limits = ()
    ) -> Fit:
        """The fit with its verdict; for the arguments see `judgement.judged`."""
        fit = judged(self.estimate, circuit, driver_result, method, bounds)
        fit = unless(fit, self.inconsistent, RESULTS.inconsistent)
        return unless(unless(fit, self.far, RESULTS.driver_unclear), self.other, RESULTS.misfit)


def fit_circuit(load: Load, candidates: LoadUnknowns) -> Found:
    """Identify the load of one recording.

    Args:
        load: The recording.
        candidates: Starts, stacked; the likeliest is the last. The start that predicts best is
            refined.
    """
    driver, element_prior = load.gains.driver, load.gains.prior
    if element_prior is not None:
        placed = element_prior.placed(candidates.log_elements)
        candidates = LoadUnknowns(placed, candidates.delay_samples)
    starts = jnp.pad(candidates.vector(), ((0, 0), (0, load.gains.outputs - 1)))

    # First at the knots of one point, and with Z_th fixed: from a distant start, a joint fit would
    # distort Z_th.
    start = _chosen(load, starts)
    if load.gains.outputs > 1:  # their starts have no delay
        start = refined(load, start, ROUGHLY).value
    rtol = min(WELL.rtol, SETTLED / math.sqrt(2 * load.records.y.size))
    well = dataclasses.replace(WELL, rtol=rtol, damping=SLIGHT)
    whole = dataclasses.replace(
        well,
        rtol=BEFORE / SETTLED * well.rtol,
        equations=_Evaluated.at,
    )
    solution = refined(load, _near(load, start, well), whole)
    q, last = solution.value, solution.stats["normal_equations"]
    near, records, every = last.near, load.known(q), load.knots
    profile, condensed = near.profile, near.condensed
    count, owned = load.gains.elements, load.gains.owned

    jacobian, part = near.jacobian, condensed.part
    prior = 1 / load.gains.widths(q) ** 2
    noise = profile.excess(records)
    # Part of the noise that only this trial has: all, or that of the outputs if V_th is shared.
    private = jnp.where(
        jnp.any(records.variance_x != load.records.variance_x),
        records.variance_y / profile.expected,
        1.0,
    )
    share = signal_share(profile.x, records.variance_x)
    values = jnp.stack([jnp.broadcast_to(share, noise.shape), noise, private * noise])
    mean_share, mean_noise, own_noise = means([profile], every, values)
    linear = Linear(jacobian, mean_share, mean_noise, jnp.diag(prior))
    information = linear.bread()
    elements = information[:count]
    # Standard errors and tests are those of the last point; they do not change in a short step.
    step = jax.lax.stop_gradient(information @ last.gradient)
    gained = jnp.dot(step, last.gradient)
    step, gained = (jnp.where(gained < LAST**2, of, 0.0) for of in (step, gained))
    logs, late, z = load.gains.split(q - step)
    used = records.selected[0, every.index]
    moved = jnp.sqrt(jnp.max(jnp.where(used, power(load.gains.at(every).w(z)), 0.0)))
    rest = prior * (q - load.gains.centre(q))
    spread = jax.scipy.linalg.block_diag(jnp.diag(prior[:owned]), driver.cov)
    tested = changes(load, near)
    rows = condensed.rows(tested)
    found = other_circuit.scores(rows, linear, part, rest, spread, information, slice(count))
    of_circuit, of_scales = (
        jax.tree.map(lambda leaf, which=which: leaf[which], found)
        for which in (slice(1 - load.gains.outputs or None), slice(-load.gains.outputs, None))
    )
    other = other_circuit.Scores.of(of_circuit, gain=True)
    falling = falling_resistance.score(
        by_falling(load, near),
        profile,
        share,
        noise,
        near.by_unknown(near.slopes),
        every,
        rest,
        spread,
        information,
        count,
    )
    # If a wrong gain explains the excess of the low harmonics, the excess is no hum.
    of_gain = -load.gains.outputs
    others = linear.told(rows[of_gain][None])[0] @ information
    slopes = near.by_unknown(near.slopes)
    made = combined(others, slopes.reshape(q.size, -1)).reshape(slopes.shape[1:])
    explained = (as_complex(-found.size[of_gain]) * profile.x)[None, :] * every.between(
        tested[of_gain] - made
    )
    wrong_gain = (jnp.abs(found.z[of_gain]) > NO_HUM) & ~profile.shows_hum(
        records, profile.whitened(explained)
    )
    of_own = (elements[:, :owned] * prior[None, :owned]) @ elements[:, :owned].T
    of_driver = elements[:, owned:] @ driver.cov @ elements[:, owned:].T
    by_term = elements @ jacobian
    shared = of_driver + (by_term * (linear.noise - own_noise)[None, :]) @ by_term.T
    # For an element without any effect the matrix product contains only rounding errors.
    unknown = jnp.diagonal(elements)
    unknown = jnp.diag(jnp.where(unknown > 1, unknown, 0.0))
    change = load.gains.split(q)[2] - driver.mean
    # Increase of the Σ r² of the calibrations.
    strain = jnp.sum((change @ inverse_root(driver.cov)) ** 2)
    # Σ r² of the priors of elements, which a choice of circuits must weigh.
    beside = jnp.zeros(())
    if element_prior is not None:
        beside = jnp.sum(((logs - element_prior.centre) / element_prior.width) ** 2)
    squares, terms = 2 * profile.objective, load.terms
    estimate = Estimate(
        parameters=logs,
        delay_samples=late,
        cov=(by_term * own_noise[None, :]) @ by_term.T + of_own + shared + unknown,
        shared_cov=shared,
        chi2=squares / (terms - owned),
        rrse=profile.rrse(records, load.records.x),
        result=solution.result,
        steps=solution.stats["num_steps"],
        strain=strain,
        hum=profile.shows_hum(records) & ~wrong_gain,
        falls=falling.causes(squares, terms, other.relevant()),
        support=Support(
            squares + strain + beside - gained, terms, other.relevant(), *other.spread.possible()
        ),
    )
    wrong = other.seen() | other.has_other_gain() | falling.seen()
    return Found(estimate, moved > FAR, wrong, of_scales.contradicts()[1:].any())
