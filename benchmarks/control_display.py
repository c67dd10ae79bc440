"""A display whose loads change at every pulse, in NumPy: the windows, and the charge that flows.

Nothing here is shared with what `etid.online` predicts. The response of each load to one pulse from
rest is computed over six periods, from the circuit of the transformer at 120 000 frequencies. The
circuit is linear: a pulse of amplitude A after pulses of amplitude B and C is
A u(t) + B u(t + T) + C u(t + 2T). The charge is the integral of the current over the phase of the
unloaded voltage, on a grid of 0.4 µs. Where a load changes, the tails of the pulses before are
those of the new load.
"""

from collections.abc import Callable, Sequence

import numpy as np
import scipy.integrate
from jaxtyping import Complex, Float, Int

from etid.simulation.scenes import Scene

FINE = 12  # points per sample; a third of a sample must be whole points
PERIODS = 6  # after which a pulse has decayed, even through a short circuit
OLDER = 3  # pulses whose tails are added, the newest one included
DELAYS = np.array([-1e-7, 0.0, 1e-7])  # [s] of the trigger, drawn for each window

Load = Callable[[Float[np.ndarray, " f"]], Complex[np.ndarray, " f"]]


class Display:
    """A display at 60 Hz and 200 kHz.

    Attributes:
        charge: Charge of a pulse of unit amplitude from rest in its own phase and in the next ones,
            through each load [C].

    Args:
        scene: Driver and converter.
        loads: The loads that the electrodes may meet.
        seed: Seed of noise and delays.
    """

    def __init__(self, scene: Scene, loads: Sequence[Load], seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        rate, period = scene.sample_rate, scene.sample_rate / scene.pulse_rate
        self.size, self.step = round(period), scene.full_scale / 2**15 / scene.scale
        points = round(PERIODS * period) * FINE
        f = np.fft.rfftfreq(points, 1 / (rate * FINE))
        v = scene.driver.v_th_spectrum(f) * rate * FINE
        z_th = scene.driver.z_th(f)
        s = 1j * f / (scene.antialias * rate)
        filtered = 1 / np.prod([s**2 + 2 * np.sin(np.pi * of / 8) * s + 1 for of in (1, 3)], axis=0)
        time = np.arange(points) / (rate * FINE)

        unloaded = np.fft.irfft(v, points)
        top, below = int(np.argmax(unloaded)), np.flatnonzero(unloaded <= 0)
        phase = time[below[below < top].max()], time[below[below > top].min()]
        rms = np.sqrt(np.mean(np.fft.irfft(v * filtered, points) ** 2) * PERIODS)
        self.sigma = 0.0 if scene.snr_db is None else rms * 10 ** (-scene.snr_db / 20)

        ends = np.array(phase)[:, None] + np.arange(OLDER) / scene.pulse_rate
        charges: list[np.ndarray] = []
        self.voltage: list[np.ndarray] = []
        # Window k periods after a pulse, whose first sample is `third` thirds of a sample late.
        third, k = np.arange(-1, 2)[:, None], np.arange(OLDER)
        first = np.rint(k * period * FINE + third * FINE / 3).astype(int)
        at = (first[..., None] + FINE * np.arange(self.size)) % points
        for load in loads:
            z = load(f)
            with np.errstate(invalid="ignore"):
                through = np.where(np.isinf(z), 0.0, v / (z + z_th))
                voltage = np.where(np.isinf(z), v, z * through) * filtered
            charge = scipy.integrate.cumulative_trapezoid(
                np.fft.irfft(through, points), time, initial=0.0
            )
            charges.append(np.diff(np.interp(ends, time, charge), axis=0)[0])
            late = voltage * np.exp(2j * np.pi * f * DELAYS[:, None])
            self.voltage.append(np.fft.irfft(late, points)[:, at].astype(np.float32))
        self.charge = np.array(charges)

    def charges(
        self, load: Int[np.ndarray, " lane"], amplitude: Float[np.ndarray, "older lane"]
    ) -> Float[np.ndarray, " lane"]:
        """Charge of a pulse at every electrode [C].

        Args:
            load: Number of the load at each electrode.
            amplitude: Amplitudes of this pulse and of those before, the newest first.
        """
        return np.sum(self.charge[load].T * amplitude, axis=0)

    def windows(
        self,
        number: int,
        load: Int[np.ndarray, " lane"],
        amplitude: Float[np.ndarray, "older lane"],
    ) -> Float[np.ndarray, "lane sample"]:
        """What the converter records of pulse `number` [V]; the other arguments as `charges`."""
        third = (1, 0, 2)[number % 3]  # a window begins at the sample nearest to its period
        delay = self.rng.integers(DELAYS.size, size=load.size)
        v = self.sigma * self.rng.standard_normal((load.size, self.size), dtype=np.float32)
        for at in range(load.size):
            v[at] += amplitude[:, at].astype(np.float32) @ self.voltage[load[at]][delay[at], third]
        return (self.step * np.rint(v / self.step)).astype(float)
