"""Score tests of a fitted load: what the data show of changes that its parameters cannot make.

Let r be the residual of a fit in standard deviations and d its derivative with respect to the size
ε of a change, with the effect of the parameters projected out. If there is no such change, z = d·r
/ σ(d·r) is normal (Rao's score test). The parameters need not be at a minimum: the part of the
residual that they could still explain is projected out, too (Neyman's C(α)).

The covariance is a "sandwich" (White 1980, Econometrica 48),

    cov = H⁻¹ (J C Jᵀ + P) H⁻¹,      H = J W Jᵀ + P,

with the derivatives J of the terms, the variance C of each term, the share W of signal in each
term, and the curvature P of the priors, which is also the covariance of their gradient.

**A resistance that falls with its current** is no change of the gains: harmonics mix. To first
order in 1/I_0, a resistor R / (1 + |i|/I_0) adds the voltage −|u| u / (R I_0) to its own voltage u.
The rest of the circuit filters it like the voltage of the relaxations, and the feed like a change
of Z_L. So it is a change of the outputs at all harmonics.
"""

import functools
import operator
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float

from etid.circuits.directions import DIRECTIONS, named, scored
from etid.likelihood.linear import inverse
from etid.likelihood.load import Load, Near
from etid.precision import namespace
from etid.signals.knots import Knots
from etid.signals.transfer import AnyArray, as_complex, power, reciprocal

DOUBTED = 2.5  # standard deviations of a gain that goes into ±; one good recording in 80 has them
GAIN = 0.02  # standard deviation of the gain between two channels that nobody compared
HARMONICS = 512  # that a pulse needs, up to 30 kHz; without the rest z is a few per cent smaller
FINE = 2  # points of the grid in time, relative to twice the number of these harmonics
NOTHING = 1e-9  # of the power of a change; rounding leaves less of one that the circuit can make


class Linear(NamedTuple):
    """The terms of a fit near its minimum, linear in the parameters.

    Attributes:
        jacobian: J, transposed.
        share: Diagonal of W.
        noise: Diagonal of C.
        residual: The terms.
        pull: Gradient of the priors.
        spread: Covariance of this gradient, P in the score.
        bread: H⁻¹.
    """

    jacobian: Float[AnyArray, "*row q part"]
    share: Float[AnyArray, "*row part"]
    noise: Float[AnyArray, "*row part"]
    residual: Float[AnyArray, "*row part"]
    pull: Float[AnyArray, "*row q"]
    spread: Float[AnyArray, "*row_or_not q q"]
    bread: Float[AnyArray, "*row q q"]

    @classmethod
    def of(
        cls,
        jacobian: Float[AnyArray, "*row q part"],
        means: Float[AnyArray, "*row 2 part"],
        residual: Float[AnyArray, "*row part"],
        pull: Float[AnyArray, "*row q"],
        spread: Float[AnyArray, "*row_or_not q q"],
        precision: Float[AnyArray, "*row_or_not q q"],
    ) -> "Linear":
        """The terms; `means` are W and C, `precision` is what the priors tell of the parameters."""
        share, noise = means[..., 0, :], means[..., 1, :]
        weighted = jacobian * share[..., None, :]
        expected = weighted @ jacobian.swapaxes(-1, -2) + precision
        return cls(jacobian, share, noise, residual, pull, spread, inverse(expected))


class Scores(NamedTuple):
    """Scores of changes.

    Attributes:
        z: Standard deviations; NaN if the parameters can make the change.
        size: Estimate of ε.
        moved: Largest change of the logarithm of an element by this ε.
        stderr: Standard error of ε.
        slope: Change of the logarithm of each element for each unit of ε.
        others: What the parameters do of the change.
        explained: Part of Σ r² that the change explains.
    """

    z: Float[AnyArray, "*row change"]
    size: Float[AnyArray, "*row change"]
    moved: Float[AnyArray, "*row change"]
    stderr: Float[AnyArray, "*row change"]
    slope: Float[AnyArray, "*row change element"]
    others: Float[AnyArray, "*row change q"]
    explained: Float[AnyArray, "*row change"]

    @classmethod
    def of(
        cls,
        score: Float[AnyArray, "*row change"],
        variance: Float[AnyArray, "*row change"],
        curvature: Float[AnyArray, "*row change"],
        whole: Float[AnyArray, "*row change"],
        others: Float[AnyArray, "*row change q"],
        elements: int,
    ) -> "Scores":
        """Scores from the score of each change, its variance, and its curvature.

        `whole` is the curvature before the parameters are projected out.
        """
        xp = namespace(score)
        size, deviation = score / curvature, xp.sqrt(variance)
        slope = -others[..., :elements]
        moved = xp.abs(size) * xp.abs(slope).max(-1)
        z = xp.where(curvature <= NOTHING * whole, np.nan, score / deviation)
        return cls(z, size, moved, deviation / curvature, slope, others, score**2 / curvature)

    def of_changes(self, which: int | slice) -> "Scores":
        """Those of one or several changes."""
        axis = [2 if name in ("slope", "others") else 1 for name in self._fields]
        keep = [(..., which) if n == 1 else (..., which, slice(None)) for n in axis]
        return Scores(*(of[place] for of, place in zip(self, keep, strict=True)))

    def named(self, counts: Mapping[str, int]) -> dict[str, "Scores"]:
        """Those of changes with these names, each of so many in their order."""
        ends = np.cumsum(list(counts.values())).tolist()
        places = zip(counts, [0, *ends[:-1]], ends, strict=True)
        return {name: self.of_changes(slice(first, last)) for name, first, last in places}


def smooth(linear: Linear, rows: Float[AnyArray, "*row change part"], elements: int) -> Scores:
    """Scores of changes of the gains at the knots: `rows` are those of the terms."""
    by_share = (rows * linear.share[..., None, :]) @ linear.jacobian.swapaxes(-1, -2)
    others = by_share @ linear.bread
    left = rows - others @ linear.jacobian
    score = (left @ linear.residual[..., None])[..., 0]
    score = score - (others * linear.pull[..., None, :]).sum(-1)
    of_priors = ((others @ linear.spread) * others).sum(-1)
    sums = left**2 @ namespace(rows).stack([linear.noise, linear.share], -1)
    whole = (rows**2 @ linear.share[..., None])[..., 0]
    return Scores.of(
        score, sums[..., 0] + of_priors, sums[..., 1] + of_priors, whole, others, elements
    )


def changes(load: Load, near: Near) -> dict[str, Complex[AnyArray, "*row change output knot"]]:
    """Derivatives of the gains with respect to each change that a fit tests for."""
    place = load.gains.at(load.knots.index).departing(near.q, near.slopes)
    return {name: DIRECTIONS[name].change(place) for name in scored()}


def of_changes(
    linear: Linear, rows: Mapping[str, Float[AnyArray, "*row change part"]], elements: int
) -> dict[str, Scores]:
    """Scores of named changes of the gains: `rows` are those of the terms."""
    every = namespace(linear.residual).concatenate(list(rows.values()), -2)
    found = smooth(linear, every, elements)
    return found.named({name: of.shape[-2] for name, of in rows.items()})


def seen(each: Mapping[str, Scores]) -> dict[str, Bool[AnyArray, "*row"]]:
    """Whether the data show each of `DIRECTIONS`."""
    found = {name: DIRECTIONS[name].seen(*of[:3]).any(-1) for name, of in each.items()}
    if "falling" in each:  # no resistance grows with its current
        found["falling"] = found["falling"] & (each["falling"].z[..., 0] > 0)
    return found


def verdicts(
    seen: Mapping[str, Bool[AnyArray, "*row"]],
) -> tuple[Bool[AnyArray, "*row"], Bool[AnyArray, "*row"]]:
    """Whether what is seen makes a fit a misfit, and whether it is inconsistent."""
    misfit, inconsistent = (
        functools.reduce(operator.or_, [on for name, on in seen.items()
                                        if DIRECTIONS[name].verdict == verdict])
        for verdict in ("misfit", "inconsistent")
    )  # fmt: skip
    return misfit, inconsistent


def relevant(each: Mapping[str, Scores]) -> Float[AnyArray, "*row change"]:
    """Z of the changes that have a name; 0 for those that do not matter."""
    found = [DIRECTIONS[name].relevant(*each[name][:3]) for name in named()]
    return namespace(*found).concatenate(found, -1)


def doubt(
    gain: Scores, proven: Bool[AnyArray, "*row"]
) -> tuple[Bool[AnyArray, "*row"], Float[AnyArray, "*row element element"]]:
    """Whether another gain is likely, and the covariance that it then adds.

    One standard deviation of the logarithms of the elements is what they change by its mean, given
    the score and a prior of width `GAIN`. A gain that is proven makes the fit a misfit.
    """
    xp = namespace(gain.z)
    doubtful = (xp.abs(gain.z) > DOUBTED) & ~proven
    mean = gain.size / (1 + (gain.stderr / GAIN) ** 2)
    shift = xp.where(doubtful[..., None], mean[..., None] * gain.slope, 0.0)
    return doubtful, shift[..., :, None] * shift[..., None, :]


def rough(
    linear: Linear,
    added: Complex[AnyArray, "*row output bin"],
    near: Near,
    knots: Knots,
    share: Float[AnyArray, "*row bin"],
    noise: Float[AnyArray, "*row output bin"],
    elements: int,
) -> Scores:
    """Score of one change of the outputs at all harmonics, which is not smooth in frequency.

    `share` is that of the signal in the power of X, `noise` the variances of the innovations
    relative to those expected.
    """
    xp, profile = namespace(added), near.profile
    weighted = profile.weighted(profile.whitened(added))
    parts = xp.conj(weighted) * (profile.driving * as_complex(share)[..., None, :])
    sums = knots.summed(xp.stack([parts.real, parts.imag], -3))
    by_q = near.by_q(near.slopes)
    told = by_q.real * sums[..., :1, :, :] - by_q.imag * sums[..., 1:, :, :]
    others = (told.sum((-2, -1))[..., None, :] @ linear.bread)[..., 0, :]
    made = (others[..., None, None] * by_q).sum(-3)
    direction = added - profile.driving * knots.between(made)
    total = (xp.conj(direction) * profile.pull).real.sum((-2, -1))
    total = total + (others * linear.pull).sum(-1)
    of_priors = ((others[..., None, :] @ linear.spread)[..., 0, :] * others).sum(-1)
    squares = profile.weight * power(profile.whitened(direction))
    variance = (squares * noise).sum((-2, -1)) + of_priors
    curvature = (squares * share[..., None, :]).sum((-2, -1)) + of_priors
    score, variance, curvature = (one[..., None] for one in (total, variance, curvature))
    none = xp.zeros_like(curvature)
    return Scores.of(score, variance, curvature, none, others[..., None, :], elements)


def falling(near: Near, knots: Knots) -> Complex[AnyArray, "*row output bin"]:
    """What a resistance that falls with its current adds to the outputs, for 1/(R I_0) = 1/V.

    The current is that of the pulse, whose shape the first harmonics give.
    """
    xp, slopes = namespace(near.q), near.slopes
    relaxing = slopes.z - slopes.z[..., -1:].real  # without the series resistor
    v_out = knots.between(slopes.gains[..., 0, :]) * near.profile.x
    if near.profile.made is not None:
        v_out = v_out + near.profile.made[..., 0, :]
    count = min(HARMONICS, v_out.shape[-1])
    u = (v_out * knots.between(relaxing * reciprocal(slopes.z)))[..., :count]
    # There is no direct voltage behind a transformer, or with charge-balanced pulses.
    whole = xp.concatenate([xp.zeros_like(u[..., :1]), u], -1)
    points = xp.fft.irfft(whole, 2 * FINE * count, norm="forward")
    added = xp.fft.rfft(-xp.abs(points) * points, norm="forward")[..., 1 : count + 1]
    rest = xp.zeros((*added.shape[:-1], v_out.shape[-1] - count), added.dtype)
    added = xp.concatenate([added, rest], -1)
    sensitivity = slopes.by_z * (slopes.z * reciprocal(slopes.gains[..., 0, :]))[..., None, :]
    return added[..., None, :] * knots.between(sensitivity * relaxing[..., None, :])


def compressed(near: Near, knots: Knots) -> dict[str, Complex[AnyArray, "*row output bin"]]:
    """What amplifiers that compress their peaks add to the voltage behind a measured current.

    An amplifier shows v (1 − |v|/U) of a signal v, to first order for 1/U. If it is that of the
    current, the voltage has Z_L |i| i / U more than it should; if it is its own, |v| v / U less.
    """
    xp, profile = namespace(near.q), near.profile
    gains = knots.between(near.slopes.gains[..., 0, :])
    v_out = gains * profile.x
    if profile.made is not None:
        v_out = v_out + profile.made[..., 0, :]
    of_current, of_voltage = (_bent(of, xp.abs(of).max(-1)) for of in (profile.x, v_out))
    each = {"compressed current": gains * of_current, "compressed voltage": -of_voltage}
    return {name: added[..., None, :] for name, added in each.items()}


def _bent(
    v: Complex[AnyArray, "*row bin"], unit: Float[AnyArray, "*row"]
) -> Complex[AnyArray, "*row bin"]:
    """|v| v of a signal, by this unit; of pulses, it differs from v at their edges."""
    xp, count = namespace(v), v.shape[-1]
    whole = xp.concatenate([xp.zeros_like(v[..., :1]), v], -1) / as_complex(unit)[..., None]
    points = xp.fft.irfft(whole, 2 * FINE * count, norm="forward")
    bent = xp.fft.rfft(xp.abs(points) * points, norm="forward")[..., 1 : count + 1]
    return bent * as_complex(unit)[..., None]
