"""The fit of one load, given the calibrations of its driver, and its standard errors and tests.

`etid.estimators.maximum_likelihood.load` has the likelihood, and
`etid.estimators.maximum_likelihood.search` goes to its minimum.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from etid.circuits.circuit import AbstractCircuit
from etid.estimators.element_limits import Limits
from etid.estimators.estimate import Estimate
from etid.estimators.judgement import judged, unless
from etid.estimators.maximum_likelihood.condensed import means
from etid.estimators.maximum_likelihood.load import Load, by_falling, changes
from etid.estimators.maximum_likelihood.search import best_start, minimum
from etid.estimators.sandwich import Linear
from etid.estimators.score_tests import falling_resistance, other_circuit
from etid.estimators.unknowns import LoadUnknowns
from etid.results.fit import Fit, Support
from etid.results.verdicts import RESULTS
from etid.signals.harmonics import signal_share
from etid.signals.transfer import as_complex, combined, power
from etid.solvers.matrices import inverse_root
from etid.solvers.successive import Minimum

# Largest change of W, which is uncertain by 0.1 at 40 dB. At 24 dB one fit of 30 exceeds it. Two of
# 200 fits were wrong by five standard errors; both exceed it.
FAR = 0.5
BEYOND = 3.9  # standard deviations of an error of the instrument: by chance once in ten thousand
UNSEEN = 1e-3  # of the variance of its prior, below which a recording tells nothing about an error
NO_HUM = 5.0  # standard deviations of a wrong gain, above which it may pass for hum


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
    q, least = minimum(load, jnp.concatenate([best_start(load, candidates), driver.mean]))
    # Standard errors and tests are those of the last point; they do not change in a short step.
    at, near, every = least.point, least.near, load.knots
    records = load.known(at)
    profile, condensed = near.profile, near.condensed
    count, owned = load.gains.elements, load.gains.owned
    share, noise = signal_share(profile.x, records.variance_x), profile.excess(records)
    linear, own_noise = _linear(load, least, share, noise)
    jacobian, part = linear.jacobian, condensed.part
    prior = 1 / load.gains.widths(at) ** 2
    information = linear.bread()
    elements = information[:count]
    logs, late, z = load.gains.split(q)
    used = records.selected[0, every.index]
    moved = jnp.sqrt(jnp.max(jnp.where(used, power(load.gains.at(every).w(z)), 0.0)))
    rest = prior * (at - load.gains.centre(at))
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
    made = combined(others, slopes.reshape(at.size, -1)).reshape(slopes.shape[1:])
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
    change = load.gains.split(at)[2] - driver.mean
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
        result=least.result,
        steps=least.points,
        strain=strain,
        hum=profile.shows_hum(records) & ~wrong_gain,
        falls=falling.causes(squares, terms, other.relevant()),
        support=Support(
            squares + strain + beside - 2 * least.promised,
            terms,
            other.relevant(),
            *other.spread.possible(),
        ),
    )
    wrong = other.seen() | other.has_other_gain() | falling.seen()
    contradicts = of_scales.contradicts()[1:].any()
    if driver.faults is not None:  # the prior of an error and the data differ by N(0, 1 − its var)
        left = 1 - jnp.diagonal(information)[owned:]
        tolerated = jnp.any(driver.faults != 0, axis=1) & (left > UNSEEN)
        beyond = z**2 > BEYOND**2 * jnp.where(tolerated, left, jnp.inf)
        contradicts |= beyond.any()
    return Found(estimate, moved > FAR, wrong, contradicts)


def covariance_of_priors(load: Load, least: Minimum) -> Float[Array, "q q"]:
    """H⁻¹: how the parameters move with the means of their priors."""
    profile, records = least.near.profile, load.known(least.point)
    share = signal_share(profile.x, records.variance_x)
    return _linear(load, least, share, profile.excess(records))[0].bread()


def _linear(
    load: Load, least: Minimum, share: Float[Array, " harmonic"], noise: Float[Array, "..."]
) -> tuple[Linear, Float[Array, " part"]]:
    """The terms at the minimum, and the part of their noise that only this recording has.

    Args:
        load: The recording.
        least: Its minimum.
        share: Share of signal at each harmonic.
        noise: Noise of the innovations relative to the expected one.
    """
    profile, records = least.near.profile, load.known(least.point)
    # All noise, or that of the outputs if V_th is shared.
    private = jnp.where(
        jnp.any(records.variance_x != load.records.variance_x),
        records.variance_y / profile.expected,
        1.0,
    )
    values = jnp.stack([jnp.broadcast_to(share, noise.shape), noise, private * noise])
    mean_share, mean_noise, own_noise = means([profile], load.knots, values)
    prior = jnp.diag(1 / load.gains.widths(least.point) ** 2)
    return Linear(least.near.jacobian, mean_share, mean_noise, prior), own_noise
