"""What the states at both ends of a record make of its outputs, if it is not of whole periods.

At the bins of its own discrete Fourier transform, where e^(−sN/fs) = 1, a record of N samples obeys

    D(s) Y = N(s) X + P(s),

and P holds the states at both ends (Pintelon and Schoukens, System Identification, 2012, sections
on arbitrary excitation). A state of the source is a voltage in series with it, which decays with a
pole of Z_th; a state of the load is one in series with the load. So with the decays φ of the source
and ψ of the load,

    V_out = G (X − Φ − Ψ) + Ψ,      I = (X − Φ − Ψ) / (Z_L + Z_th),      Φ = Σ p φ,   Ψ = Σ p ψ,

with real numbers p. The poles are those of Z_th and of Z_L; nobody needs those of the loop. A
denominator of Z_L follows from Z_L at a few frequencies, where it is a ratio of polynomials,

    Z_L (d₀ + d₁ s + … + sⁿ) = n₀ + n₁ s + …,      ψ_l = s^l / (d₀ + d₁ s + … + sⁿ).

For other loads ψ are relaxations with fixed rates, `PER_DECADE` of them.

**Size.** Each φ and ψ is the transform of a decay that begins with 1 V. A state is not larger than
`LARGEST` times the effective value of the record. This weak prior keeps the states finite whose
effects on the record cancel.

**An error of the gain** (`etid.likelihood.discrepancy`) multiplies all of V_out by e^δ, Ψ too. What
δ does to the state of its own channel at the ends of a record is of second order, or at rest there.

**Hum and wander.** Sinusoids at the mains' frequencies and a parabola in time, which one of the
instruments adds to its record, are states whose decays do not depend on the circuit. In the record
of the input they are among φ, in others beside them.

**Ends.** The samples beside the ends have no neighbours on one side, so that aliases of the cut are
in the record. They are smooth in frequency: polynomials of s stand for them. The offset of a record
is its mean, so that bin 0 tells nothing.
"""

import dataclasses
import functools
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Complex, Float

from etid.circuits.circuit import AbstractCircuit
from etid.likelihood.linear import inverse
from etid.likelihood.profile import States
from etid.precision import namespace
from etid.signals.harmonics import real_parts
from etid.signals.low_pass import Filters
from etid.signals.transfer import AnyArray, as_complex, frequency_variable, power, reciprocal

ENDS = 4  # polynomials; with 2 to 12 of them estimates and errors are the same
LARGEST = 10.0
MAINS = 50.0, 150.0, 60.0, 180.0  # [Hz]
SHORTEST = 0.75  # [periods of the lower mains frequency] record in which they are seen
DISTURBANCES = 2 * len(MAINS) + 2  # numbers of hum and wander in a record
PER_DECADE = 2  # relaxations of a load that is no ratio of polynomials


@functools.cache
def orders(kind: type[AbstractCircuit]) -> tuple[int, int] | None:
    """Degrees of numerator and denominator of Z_L; None if it is no ratio of polynomials."""
    if not kind().impedance().is_rational:
        return None
    of = eqx.filter_eval_shape(lambda: kind().impedance().rational())  # computes nothing
    return of.num.shape[0] - 1, of.den.shape[0] - 1


@functools.lru_cache(maxsize=16)
def ends(bins: int) -> Complex[np.ndarray, "end bin"]:
    """What the ends of a record add to an output, at its first bins without bin 0."""
    place = np.arange(1.0, bins + 1) / bins
    return np.stack([(1j * place) ** power for power in range(ENDS)])


def disturbances(
    bins: int, first: Float[AnyArray, ""] | float
) -> Complex[AnyArray, "disturbance bin"]:
    """What hum and wander add to a record, at its first bins without bin 0; the first is [Hz].

    With a size of 1 they are as large as the widest prior of a state allows. In a shorter record
    than `SHORTEST` they look like the decays of its circuit, and are 0.
    """
    xp, k = namespace(first), np.arange(1.0, bins + 1)
    place = xp.asarray(np.array(MAINS) / first)[:, None]
    ahead, back = (
        as_complex(xp.sinc(of - k)) * xp.exp(1j * np.pi * (of - k)) for of in (place, -place)
    )
    waves = xp.stack([ahead + back, 1j * (ahead - back)])
    found = xp.concatenate([waves.reshape(-1, bins), np.stack([1j / k, 1 / k**2])])
    return xp.where(are_seen(first), found / LARGEST, 0.0)


@functools.lru_cache(maxsize=4)
def _kept(bins: int, first: float) -> Complex[np.ndarray, "disturbance bin"]:
    return disturbances(bins, np.asarray(first))


def are_seen(first: Float[AnyArray, ""] | float) -> Bool[AnyArray, ""]:
    """Whether hum and wander are told from decays in records whose first bin is there [Hz]."""
    return namespace(first).asarray(first < MAINS[0] / SHORTEST)


def disturbed(
    of: Complex[AnyArray, "*row some bin"], first: Float[AnyArray, ""] | float
) -> Complex[AnyArray, "*row more bin"]:
    """The states of a record and, after them, those of hum and wander."""
    xp, bins = namespace(of, first), of.shape[-1]
    added = _kept(bins, float(first)) if namespace(first) is np else disturbances(bins, first)
    return xp.concatenate([of, added + xp.zeros((*of.shape[:-2], 1, 1))], -2)


def _channels(of: AnyArray, axis: int = -2) -> list[AnyArray]:
    """Values of V_out and of the current."""
    return [namespace(of).take(of, row, axis) for row in range(2)]


class Relaxations(NamedTuple):
    """The decays ψ of a load.

    Attributes:
        values: ψ, per unit of the effective value of a record.
        by_logs: −∂ ln D/∂ ln e for each element, D the denominator of Z_L; None if ψ are fixed.
    """

    values: Complex[AnyArray, "*row decay bin"]
    by_logs: Complex[AnyArray, "*row element bin"] | None = None


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Transient:
    """What the states of records are made of.

    Attributes:
        decays: φ of the source; none behind a measured current.
        ends: What the ends of the record add to each output.
        width: Prior standard deviation of a state.
        behind: Whether the load is behind a source, whose current its states change.
        passed: What filters make of the states of the load; None without filters.
    """

    decays: Complex[AnyArray, "*row_or_not decay bin"]
    ends: Complex[AnyArray, "*row_or_not end bin"]
    width: Float[AnyArray, "*row output"]
    behind: bool = dataclasses.field(default=True, metadata={"static": True})
    passed: Complex[AnyArray, "*row bin"] | None = None

    def filtered(
        self,
        filters: Filters,
        frequency: Float[AnyArray, "*row bin"],
        of_x: Float[AnyArray, "*row"],
    ) -> "Transient":
        """The same of a current and V_out with known filters, whose states are unknown, too.

        Both records have passed both filters, so that with the decays φ of each filter

            V_out = G (X − H_v Σ p φ_i) + H_v H_i Ψ + H_i Σ p φ_v.

        `of_x` is the `width_of` of the current, which is not that of V_out.
        """
        xp = namespace(self.width)
        of_v_out, of_current = (one[..., None, :] for one in _channels(filters(frequency)))
        by_v_out, by_current = _channels(filters.decays(frequency), axis=-3)
        unit = frequency[..., :1, None] * as_complex(of_x / self.width[..., 0])[..., None, None]
        more = of_current * by_v_out * frequency[..., :1, None]
        rest = self.ends + xp.zeros((*more.shape[:-2], 1, 1))
        return dataclasses.replace(
            self,
            decays=of_v_out * by_current * unit,
            ends=xp.concatenate([rest, more], -2),
            passed=(of_v_out * of_current)[..., 0, :],
        )

    def disturbed(self, first: Float[AnyArray, ""] | float) -> "Transient":
        """The same of records with hum and wander, whose first bin is at this frequency [Hz]."""
        of = {"decays": disturbed(self.decays, first), "ends": disturbed(self.ends, first)}
        return dataclasses.replace(self, **of)

    def of(self, rows: np.ndarray) -> "Transient":
        """Those of some of the rows."""
        width = self.width[rows]
        if self.passed is None:
            return dataclasses.replace(self, width=width)
        of = {"decays": self.decays[rows], "ends": self.ends[rows], "passed": self.passed[rows]}
        return dataclasses.replace(self, width=width, **of)

    def at(self, index: np.ndarray) -> "Transient":
        """The same at some of the bins."""
        passed = None if self.passed is None else self.passed[..., index]
        of = {"decays": self.decays[..., index], "ends": self.ends[..., index]}
        return dataclasses.replace(self, passed=passed, **of)

    def states(
        self,
        gains: Complex[AnyArray, "*row output bin"],
        turn: Complex[AnyArray, "*row bin"],
        relaxations: Complex[AnyArray, "*row decay bin"],
    ) -> States:
        """The states of records with these gains; `turn` is e^(−jωτ) of V_out."""
        xp, outputs = namespace(gains), gains.shape[-2]
        if self.passed is not None:
            relaxations = relaxations * self.passed[..., None, :]
        decays = self.decays + xp.zeros((*relaxations.shape[:-2], 1, 1))
        none = -relaxations if self.behind else 0 * relaxations
        inputs = xp.concatenate([-decays, none], -2)[..., None, :]
        made = inputs * gains[..., None, :, :]
        first = np.eye(outputs)[0][:, None]
        own = first * (relaxations * turn[..., None, :])[..., None, :]
        count = decays.shape[-2]
        made = xp.concatenate([made[..., :count, :, :], made[..., count:, :, :] + own], -3)
        rows, bins = self.ends.shape[:-2], self.ends.shape[-1]
        of_ends = np.eye(outputs)[:, None, :, None] * self.ends[..., None, :, None, :]
        of_ends = of_ends.reshape(*rows, -1, outputs, bins)
        of_ends = of_ends + xp.zeros((*made.shape[:-3], 1, 1, 1))
        first = self.width[..., :1] * np.ones(inputs.shape[-3])
        each = xp.concatenate([first, xp.repeat(self.width, self.ends.shape[-2], -1)], -1)
        width = each + xp.zeros((*made.shape[:-3], 1))
        return States(inputs, xp.concatenate([made, of_ends], -3), width)


def relaxations(
    degrees: tuple[int, int] | None,
    frequency: Float[AnyArray, "*#row knot"],
    z: Complex[AnyArray, "*row knot"],
    every: Float[AnyArray, "*#row bin"],
    slopes: Complex[AnyArray, "*row element knot"] | None = None,
) -> Relaxations:
    """The decays of a load.

    Args:
        degrees: Those of Z_L, from `orders`.
        frequency: Frequencies at which Z_L is known [Hz].
        z: Z_L there [Ω].
        every: Frequencies of the decays [Hz].
        slopes: ∂Z_L/∂ ln e of each element, if their effect is asked for.
    """
    xp = namespace(z, every)
    unit = xp.sqrt(
        frequency[..., :1] * frequency[..., -1:]
    )  # in its powers of s, numbers are near 1
    wide = xp.zeros((*z.shape[:-1], 1))
    s, at = (frequency_variable(of / unit / (2 * np.pi) + wide) for of in (frequency, every))
    if degrees is None:
        last = 2 * np.pi * every.shape[-1]
        rates = np.geomspace(1.0, last, int(PER_DECADE * np.log10(last)) + 1)[:, None]
        scaled = every[..., None, :] / (every[..., :1, None] * rates)
        values = reciprocal(rates + rates * frequency_variable(scaled))
        return Relaxations(values + wide[..., None])
    num, den = degrees
    if den == 0:  # no state
        return Relaxations(xp.zeros((*z.shape[:-1], 0, every.shape[-1]), complex))
    powers = xp.stack([s**k for k in range(max(num, den) + 1)], -2)
    scale = 1 / (xp.abs(z) * (1 + xp.abs(s)) ** den)
    left = powers[..., :den, :] * z[..., None, :]
    rows = xp.concatenate([left, -powers[..., : num + 1, :]], -2) * as_complex(scale)[..., None, :]
    real = real_parts(rows)
    inverted = inverse(real @ real.swapaxes(-1, -2))

    def solved(right: Complex[AnyArray, "*row some knot"]) -> AnyArray:
        """The denominator for several right sides."""
        right = real_parts(right * as_complex(scale)[..., None, :])
        return (right @ real.swapaxes(-1, -2) @ inverted)[..., :den]

    d = as_complex(solved(-(z * powers[..., den, :])[..., None, :]))[..., 0, :]
    of_bins = xp.stack([at**k for k in range(den + 1)], -2)
    whole = of_bins[..., den, :] + (d[..., None] * of_bins[..., :den, :]).sum(-2)
    inverse_of = reciprocal(whole)
    values = of_bins[..., :den, :] * inverse_of[..., None, :]
    scaled = values * as_complex(every[..., :1] / (2 * np.pi * unit))[..., None, :]
    if slopes is None:
        return Relaxations(scaled)
    whole = powers[..., den, :] + (d[..., None] * powers[..., :den, :]).sum(-2)
    moved = as_complex(solved(-slopes * whole[..., None, :]))
    by_logs = -(moved[..., None] * values[..., None, :, :]).sum(-2)
    return Relaxations(scaled, by_logs)


def width_of(
    y: Complex[AnyArray, "*row output bin"], used: Bool[AnyArray, "*row output bin"]
) -> Float[AnyArray, "*row output"]:
    """Prior standard deviation of a state of records of so many bins."""
    xp = namespace(y)
    return LARGEST * xp.sqrt(2 * xp.where(used, power(y), 0.0).sum(-1))


def states_of_calibrations(
    gains: Complex[AnyArray, "*row record bin"],
    decays: Complex[AnyArray, "*row decay bin"],
    of_ends: Complex[AnyArray, "end bin"],
    width: Float[AnyArray, " record"],
) -> States:
    """The states of calibrations behind one source, each with its own; resistors have none."""
    xp, count, bins = namespace(gains), gains.shape[-2], gains.shape[-1]
    rows, alone = gains.shape[:-2], np.eye(count)[:, None, :, None]
    if count == 1:  # of a long record, a product with 1 takes as long as all others
        inputs, of_ends = -decays[..., None, :], of_ends[:, None, :]
    else:
        inputs = (-decays[..., None, :, None, :] * alone).reshape(*rows, -1, count, bins)
        of_ends = (alone * of_ends[:, None, :]).reshape(-1, count, bins)
    inputs = xp.broadcast_to(inputs, (*rows, *inputs.shape[-3:]))
    of_ends = xp.broadcast_to(of_ends, (*rows, *of_ends.shape))
    outputs = xp.concatenate([inputs * gains[..., None, :, :], of_ends], -3)
    each = [xp.repeat(width, of) for of in (decays.shape[-2], of_ends.shape[-3] // count)]
    return States(inputs, outputs, xp.concatenate(each) + xp.zeros((*rows, 1)))
