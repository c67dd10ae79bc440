"""The fit of loads behind one driver: elements, standard errors, and what the data contradict."""

import dataclasses
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from etid.circuits.directions import DIRECTIONS, ON_LOADS, SEEN
from etid.likelihood import scores
from etid.likelihood.approximate import approximated, departs, without_delta
from etid.likelihood.gains import FAULTS
from etid.likelihood.linear import diagonal, inverse, replaced, taken
from etid.likelihood.load import Load, Near
from etid.likelihood.noise import MISFIT_CHI2, excess, is_smooth, misses, pull_of_ignored, shows_hum
from etid.likelihood.profile import rrse
from etid.likelihood.scores import Linear, Scores
from etid.likelihood.search import Minimum, minimum, select
from etid.likelihood.source import Errors
from etid.precision import array_function, held, namespace
from etid.results.fit import Support
from etid.results.instrument import BUDGETED, LATER, Effects
from etid.signals.harmonics import signal_share
from etid.signals.transfer import AnyArray, as_complex, power

NO_HUM = 5.0  # standard deviations of a wrong gain, above which it may pass for hum
SHARE = 0.5  # of the excess of χ², which a change explains that is not smooth if it is the cause
BIASED = 2.0  # standard errors; a mean error of as many leaves half of the intervals right
UNSURE = 4.0  # standard deviations of χ² that are no excess
# Largest change of W, which is uncertain by 0.1 at 40 dB. At 24 dB one fit of 30 exceeds it. Two of
# 200 fits were wrong by five standard errors; both exceed it.
FAR = 0.5
UNSEEN = 1e-3  # of the variance of its prior, below which a recording tells nothing about an error


class Estimate(NamedTuple):
    """Fits without their verdicts.

    Attributes:
        logs: Logarithms of the elements.
        delays: Trigger delay of each output [samples].
        z: Changes of the source (`etid.likelihood.source`).
        cov: Covariance of `logs`.
        shared_cov: The part of it that comes from the driver.
        chi2: Σ r² per degree of freedom.
        rrse: Root relative squared error of the output that is predicted worst.
        settled: Whether the search has found a minimum.
        points: Number of points of the search.
        strain: Increase of the Σ r² of the calibrations.
        hum: Whether the residual shows mains hum.
        falls: Whether a resistance that falls with its current explains most of the misfit.
        doubtful: Whether another gain of V_out is likely; `cov` contains its effect.
        far: Whether W is too far from W₀ for its linear distribution.
        other: Whether the data show another circuit, another gain of V_out, or a resistance that
            falls with its current.
        inconsistent: Whether a delay, or the scale of an output such as a current, contradicts the
            driver.
        biased: Whether noise of X that the weights leave out has moved an element far.
        support: How well the data support the circuit.
        effects: What errors of the instrument do to the elements.
        approximate: Whether `cov` contains what the circuit leaves, which the noise does not
            explain. `chi2` and `rrse` are those of the circuit alone.
        tested: Scores of each of `scored`, and of a falling resistance.
    """

    logs: Float[AnyArray, "*row element"]
    delays: Float[AnyArray, "*row output"]
    z: Float[AnyArray, "*row z"]
    cov: Float[AnyArray, "*row element element"]
    shared_cov: Float[AnyArray, "*row element element"]
    chi2: Float[AnyArray, "*row"]
    rrse: Float[AnyArray, "*row"]
    settled: Bool[AnyArray, "*row"]
    points: Int[AnyArray, "*row"]
    strain: Float[AnyArray, "*row"]
    hum: Bool[AnyArray, "*row"]
    falls: Bool[AnyArray, "*row"]
    doubtful: Bool[AnyArray, "*row"]
    far: Bool[AnyArray, "*row"]
    other: Bool[AnyArray, "*row"]
    inconsistent: Bool[AnyArray, "*row"]
    biased: Bool[AnyArray, "*row"]
    support: Support
    effects: Effects
    approximate: Bool[AnyArray, "*row"]
    tested: Mapping[str, Scores]


@array_function
def fit(
    load: Load,
    starts: Float[AnyArray, "start *row q"],
    aside: Float[AnyArray, ""] | float = 0.0,
    inexact: bool = True,
) -> Estimate:
    """The fits from their starts; for the other arguments see `etid.likelihood.search.minimum`.

    Where a circuit leaves more than the noise, NumPy fits records anew with what it leaves
    (`etid.likelihood.approximate`), if circuits may be `inexact`. Under JAX elements and delays
    have derivatives, and nothing else.
    """
    least = minimum(load, starts, aside)
    logs, delays, z = load.gains.split(least.q)
    found = _estimate(load, least)._replace(logs=logs, delays=delays, z=z)
    if namespace(least.q) is not np or not inexact:
        return found
    smooth = is_smooth(least.near.condensed.part, load.gains.exact)
    departing = departs(load, least.near) if smooth.any() else smooth
    missed = found.other | found.inconsistent | misses(found.chi2, found.rrse)
    departing = departing | (missed & (found.chi2 > MISFIT_CHI2))
    if (rows := np.flatnonzero(departing)).size:
        of = taken(least, rows), starts[0, rows], taken(found, rows)
        return replaced(found, rows, _approximated(load.of(rows), *of))
    return found


def _approximated(
    load: Load, least: Minimum, start: Float[np.ndarray, "row q"], exact: Estimate
) -> Estimate:
    """The fits with δ, but for those in which something else explains what the circuit leaves."""
    of = approximated(load, least, start)
    alone = _estimate(of.exact, of.least_exact) if (of.rough > 1).any() else exact
    found = _estimate(of.load, of.least)
    named = [
        (DIRECTIONS[name].seen(*alone.tested[name][:3]) & of.explains[name]).any(-1)
        for name in scores.named()
    ]
    over = SHARE * (alone.chi2 - 1) * load.records.terms
    for name in ("compressed current", "compressed voltage"):  # not smooth in frequency
        if name in alone.tested:
            one = alone.tested[name]
            causes = DIRECTIONS[name].seen(*one[:3]) & (one.explained > over[:, None])
            named.append(causes.any(-1))
    if load.gains.outputs.count > 1:  # outputs that contradict each other are not averaged
        named.append(alone.inconsistent)
    falls = exact.falls | alone.falls
    other = np.any(named, 0) | falls | misses(found.chi2, found.rrse) | ~found.settled
    tested = {
        name: each._replace(others=without_delta(of.load, each.others))
        for name, each in found.tested.items()
    }
    deviance = found.support.deviance + found.support.terms * np.log(of.rough)
    found = found._replace(
        tested=tested,
        chi2=exact.chi2,
        rrse=exact.rrse,
        falls=falls,
        other=other,
        approximate=~other,
        support=dataclasses.replace(found.support, deviance=deviance),
    )
    exact = exact._replace(falls=falls)
    if load.gains.outputs.count == 1:  # a contradiction that goes with δ is one of the circuit
        both = exact.inconsistent & found.inconsistent
        exact = exact._replace(inconsistent=both, other=other)
    return select(other, exact, found)


class _Tested(NamedTuple):
    """The terms near a point, and the scores of changes of the gains.

    Attributes:
        share: Share of signal in the power of X.
        noise: Variances of the innovations, relative to those expected.
        private: Means of the part of them that only the recording has, for each term.
        linear: The terms.
        changes: The changes of each of `scored`.
        each: Their scores.
    """

    share: Float[AnyArray, "*row bin"]
    noise: Float[AnyArray, "*row output bin"]
    private: Float[AnyArray, "*row part"]
    linear: Linear
    changes: dict[str, AnyArray]
    each: dict[str, Scores]

    @classmethod
    def of(cls, load: Load, near: Near) -> "_Tested":
        """The tests of a load near a point, which need not be a minimum."""
        q, xp, gains = near.q, namespace(near.q), load.gains
        records, profile, condensed = load.known(q), near.profile, near.condensed
        share = signal_share(profile.x, records.variance_x)
        noise = excess(profile.squares, records.used)
        # All noise is that of a recording alone, or that of its outputs if V_th is shared.
        private = noise if load.unloaded is None else noise * records.variance_y / profile.expected
        values = xp.stack([xp.broadcast_to(share[..., None, :], noise.shape), noise, private], -3)
        means = condensed.means([profile], load.knots, values)
        told = load.told(q)
        linear = Linear.of(
            near.jacobian,
            means[..., :2, :],
            condensed.part,
            told.gradient,
            _block(told.matrix[..., : gains.owned, : gains.owned], gains.source.cov),
            told.matrix,
        )
        changes = scores.changes(load, near)
        rows = {name: condensed.rows(of) for name, of in changes.items()}
        each = scores.of_changes(linear, rows, gains.elements)
        return cls(share, noise, means[..., 2, :], linear, changes, each)


@held
def _estimate(load: Load, least: Minimum) -> Estimate:
    """Standard errors and tests of a minimum."""
    xp, gains = namespace(least.q), load.gains
    source, e, owned = gains.source, gains.elements, gains.owned
    every, at_knots = load.knots, gains.at(load.knots.index)
    # Standard errors and tests are those of the last point; they do not change in a short step.
    near, at = least.near, least.near.q
    records, profile = load.known(at), near.profile
    share, noise, mean_private, linear, changes, each = _Tested.of(load, near)
    mean_noise = linear.noise
    gain, spreads, layer = (each[name].of_changes(0) for name in ("gain", "spread", "layer"))
    added = scores.falling(near, every)
    each["falling"] = scores.rough(linear, added, near, every, share, noise, e)
    fall = each["falling"].of_changes(0)
    if source.loaded is None:
        for name, added in scores.compressed(near, every).items():
            each[name] = scores.rough(linear, added, near, every, share, noise, e)

    squares, terms = 2 * profile.objective, records.terms
    # Hum that a record is too short for is exactly 0.
    states = 0 if profile.states is None else (profile.states != 0).sum(-1)
    seen, relevant = scores.seen(each), scores.relevant(each)
    over = squares - terms + states - UNSURE * xp.sqrt(2 * terms)
    causes = (fall.z >= xp.abs(relevant).max(-1)) & (fall.explained > SHARE * over)

    # If a wrong gain explains the excess of the low harmonics, the excess is no hum.
    made = (gain.others[..., None, None] * near.by_q(near.slopes)).sum(-3)
    of_gain = changes["gain"][..., 0, :, :] - made
    explained = as_complex(-gain.size)[..., None, None] * profile.driving
    explained = profile.whitened(explained * every.between(of_gain))
    without = power(profile.innovations - explained) / profile.expected
    hum = shows_hum(profile.squares, records.frequency, records.used)
    wrong_gain = xp.abs(gain.z) > NO_HUM
    wrong_gain = wrong_gain & ~shows_hum(without, records.frequency, records.used)

    bread = linear.bread
    elements = bread[..., :e, :]
    by_term = elements @ linear.jacobian
    own = (by_term * mean_private[..., None, :]) @ by_term.swapaxes(-1, -2)
    of_own = elements[..., :owned]
    own = own + of_own @ linear.spread[..., :owned, :owned] @ of_own.swapaxes(-1, -2)
    of_driver = elements[..., owned:]
    shared = of_driver @ source.cov @ of_driver.swapaxes(-1, -2)
    if load.unloaded is not None:
        of_unloaded = (mean_noise - mean_private)[..., None, :]
        shared = shared + (by_term * of_unloaded) @ by_term.swapaxes(-1, -2)
    doubtful, of_doubt = scores.doubt(gain, seen["gain"])
    shared = shared + of_doubt
    # For an element without any effect the matrix product contains only rounding errors.
    variance = diagonal(elements[..., :e])
    unknown = xp.where(variance > 1, variance, 0.0)[..., None] * np.eye(e)

    logs, delays, z = gains.split(least.q)
    change = gains.split(at)[2] - source.mean
    strain = ((change @ inverse(source.cov)) * change).sum(-1) if change.shape[-1] else 0 * squares
    w = at_knots.w(gains.split(at)[2])
    moved = xp.where(records.used[..., 0, every.index], power(w), 0.0).max(-1)
    rest, delta = load.rest(at) ** 2, slice(gains.exact, owned)
    beside = rest[..., :e].sum(-1) + rest[..., delta].sum(-1) + rest[..., at.shape[-1] :].sum(-1)
    if gains.discrepancy is not None:  # −2 ln of the likelihood without its coefficients
        by_delta = linear.jacobian[..., delta, :]
        curved = np.eye(by_delta.shape[-2]) + by_delta @ by_delta.swapaxes(-1, -2)
        beside = beside + xp.linalg.slogdet(curved)[1]
    possible = xp.isfinite(spreads.z) & xp.isfinite(spreads.stderr)
    support = Support(
        squares + strain + beside - 2 * least.promised,
        terms,
        relevant,
        xp.where(possible, spreads.stderr, 0.0),
        xp.where(possible[..., None], spreads.slope, 0.0),
        would_show(layer, np.asarray(gains.circuit.scaling()[0])),
    )
    other, contradicts = scores.verdicts(seen)
    width = load.width[e]  # of the prior of the delay of V_out
    contradicts = contradicts | beyond(delays[..., 0] / width, bread[..., e, e] / width**2)
    if source.tolerances is not None and source.errors is not None:
        by_z = source.errors.by_z[:, :FAULTS]  # the calibrations show those of their resistors
        told = (by_z * (bread[..., owned:, owned:] @ by_z)).sum(-2)
        errors = source.errors.at + z @ source.errors.by_z
        contradicts = contradicts | beyond(errors[..., :FAULTS], told).any(-1)
    direct = xp.concatenate([each[name].others for name in ON_LOADS], -2)
    return Estimate(
        logs=logs,
        delays=delays,
        z=z,
        cov=own + shared + unknown,
        shared_cov=shared,
        chi2=squares / (terms - gains.exact - states),
        rrse=rrse(load.records, profile),
        settled=least.settled,
        points=least.points,
        strain=strain,
        hum=hum & ~wrong_gain,
        falls=causes & seen["falling"],
        doubtful=doubtful,
        far=xp.sqrt(moved) > FAR,
        other=other,
        inconsistent=contradicts,
        biased=_is_biased(load, near, bread, variance),
        support=support,
        effects=dataclasses.replace(
            _effects(source.errors, bread, direct, e, owned),
            discrepancy=xp.sqrt((elements[..., delta] ** 2).sum(-1)),
        ),
        approximate=xp.zeros(squares.shape, bool),
        tested=each,
    )


def _is_biased(
    load: Load,
    near: Near,
    bread: Float[AnyArray, "*row q q"],
    variance: Float[AnyArray, "*row element"],
) -> Bool[AnyArray, "*row"]:
    """Whether noise of X that the weights leave out has moved an element by `BIASED` errors."""
    xp, slopes = namespace(near.q), near.slopes
    if load.ignored is None:
        return xp.zeros(near.q.shape[:-1], bool)
    weight = near.profile.weight * load.ignored[..., None, :]
    gradient = pull_of_ignored(load.knots, weight, slopes.gains, slopes.by_q)
    moved = (bread @ gradient[..., None])[..., : load.gains.elements, 0]
    return (xp.abs(moved) > BIASED * xp.sqrt(variance)).any(-1)


def _block(
    own: Float[AnyArray, "*row_or_not own own"], of_source: Float[AnyArray, "z z"]
) -> Float[AnyArray, "*row_or_not q q"]:
    """Block-diagonal matrix of the priors of the own parameters and of the source."""
    xp, rows, count, z = namespace(own), own.shape[:-2], own.shape[-1], of_source.shape[0]
    upper = xp.concatenate([own, xp.zeros((*rows, count, z))], -1)
    beside = xp.broadcast_to(of_source, (*rows, z, z))
    lower = xp.concatenate([xp.zeros((*rows, z, count)), beside], -1)
    return xp.concatenate([upper, lower], -2)


def would_show(layer: Scores, powers: np.ndarray) -> Float[AnyArray, "*row"]:
    """Standard deviations of a layer, if no element would be negative then.

    Z is linear in R and in 1/C, whose logarithms are those of the elements times `powers`. Infinite
    if R or 1/C would be negative; 0 if the circuit can make the change itself.
    """
    xp = namespace(layer.z)
    negative = (layer.slope * powers).min(-1) < -1
    deviations = xp.where(negative, np.inf, 1 / layer.stderr)
    return xp.where(xp.isfinite(layer.z), deviations, 0.0)


def beyond(z: Float[AnyArray, "*error"], variance: Float[AnyArray, "*error"]) -> AnyArray:
    """Whether an error of the instrument, in its standard deviations, contradicts its tolerance."""
    xp, left = namespace(z), 1 - variance  # the prior and the data differ by N(0, 1 − its variance)
    return z**2 > SEEN**2 * xp.where(left > UNSEEN, left, np.inf)


def _effects(
    errors: Errors | None, bread: AnyArray, direct: AnyArray, e: int, owned: int
) -> Effects:
    """Changes of the logarithms of the elements by errors of the instrument.

    A change of the prior mean of z by ζ moves them by H⁻¹ ζ. `direct` is what the parameters do of
    gain, crosstalk and capacitance of the record alone.
    """
    if errors is None:
        return Effects.unknown(e, *bread.shape[:-2])
    xp, elements, direct = namespace(bread), bread[..., :e, owned:], direct[..., :e]
    moved = (elements @ (errors.by_z + errors.unstated)).swapaxes(-1, -2)
    own = moved[..., :FAULTS, :] - errors.direct[:, None] * direct
    drift = xp.sqrt(((elements @ errors.drift) ** 2).sum(-1))
    of = {
        "drift": drift,
        "later gain": BUDGETED["later gain"] * direct[..., ON_LOADS.index("gain"), :],
    }
    moved = xp.concatenate([own, moved[..., FAULTS:, :]], -2)
    return Effects.of_errors(moved, xp.stack([of[name] for name in LATER], -2), errors.stated)
