"""filterpy's extended Kalman filter with etid's model: `python -m ... PROBLEM RESULT`.

The model is that of `etid.display.Tracker`, with derivatives in closed form, and one filter for
each electrode. It is told the sampling phase of each pulse and the gains of the bands, and has no
tests for changes. PROBLEM holds gains and their variances (pulse, lane, band), delays [samples] of
the pulses, the bands, the standard deviation of the random walk, and logarithms of the elements to
start from. RESULT gets the processor time of each pulse and the last logarithms.
"""

import time

import numpy as np
from filterpy.kalman import (  # pyright: ignore[reportMissingImports]  # see lmfit_leastsq
    ExtendedKalmanFilter,
)

from benchmarks.rivals import serve

DELAY = 0.1  # [samples] standard deviation of a pulse's delay besides its sampling phase


class Display:
    """One filter for each electrode."""

    def __init__(self, given):
        self.s, self.turn = 2j * np.pi * given["frequency"], given["turn"]
        self.source = given["source"]
        self.filters = []
        for logs in given["start"]:
            one = ExtendedKalmanFilter(dim_x=4, dim_z=2 * self.s.size)
            one.x, one.P = np.append(logs, 0.0), np.diag([0.1, 0.1, 0.1, DELAY]) ** 2
            self.filters.append(one)
        self.walk = np.diag([float(given["change"])] * 3 + [0.0]) ** 2

    def update(self, gains, variances, delay):
        """One pulse at all electrodes."""
        turned = gains * np.exp(1j * self.turn * delay)
        for one, gain, variance in zip(self.filters, turned, variances, strict=True):
            # Each pulse has a delay of its own.
            one.x[3], one.P[3], one.P[:, 3], one.P[3, 3] = 0.0, 0.0, 0.0, DELAY**2
            one.P = one.P + self.walk
            one.R = np.diag(np.tile(variance, 2))
            one.update(parts(gain), self.slope, self.expected)

    def load(self, x):
        """Z_L and its derivatives with respect to the logarithms of R_s, R_p, C_p."""
        r_s, r_p, c_p = np.exp(x[:3])
        low = 1 / (1 + self.s * r_p * c_p)
        return r_s + r_p * low, [
            np.full(self.s.size, r_s + 0j),
            r_p * low**2,
            -self.s * c_p * (r_p * low) ** 2,
        ]

    def expected(self, x):
        """Real and imaginary parts of the gain."""
        z, _ = self.load(x)
        return parts(z / (z + self.source) * np.exp(-1j * self.turn * x[3]))

    def slope(self, x):
        """Derivatives of `expected`."""
        z, by_element = self.load(x)
        delayed = np.exp(-1j * self.turn * x[3])
        slope = self.source / (z + self.source) ** 2 * delayed
        by_delay = -1j * self.turn * z / (z + self.source) * delayed
        return np.stack([parts(slope * one) for one in by_element] + [parts(by_delay)], axis=1)


def parts(values):
    return np.concatenate([np.real(values), np.imag(values)])


def solved(problem):
    display, seconds = Display(problem), []
    for pulse in zip(problem["gains"], problem["variances"], problem["delays"], strict=True):
        begin = time.process_time()
        display.update(*pulse)
        seconds.append(time.process_time() - begin)
    return {"seconds": seconds, "logs": [one.x[:3] for one in display.filters]}


if __name__ == "__main__":
    serve(solved)
