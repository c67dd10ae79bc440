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

import itertools
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float, Int

from etid.signals.harmonics import COHERENT, flat, harmonics_of
from etid.signals.pulse_train import PHASES, fast_length

SEAM = 4  # samples on each side of the joint between two periods
PLACES = np.linspace(0.0, 0.5, 6)  # of the sample rate, where weights are found
PAIRS = np.arange(1, 3)  # multiples k of the sample rate whose aliases count
# Parts of the band, relative to the sample rate, that show aliases.
UPPER, LOWER = (0.4, 0.5), (0.1, 0.35)
FALLS = np.linspace(2.0, 30.0, 57)  # from that of edges to that behind a filter
SURE = 4.0  # [standard errors] of a power that is not by chance
CLEAR = 40.0  # [standard errors] of about half the noise, which is itself known to 3 %
TOLD = 0.1  # part of a delay that must be told from aliases


class Aliases(NamedTuple):
    """The spectrum of a record beyond half the sample rate, S u^(−p) at u times the sample rate.

    Attributes:
        power: S, as the power of a coefficient.
        fall: p up to the sample rate.
        beyond: p from there on.
    """

    power: float
    fall: float
    beyond: float

    def at(self, place: Float[np.ndarray, " place"]) -> Float[np.ndarray, "pair place"]:
        """Power of the aliases of each of `PAIRS` at frequencies relative to the sample rate."""
        both = np.stack([PAIRS[:, None] - place, PAIRS[:, None] + place])
        return self.power * (both ** -np.where(both < 1, self.fall, self.beyond)).sum(0)


class Periods(NamedTuple):
    """The transforms of the periods of a record.

    Attributes:
        of_each: Coefficients of each period, as it was cut.
        place: Their frequencies, relative to the sample rate.
        starts: Samples at which the periods are cut.
        spacing: Length of a period [samples].
    """

    of_each: Complex[np.ndarray, "period place"]
    place: Float[np.ndarray, " place"]
    starts: Int[np.ndarray, " period"]
    spacing: float

    @classmethod
    def of(cls, v: Float[np.ndarray, " time"], spacing: float, periods: int) -> "Periods":
        """The periods of a record, whose length is `spacing` [samples]."""
        length = int(spacing) - 1
        starts = np.rint(np.arange(periods) * spacing).astype(int)
        starts = np.minimum(starts, v.size - length)
        cut = v[starts[:, None] + np.arange(length)]
        first, last = cut[:, [0, -1]].mean(0)
        cut = cut - first - (last - first) * np.linspace(0, 1, length)
        size = fast_length(length)
        place = np.arange(size // 2 + 1) / size
        return cls(np.fft.rfft(cut, size) / spacing, place, starts, spacing)

    @property
    def turns(self) -> Complex[np.ndarray, "pair period"]:
        """How the aliases of `PAIRS` are turned in each period."""
        return _turns(self.spacing, len(self.starts))

    def _part(
        self, low: float, high: float
    ) -> tuple[Complex[np.ndarray, "period place"], Float[np.ndarray, " place"]]:
        """Coefficients of each period in a part of the band, as if it began at its place."""
        inside = (self.place >= low) & (self.place < high)
        late, place = self.starts - self.spacing * np.arange(len(self.starts)), self.place[inside]
        return self.of_each[:, inside] * np.exp(-2j * np.pi * np.outer(late, place)), place

    def longer(self) -> float:
        """By how much a period is longer than was said [samples].

        A longer period turns the phases of each period more. Aliases of the first pair do not
        count, unless there are too few periods to tell them.
        """
        line = np.arange(len(self.starts)) - (len(self.starts) - 1) / 2
        plain, turn = np.ones(line.size), self.turns[0]
        apart = _without(line, plain, turn.real, turn.imag)
        if apart @ apart < TOLD * (line @ line):
            apart = line
        of_each, place = self._part(*PHASES)
        slope = -2j * np.pi * place * of_each.mean(0) * (apart @ line)
        return float(np.vdot(slope, apart @ of_each).real / np.vdot(slope, slope).real)

    def aliases(
        self, noise: Float[np.ndarray, " harmonic"], like: Aliases | None = None
    ) -> Aliases | None:
        """The aliases, from the differences between the periods; None if there are none.

        Args:
            noise: Power of the noise in each harmonic of the mean over the periods.
            like: Aliases of the other record, which fall alike beyond the sample rate, and below
                it, too, if the lower part of the band does not tell.
        """
        (power, lower), errors = np.transpose([self._beside(noise, of) for of in (UPPER, LOWER)])
        # Mean powers of both parts of the band of a spectrum with a power of 1 at the sample rate.
        shapes = [((1 - np.linspace(*of, 16)) ** -FALLS[:, None]).mean(1) for of in (UPPER, LOWER)]
        if like is not None and lower < CLEAR * errors[1]:
            fall = like.fall
        elif like is not None or power > SURE * errors[0]:
            ratio = np.log(max(power, errors[0]) / max(lower, errors[1]))
            fall = float(np.interp(ratio, np.log(shapes[0] / shapes[1]), FALLS))
        else:
            return None
        power = max(float(power / np.interp(fall, FALLS, shapes[0])), 0.0)
        return Aliases(power, fall, fall if like is None else like.fall)

    def _beside(
        self, noise: Float[np.ndarray, " harmonic"], part: tuple[float, float]
    ) -> tuple[float, float]:
        """Mean power of the aliases in a part of the band, and its standard error."""
        count, inside = len(self.of_each), np.var(self._part(*part)[0], axis=0)
        begin, end = (int(2 * of * noise.size) for of in part)
        of_noise = (count - 1) * noise[begin:end].mean()
        seen = 1 - abs(self.turns[0].mean()) ** 2  # the mean holds the rest
        error = of_noise / seen / np.sqrt(inside.size * (count - 1))
        return float((inside.mean() - of_noise) / seen), float(error)


def _turns(spacing: float, periods: int) -> Complex[np.ndarray, "pair period"]:
    return np.exp(2j * np.pi * spacing * np.outer(PAIRS, np.arange(periods)))


def _without(
    line: Float[np.ndarray, " period"], *others: Float[np.ndarray, " period"]
) -> Float[np.ndarray, " period"]:
    """A vector without what others can make."""
    columns = np.array(others).T
    return line - columns @ np.linalg.lstsq(columns, line, rcond=1e-6)[0]


def weights(
    spacing: float, periods: int, noise: Float[np.ndarray, " place"], aliases: Aliases
) -> Float[np.ndarray, "place period"]:
    """The weights of the periods with the least error, at each of `PLACES`.

    Args:
        spacing: Length of a period [samples].
        periods: Number of periods.
        noise: Power of the noise in a coefficient of the plain mean, at each of `PLACES`.
        aliases: The aliases.
    """
    turns = _turns(spacing, periods)
    of_pairs = np.real(turns[:, :, None] * turns[:, None, :].conj())
    errors = np.einsum("kp,kij->pij", COHERENT * spacing * aliases.at(PLACES), of_pairs)
    errors += (periods * noise)[:, None, None] * np.eye(periods)
    found = np.linalg.solve(errors, np.ones((noise.size, periods, 1)))[..., 0]
    return found / found.sum(-1, keepdims=True)


def left(
    of: Float[np.ndarray, "place period"], spacing: float, aliases: Aliases
) -> Float[np.ndarray, " place"]:
    """Power of the aliases that a mean with these weights holds, as of independent errors."""
    kept = np.square(np.abs(of @ _turns(spacing, of.shape[1]).T))
    return COHERENT * spacing * (aliases.at(PLACES).T * kept).sum(-1)


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
    found = 0.0
    for number, (begin, end) in enumerate(itertools.pairwise(ends)):
        alone = np.zeros(v.shape)
        alone[..., begin:end] = v[..., begin:end]
        one = periods * harmonics_of(alone, periods)
        place = np.arange(1, one.shape[-1] + 1) * (periods / samples)
        turn = np.exp(2j * np.pi * place * (number * (spacing - samples / periods)))
        found = found + one * (np.interp(place, PLACES, of[:, number]) * turn)
    return np.asarray(found)
