"""The extended Kalman filter of filterpy with the model of `etid.Tracker`, for its time.

Same bands, same circuit, same random walk, derivatives in closed form, one filter for each
electrode as filterpy is made for. It is told the sampling phase of each pulse: an extended Kalman
filter has no search over delays. It has no tests for changes and no verdicts.
"""

import importlib
import time

import numpy as np
from jaxtyping import Complex, Float

import etid

DELAY = 0.1  # [samples] standard deviation of a pulse's delay besides its sampling phase


class Rival:
    """One filter for each electrode.

    Args:
        tracker: Tracker of `SkinRC` whose model is used.
        start: Logarithms of the elements at which each filter starts.

    Raises:
        ImportError: filterpy is not installed (`pip install etid[bench]`).
    """

    def __init__(self, tracker: etid.Tracker, start: Float[np.ndarray, "lane element"]) -> None:
        filterpy = importlib.import_module("filterpy.kalman")
        bands = tracker.model.bands
        self.tracker = tracker
        self.s = 2j * np.pi * np.asarray(bands.frequency)
        self.turn = np.asarray(tracker.model.turn)
        self.source, self.weight = np.asarray(tracker.model.source), np.asarray(bands.weight)
        self.filters = []
        for logs in start:
            one = filterpy.ExtendedKalmanFilter(dim_x=4, dim_z=2 * self.s.size)
            one.x, one.P = np.append(logs, 0.0), np.diag([0.1, 0.1, 0.1, DELAY]) ** 2
            self.filters.append(one)
        self.walk = np.diag([float(tracker.change)] * 3 + [0.0]) ** 2

    def update(self, v_out: Float[np.ndarray, "lane sample"], phase: float) -> float:
        """One pulse at all electrodes.

        Args:
            v_out: One window per electrode [V].
            phase: Known part of the delay [samples].

        Returns:
            Processor's time without that of the bands [s].
        """
        seen = self.tracker.projection.seen(v_out, self.tracker.adc_range)
        begin = time.process_time()
        real, imaginary = np.split(np.asarray(seen.gain), 2, axis=1)
        gains = (real + 1j * imaginary) * np.exp(1j * self.turn * phase)
        for one, gain, variance in zip(self.filters, gains, np.asarray(seen.variance), strict=True):
            # Each pulse has a delay of its own.
            one.x[3], one.P[3], one.P[:, 3], one.P[3, 3] = 0.0, 0.0, 0.0, DELAY**2
            one.P = one.P + self.walk
            one.R = np.diag(np.tile(variance / self.weight, 2))
            one.update(_parts(gain), self._slope, self._expected)
        return time.process_time() - begin

    def _load(self, x: np.ndarray) -> tuple[Complex[np.ndarray, " band"], list[np.ndarray]]:
        """Z_L and its derivatives with respect to the logarithms of R_s, R_p, C_p."""
        r_s, r_p, c_p = np.exp(x[:3])
        low = 1 / (1 + self.s * r_p * c_p)
        return r_s + r_p * low, [
            np.full(self.s.size, r_s + 0j),
            r_p * low**2,
            -self.s * c_p * (r_p * low) ** 2,
        ]

    def _expected(self, x: np.ndarray) -> Float[np.ndarray, " part"]:
        z, _ = self._load(x)
        return _parts(z / (z + self.source) * np.exp(-1j * self.turn * x[3]))

    def _slope(self, x: np.ndarray) -> Float[np.ndarray, "part own"]:
        z, by_element = self._load(x)
        delayed = np.exp(-1j * self.turn * x[3])
        slope = self.source / (z + self.source) ** 2 * delayed
        by_delay = -1j * self.turn * z / (z + self.source) * delayed
        return np.stack([_parts(slope * one) for one in by_element] + [_parts(by_delay)], axis=1)


def _parts(values: Complex[np.ndarray, " band"]) -> Float[np.ndarray, " part"]:
    """Real parts, then imaginary parts."""
    return np.concatenate([np.real(values), np.imag(values)])
