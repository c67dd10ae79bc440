"""What a laboratory adds to a voltage, and loads that are not one resistor and capacitor."""

import dataclasses
import math

import numpy as np
from jaxtyping import Complex, Float

from etid.simulation.transformer import Impedance, Sampler, SkinLoad, TransformerDriver

Volts = Float[np.ndarray, " time"]
ROUNDS = 60  # of a fixed point that gains a factor of 1.5 at least


@dataclasses.dataclass(frozen=True)
class Hum:
    """A sine, and its harmonics at a third of its amplitude each."""

    frequency: float  # of the sine [Hz]
    amplitude: float  # at the converter [V]
    harmonics: tuple[int, ...] = ()  # multiples of the frequency that come with it
    phase: float | None = None  # in turns; drawn for each record if it is None

    def __call__(self, time: Volts, rng: np.random.Generator) -> Volts:
        """Volts at these times [s]."""
        turns = self.frequency * time + (rng.random() if self.phase is None else self.phase)
        total = self.amplitude * np.sin(2 * np.pi * turns)
        for number in self.harmonics:
            own = number * turns + rng.random()
            total = total + self.amplitude / 3 * np.sin(2 * np.pi * own)
        return total


@dataclasses.dataclass(frozen=True)
class Offset:
    """A constant voltage."""

    volts: float  # at the converter [V]

    def __call__(self, time: Volts, rng: np.random.Generator) -> Volts:
        """Volts at these times [s]."""
        return np.full(time.shape, self.volts)


@dataclasses.dataclass(frozen=True)
class Spike:
    """Half a sine at a random place in one of the periods, as when a hand moves; or a rectangle."""

    height: float  # at the converter [V]
    width: float  # from its begin to its end [s]
    rectangular: bool = False

    def __call__(self, time: Volts, rng: np.random.Generator) -> Volts:
        """Volts at these times [s]."""
        begin = rng.uniform(0.0, time[-1] - self.width)
        place = (time - begin) / self.width
        inside = (place > 0) & (place < 1)
        shape = 1.0 if self.rectangular else np.sin(np.pi * np.clip(place, 0, 1))
        return np.where(inside, self.height * shape, 0.0)


@dataclasses.dataclass(frozen=True)
class Tail:
    """An exponential tail after every pulse, as dielectric absorption leaves it."""

    height: float  # at the end of a pulse [V at the converter]
    time_constant: float  # [s]
    end: float  # of the first pulse [s]
    period: float  # [s]

    def __call__(self, time: Volts, rng: np.random.Generator) -> Volts:
        """Volts at these times [s]."""
        since = np.mod(time - self.end, self.period)
        before = 1 - np.exp(-self.period / self.time_constant)  # what is left of earlier tails
        return self.height * np.exp(-since / self.time_constant) / before


@dataclasses.dataclass(frozen=True)
class Pink:
    """Noise with a power of 1/f above the first frequency of the record."""

    rms: float  # effective value at the converter [V]

    def __call__(self, time: Volts, rng: np.random.Generator) -> Volts:
        """Volts at these times [s]."""
        white = np.fft.rfft(rng.standard_normal(time.size))
        white[0] = 0.0
        white[1:] /= np.sqrt(np.arange(1, white.size))
        found = np.fft.irfft(white, time.size)
        return self.rms * found / np.std(found)


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
class Shunted:
    """A load with a capacitor across it."""

    load: Impedance  # the load
    c: float  # the capacitor [F]

    def __call__(self, f: Float[np.ndarray, " f"]) -> Complex[np.ndarray, " f"]:
        """Impedance [ohm] at frequencies f [Hz]."""
        z = self.load(f)
        return z / (1 + 2j * np.pi * f * self.c * z)


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
