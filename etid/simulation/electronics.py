"""What stands between the terminal and the file: an amplifier, its filter and a converter.

    · scale → + noise of the amplifier → anti-alias filter → sampling → + offset → + hum → · gain
    → nonlinearity → + noise of the converter → rounding to a code, clipped at the full scale

The noise of the amplifier is white, with 1/f noise below a corner. It passes the same analog filter
as the signal, and sampling folds what is left above half the sample rate. A sampled record of it is
a stationary Gaussian sequence with the power

    S(f) = σ² Σ_m |H(f + m f_s)|² (1 + f_c / |f + m f_s|) / mean of Σ_m |H(f + m f_s)|²

(Papoulis, Probability, Random Variables and Stochastic Processes, chapter 9), which is made here by
its spectrum, twice as long as the record: a record is no period of its noise.

`INSTRUMENTS` has instruments that exist, as settings of `etid.scenes.Scene`.
"""

import dataclasses
import functools
import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Complex, Float

FILTERS = ("butterworth", "delta_sigma", "average")

# Harmonics are summed up to this multiple of the corner of a filter of order 4, where its gain is
# 3e-6. Higher harmonics add less than 1e-6 V to a 50 V pulse, 1/1000 of a 16-bit step.
_BANDWIDTH = 25
# [Hz] A pulse has less than 1e-5 V above this frequency, with any filter.
_NOTHING = 5e6
# Half-width of the transition of a decimation filter, relative to its corner.
_TRANSITION = 0.093
# sinc² is one half here [cycles]: the corner of a mean over a time, times that time.
_HALF_POWER = 0.442946
_GRID = 2048  # frequencies of a mean over the band of a record


@dataclasses.dataclass(frozen=True)
class Electronics:
    """Amplifier, filter and converter of a scene whose noise comes before the filter.

    The corner of the filter is `Scene.antialias`, the size of the amplifier's noise in a sample
    `Scene.snr_db`; `Electronics()` is the usual filter behind a noisy amplifier.

    Args:
        filter_type: `butterworth`; `delta_sigma`, a decimation filter with a gain of 1 up to 0.907
            of the corner, of 0 from 1.093 on, and no phase; or `average`, the mean over a time
            around each sample, as an oscilloscope takes it to gain resolution.
        filter_order: Order of the Butterworth filter.
        noise_corner: Frequency below which the amplifier has more 1/f noise than white noise [Hz].
        converter_noise: Standard deviation of white noise behind the filter [V at the converter].
        nonlinearity: Largest deviation from the straight line through both ends of the range,
            relative to `Scene.full_scale`: a sine, whose zeros are the ends and the middle.
        gain_drift: Standard deviation of the gain, drawn for each record.
        hum: Amplitude of the mains hum, whose phase is drawn for each record [V at the converter].
        hum_rate: Its frequency [Hz].
    """

    filter_type: str = "butterworth"
    filter_order: int = 4
    noise_corner: float = 0.0
    converter_noise: float = 0.0
    nonlinearity: float = 0.0
    gain_drift: float = 0.0
    hum: float = 0.0
    hum_rate: float = 50.0

    def __post_init__(self) -> None:
        if self.filter_type not in FILTERS:
            raise ValueError(
                f"filter_type is {self.filter_type!r}; use one of {', '.join(FILTERS)}"
            )
        if not 1 <= self.filter_order <= 12:
            raise ValueError(f"filter_order is {self.filter_order}; use 1 to 12")
        for field in dataclasses.fields(self)[2:]:
            value = getattr(self, field.name)
            if not (value >= 0 and math.isfinite(value)):
                raise ValueError(f"{field.name} is {value}; it must be finite and not negative")

    def response(self, f: Float[np.ndarray, " f"], corner: float) -> Complex[np.ndarray, " f"]:
        """Gain of the filter.

        Args:
            f: Frequencies, positive or negative [Hz].
            corner: Half-power frequency of the filter; that of a gain of one half of `delta_sigma`
                [Hz].
        """
        if self.filter_type == "average":
            return np.sinc(f * _HALF_POWER / corner) + 0j
        if self.filter_type == "delta_sigma":
            place = (np.abs(f) / corner - 1) / _TRANSITION
            return 0.5 - 0.5 * np.sin(np.pi / 2 * np.clip(place, -1, 1)) + 0j
        return _butterworth(f / corner, self.filter_order)

    def reach(self, corner: float) -> float:
        """Frequency above which the filter with this corner passes nothing of a pulse [Hz]."""
        if self.filter_type == "delta_sigma":
            return (1 + _TRANSITION) * corner
        order = self.filter_order if self.filter_type == "butterworth" else 1
        return min(_BANDWIDTH ** (4 / order) * corner, _NOTHING)

    def noise_power(
        self, f: Float[np.ndarray, " f"], corner: float, sample_rate: float
    ) -> Float[np.ndarray, " f"]:
        """Power of the amplifier's noise in a sampled record.

        Args:
            f: Frequencies; those above half the sample rate are folded [Hz].
            corner: Corner of the filter [Hz].
            sample_rate: Samples per second [Hz].

        Returns:
            Power relative to that of white noise whose samples have the standard deviation of the
            amplifier's, its 1/f noise aside. At 0 Hz, where 1/f noise has no limit, without it.
        """
        grid = (np.arange(_GRID) + 0.5) / _GRID * sample_rate
        mean = np.mean(self._folded(grid, corner, sample_rate, 0.0))
        return self._folded(f, corner, sample_rate, self.noise_corner) / mean

    def _folded(
        self, f: Float[np.ndarray, " f"], corner: float, sample_rate: float, noise_corner: float
    ) -> Float[np.ndarray, " f"]:
        inside = np.mod(f + sample_rate / 2, sample_rate) - sample_rate / 2
        total = np.zeros(f.shape)
        folds = math.ceil(self.reach(corner) / sample_rate) + 1
        for fold in range(-folds, folds + 1):
            at = inside + fold * sample_rate
            white = np.abs(self.response(at, corner)) ** 2
            flicker = np.divide(noise_corner, np.abs(at), out=np.zeros(f.shape), where=at != 0)
            total += white * (1 + flicker)
        return total

    def noise(
        self,
        rng: np.random.Generator,
        sigma: float,
        shape: tuple[int, ...],
        corner: float,
        sample_rate: float,
    ) -> Float[np.ndarray, "*record time"]:
        """Noise of the amplifier behind the filter.

        Args:
            rng: Source of random numbers.
            sigma: Standard deviation of a sample, the 1/f noise aside.
            shape: Of the records; the last axis is time.
            corner: Corner of the filter [Hz].
            sample_rate: Samples per second [Hz].

        Returns:
            Records in the unit of `sigma`.
        """
        # At least 64 samples more: the filters here ring no longer.
        length = 2 * shape[-1] + 64
        white = np.fft.rfft(rng.standard_normal((*shape[:-1], length)))
        shaped = np.fft.irfft(white * _shape(self, length, corner, sample_rate), length)
        return sigma * shaped[..., : shape[-1]]

    def measured(
        self,
        volts: Float[np.ndarray, " time"],
        rng: np.random.Generator,
        sigma: float,
        corner: float,
        sample_rate: float,
        full_scale: float,
    ) -> Float[np.ndarray, " time"]:
        """A voltage as the converter sees it.

        Args:
            volts: The signal behind the filter [V at the converter].
            rng: Source of random numbers.
            sigma: Standard deviation of the amplifier's noise in a sample [V at the converter].
            corner: Corner of the filter [Hz].
            sample_rate: Samples per second [Hz].
            full_scale: End of the range [V at the converter].
        """
        # Draw also if the factor is 0: scenes with and without an effect then have the same noise.
        gain, phase = 1 + self.gain_drift * rng.standard_normal(), rng.random()
        turns = self.hum_rate / sample_rate * np.arange(volts.size) + phase
        seen = volts + self.hum * np.sin(2 * np.pi * turns)
        seen = gain * (seen + self.noise(rng, sigma, volts.shape, corner, sample_rate))
        bend = np.sin(np.pi * np.clip(seen / full_scale, -1, 1))
        seen = seen + self.nonlinearity * full_scale * bend
        return seen + self.converter_noise * rng.standard_normal(volts.size)


@functools.lru_cache(maxsize=16)
def _shape(
    electronics: Electronics, length: int, corner: float, sample_rate: float
) -> Float[np.ndarray, " f"]:
    """Amplitude of the noise at the frequencies of a transform of so many samples."""
    f = np.fft.rfftfreq(length, 1 / sample_rate)
    return np.sqrt(electronics.noise_power(f, corner, sample_rate))


def _butterworth(f: Float[np.ndarray, " f"], order: int) -> Complex[np.ndarray, " f"]:
    """Gain of the Butterworth filter whose corner is 1."""
    poles = np.exp(0.5j * np.pi * ((2 * np.arange(order) + 1) / order + 1))
    return 1 / np.prod([1j * f - pole for pole in poles], axis=0)


INSTRUMENTS: Mapping[str, Mapping[str, Any]] = MappingProxyType(
    {
        # NI 6225, 16 bits, no filter: NI 6225 Specifications (M Series), AI Absolute Accuracy at
        # ±10 V: random noise 244 µV rms, INL 76 ppm of range; per °C 25 ppm of gain and 57 ppm of
        # range of offset, here with 0.1 °C between two records; timing accuracy 50 ppm (NI 6255
        # Specifications, of the same series). To be checked against the sheet: bandwidth 700 kHz.
        "multifunction_card": {
            "electronics": Electronics(
                filter_order=1, converter_noise=244e-6, nonlinearity=76e-6, gain_drift=2.5e-6
            ),
            "antialias": 3.5,
            "offset_rms": 57e-6,
            "pulse_rate_ppm": 50.0,
            "bits": 16,
            "full_scale": 10.0,
        },
        # NI PXI-4461, 24 bits, 204.8 kS/s: NI PXI-4461 Specifications, range of ±10 V: alias-free
        # up to 0.4535 of the sample rate, nothing from 0.5465 on; dynamic range 118 dB, of a sine
        # of full scale; clock 20 ppm.
        "delta_sigma_card": {
            "electronics": Electronics(filter_type="delta_sigma", converter_noise=9e-6),
            "antialias": 0.5,
            "pulse_rate_ppm": 20.0,
            "bits": 24,
            "full_scale": 10.0,
        },
        # Tektronix DPO3000, 8 bits: MSO3000 and DPO3000 Series Oscilloscopes User Manual, Warranted
        # Specifications: with the limit of 20 MHz, noise and rounding together below 5 % of a
        # division, here 2.2 %, noise of half a step; clock 10 ppm. INL below one step: TDS5000B
        # Series Specifications, table 1-2. Ten divisions of 0.8 V.
        "oscilloscope_8_bit": {
            "electronics": Electronics(converter_noise=0.015, nonlinearity=1 / 128),
            "antialias": 5.0,  # a pulse has nothing above 1 MHz, and noise is folded
            "pulse_rate_ppm": -10.0,
            "bits": 8,
            "full_scale": 4.0,
        },
        # Tektronix TDS7000B in Hi Res mode: CSA7000B Series & TDS7000B Series Instruments User
        # Manual, table 3-1: the mean of all samples in an interval, kept with 16 bits, of which
        # 12.14 are effective at 250 kS/s. Clock 15 ppm: TDS5000B Series Specifications, table 1-3.
        "oscilloscope_12_bit": {
            "electronics": Electronics(
                filter_type="average", converter_noise=8.0 / 2**12.14 / math.sqrt(12)
            ),
            "antialias": 0.442946,  # of a mean over one interval
            "pulse_rate_ppm": 15.0,
            "bits": 16,
            "full_scale": 4.0,
        },
    }
)
"""Settings of a `Scene` for instruments that exist, by kind: figures of their data sheets."""
