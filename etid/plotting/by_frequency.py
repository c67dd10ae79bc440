"""The residual of a fit by frequency, beside the noise that the fit expects there.

The coefficient of a record of T seconds at one harmonic is noise of a band of 1/T. Its E|noise|² is
half of the power in this band, so that the one-sided density is

    √(2 T E|noise|²)   [V/√Hz].

The residual is e = Y − G X, in the same unit, and E|e|² = var Y + |G|² var X are the weights of the
likelihood. The mean of |e|² over n harmonics of noise has the gamma distribution with the shape n.

Where the circuit of a fit leaves more than noise, its gain has a smooth relative error δ, and the
residual a part |G X δ|. In a band this is one number: 95 % of it are below √(ln 20) of its size.
"""

import dataclasses
from typing import Any, cast

import jax
import numpy as np
import scipy.special
from jaxtyping import Bool, Float, Int
from matplotlib.axes import Axes

from etid.circuits.circuit import AbstractCircuit
from etid.estimators.estimator import NOISE
from etid.estimators.lanes import Harmonics
from etid.estimators.maximum_likelihood.estimator import MaximumLikelihood
from etid.estimators.registry import MAXIMUM_LIKELIHOOD, named
from etid.identify.inexact import discrepancy
from etid.identify.posterior import given
from etid.plotting.bands import fitted, used
from etid.plotting.style import BLUE, INK, VIOLET, plain_ticks
from etid.printing import PREFIXES, per_cent, several
from etid.recordings.preflight import Inspected
from etid.results.driver import ContinuousDriver, Driver
from etid.results.feed import AbstractFeed, MeasuredCurrent
from etid.results.fit import Fit

PER_DECADE = 10  # bands
LEFT = "95 % of the noise and what the circuit leaves"
FEWEST = 4  # harmonics of a band at least: their mean is known to 50 %


@dataclasses.dataclass(frozen=True)
class ByFrequency:
    """The residual and the noise of a fit at the harmonics of its recording.

    Attributes:
        frequency: The harmonics [Hz].
        residual: |Y − G X| of each, as a density [V/√Hz].
        noise: What the fit expects of each, as a density [V/√Hz].
        selected: Harmonics that the fit used.
        which: The noise in words.
        left: What 95 % of the parts |G X δ| do not exceed; 0 where noise explains the residual.
        accepted: |G X| times what the circuit may leave; 0 as well.
        accept: What the circuit may leave, relative to the signal.
    """

    frequency: Float[np.ndarray, " harmonic"]
    residual: Float[np.ndarray, " harmonic"]
    noise: Float[np.ndarray, " harmonic"]
    selected: Bool[np.ndarray, " harmonic"]
    which: str
    left: Float[np.ndarray, " harmonic"]
    accepted: Float[np.ndarray, " harmonic"]
    accept: float


def is_white(found: Fit | Driver) -> bool:
    """Whether the method of a fit takes noise for white."""
    try:
        return named(str(found.method)).describe().noise == NOISE
    except ValueError:  # joint fits and others, all at harmonics
        return False


def by_frequency(
    seen: Inspected,
    feed: ContinuousDriver | MeasuredCurrent,
    circuit: AbstractCircuit,
    found: Fit | Driver,
) -> ByFrequency:
    """The residual and the noise of a recording of whole periods.

    Args:
        seen: The recording.
        feed: Its driver, or the measured current.
        circuit: The load.
        found: The fit, or the driver that was identified with a known load.
    """
    lane = used(seen, feed, circuit, found.remarks)
    size = seen.noise.power.shape[-1]  # padded harmonics follow
    every = jax.tree.leaves(dataclasses.replace(lane, filters=None))
    lane = Harmonics(*(of[:size] if np.ndim(of) else of for of in every))
    samples = seen.periods[1]
    if is_white(found):
        white = np.square(seen.trusted) / samples
        lane = dataclasses.replace(
            lane, variance_x=np.full(size, white[0]), variance_y=np.full(size, white[1])
        )
    _, gain, _ = fitted(lane, feed, circuit)
    power = np.square(np.abs(lane.y - gain * lane.x))
    expected = lane.variance_y + np.square(np.abs(gain)) * lane.variance_x
    accept, delta = _inexact(seen, feed, found, np.asarray(lane.frequency))
    signal = np.square(np.abs(gain * lane.x))
    of = power, expected, signal * delta**2 * np.log(20), signal * accept**2
    residual, noise, left, accepted = np.sqrt(2 * samples / lane.sample_rate * np.stack(of))
    at, selected = map(np.asarray, (lane.frequency, lane.selected))
    more = left, accepted, accept
    return ByFrequency(at, residual, noise, selected, _which(seen, found), *more)


def _inexact(
    seen: Inspected,
    feed: AbstractFeed,
    found: Fit | Driver,
    frequency: Float[np.ndarray, " harmonic"],
) -> tuple[float, Float[np.ndarray, " harmonic"]]:
    """What the circuit of a fit may leave, and the standard deviation of δ; 0 without δ."""
    if not isinstance(found, Fit) or not found.inexact:
        return 0.0, np.zeros(frequency.size)
    estimator = MAXIMUM_LIKELIHOOD  # joint fits and those of a batch keep no options
    if found.method.partition("(")[0] == estimator.name:
        estimator = cast("MaximumLikelihood", named(found.method))
    driver = feed if isinstance(feed, Driver) else None
    alone = dataclasses.replace(found, method=str(estimator))
    lane, known, _ = given(alone, seen.recording, driver, "fit.plot")
    std = discrepancy(found, lane, known)
    return estimator.accept, np.interp(np.log(frequency), np.log(lane.frequency), std)


def _which(seen: Inspected, found: Fit | Driver) -> str:
    """The noise in words: by what it was measured, or white."""
    bins = int(seen.noise.bins.min())
    if is_white(found) or bins == 0:
        return "white noise"
    where = "between the harmonics" if seen.periods[0] > 1 else "in the quiet part"
    return f"noise {where} ({several(bins, 'bin')})"


def sample_std(seen: Inspected, feed: AbstractFeed, circuit: AbstractCircuit) -> float:
    """Standard deviation of predicted − measured voltage if only noise is left [V].

    The noise of V_th reaches the residual through the loaded driver G = Z_L / (Z_L + Z_th), that of
    a measured current through G = Z_L. The powers of all bins are summed (Parseval),

        σ² = 2 P Σ (E|noise of Y|² + |G|² E|noise of X|²)

    over the harmonics, each of which stands for the P bins around it.
    """
    of_th, of_out = seen.noise.power
    periods = max(seen.periods[0], 1)
    samples = seen.periods[1] if seen.periods[0] else seen.v_out.size
    harmonic = np.arange(1.0, of_out.size + 1)
    frequency = jax.device_put(harmonic * (periods * seen.recording.sample_rate / samples))
    gain = np.abs(np.asarray(feed.gain(circuit.response(frequency), frequency)))
    return float(np.sqrt(2 * periods * np.sum(of_out + gain**2 * of_th)))


def band_of(count: int) -> Int[np.ndarray, " harmonic"]:
    """Number of the band of each harmonic."""
    edges = [0]
    while edges[-1] < count:
        edges.append(max(edges[-1] + FEWEST, round(edges[-1] * 10 ** (1 / PER_DECADE))))
    return np.searchsorted(edges, np.arange(count), side="right") - 1


def draw_by_frequency(axis: Axes, found: ByFrequency) -> None:
    """Residual in bands, the noise that the fit expects, and where 95 % of such noise lies.

    Harmonics that the fit did not use are pale, and no noise is expected there. If ± contain what
    the circuit leaves, a band of its own holds it, below what is accepted.
    """
    band, used = band_of(found.frequency.size), found.selected
    power = int(np.clip(3 * np.floor(np.log10(np.median(found.noise[used])) / 3), -15, 0))
    unit = 10.0**power

    def mean(values: Float[np.ndarray, " harmonic"]) -> Float[np.ndarray, " band"]:
        sums = np.bincount(band, np.where(some, values, 0.0))
        return sums[number > 0] / number[number > 0]

    for some, alpha in ((~used, 0.3), (used, 1.0)):
        number = np.bincount(band, some)
        at = np.exp(mean(np.log(found.frequency))) / 1e3
        size = np.sqrt(mean(found.residual**2)) / unit
        axis.plot(at, size, "o", ms=3.5, color=BLUE, alpha=alpha, zorder=3)
    shape, expected = number[number > 0], np.sqrt(mean(found.noise**2)) / unit
    low, high = (np.sqrt(scipy.special.gammaincinv(shape, p) / shape) for p in (0.025, 0.975))
    axis.fill_between(at, low * expected, high * expected, color="0.85", lw=0)
    if found.left.any():
        most = np.sqrt((high * expected) ** 2 + mean(found.left**2) / unit**2)
        look: Any = {"color": VIOLET, "alpha": 0.25, "lw": 0}
        axis.fill_between(at, high * expected, most, label=LEFT, **look)
        accepted = np.sqrt(mean(found.accepted**2)) / unit
        label = f"accepted: {per_cent(found.accept)} of the signal"
        axis.plot(at, accepted, "--", color=VIOLET, lw=1.0, label=label)
    noise = found.noise[used] / unit
    axis.plot(found.frequency[used] / 1e3, noise, color=INK, lw=1.1, label=found.which)
    axis.set(xscale="log", yscale="log", xlabel="frequency [kHz]")
    axis.set(ylabel=f"residual [{PREFIXES[power]}V/√Hz]")
    bottom, top = axis.get_ylim()
    axis.set_ylim(min(bottom, noise.min() / 4), max(top, noise.max() * 4))  # else noise looks large
    plain_ticks(axis.xaxis)
    plain_ticks(axis.yaxis, short=50.0)  # the panel is low
