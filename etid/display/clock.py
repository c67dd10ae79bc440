"""When the pulses of a stimulator come, counted in samples of a converter with its own quartz.

Two quartzes differ by up to 100 ppm, a third of a sample from pulse to pulse. The clock is a Kalman
filter of three states: how late the pulses are [samples], how much later each is than the one
before, and a constant that each measurement contains: loads delay a pulse by up to a sample, as the
trigger of the unloaded record did. What it follows are changes since the stream began.

**A measurement** is the place of the largest correlation between the sum of all electrodes and a
typical pulse. It needs no model of the load. Windows without such a pulse are no measurement; the
clock goes on with what it knows.

**Pulses that are elsewhere**, after lost samples or a long rest, have left the delays that a pulse
may have (`etid.display.pulse_fit.DELAYS`). Two such pulses that agree move the clock.
"""

import math

import numpy as np
from jaxtyping import Float

from etid.display.pulse_fit import DELAYS

SMOOTH = 0.1  # of the sample rate: a pulse is compared below it, so that its correlation is round
LIKE = 0.5  # least coefficient of correlation of a pulse
APART = 1e-4  # standard deviation of the ratio of two quartzes, less 1
WANDER = 1e-9  # standard deviation of its change from pulse to pulse
SPREAD = 0.2  # [samples] of one measurement: noise, and a trigger that jitters
OFFSET = 0.5  # [samples] by loads, other than the typical one
BESIDE = 0.6  # [samples] that a pulse may be beside its window; no noise moves windows then


class Place:
    """Finds where a pulse is in a window.

    Args:
        pulse: A typical pulse [V].

    Attributes:
        samples: Length of a window [samples].
    """

    def __init__(self, pulse: Float[np.ndarray, " sample"]) -> None:
        self.samples = pulse.size
        self._used = slice(1, int(SMOOTH * pulse.size) + 1)
        spectrum = np.fft.rfft(pulse)[self._used]
        self._conjugate = spectrum.conj()
        self._size = np.sqrt(2 * np.sum(np.abs(spectrum) ** 2))

    def late(self, window: Float[np.ndarray, "lane sample"]) -> float:
        """How much later the pulse is than the typical one [samples]; NaN if there is none."""
        with np.errstate(invalid="ignore", over="ignore"):
            total = window.sum(axis=0)
            if not np.isfinite(total).all():  # some electrodes have no numbers
                total = window[np.isfinite(window).all(axis=1)].sum(axis=0)
        spectrum = np.fft.rfft(total)[self._used]
        product = np.zeros(self.samples // 2 + 1, complex)
        product[self._used] = spectrum * self._conjugate
        alike = np.fft.irfft(product, self.samples)
        at, size = int(alike.argmax()), np.sqrt(2 * np.sum(np.abs(spectrum) ** 2))
        if not alike[at] * self.samples > LIKE * self._size * size:
            return math.nan
        before, top, after = alike[[at - 1, at, (at + 1) % self.samples]]
        at += 0.5 * (before - after) / (before - 2 * top + after)
        return at - self.samples if at > self.samples / 2 else at


class Clock:
    """Where each window of a pulse begins.

    Args:
        period: Nominal length of a period [samples].
        pulse: A typical pulse in a window [V].

    Attributes:
        period: Nominal length of a period [samples].
        samples: Length of a window [samples].
        number: Number of the pulse that comes next.
    """

    def __init__(self, period: float, pulse: Float[np.ndarray, " sample"]) -> None:
        self.period, self.samples, self.number = period, pulse.size, 0
        self._place = Place(pulse)
        self._state, self._cov = np.zeros(3), np.diag([0.0, (APART * period) ** 2, OFFSET**2])
        self._elsewhere, self._shift = math.nan, 0

    @property
    def place(self) -> float:
        """Where the next pulse begins [samples since the start]."""
        return self.number * self.period + self._state[0]

    @property
    def begin(self) -> int:
        """First sample of the next window."""
        return round(self.number * self.period) + self._shift

    def skip(self, pulses: int) -> None:
        """Go on by some pulses."""
        self.number += pulses
        forward = np.eye(3)
        forward[0, 1] = pulses
        self._state = forward @ self._state
        self._cov = forward @ self._cov @ forward.T
        self._cov[1, 1] += pulses * (WANDER * self.period) ** 2
        if abs(self._state[0] - self._shift) > BESIDE:
            self._shift = round(self._state[0])

    def restart(self, number: int) -> None:
        """Begin anew with a pulse at its nominal place; the quartzes remain what they are."""
        self.number, self._state[0], self._elsewhere, self._shift = number, 0.0, math.nan, 0
        self._cov[0, :] = self._cov[:, 0] = 0.0

    def follow(self, window: Float[np.ndarray, "lane sample"]) -> None:
        """Measure where the pulse of a window was, and go on to the next one."""
        late = self._place.late(window)
        if math.isfinite(late):
            self._corrected(self.begin + late - self.place)
        self.skip(1)

    def _corrected(self, measured: float) -> None:
        """Take a measurement of the place of the next pulse, relative to `place`."""
        off = measured - self._state[2]
        if abs(off) > DELAYS[-1]:
            if abs(off - self._elsewhere) < 1:
                self._state[0] += measured
                self._state[2], self._elsewhere = 0.0, math.nan
                self._cov[:, [0, 2]] = self._cov[[0, 2]] = 0.0
                self._cov[0, 0], self._cov[2, 2] = SPREAD**2, OFFSET**2
            else:
                self._elsewhere = off
            return
        self._elsewhere = math.nan
        seen = self._cov[:, 0] + self._cov[:, 2]
        gain = seen / (seen[0] + seen[2] + SPREAD**2)
        self._state = self._state + gain * off
        self._cov = self._cov - np.outer(gain, seen)
