"""What a fit leaves of a recording, and whether it is noise.

The residual W = predicted − measured at each frequency that the fit used is relative to its
expected noise, so that E|W|² = 1. If only this noise is left, each W is an independent complex
normal number: Z_th, the load and the filters colour the noise of a record, not W. Then the
correlations by lag τ,

    Σ |W|² (cos ωτ − mean of cos ωτ) / Σ |W|²                         (with itself)
    Σ Re(W X* e^(jωτ) / |X|) / n                                      (with the input X),

have the mean 0 and the variances 1/n · var cos ωτ and 1/(2n) for n frequencies. The input is
whitened by its size, and the second one is relative to the noise. These are the tests of Ljung
(System Identification, 1999, chapter 16); of samples in time they would need white noise.

Both are those of the mean of the periods. How far each period is from their mean, relative to its
noise, shows what changes during a record.
"""

import dataclasses
import statistics

import numpy as np
import scipy.special
from jaxtyping import Complex, Float

from etid.printing import Overview, Overviewed, per_cent, rounded, several
from etid.results.data import AnyAxes, Size, drawn

LEVEL = 0.99  # of white residuals inside of the band
CHANCE = 0.01  # probability that as many lags of noise lie outside
LAGS = 60


@dataclasses.dataclass(frozen=True, eq=False)
class Correlation:
    """A correlation of residuals by lag.

    Attributes:
        lag: Lags [s]; in frequencies for the neighbours of an impedance.
        values: Correlation coefficients; with the input, relative to the noise.
        band: What 99 % of them do not exceed in size, if only noise is left.
    """

    lag: Float[np.ndarray, " lag"]
    values: Float[np.ndarray, " lag"]
    band: Float[np.ndarray, " lag"]

    @classmethod
    def of_power(
        cls,
        power: Float[np.ndarray, " frequency"],
        frequency: Float[np.ndarray, " frequency"],
        lag: Float[np.ndarray, " lag"],
    ) -> "Correlation":
        """The autocorrelation of residuals with these powers |W|²."""
        waves = np.cos(2 * np.pi * lag[:, None] * frequency)
        waves -= waves.mean(1, keepdims=True)
        values = waves @ power / power.sum()
        return cls(lag, values, _quantile() * np.sqrt(np.mean(waves**2, 1) / frequency.size))

    @classmethod
    def with_input(
        cls,
        whitened: Complex[np.ndarray, " frequency"],
        x: Complex[np.ndarray, " frequency"],
        frequency: Float[np.ndarray, " frequency"],
        lag: Float[np.ndarray, " lag"],
    ) -> "Correlation":
        """The correlation with an input, which comes earlier where the lag is positive."""
        turned = np.exp(2j * np.pi * lag[:, None] * frequency - 1j * np.angle(x))
        values = np.real(turned @ whitened) / frequency.size
        return cls(lag, values, np.full(lag.size, _quantile() / np.sqrt(2 * frequency.size)))

    @classmethod
    def of_neighbours(cls, whitened: Complex[np.ndarray, " frequency"]) -> "Correlation":
        """The correlation of residuals with those some frequencies higher."""
        n = whitened.size
        steps = np.arange(1, lags(n) + 1)
        products = [np.real(np.vdot(whitened[:-by], whitened[by:])) for by in steps]
        values = np.array(products) / np.sum(np.abs(whitened) ** 2)
        return cls(steps * 1.0, values, _quantile() * np.sqrt((n - steps) / 2) / n)

    @property
    def outside(self) -> float:
        """Share of the lags outside of the band."""
        return float(np.mean(np.abs(self.values) > self.band))

    @property
    def is_noise(self) -> bool:
        """Whether noise has as many lags outside of the band once in a hundred times at least."""
        count = round(self.outside * self.values.size)
        if count == 0:
            return True
        # The probability of `count` or more.
        chance = scipy.special.bdtrc(count - 1, self.values.size, 1 - LEVEL)
        return bool(chance > CHANCE)


@dataclasses.dataclass(frozen=True, eq=False)
class ByPeriod:
    """How far each pulse period of V_out is from their mean, up to 0.03 of the sample rate.

    Above, aliases of the edges differ from period to period. Drifts of the mean are removed.

    Attributes:
        rms: Root mean square of each period, relative to its noise.
        terms: Number of real numbers of each.
    """

    rms: Float[np.ndarray, " period"]
    terms: int

    @property
    def limit(self) -> float:
        """What 99 % of the periods do not exceed if only noise is left."""
        return float(np.sqrt(scipy.special.chdtri(self.terms, 1 - LEVEL) / self.terms))

    @property
    def is_noise(self) -> bool:
        """Whether noise makes periods differ as much once in a hundred times at least."""
        alone = self.terms * (1 - 1 / self.rms.size)
        square, freedom = alone * np.sum(self.rms**2), alone * self.rms.size
        return bool(scipy.special.chdtrc(freedom, square) > CHANCE)


def lags(frequencies: int) -> int:
    """Number of lags that as many frequencies tell apart."""
    return max(1, min(LAGS, frequencies // 2))


def _quantile() -> float:
    return statistics.NormalDist().inv_cdf((1 + LEVEL) / 2)


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Residual(Overviewed):
    """What a fit leaves: predicted − measured, as `fit.residual()` returns it.

    The bands of its correlations hold 99 % of the lags if only noise is left, of the size by
    frequency that the fit expects. They assume that the noise of different frequencies is
    independent, neither that it is white nor that the samples of V_out are.

    Attributes:
        title: Circuit and verdict of the fit, and the recording.
        time: Time of each sample [s]; empty for an impedance.
        in_time: Residual of V_out [V]; NaN where nothing is predicted, as with known filters.
        frequency: Frequencies that the fit used [Hz].
        whitened: Residual of V_out there, relative to its noise: E|W|² = 1. Of an impedance
            without standard errors, the noise is a part of |Z|, as large as the residual.
        own: Autocorrelation; of an impedance, the correlation of neighbours in frequency.
        with_input: Correlation with V_th, or with the current that causes V_out; None for an
            impedance.
        by_period: Difference of each pulse period from their mean; None if the record holds less
            than two whole ones.
    """

    title: str
    time: Float[np.ndarray, " time"]
    in_time: Float[np.ndarray, " time"]
    frequency: Float[np.ndarray, " frequency"]
    whitened: Complex[np.ndarray, " frequency"]
    own: Correlation
    with_input: Correlation | None
    by_period: ByPeriod | None

    @property
    def rms(self) -> float:
        """Root mean square relative to the noise; 1 if only noise is left."""
        return float(np.sqrt(np.mean(np.abs(self.whitened) ** 2)))

    @property
    def correlations(self) -> dict[str, Correlation]:
        """The correlations by name."""
        own = "with itself" if self.time.size else "with its neighbours"
        of = {own: self.own, "with the input": self.with_input}
        return {name: one for name, one in of.items() if one is not None}

    @property
    def is_noise(self) -> bool:
        """Whether correlations and periods look like noise: each fails once in a hundred by chance.

        A residual that is only larger than its noise has no correlations: see `rms`. These tests
        look for anything; those behind the verdict of the fit look for causes with a name, and see
        smaller ones.
        """
        return not self._left

    def plot(
        self, *, axes: AnyAxes = None, size: Size = None, title: str | None = ""
    ) -> np.ndarray:
        """Draw it; the same as `etid.plot(residual)`, with its arguments."""
        return drawn(self, axes=axes, size=size, title=title)

    @property
    def _left(self) -> list[str]:
        """What is left, in words."""
        left = [name for name, one in self.correlations.items() if not one.is_noise]
        found = [f"correlates {' and '.join(left)}"] if left else []
        if self.by_period is not None and not self.by_period.is_noise:
            found.append("differs between the periods")
        return found

    @property
    def note(self) -> str:
        """A sentence that says whether something is left."""
        left = " and ".join(self._left)
        return f"More than noise is left: it {left}." if left else "No more than noise shows."

    def _overview(self) -> Overview:
        rows = [
            (f"correlation {name}", several(one.values.size, "lag"), per_cent(one.outside))
            for name, one in self.correlations.items()
        ]
        if (of := self.by_period) is not None:
            beyond = float(np.mean(of.rms > of.limit))
            rows.append(("difference of periods", several(of.rms.size, "period"), per_cent(beyond)))
        size = rounded(self.rms, 3)
        sizes = ["as large as the noise" if size == "1" else f"{size} times the noise"]
        if (known := self.in_time[np.isfinite(self.in_time)]).size:
            sizes.insert(0, f"{rounded(1e3 * float(np.sqrt(np.mean(known**2))), 3)} mV")
        title = f"Residual of {self.title}: rms {', '.join(sizes)}"
        heads = "", "", f"outside (noise: {per_cent(1 - LEVEL)})"
        return Overview(title, rows, heads, [self.note])
