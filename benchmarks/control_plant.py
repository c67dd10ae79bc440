"""A display under a fingertip that changes, from waveforms of ngspice.

ngspice solves driver and skin from rest, with one pulse, over two periods. The circuit is linear:
a pulse of amplitude A after one of amplitude B is A u(t) + B u(t + T). The older pulses have
decayed to e^(-8) of the tail of the last one. Where skin changes between two pulses, the tail of
the pulse before is that of the new skin; it is 0.3 % of the pulse.

Each window has its own delay, sampling phase, noise and rounding by the converter.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
import scipy.interpolate
from jaxtyping import Float

from benchmarks import ngspice
from etid.simulation.published import TYPICAL
from etid.simulation.scenes import Scene
from etid.simulation.transformer import ResistorLoad, SkinLoad

OPEN = ResistorLoad(1e12)
FINE = 16  # points per sample of the waveform that is sampled
# What happens to the skin at an electrode.
KINDS = {
    "dry": "dry",
    "wetting": "wetting within 100 ms",
    "sweating": "sweating slowly",
    "lifted": "lifted off and put back",
}
SPOTS, SPREAD = 7, 0.3  # different places of the fingertip, and the spread of their elements
WETTING = 6  # pulses from dry to damp
LIFTED, BACK = 70, 90  # pulses between which the last electrode touches nothing
SETTLED = 2  # pulses after a change that do not count: the target begins with the third
CORNER = 0.4  # of the sample rate, of the 4th-order Butterworth anti-alias filter


class Fingertip:
    """The skin at each electrode and pulse."""

    def __init__(self, electrodes: int, pulses: int) -> None:
        spots = np.exp(SPREAD * np.random.default_rng(0).standard_normal((SPOTS, 3)))
        dry, damp = (np.array(dataclasses.astuple(TYPICAL[name])) for name in ("dry", "damp"))
        pulse, at = np.arange(pulses)[:, None], np.arange(electrodes)
        kind = np.array(list(KINDS))[at % 3]
        kind[-1] = "lifted"
        self.kind = kind.tolist()
        begin, wetting, sweating = 30 + 3 * (at // 3 % 4), kind == "wetting", kind == "sweating"
        wet = np.where(wetting, np.clip((pulse - begin + 1) / WETTING, 0, 1), 0.0)
        wet = np.where(sweating, pulse / pulses / 3, wet)[..., None]  # a third of the way to damp
        # Fewer places sweat: each pulse of them is another run of ngspice.
        values = spots[at // 3 % np.where(sweating, 2, SPOTS)] * dry ** (1 - wet) * damp**wet
        lifted = (kind == "lifted") & (pulse >= LIFTED)
        self.loads: list[list[SkinLoad | ResistorLoad]] = [
            [OPEN if up else SkinLoad(*map(float, of)) for up, of in zip(*row, strict=True)]
            for row in zip(lifted & (pulse < BACK), values, strict=True)
        ]
        # Pulses that count: neither a change nor one of the two pulses that follow it.
        changed = (pulse == 0) | (wetting & (begin <= pulse) & (pulse < begin + WETTING))
        changed |= lifted & (pulse <= BACK)
        self.counts = ~changed
        for later in range(1, SETTLED + 1):
            self.counts[later:] &= ~changed[:-later]


@dataclasses.dataclass(frozen=True)
class Response:
    """One skin, a pulse of unit amplitude: this period, and what it leaves to the next."""

    # terminal voltage after the anti-alias filter [V] by time from the start [s]
    voltage: scipy.interpolate.CubicSpline
    charge: Float[np.ndarray, " 2"]  # charge in the phase, of the pulse and of the pulse before [C]
    peak: float  # largest current of either sign [A]
    mean: float  # mean terminal voltage in the phase [V]


class Plant:
    """Gives the windows of all electrodes, and the true charge and current.

    Args:
        scene: Driver and converter.
        seed: Seed of noise and delays.
        known: Responses of this driver and converter, which are added to.
    """

    def __init__(
        self, scene: Scene, seed: int, known: dict[SkinLoad | ResistorLoad, Response]
    ) -> None:
        self.scene, self.rng, self.known = scene, np.random.default_rng(seed), known
        self.period = 1 / scene.pulse_rate
        time, v, _ = self._solved(OPEN)
        top = int(np.argmax(v))
        below = np.flatnonzero(v <= 0)
        self.phase = time[below[below < top].max()], time[below[below > top].min()]
        snr = scene.snr_db
        rms = np.sqrt(np.trapezoid(v**2, time) / self.period)
        self.sigma = 0.0 if snr is None else float(rms * 10 ** (-snr / 20))

    def _solved(self, load: SkinLoad | ResistorLoad) -> Float[np.ndarray, "3 step"]:
        text = ngspice.single_pulse(self.scene.driver, load, 2 * self.period)
        return ngspice.solve(text)

    def response(self, load: SkinLoad | ResistorLoad) -> Response:
        """The waveforms of one load."""
        if load not in self.known:
            self.known[load] = self._response(load)
        return self.known[load]

    def _response(self, load: SkinLoad | ResistorLoad) -> Response:
        time, v, i = self._solved(load)
        rate = self.scene.sample_rate * FINE
        grid = np.arange(round(2 * self.period * rate)) / rate
        even = scipy.interpolate.CubicSpline(time, v)(grid)
        s = 1j * np.fft.rfftfreq(grid.size, 1 / rate) / (CORNER * self.scene.sample_rate)
        for odd in (1, 3):
            even = np.fft.irfft(
                np.fft.rfft(even) / (s**2 + 2 * np.sin(np.pi * odd / 8) * s + 1), grid.size
            )
        whole = scipy.interpolate.CubicSpline(time, i).antiderivative()
        begin, end = self.phase
        charge = [float(whole(end + shift) - whole(begin + shift)) for shift in (0.0, self.period)]
        inside = (time > begin) & (time < end)
        mean = float(np.trapezoid(v[inside], time[inside]) / (end - begin))
        first = time < self.period
        return Response(
            scipy.interpolate.CubicSpline(grid, even),
            np.array(charge),
            float(np.abs(i[first]).max()),
            mean,
        )

    def delivered(
        self,
        loads: Sequence[SkinLoad | ResistorLoad],
        amplitude: Float[np.ndarray, " lane"],
        before: Float[np.ndarray, " lane"],
    ) -> tuple[Float[np.ndarray, " lane"], Float[np.ndarray, " lane"], Float[np.ndarray, " lane"]]:
        """True charge [C], largest current [A] and mean voltage in the phase [V] of a pulse."""
        found = [self.response(load) for load in loads]
        charge = np.array([one.charge for one in found])
        q = charge[:, 0] * amplitude + charge[:, 1] * before
        peak = np.array([one.peak for one in found]) * amplitude
        return q, peak, np.array([one.mean for one in found]) * amplitude

    def windows(
        self,
        number: int,
        samples: int,
        loads: Sequence[SkinLoad | ResistorLoad],
        amplitude: Float[np.ndarray, " lane"],
        before: Float[np.ndarray, " lane"],
    ) -> Float[np.ndarray, "lane sample"]:
        """What the converter records of pulse `number` [V]; the other arguments as `delivered`."""
        rate, scene = self.scene.sample_rate, self.scene
        begin = round(number * self.period * rate) / rate - number * self.period
        rows = []
        for load, now, then in zip(loads, amplitude, before, strict=True):
            delay = begin + scene.trigger_jitter_rms * self.rng.standard_normal()
            at = np.arange(samples) / rate + delay
            spline = self.response(load).voltage
            # The end of the second period continues at its beginning in the filtered waveform.
            v = now * spline(np.maximum(at, 0.0)) + then * spline(
                np.minimum(at + self.period, 2 * self.period - 1 / rate)
            )
            rows.append(v + self.sigma * self.rng.standard_normal(samples))
        step = scene.full_scale / 2 ** (16 - 1) / scene.scale
        return step * np.rint(np.array(rows) / step)
