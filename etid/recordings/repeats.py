"""Differences between the pulse periods of one record, in bands of frequency.

Estimators fit the average over the periods. The average hides all differences between the periods.
This module cuts a record into its P periods and transforms each period. The deviation of a period p
from the mean Y is a change of the logarithm of the gain in about fifty bands of frequency,

    η = Σ conj(Y) (Y_p − Y) / Σ |Y|².

The module also computes the variance of η that noise causes. It needs no model of driver or load.

The length of a period is usually not a whole number of samples. A cut is at the nearest sample; a
rotation of the phase corrects the remaining fraction. Smooth parts of a deviation do not come from
pulses but from a drift of the mean or from mains hum of 50 Hz. They are projected out as a
polynomial over the period.

A driver with a source impedance turns a change of the load into one of a measured current X too.
Both are recorded at once, so the module then compares X̄ Y_p − Ȳ X_p, which no change of the driver
moves. Its projection on X̄ Ȳ, weighted by the noise, is the change of the logarithm of Y / X.

**Aliases** rotate by e^(−j2πδ) if a cut is late by a fraction δ of a sample; the rest does not.
`turn` is the direction t of this rotation. A deviation in this direction proves nothing: only
(1 − t tᴴ) η counts. Without a filter, those of fs + f show, too, which rotate by e^(j2πδ). Where
the power A² of the aliases is known (`etid.signals.averaging`), those of twice the sample rate have
directions besides, and η is weighted as if they were noise: by (1 + Σ ρ t tᴴ)⁻¹, ρ = n A²/σ² in a
band of n harmonics.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from etid.recordings.inspection import Inspection
from etid.recordings.preflight import Inspected
from etid.recordings.recording import quietly
from etid.signals.deviations import (
    PLAIN,
    SURE,
    TINY,
    Bands,
    Deviations,
    bands,
    deviations_of,
    rotations,
    smoothed,
)
from etid.signals.harmonics import aliases
from etid.signals.periods import Periods, turns
from etid.signals.transfer import power as power_of

ALIASES = 0.03  # of the sample rate; above, a change is not told from aliases


class Repeats(NamedTuple):
    """Deviations of the periods of a recording from their mean.

    A batch of recordings has one more axis, the first axis.

    Attributes:
        frequency: Centre of each band [Hz].
        sample_rate: Samples per second [Hz].
        gain: Deviation η of the logarithm of V_out.
        power: Σ |Y|².
        smooth: Σ conj(Y) times each polynomial.
        variance: Variance of the real part of a weighted sum of `gain` over the periods, if the
            squares of the weights have the sum 1. The imaginary part has the same variance.
        turn: Directions of the aliases, T, orthogonal to each other; the length of each is 1, or 0
            if all cuts have the same delay.
        removed: The part M of these directions that does not count: (1 − Tᴴ M T) η does.
        unloaded: Deviation of the amplitude of V_th.
        unloaded_variance: Variance of `unloaded`, defined as `variance`.
    """

    frequency: Float[np.ndarray, "*lane band"]
    sample_rate: Float[np.ndarray, "*lane"]
    gain: Complex[np.ndarray, "*lane period band"]
    power: Float[np.ndarray, "*lane band"]
    smooth: Complex[np.ndarray, "*lane polynomial band"]
    variance: Float[np.ndarray, "*lane band"]
    turn: Complex[np.ndarray, "*lane direction period"]
    removed: Complex[np.ndarray, "*lane band direction direction"]
    unloaded: Float[np.ndarray, "*lane period"]
    unloaded_variance: Float[np.ndarray, "*lane"]


@quietly()
def repeats(inspected: Sequence[Inspected]) -> list[Repeats | None]:
    """Deviations of the periods of each recording.

    The result is None for a recording with fewer than two periods or with a coarse converter: the
    rounding errors of a coarse converter differ between the periods and are not noise.

    Recordings that were inspected together are processed together. The computation uses single
    precision: the noise of a record is a hundred times its rounding errors.

    Skin that changes during the record looks like hum between the harmonics. If the periods still
    differ after the subtraction of hum, hum was not the reason. Then the periods are compared as
    they were recorded.
    """
    deviations: list[Repeats | None] = [None] * len(inspected)
    alike: dict[int, list[int]] = {}
    for number, one in enumerate(inspected):
        if one.periods[0] > 1 and one.is_periodic and not one.coarse.any():
            alike.setdefault(id(one.inspection), []).append(number)
    for numbers in alike.values():
        inspection = inspected[numbers[0]].inspection
        rows = np.array([inspected[number].row for number in numbers])
        late = np.array([inspected[number].lag for number in numbers])
        found = _of_rows(inspection, rows, late, inspection.quiet)
        for place, number in enumerate(numbers):
            one = Repeats(*(field[place] for field in found))
            if inspected[number].hums and _differ(one):
                again = _of_rows(inspection, rows[[place]], late[[place]], inspection.recorded)
                one = Repeats(*(field[0] for field in again))
            deviations[number] = one
    return deviations


def _differ(of: Repeats) -> bool:
    """Whether the periods differ by more than noise explains, in bands without aliases."""
    plain = of.frequency < PLAIN * of.sample_rate
    square = (power_of(of.gain) / of.variance)[:, plain].sum()
    freedom = 2 * (len(of.gain) - 1) * np.count_nonzero(plain)
    return bool(square > freedom + SURE * math.sqrt(2 * freedom))


class _Rows(NamedTuple):
    """Some of the recordings of an inspection, with the same bands.

    Attributes:
        inspection: The inspection.
        rows: The recordings.
        at: Start of each of their periods [samples].
        aliased: Whether their aliases are known.
        layout: The bands.
    """

    inspection: Inspection
    rows: Int[np.ndarray, " lane"]
    at: Float[np.ndarray, "lane period"]
    aliased: Bool[np.ndarray, " lane"]
    layout: Bands

    def in_bands(
        self, values: Float[np.ndarray, "recording harmonic"]
    ) -> Float[np.ndarray, "lane band"]:
        """Values at the harmonics of each recording, at the centre of each band."""
        frequency, rate = self.inspection.spectrum[0], self.inspection.sample_rate
        angle = frequency[: values.shape[1]] * (2 * np.pi / rate)
        place = np.interp(self.layout.middle, angle, np.arange(angle.size))
        below = np.minimum(place.astype(int), angle.size - 2)
        low, high = (values[self.rows[:, None], at] for at in (below, below + 1))
        return low + (place - below) * (high - low)

    def noise(self, record: int) -> Float[np.ndarray, "lane band"]:
        """Variance of the real part of a harmonic of one period, of one of the records."""
        variance = self.in_bands(self.inspection.variance[:, record])
        return variance * (self.inspection.periods[1] * self.layout.length / 2)

    def aliases(self) -> Bool[np.ndarray, "lane band"]:
        """Bands whose aliases may exceed the noise.

        Those above `ALIASES`, and those where what continues V_out beyond is too large. Aliases of
        the n harmonics of a band add up, noise does not.
        """
        high = np.repeat(self.layout.middle[None] > 2 * np.pi * ALIASES, self.rows.size, axis=0)
        if self.inspection.has_current:
            return high
        variance = self.inspection.variance[:, 1]
        y = self.inspection.spectrum[2][:, : variance.shape[1]]
        ratio = np.asarray(aliases(y, variance, *self.inspection.periods).power / variance)
        return high | (self.in_bands(ratio) * self.layout.number > 0.1)

    def deviations(
        self,
        records: Float[np.ndarray, "recording 2 time"],
        which: int,
        late: Int[np.ndarray, " lane"],
    ) -> Deviations:
        """Deviations of the periods of one of the records, which may be late [samples]."""
        inspection, count = self.inspection, self.layout.polynomials.shape[1]
        if records is inspection.quiet:
            found = inspection.cut(which).take(self.rows)
        else:
            found = self._cut(records[self.rows, which], self.at)
        raw = found.each[..., 1 : count + 1].astype(np.complex64)
        after = found.starts - self.at
        for lane in np.flatnonzero(late):
            # Else a late record would be cut within its pulses. The samples cut off at one end are
            # added at the other.
            v = np.roll(records[self.rows[lane], which, : inspection.periods[1]], -late[lane])
            own = self._cut(v[None], self.at[[lane]])
            raw[lane], after[lane] = own.each[0, :, 1 : count + 1], own.starts[0] - self.at[lane]
        return deviations_of(raw, after, self.layout, self.noise(which), self.aliased)

    def _cut(
        self, v: Float[np.ndarray, "lane time"], at: Float[np.ndarray, "lane period"]
    ) -> Periods:
        return Periods.of(v, at, self.inspection.sample_rate / self.inspection.pulse_rate)


def _of_rows(
    inspection: Inspection,
    rows: Int[np.ndarray, " lane"],
    late: Int[np.ndarray, " lane"],
    records: Float[np.ndarray, "recording 2 time"],
) -> Repeats:
    """Deviations of some recordings of an inspection, from these voltages; `v_out` may be late."""
    rates = inspection.sample_rate, inspection.pulse_rate
    of = _Rows(
        inspection,
        rows,
        inspection.begins[rows],
        inspection.differing.rows[rows],
        bands(*rates, 0.4),
    )
    own = of.deviations(records, 1, late)
    if inspection.has_current:
        return _of_currents(of, own, of.deviations(records, 0, 0 * late))
    # Of V_th only the amplitude is wanted. If some of the samples were left out, the aliases of its
    # edges would look like another amplitude in each period: by 1e-3 if every fourth remains.
    low = of._replace(layout=bands(*rates, 1 / 32))
    unloaded = low.deviations(records, 0, 0 * late)
    weight, smooth = 1 / unloaded.variance, smoothed(unloaded.mean, low.layout)
    # Effect of an amplitude change by 1 after the projection of the polynomials.
    unit = 1 - (np.real(smooth.sum(2))[:, :, None] * smooth).sum(1) / unloaded.power
    total = (weight * power_of(unit)).sum(1)
    along = np.real(unloaded.gain * (weight * np.conj(unit))[:, None, :]).sum(2)
    amplitude = along / total[:, None]
    # Coloured noise does not look like an amplitude change: the rest measures its size.
    rest = unloaded.gain - amplitude[:, :, None] * unit[:, None, :]
    periods = inspection.periods[0]
    freedom = (2 * low.layout.middle.size - 1) * (periods - 1)
    noise = np.maximum(1.0, (weight[:, None, :] * power_of(rest)).sum((1, 2)) / freedom)
    width = _phases(records[rows, 0], inspection.limits[rows, 0]) / periods
    # Because cuts fall between samples, the amplitude differs by 1e-4 for 133 samples of a pulse,
    # by 0.03 for 8 samples.
    variance = noise / total + (2 / np.square(width)) ** 2
    return _joined(of, own, smoothed(own.mean, of.layout), amplitude, variance)


def _directions(
    of: _Rows, own: Deviations
) -> tuple[
    Complex[np.ndarray, "lane direction period"],
    Complex[np.ndarray, "lane band direction direction"],
]:
    """`Repeats.turn` and `Repeats.removed`."""
    turns, basis = rotations(own.late)
    count, layout, known = basis.shape[2], of.layout, of.aliased
    places = of.aliases()
    basis[~known, :, 2:] = 0
    basis[~(known | _shows(own, basis[..., 1], places)), :, 1:] = 0
    removed = np.zeros((len(basis), layout.middle.size, count, count), complex)
    for direction in range(2):
        on = np.any(basis[..., direction], axis=1, keepdims=True)
        removed[..., direction, direction] = places & on
    if known.any():
        place = layout.middle / (2 * np.pi)
        y = of.inspection.differing.of_out.take(of.rows[known]).at(place)[:, :2]
        noise = of.in_bands(of.inspection.variance[:, 1])[known]
        ratio = np.repeat(y * layout.number / (own.late.shape[1] * noise)[:, None], 2, axis=1)
        inside = basis[known].conj().swapaxes(1, 2) @ turns[known]
        of_aliases = np.einsum("rak,rkb,rck->rbac", inside, ratio, inside.conj())
        removed[known] = np.eye(count) - np.linalg.inv(np.eye(count) + of_aliases)
    return basis.swapaxes(1, 2), removed


def _shows(
    own: Deviations,
    direction: Complex[np.ndarray, "lane period"],
    places: Bool[np.ndarray, "lane band"],
) -> Bool[np.ndarray, " lane"]:
    """Whether deviations in a direction exceed the noise, in bands that may have aliases.

    Aliases of fs + f do so without a filter. Of four periods or fewer, their direction and that of
    fs − f leave too little.
    """
    along = (direction.conj()[:, None] @ own.gain)[:, 0]
    squares = np.where(places, power_of(along) / (2 * own.variance), 0.0).sum(1)
    count = np.count_nonzero(places, axis=1)
    return (squares > count + SURE * np.sqrt(count)) & (own.gain.shape[1] > 4)


def _of_currents(of: _Rows, own: Deviations, other: Deviations) -> Repeats:
    """Deviations of the quotients of voltage and current."""
    pairs, layout = [], of.layout
    angle = own.late * (2 * np.pi / layout.size)
    clock = turns(angle, 1, own.raw.shape[2] + 1).astype(np.complex64)  # one for both
    for one in (own, other):
        unit = np.sqrt(one.power.sum(1))  # squares of small currents would underflow
        turned = one.raw * clock
        turned = turned / unit[:, None, None]
        noise = np.repeat(one.variance * one.power / unit[:, None] ** 2, layout.number, axis=1)
        pairs.append((turned, turned.mean(1), noise))
    (y, y_mean, y_noise), (x, x_mean, x_noise) = pairs
    white = 1 / np.sqrt(power_of(x_mean) * y_noise + power_of(y_mean) * x_noise)
    mean, by_y, by_x = white * x_mean * y_mean, white * x_mean, white * y_mean
    deviation = by_y[:, None] * y - by_x[:, None] * x
    power = np.maximum(np.add.reduceat(power_of(mean), layout.edges, axis=1), TINY)
    smooth, gain = [], []
    # A drift of either channel is a polynomial times the mean of the other one.
    for row in range(len(mean)):
        drifts = np.concatenate([by_y[row] * layout.polynomials, by_x[row] * layout.polynomials])
        stacked = np.linalg.qr(np.concatenate([np.real(drifts), np.imag(drifts)], axis=1).T)[0].T
        basis = stacked[:, : mean.shape[1]] + 1j * stacked[:, mean.shape[1] :]
        rest = deviation[row] - np.real(deviation[row] @ basis.conj().T) @ basis
        gain.append(np.add.reduceat(rest * mean[row].conj(), layout.edges, axis=1) / power[row])
        smooth.append(np.add.reduceat(mean[row].conj() * basis, layout.edges, axis=1))
    none = np.zeros(own.late.shape)  # an amplitude that changes in both records does no harm
    found = own._replace(gain=np.stack(gain), power=power, variance=1 / power)
    return _joined(of, found, np.stack(smooth), none, np.ones(len(none)))


def _joined(
    of: _Rows,
    own: Deviations,
    smooth: Complex[np.ndarray, "lane polynomial band"],
    unloaded: Float[np.ndarray, "lane period"],
    unloaded_variance: Float[np.ndarray, " lane"],
) -> Repeats:
    """The result, with the directions of the aliases."""
    turn, removed = _directions(of, own)
    count, rate = len(of.rows), of.inspection.sample_rate
    frequency = np.repeat(of.layout.middle[None] * (rate / (2 * np.pi)), count, axis=0)
    parts = own.gain, own.power, smooth, own.variance, turn, removed
    return Repeats(frequency, np.full(count, rate), *parts, unloaded, unloaded_variance)


def _phases(
    v: Float[np.ndarray, "lane time"], limits: Float[np.ndarray, "lane limit"]
) -> Int[np.ndarray, " lane"]:
    """Number of samples in all pulses; of biphasic pulses, those in the shorter phase."""
    low, high = limits.T
    half = np.maximum(-low, high)[:, None] / 2
    above = np.where(high > half[:, 0], np.count_nonzero(v > half, axis=1), 0)
    below = np.where(low < -half[:, 0], np.count_nonzero(v < -half, axis=1), 0)
    shorter = np.minimum(above, below)
    return np.where(shorter > 0, shorter, np.maximum(above, below))
