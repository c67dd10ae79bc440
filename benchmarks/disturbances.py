"""What a laboratory adds to a voltage, and loads that are not one resistor and capacitor."""

import dataclasses
import math
from collections.abc import Callable

import numpy as np
from jaxtyping import Complex, Float

from etid.simulation.transformer import Impedance, Sampler, SkinLoad, TransformerDriver

Volts = Float[np.ndarray, " time"]
Added = Callable[[Volts, np.random.Generator], Volts]
"""A voltage at the converter [V] that does not come from the driver, at times [s]."""

ROUNDS = 60  # of a fixed point that gains a factor of 1.5 at least


def hum(
    frequency: float,
    amplitude: float,
    harmonics: tuple[int, ...] = (),
    phase: float | None = None,
) -> Added:
    """A sine [Hz, V], and its harmonics at a third of its amplitude each.

    Its phase [turns] is drawn for each record if it is not given.
    """

    def volts(time: Volts, rng: np.random.Generator) -> Volts:
        turns = frequency * time + (rng.random() if phase is None else phase)
        total = amplitude * np.sin(2 * np.pi * turns)
        for number in harmonics:
            own = number * turns + rng.random()
            total = total + amplitude / 3 * np.sin(2 * np.pi * own)
        return total

    return volts


def offset(volts: float) -> Added:
    """A constant voltage."""
    return lambda time, _: np.full(time.shape, volts)


def spike(height: float, width: float, rectangular: bool = False) -> Added:
    """Half a sine [V, s] at a random place, as when a hand moves; or a rectangle."""

    def volts(time: Volts, rng: np.random.Generator) -> Volts:
        place = (time - rng.uniform(0.0, time[-1] - width)) / width
        shape = 1.0 if rectangular else np.sin(np.pi * np.clip(place, 0, 1))
        return np.where((place > 0) & (place < 1), height * shape, 0.0)

    return volts


def tail(height: float, time_constant: float, end: float, period: float) -> Added:
    """An exponential [V, s] after the end of every pulse, as dielectric absorption leaves it."""

    def volts(time: Volts, _: np.random.Generator) -> Volts:
        since = np.mod(time - end, period)
        before = 1 - np.exp(-period / time_constant)  # what is left of earlier tails
        return height * np.exp(-since / time_constant) / before

    return volts


def pink(rms: float) -> Added:
    """Noise with a power of 1/f above the first frequency of the record, and this rms [V]."""

    def volts(time: Volts, rng: np.random.Generator) -> Volts:
        white = np.fft.rfft(rng.standard_normal(time.size))
        white[0] = 0.0
        white[1:] /= np.sqrt(np.arange(1, white.size))
        found = np.fft.irfft(white, time.size)
        return rms * found / np.std(found)

    return volts


@dataclasses.dataclass(frozen=True)
class Leaky:
    """A load with a resistor across it."""

    load: Impedance  # the load
    r: float  # the resistor [ohm]

    def __call__(self, f: Float[np.ndarray, " f"]) -> Complex[np.ndarray, " f"]:
        """Impedance [ohm] at frequencies f [Hz]."""
        z = self.load(f)
        return z * self.r / (z + self.r)


@dataclasses.dataclass(frozen=True)
class Nonlinear:
    """Terminal voltage with skin whose R_p falls with the voltage v across it.

    R_p(v) = R_p / (1 + k (v / v₀)²), v₀ the peak of v, so that R_p is (1 − fall) R_p there. The
    current that it takes in excess of v / R_p is a source beside the linear circuit, a fixed point
    of

        V_p = Z_p (I − I_excess),   I = (V_th + Z_p I_excess) / (Z_th + R_s + Z_p).
    """

    skin: SkinLoad  # its elements at small voltages
    fall: float  # part of R_p that is lost at the peak

    def __call__(self, driver: TransformerDriver, sampler: Sampler) -> Complex[np.ndarray, " f"]:
        """Fourier coefficients [V] of the terminal voltage."""
        of = self.skin
        f = np.concatenate([[0.0], sampler.f])
        z_th, z_p = driver.z_th(f), of.r_p / (1 + 2j * np.pi * f * of.r_p * of.c_p)
        v_th = sampler.pulse_rate * driver.v_th_spectrum(f)  # 0 at 0 Hz, as of any transformer
        grid = 2 ** math.ceil(math.log2(2 * f.size))
        curve = self.fall / (1 - self.fall)
        excess, total = np.zeros(f.size, complex), z_th + of.r_s + z_p
        for _ in range(ROUNDS):
            current = (v_th + z_p * excess) / total
            v = np.fft.irfft(z_p * (current - excess), grid, norm="forward")
            more = curve * (v / np.abs(v).max()) ** 2 * v / of.r_p
            excess = np.fft.rfft(more, norm="forward")[: f.size]
        return (v_th - z_th * (v_th + z_p * excess) / total)[1:]
