"""The fit of one load, given the calibrations of its driver, and its standard errors and tests.

`etid.estimators.maximum_likelihood.load` has the likelihood, and
`etid.estimators.maximum_likelihood.search` goes to its minimum.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from etid.circuits.circuit import AbstractCircuit
from etid.circuits.directions import ON_LOADS, SEEN
from etid.estimators.element_limits import Limits
from etid.estimators.element_prior import ElementPrior
from etid.estimators.estimate import Estimate
from etid.estimators.judgement import judged, unless
from etid.estimators.maximum_likelihood.condensed import Near, means
from etid.estimators.maximum_likelihood.gains import Gains
from etid.estimators.maximum_likelihood.given_driver import around
from etid.estimators.maximum_likelihood.load import (
    Load,
    by_falling,
    changes,
)
from etid.estimators.maximum_likelihood.profile import Records
from etid.estimators.maximum_likelihood.search import best_start, minimum
from etid.estimators.score_tests import falling_resistance, other_circuit
from etid.estimators.unknowns import LoadUnknowns
from etid.likelihood.calibrations import Calibrations
from etid.likelihood.fit import FAR, NO_HUM, UNSEEN
from etid.likelihood.gains import FAULTS
from etid.likelihood.sandwich import Linear
from etid.results.driver import HarmonicDriver
from etid.results.fit import Fit, Support
from etid.results.instrument import BUDGETED, LATER, Effects, Instrument
from etid.results.verdicts import RESULTS
from etid.signals.harmonics import Spectrum, signal_share
from etid.signals.transfer import as_complex, combined, power
from etid.solvers.matrices import inverse_root, root


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
        self,
        circuit: AbstractCircuit,
        driver_result: RESULTS,
        method: str,
        bounds: Limits = (),
        prior: ElementPrior | None = None,
    ) -> Fit:
        """The fit with its verdict; for the arguments see `judgement.judged`."""
        fit = judged(self.estimate, circuit, driver_result, method, bounds, prior)
        fit = unless(fit, self.inconsistent, RESULTS.inconsistent)
        return unless(unless(fit, self.far, RESULTS.driver_unclear), self.other, RESULTS.misfit)


def fit_circuit(load: Load, candidates: LoadUnknowns) -> Found:
    """Identify the load of one recording from its best start; the likeliest is the last."""
    driver, count, owned = load.gains.driver, load.gains.elements, load.gains.owned
    start = best_start(load, candidates).at[count:].add(driver.aside)
    q, least = minimum(load, jnp.concatenate([start, driver.mean]))
    # Standard errors and tests are those of the last point; they do not change in a short step.
    at, near, every = least.point, least.near, load.knots
    records = load.known(at)
    profile, condensed = near.profile, near.condensed
    share, noise = signal_share(profile.x, records.variance_x), profile.excess(records)
    linear, own_noise = _linear(load, near, noise)
    prior = 1 / load.gains.widths(at) ** 2
    information = linear.bread()
    elements = information[:count]
    logs, late, z = load.gains.split(q)
    used = records.selected[0, every.index]
    moved = jnp.sqrt(jnp.max(jnp.where(used, power(load.gains.at(every).w(z)), 0.0)))
    fitted = _fitted(load, at, information)
    changed = changes(load, near)
    rows = condensed.rows(jnp.concatenate(list(changed.values())))
    found = other_circuit.scores(rows, linear, condensed.part, fitted)
    other = other_circuit.Scores.of(found, load.gains.outputs - 1)
    gain, layer = other.of_one("gain"), other.of_one("layer")
    added = by_falling(load, near)
    falling = falling_resistance.score(added, near, every, share, noise, fitted)
    # If a wrong gain explains the excess of the low harmonics, the excess is no hum.
    direct = jnp.stack([other.of_one(name).others for name in ON_LOADS])
    others = gain.others
    slopes = near.by_unknown(near.slopes)
    made = combined(others, slopes.reshape(at.size, -1)).reshape(slopes.shape[1:])
    explained = (as_complex(-gain.size) * profile.x)[None, :]
    explained = explained * every.between(changed["gain"][0] - made)
    wrong_gain = (jnp.abs(gain.z) > NO_HUM) & ~profile.shows_hum(
        records, profile.whitened(explained)
    )
    of_own = (elements[:, :owned] * prior[None, :owned]) @ elements[:, :owned].T
    of_driver = elements[:, owned:] @ driver.cov @ elements[:, owned:].T
    by_term = elements @ linear.jacobian
    likely, doubt = other.doubt()
    shared = of_driver + (by_term * (linear.noise - own_noise)[None, :]) @ by_term.T + doubt
    # For an element without any effect the matrix product contains only rounding errors.
    unknown = jnp.diagonal(elements)
    unknown = jnp.diag(jnp.where(unknown > 1, unknown, 0.0))
    change = load.gains.split(at)[2] - driver.mean
    # Increase of the Σ r² of the calibrations.
    strain = jnp.sum((change @ inverse_root(driver.cov)) ** 2)
    # Σ r² of the priors of elements, which a choice of circuits must weigh.
    beside = jnp.sum(load.rest(at)[:count] ** 2)
    squares, terms = 2 * profile.objective, load.terms
    effects = None
    if driver.errors is not None:
        effects = _effects(load.gains, information, direct)
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
        doubtful=likely,
        by_tolerance=effects,
        support=Support(
            squares + strain + beside - 2 * least.promised,
            terms,
            other.relevant(),
            *other.of_one("spread").possible(),
            layer.would_show(load.gains.circuit.scaling()[0]),
        ),
    )
    wrong = other.misfit | falling.seen()
    contradicts = other.inconsistent
    width = load.gains.widths(at)[count]  # of the prior of the delay of V_out
    contradicts |= beyond(late[0] / width, information[count, count] / width**2)
    if driver.errors is not None and driver.errors.told is not None:
        by_z = driver.errors.by_z[:, :FAULTS]  # the calibrations show those of their resistors
        variance = jnp.sum(by_z * (information[owned:, owned:] @ by_z), axis=0)
        contradicts |= beyond(driver.errors.values(z)[:FAULTS], variance)
    return Found(estimate, moved > FAR, wrong, contradicts)


def beyond(z: Float[Array, "*error"], variance: Float[Array, "*error"]) -> Bool[Array, ""]:
    """Whether an error of the instrument, in its standard deviations, contradicts its tolerance."""
    left = 1 - variance  # the prior of an error and the data differ by N(0, 1 − its variance)
    return jnp.any(z**2 > SEEN**2 * jnp.where(left > UNSEEN, left, jnp.inf))


def _effects(
    gains: Gains, information: Float[Array, "q q"], direct: Float[Array, "3 q"]
) -> Effects:
    """Changes of the logarithms of the elements by errors of the instrument.

    A change of the prior mean of z by ζ moves them by H⁻¹ ζ. `direct` is what the parameters do of
    gain, crosstalk and capacitance of the record alone.
    """
    errors, elements = gains.driver.errors, information[: gains.elements, gains.owned :]
    assert errors is not None
    moved = (elements @ (errors.by_z + errors.unstated)).T
    moved = moved.at[:FAULTS].add(-errors.direct[:, None] * direct[:, : gains.elements])
    drift = jnp.sqrt(jnp.sum((elements @ errors.drift) ** 2, axis=1))
    of_gain = direct[ON_LOADS.index("gain"), : gains.elements]
    of = {"drift": drift, "later gain": BUDGETED["later gain"] * of_gain}
    stated = (errors.told or Instrument()).budgeted()
    return Effects.of_errors(moved, jnp.stack([of[name] for name in LATER]), stated)


def inverse_information(load: Load, near: Near) -> Float[Array, "q q"]:
    """H⁻¹: how the parameters move with the means of their priors.

    Without noise in the records it is the Cramer-Rao bound of their covariance.
    """
    return _linear(load, near, near.profile.excess(load.known(near.q)))[0].bread()


def other_circuit_at(
    spectrum: Spectrum,
    own: LoadUnknowns,
    sample_rate: Float[Array, ""],
    circuit: AbstractCircuit,
    driver: HarmonicDriver,
) -> Bool[Array, ""]:
    """Whether the harmonics show another circuit than one that was fitted by another criterion.

    Z_th varies within its covariance. The elements need not be at a minimum, because the part of
    the residual that they could still explain is projected out.
    """
    calibrations, deviations = Calibrations.of(driver), root(driver.later_cov())
    common, count = calibrations.start(), deviations.shape[1]
    directions = jnp.pad(deviations, ((0, common.size - count), (0, 0)))
    z, unit = jnp.zeros(count), jnp.eye(count)
    known = around(calibrations, common, directions, spectrum.frequency, False, z, unit)
    load = Load.behind(known, circuit, Records.of(spectrum), sample_rate)
    return scores_at(load, jnp.concatenate([own.vector(), z])).seen()


def scores_at(load: Load, q: Float[Array, " q"]) -> other_circuit.Scores:
    """What a load shows of another circuit or gain; q need not be at a minimum."""
    near = load.near(q)
    linear, _ = _linear(load, near, near.profile.excess(load.known(q)))
    changed, fitted = changes(load, near), _fitted(load, near.q, linear.bread())
    rows = near.condensed.rows(jnp.concatenate(list(changed.values())))
    found = other_circuit.scores(rows, linear, near.condensed.part, fitted)
    return other_circuit.Scores.of(found, load.gains.outputs - 1)


def _fitted(
    load: Load, q: Float[Array, " q"], information: Float[Array, "q q"]
) -> other_circuit.Fitted:
    """The unknowns at q; `information` is the inverse of theirs."""
    precision, owned = 1 / load.gains.widths(q) ** 2, load.gains.owned
    spread = jax.scipy.linalg.block_diag(jnp.diag(precision[:owned]), load.gains.driver.cov)
    pull = precision * (q - load.gains.centre(q))
    return other_circuit.Fitted(pull, spread, information, slice(load.gains.elements))


def _linear(
    load: Load, near: Near, noise: Float[Array, "output harmonic"]
) -> tuple[Linear, Float[Array, " part"]]:
    """The terms at a point, and the part of their noise that only this recording has."""
    profile, records = near.profile, load.known(near.q)
    # All noise, or that of the outputs if V_th is shared.
    private = jnp.where(
        jnp.any(records.variance_x != load.records.variance_x),
        records.variance_y / profile.expected,
        1.0,
    )
    share = jnp.broadcast_to(signal_share(profile.x, records.variance_x), noise.shape)
    values = jnp.stack([share, noise, private * noise])
    mean_share, mean_noise, own_noise = means([profile], load.knots, values)
    priors = jnp.diag(1 / load.gains.widths(near.q))
    return Linear(near.jacobian, mean_share, mean_noise, priors), own_noise
