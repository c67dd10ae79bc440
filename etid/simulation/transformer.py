r"""A pulse transformer driving a load: exact steady state, sampled through an anti-alias filter.

The driver is a lumped circuit, solved at each frequency by nodal analysis (s = j2πf):

    v_s --R_src--p--R_1--L_1--+--(1:n)--R_2--L_2--s--R_prot--o
                 |            |                   |          |
                C_pri     L_m ‖ R_core          C_sec   C_cable ‖ C_div ‖ R_div
                 |            |                   |          |
                gnd          gnd                 gnd        gnd      and C_ww from p to s

Referred to the secondary, z_1 = n²(R_1 + sL_1), z_m = n²(sL_m ‖ R_core) and z_2 = R_2 + sL_2 form a
T circuit. Its admittances are finite at every frequency, including f = 0. Elimination of node p
leaves a Thévenin source at node s. R_prot and the shunt at node o complete the driver. Z_th has six
poles, and V_th has no direct voltage.

With a load Z_L the voltage is V_out = V_th · Z_L / (Z_L + Z_th) at every harmonic of the pulse
rate. A record is the sum of the harmonics at the sampling times. Nothing is discretised, so there
is no bias by discretisation.
"""

import dataclasses
import math
from collections.abc import Callable
from fractions import Fraction
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Array, Complex, Float

from etid.precision import namespace
from etid.printing import quantity
from etid.signals.transfer import AnyArray
from etid.simulation.electronics import Electronics

Impedance = Callable[[Float[np.ndarray, " f"]], Complex[AnyArray, " f"]]
"""A load: a function from frequencies [Hz] to impedance [ohm]."""

if TYPE_CHECKING:  # simulations compute with numbers
    Number = float
else:  # JAX may trace those of a bound
    Number = float | Float[Array, ""]

# [samples] Longest repeating block for one inverse FFT; a longer block is summed directly.
_MAX_BLOCK = 1_000_000


@dataclasses.dataclass(frozen=True)
class TransformerDriver:
    """Square-pulse source, 1:12 step-up transformer, protection resistor, measuring divider.

    The defaults are plausible for a small transformer with a metre of cable. They describe no
    particular device. A source pulse of 4.2 V becomes a pulse of 50 V. This pulse overshoots, rings
    at about 60 kHz and droops by 14 %. |Z_th| is 12.7 kΩ at 1 kHz and has a maximum of 39 kΩ near
    60 kHz.

    Args:
        amplitude: Height of the source pulse [V].
        width: Length of the source pulse at half height [s]; 4 % of a 60 Hz period.
        edge: Duration of each linear edge of the source pulse [s].
        lead_in: Time from the start of a period to the start of the rising edge [s].
        r_source: Output resistance of the pulse source [ohm].
        c_primary: Capacitance across the primary winding [F].
        r_primary: Resistance of the primary winding [ohm].
        l_primary: Leakage inductance of the primary winding [H].
        l_magnetising: Magnetising inductance, seen from the primary [H].
        r_core: Core loss, parallel to the magnetising inductance [ohm].
        turns: Secondary turns per primary turn.
        r_secondary: Resistance of the secondary winding [ohm].
        l_secondary: Leakage inductance of the secondary winding [H].
        c_secondary: Capacitance across the secondary winding [F].
        c_winding: Capacitance between the windings [F].
        r_protection: Series resistor that limits the current through the skin [ohm].
        c_cable: Capacitance of the cable to the electrodes [F].
        r_divider: Input resistance of the measuring divider [ohm].
        c_divider: Input capacitance of the measuring divider [F].
    """

    amplitude: Number = 4.2
    width: Number = 0.04 / 60.0
    edge: Number = 250e-9
    lead_in: Number = 120e-6
    r_source: Number = 30.0
    c_primary: Number = 80e-9
    r_primary: Number = 18.0
    l_primary: Number = 165e-6
    l_magnetising: Number = 0.19
    r_core: Number = 6.8e3
    turns: Number = 12.0
    r_secondary: Number = 1.2e3
    l_secondary: Number = 25e-3
    c_secondary: Number = 55e-12
    c_winding: Number = 6e-12
    r_protection: Number = 4.7e3
    c_cable: Number = 75e-12
    r_divider: Number = 2.2e6
    c_divider: Number = 24e-12

    def v_th_spectrum(self, f: Float[np.ndarray, " f"]) -> Complex[AnyArray, " f"]:
        """Fourier transform of one unloaded pulse, ∫ v_th(t) e^(−j2πft) dt.

        The Fourier coefficient of the harmonic at f is this transform times the pulse rate.

        Args:
            f: Frequencies [Hz].

        Returns:
            Spectrum at the terminal [V s].
        """
        xp = namespace(self.lead_in, self.width, self.edge)
        centre = self.lead_in + (self.width + self.edge) / 2
        trapezoid = self.width * xp.sinc(f * self.width) * xp.sinc(f * self.edge)
        source = self.amplitude * trapezoid * xp.exp(-2j * np.pi * f * centre)
        return source * self._thevenin(f)[0]

    def z_th(self, f: Float[np.ndarray, " f"]) -> Complex[AnyArray, " f"]:
        """Source impedance at the terminal.

        Args:
            f: Frequencies [Hz].

        Returns:
            Impedance [ohm].
        """
        return self._thevenin(f)[1]

    def branches(
        self, f: Float[np.ndarray, " f"]
    ) -> tuple[Complex[AnyArray, " f"], Complex[AnyArray, " f"], Complex[AnyArray, " f"]]:
        """z_1, z_m and z_2 of the T circuit, referred to the secondary.

        Args:
            f: Frequencies [Hz].

        Returns:
            Three impedances [ohm].
        """
        s = 2j * np.pi * f
        n = self.turns
        z_1 = n**2 * (self.r_primary + s * self.l_primary)
        z_m = n**2 * s * self.l_magnetising * self.r_core / (s * self.l_magnetising + self.r_core)
        return z_1, z_m, self.r_secondary + s * self.l_secondary

    def _thevenin(
        self, f: Float[np.ndarray, " f"]
    ) -> tuple[Complex[AnyArray, " f"], Complex[AnyArray, " f"]]:
        """Gain from the source to the open terminal, and the source impedance there [ohm]."""
        s = 2j * np.pi * f
        n = self.turns
        z_1, z_m, z_2 = self.branches(f)
        delta = z_1 * z_2 + z_1 * z_m + z_2 * z_m
        # Nodal matrix of p and s in real primary volts: the T circuit and what is connected to it.
        y_pp = (
            n**2 * (z_2 + z_m) / delta + 1 / self.r_source + s * (self.c_primary + self.c_winding)
        )
        y_ps = -n * z_m / delta - s * self.c_winding
        y_ss = (z_1 + z_m) / delta + s * (self.c_secondary + self.c_winding)
        y_s = y_ss - y_ps**2 / y_pp
        gain_s = -y_ps / (y_pp * self.r_source) / y_s
        z = 1 / y_s + self.r_protection
        loading = 1 + z * (1 / self.r_divider + s * (self.c_cable + self.c_divider))
        return gain_s / loading, z / loading


@dataclasses.dataclass(frozen=True)
class OpenLoad:
    """An open terminal: V_out = V_th."""

    def __call__(self, f: Float[np.ndarray, " f"]) -> Complex[np.ndarray, " f"]:
        """Infinite impedance at frequencies f [Hz]."""
        return np.full(f.shape, complex(math.inf))


@dataclasses.dataclass(frozen=True)
class ResistorLoad:
    """A known resistor.

    Args:
        r: Resistance [ohm].
    """

    r: Number

    def __str__(self) -> str:
        return quantity(self.r, "ohm")

    def __call__(self, f: Float[np.ndarray, " f"]) -> Complex[AnyArray, " f"]:
        """Impedance [ohm] at frequencies f [Hz]."""
        return self.r + np.zeros(f.shape, complex)


@dataclasses.dataclass(frozen=True)
class SkinLoad:
    """Skin under an electrode, R_s + R_p ‖ C_p (paper, eq. 7).

    Args:
        r_s: Series resistance [ohm].
        r_p: Parallel resistance [ohm].
        c_p: Parallel capacitance [F].
    """

    r_s: Number
    r_p: Number
    c_p: Number

    def __str__(self) -> str:
        units = {"r_s": "ohm", "r_p": "ohm", "c_p": "farad"}
        return ", ".join(f"{of} {quantity(getattr(self, of), unit)}" for of, unit in units.items())

    def __call__(self, f: Float[np.ndarray, " f"]) -> Complex[AnyArray, " f"]:
        """Impedance [ohm] at frequencies f [Hz]."""
        return self.r_s + self.r_p / (1 + 2j * np.pi * f * self.r_p * self.c_p)


def loading(
    z_load: Complex[np.ndarray, " f"], z_th: Complex[np.ndarray, " f"]
) -> Complex[np.ndarray, " f"]:
    """Ratio of loaded to unloaded voltage, V_out / V_th = Z_L / (Z_L + Z_th).

    Args:
        z_load: Impedance of the load [ohm]; infinite if the terminal is open.
        z_th: Source impedance [ohm].

    Returns:
        The ratio; 1 where the terminal is open.
    """
    ratio = np.ones(z_load.shape, complex)
    connected = ~np.isinf(z_load)
    ratio[connected] = z_load[connected] / (z_load + z_th)[connected]
    return ratio


class Sampler:
    """Samples periodic waveforms exactly, after an anti-alias filter.

    v_n = Σ_k c_k H(k f_0) e^(j2π k f_0 t_n),   t_n = start + n / sample_rate,   k = ±1, ±2, …

    The harmonics reach far beyond half the sample rate, so the record contains the aliases of a
    real converter. If a whole number of periods is a block of whole samples, one inverse FFT with
    folded harmonics gives the block, which is then repeated. Otherwise the sum is direct.

    Args:
        sample_rate: Samples per second [Hz].
        pulse_rate: Pulses per second f_0 [Hz].
        corner: Corner of the anti-alias filter [Hz].
        electronics: Its type and order; Butterworth of 4th order if not given.
    """

    def __init__(
        self,
        sample_rate: float,
        pulse_rate: float,
        corner: float,
        electronics: Electronics | None = None,
    ) -> None:
        filtering = electronics or Electronics()
        self.sample_rate = sample_rate
        self.pulse_rate = pulse_rate
        self.harmonics = np.arange(1, math.ceil(filtering.reach(corner) / pulse_rate) + 1)
        self.f = self.harmonics * pulse_rate
        self.antialias = filtering.response(self.f, corner)

    def rms(self, coefficients: Complex[AnyArray, " f"]) -> Number:
        """Effective value over one period of the voltage at the converter.

        Args:
            coefficients: Fourier coefficients c_k [V], before the anti-alias filter.

        Returns:
            Root mean square after the anti-alias filter [V].
        """
        at_converter = coefficients * self.antialias
        xp = namespace(at_converter)
        return xp.sqrt(2 * xp.sum(xp.abs(at_converter) ** 2))

    def sample(
        self, coefficients: Complex[np.ndarray, " f"], samples: int, start: float
    ) -> Float[np.ndarray, " samples"]:
        """Sample the waveform.

        Args:
            coefficients: Fourier coefficients c_k [V], before the anti-alias filter.
            samples: Number of samples.
            start: Time of the first sample after the start of a period [s].

        Returns:
            The record [V].
        """
        # Remove whole periods from the phase, so that it keeps its digits for any start time.
        turns = np.remainder(start * self.pulse_rate, 1.0) * self.harmonics
        c = coefficients * self.antialias * np.exp(2j * np.pi * turns)
        # str keeps the decimal value of a rate: 59.94 is 2997/50, its binary form is not.
        block = Fraction(str(self.sample_rate)) / Fraction(str(self.pulse_rate))
        if block.numerator <= _MAX_BLOCK:
            return self._folded(c, block, samples)
        return self._summed(c, samples)

    def _folded(
        self, c: Complex[np.ndarray, " f"], block: Fraction, samples: int
    ) -> Float[np.ndarray, " samples"]:
        """Repeated block of p samples = q periods, by an inverse FFT.

        Harmonic k falls on bin kq mod p.
        """
        p, q = block.numerator, block.denominator
        bins = self.harmonics * q % p
        spectrum = np.bincount(bins, np.real(c), p) + 1j * np.bincount(bins, np.imag(c), p)
        return np.resize(2 * p * np.real(np.fft.ifft(spectrum)), samples)

    def _summed(self, c: Complex[np.ndarray, " f"], samples: int) -> Float[np.ndarray, " samples"]:
        """Direct sum of the harmonics, for rates without a short common block.

        With 2kn = k² + n² − (k − n)² the sum is a convolution with a chirp (Bluestein 1970).
        """
        first = self.harmonics[-1]
        lag = np.arange(-first, samples)
        # Phases of 1e8 turns keep 1e-11 of a turn in extended precision.
        turns = (
            np.longdouble(self.pulse_rate) / self.sample_rate / 2 * lag.astype(np.longdouble) ** 2
        )
        chirp = np.exp(2j * np.pi * np.remainder(turns, 1).astype(float))
        own = np.concatenate([[0.0], c * chirp[first - self.harmonics]])
        size = 2 ** math.ceil(math.log2(lag.size + first))
        folded = np.fft.ifft(np.fft.fft(own, size) * np.fft.fft(np.conj(chirp), size))
        return 2 * np.real(folded[first : first + samples] * chirp[first:])
