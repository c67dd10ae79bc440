"""Averages over the periods of a record that are nearly free of aliases.

A sampled edge holds frequencies beyond half the sample rate fs. In period p, which begins a
fraction pδ of a sample later than a whole number of samples, the aliases of k fs − f and k fs + f
are turned by e^(±j 2π k p δ) against the signal at f. If all periods together are a whole number of
samples, the sum of these turns is 0, and so the mean over the periods has no aliases. It is not
where the pulses have a clock of their own: 15 ppm at 200 kHz and six periods are 0.3 samples, and
without a filter a percent of the spectrum at 20 kHz is aliases. The mean with the weights a_p,
Σ a_p = 1, has the error

    P Σ a_p² σ² + n Σ_k A_k² |Σ a_p e^(j 2π k p δ)|²

from noise of the power σ² in the plain mean and aliases of the power A_k². Aliases of the n
harmonics within a part `COHERENT` of the sample rate have nearly the same relative error, so that
they count n times (`etid.signals.harmonics`). At each frequency the weights with the least error
are taken. They remove aliases that exceed the noise and leave the others: to remove those of 2 fs,
too, may enlarge the noise 26 times.

**Power of the aliases.** What differs from period to period beside the noise are aliases. Their
mean power in the upper and in the lower part of the band, where they come from 0.55 fs and 0.8 fs,
determine a spectrum S f^(−p), which is continued.
"""

import functools
import itertools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float

from etid.signals.harmonics import COHERENT, flat, separates_aliases
from etid.signals.periods import Periods

# Relative to the sample rate. Below the first, the drift of the mean is larger than a delay; above
# the second, aliases are a twentieth of the signal.
PHASES = 0.005, 0.05
SEAM = 4  # samples on each side of the joint between two periods
PLACES = np.linspace(0.0, 0.5, 6)  # of the sample rate, where weights are found
PAIRS = np.arange(1, 3)  # multiples k of the sample rate whose aliases count
# Parts of the band, relative to the sample rate, that show aliases.
UPPER, LOWER = (0.4, 0.5), (0.1, 0.35)
FALLS = np.linspace(2.0, 30.0, 57)  # from that of edges to that behind a filter
LEAK = 0.1  # part of the noise that aliases on a harmonic may have
MOVED = 0.05  # [samples] of the last period, from which on its place matters
SURE = 4.0  # [standard errors] of a power, or of a length, that is not by chance
CLEAR = 40.0  # [standard errors] of about half the noise, which is itself known to 3 %
TOLD = 0.1  # part of a delay that must be told from aliases
# Mean powers of both parts of the band of a spectrum with a power of 1 at the sample rate.
SHAPES = [((1 - np.linspace(*of, 16)) ** -FALLS[:, None]).mean(1) for of in (UPPER, LOWER)]


class Aliases(NamedTuple):
    """The spectra of records beyond half the sample rate, S u^(−p) at u times the sample rate.

    Attributes:
        power: S, as the power of a coefficient; 0 if there are none.
        fall: p up to the sample rate.
        beyond: p from there on.
    """

    power: Float[np.ndarray, "*record"]
    fall: Float[np.ndarray, "*record"]
    beyond: Float[np.ndarray, "*record"]

    def at(self, place: Float[np.ndarray, " place"]) -> Float[np.ndarray, "*record pair place"]:
        """Power of the aliases of each of `PAIRS` at frequencies relative to the sample rate."""
        both = np.stack([PAIRS[:, None] - place, PAIRS[:, None] + place])
        power, fall, beyond = (np.asarray(of)[..., None, None, None] for of in self)
        return (power * both ** -np.where(both < 1, fall, beyond)).sum(-3)

    def take(self, rows: Any) -> "Aliases":
        """Those of some of the records."""
        return Aliases(*(of[rows] for of in (self.power, self.fall, self.beyond)))


class Differing(NamedTuple):
    """Aliases of both records that differ between their periods.

    Attributes:
        rows: Recordings that have them.
        spacing: Length of a period of each record [samples]; by the phases of its pulses if
            aliases need it.
        of_cause: Aliases of the first record of each record.
        of_out: Aliases of `v_out`.
    """

    rows: Bool[np.ndarray, " record"]
    spacing: Float[np.ndarray, " record"]
    of_cause: Aliases
    of_out: Aliases


def longer(
    of: Periods, spacing: Float[np.ndarray, " record"]
) -> tuple[Float[np.ndarray, " record"], Float[np.ndarray, " record"]]:
    """By how much the periods of records are longer than `spacing` [samples], and standard errors.

    A longer period turns the phases of each period more. Aliases of the first pair do not count,
    unless there are too few periods to tell them.
    """
    periods = of.starts.shape[1]
    line = np.arange(periods) - (periods - 1) / 2
    apart = np.array([_apart(one, periods) for one in spacing.tolist()])
    each, place = of.turned(spacing, *PHASES)
    slope = -2j * np.pi * place * each.mean(1) * (apart @ line)[:, None]
    moved, power = np.einsum("rp,rpk->rk", apart, each), np.vecdot(slope, slope).real
    found = np.vecdot(slope, moved).real / power
    rest = moved - found[:, None] * slope
    return found, np.sqrt(np.vecdot(rest, rest).real / (2 * place.size * power))


@functools.lru_cache(maxsize=256)  # most records have the nominal spacing
def _apart(spacing: float, periods: int) -> Float[np.ndarray, " period"]:
    """A line over the periods without what aliases of the first pair can make of it."""
    line, turn = np.arange(periods) - (periods - 1) / 2, _turns(spacing, periods)[0]
    others = np.stack([np.ones(periods), np.real(turn), np.imag(turn)], axis=1)
    apart = line - others @ np.linalg.lstsq(others, line, rcond=1e-6)[0]
    return line if apart @ apart < TOLD * (line @ line) else apart


def exact_spacing(
    of: Periods, spacing: Float[np.ndarray, " record"]
) -> Float[np.ndarray, " record"]:
    """`spacing`, or what the phases of the pulses say if the last one is surely elsewhere."""
    by, error = longer(of, spacing)
    last = of.starts.shape[1] - 1
    differs = last * np.abs(by) > np.maximum(SURE * last * error, MOVED)
    return np.where(differs, spacing + by, spacing)


def aliases_of(
    of: Periods,
    spacing: Float[np.ndarray, " record"],
    noise: Float[np.ndarray, "record harmonic"],
    like: Aliases | None = None,
) -> Aliases:
    """The aliases of records, from the differences between their periods.

    Args:
        of: The periods.
        spacing: Length of a period of each record [samples].
        noise: Power of the noise in each harmonic of the mean over the periods.
        like: Aliases of the other record, which fall alike beyond the sample rate, and below it,
            too, if the lower part of the band does not tell.
    """
    power, of_upper = _beside(of, spacing, noise, UPPER)
    lower, of_lower = _beside(of, spacing, noise, LOWER)
    ratio = np.log(np.maximum(power, of_upper) / np.maximum(lower, of_lower))
    fall = np.interp(ratio, np.log(SHAPES[0] / SHAPES[1]), FALLS)
    if like is None:
        power = np.where(power > SURE * of_upper, power, 0.0)
    else:
        fall = np.where(lower < CLEAR * of_lower, like.fall, fall)
    power = np.maximum(power / np.interp(fall, FALLS, SHAPES[0]), 0.0)
    return Aliases(power, fall, fall if like is None else like.fall)


def differing_aliases(
    coefficients: Complex[np.ndarray, "record 2 harmonic"],
    power: Float[np.ndarray, "record 2 harmonic"],
    periods: tuple[int, int],
    spacing: Float[np.ndarray, " record"],
    rests: Bool[np.ndarray, " record"],
    cut: Callable[[int], Periods],
) -> Differing:
    """Aliases that leak into the harmonics, and the exact length of the periods.

    Args:
        coefficients: `harmonics` of both records.
        power: Power of their noise.
        periods: Numbers of periods and of samples, from `whole_periods`.
        spacing: Length of a period, from the measured pulse rate [samples].
        rests: Records of pulses that are at rest at the joints.
        cut: The periods of the first or of the second record.
    """
    (count, samples), spacing = periods, spacing.copy()
    none = [Aliases(*np.zeros((3, spacing.size))) for _ in range(2)]
    found = Differing(np.zeros(spacing.size, bool), spacing, *none)
    if count < 3 or not separates_aliases(*periods):
        return found
    top = coefficients[:, 0, coefficients.shape[-1] * 9 // 10 :]  # aliases are as large there
    loud = np.square(np.abs(top)).mean(-1) / power[:, 0, -top.shape[-1] :].mean(-1) - 1
    rows = np.flatnonzero(rests & (loud > SURE / math.sqrt(top.shape[-1])))
    if not rows.size:
        return found
    of_cause, known = cut(0).take(rows), spacing[rows]
    exact = known + longer(of_cause, known)[0]
    moved = np.abs(exact - known) * count > MOVED
    spacing[rows[moved]] = exact[moved]
    # At most, aliases are as large as the signal where they meet it.
    held = np.square(np.abs(_turns(exact, count).mean(-1))).sum(-1)
    leaks = 2 * COHERENT * exact * loud[rows] * held >= LEAK
    rows, exact, of_cause = rows[leaks], exact[leaks], of_cause.take(leaks)
    if not rows.size:
        return found
    own = aliases_of(of_cause, exact, power[rows, 0])
    place = np.arange(1.0, power.shape[-1] + 1) * (count / samples)
    of_noise = np.array([np.interp(PLACES, place, one) for one in power[rows, 0]])
    plain = np.full((PLACES.size, count), 1 / count)
    leaks = (left(plain, exact, own) > LEAK * of_noise).any(-1)
    rows, exact, own = rows[leaks], exact[leaks], own.take(leaks)
    if not rows.size:
        return found
    other = aliases_of(cut(1).take(rows), exact, power[rows, 1], own)
    found.rows[rows], spacing[rows] = True, exact
    for whole, part in ((found.of_cause, own), (found.of_out, other)):
        for field, of_rows in zip(whole, part, strict=True):
            field[rows] = of_rows
    return found


def _beside(
    of: Periods,
    spacing: Float[np.ndarray, " record"],
    noise: Float[np.ndarray, "record harmonic"],
    part: tuple[float, float],
) -> tuple[Float[np.ndarray, " record"], Float[np.ndarray, " record"]]:
    """Mean power of the aliases in a part of the band, and its standard error."""
    each, place = of.turned(spacing, *part)
    count = each.shape[1]
    each = (each - each.mean(1, keepdims=True)).view(float)
    inside = np.einsum("rpk,rpk->r", each, each) / (count * place.size * spacing**2)
    begin, end = (int(2 * at * noise.shape[1]) for at in part)
    of_noise = (count - 1) * noise[:, begin:end].mean(1)
    seen = 1 - np.abs(_turns(spacing, count)[:, 0].mean(1)) ** 2  # the mean holds the rest
    error = of_noise / seen / np.sqrt(place.size * (count - 1))
    return (inside - of_noise) / seen, error


def _turns(
    spacing: Float[np.ndarray, "*record"] | float, periods: int
) -> Complex[np.ndarray, "*record pair period"]:
    """How the aliases of `PAIRS` are turned in each period."""
    turn = np.asarray(spacing)[..., None, None]
    return np.exp(2j * np.pi * turn * np.outer(PAIRS, np.arange(periods)))


def weights(
    spacing: Float[np.ndarray, "*record"] | float,
    periods: int,
    noise: Float[np.ndarray, "*record place"],
    aliases: Aliases,
) -> Float[np.ndarray, "*record place period"]:
    """The weights of the periods with the least error, at each of `PLACES`.

    Args:
        spacing: Length of a period [samples].
        periods: Number of periods.
        noise: Power of the noise in a coefficient of the plain mean, at each of `PLACES`.
        aliases: The aliases.
    """
    turns = _turns(spacing, periods)
    of_pairs = np.real(turns[..., :, None] * turns[..., None, :].conj())
    power = COHERENT * np.asarray(spacing)[..., None, None] * aliases.at(PLACES)
    errors = np.einsum("...kp,...kij->...pij", power, of_pairs)
    errors += (periods * noise)[..., None, None] * np.eye(periods)
    found = np.linalg.solve(errors, np.ones((periods, 1)))[..., 0]
    return found / found.sum(-1, keepdims=True)


def left(
    of: Float[np.ndarray, "*#record place period"],
    spacing: Float[np.ndarray, "*record"] | float,
    aliases: Aliases,
) -> Float[np.ndarray, "*record place"]:
    """Power of the aliases that a mean with these weights holds, as of independent errors."""
    turns = _turns(spacing, of.shape[-1]).swapaxes(-1, -2)
    held = aliases.at(PLACES).swapaxes(-1, -2) * np.square(np.abs(of @ turns))
    return COHERENT * np.asarray(spacing)[..., None] * held.sum(-1)


def weighted(
    v: Float[np.ndarray, "*record time"],
    spacing: float,
    of: Float[np.ndarray, "place period"],
) -> Complex[np.ndarray, "*record harmonic"]:
    """Harmonics of the mean over periods whose weights vary with the frequency.

    All periods together are rarely a whole number of samples, so the harmonics are at other
    frequencies than those of the pulses. That turns each period more than the one before it, which
    is undone.

    Args:
        v: Records of whole periods.
        spacing: Length of a period [samples].
        of: Weights at each of `PLACES`.
    """
    periods, samples = of.shape[1], v.shape[-1]
    v = flat(v, periods)
    ends = np.minimum(np.rint(np.arange(periods + 1) * spacing), samples).astype(int)
    ends[-1] = samples
    # A level at the joints would become a step there.
    joints = (ends[1:-1, None] + np.arange(-SEAM, SEAM)).ravel()
    v = v - v[..., joints].mean(-1, keepdims=True)
    # Each period alone, in the place that it has in equal parts of the record (`harmonics_of`).
    size = samples // math.gcd(periods, samples)
    alone = np.zeros((*v.shape[:-1], periods, size))
    for number, (begin, end) in enumerate(itertools.pairwise(ends)):
        at = begin % size
        inside = min(end - begin, size - at)
        alone[..., number, at : at + inside] = v[..., begin : begin + inside]
        alone[..., number, : end - begin - inside] = v[..., begin + inside : end]
    step = periods * size // samples
    each = np.fft.rfft(alone)[..., step : (size + 1) // 2 : step]
    place = np.arange(1, each.shape[-1] + 1) * (periods / samples)
    by = np.array([np.interp(place, PLACES, one) for one in of.T]) * (periods / samples)
    late = np.arange(periods) * (spacing - samples / periods)
    return np.einsum("...pk,pk->...k", each, by * np.exp(2j * np.pi * np.outer(late, place)))


def without_aliases(
    v: Float[np.ndarray, "record 2 time"],
    coefficients: Complex[np.ndarray, "record 2 harmonic"],
    power: Float[np.ndarray, "record 2 harmonic"],
    differing: Differing,
    periods: int,
    samples: int,
) -> tuple[Complex[np.ndarray, "record 2 harmonic"], Float[np.ndarray, "record 2 harmonic"]]:
    """Harmonics and the power of their noise, of weighted means where aliases differ.

    Args:
        v: Samples of both records.
        coefficients: `harmonics` of both records.
        power: Power of their noise.
        differing: The aliases that differ between the periods.
        periods: Number of periods.
        samples: Number of their samples.
    """
    coefficients, power = coefficients.copy(), power.copy()
    place = np.arange(1.0, power.shape[-1] + 1) * (periods / samples)
    for row in np.flatnonzero(differing.rows):
        spacing = differing.spacing[row]
        both = differing.of_cause.take(row), differing.of_out.take(row)
        of = weights(spacing, periods, np.interp(PLACES, place, power[row, 0]), both[0])
        coefficients[row] = weighted(v[row, :, :samples], spacing, of)
        power[row] *= np.interp(place, PLACES, periods * np.square(of).sum(-1))
        power[row] += [np.interp(place, PLACES, left(of, spacing, one)) for one in both]
    return coefficients, power
