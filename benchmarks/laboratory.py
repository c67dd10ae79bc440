"""Recordings as a laboratory makes them: every voltage has its own driver, load, clock and faults.

Each of the two voltages of a recording is an `Output` that can be changed alone, and a `Record` can
tell its file what is not true. The waveforms are the exact ones of `etid.simulation.transformer`:

    pulses → driver and load → gain → anti-alias filter → sampling → · scale → + added voltages
    + white noise → rounding to a code, clipped at the full scale.

Where the load differs from pulse to pulse, the records of each load are joined between the pulses.
The voltage is at rest there but for the 2 % of the droop that the transformer has left.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from jaxtyping import Complex, Float

from benchmarks.disturbances import Added
from etid.recordings.recording import Recording, Samples
from etid.simulation.scenes import Scene
from etid.simulation.transformer import Impedance, OpenLoad, Sampler, TransformerDriver, loading

SCALE = Scene().scale  # volts at the converter per volt at the terminal
CORNER = Scene().antialias  # of the usual anti-alias filter, relative to the sample rate
TAYLOR = 3  # terms of a voltage at jittered times: the next is 1e-4 of a step at half a sample


@dataclasses.dataclass(frozen=True)
class Output:
    """What one input of the converter sees."""

    driver: TransformerDriver  # what drives it
    # what is connected during each pulse; the last stays for all pulses that follow
    loads: tuple[Impedance, ...] = (OpenLoad(),)
    pulse_rate: float = 60.0  # true pulses per second [Hz]
    # times of the pulses in a record of `over` periods and their heights relative to the usual, if
    # they are not one in each period
    pulses: tuple[tuple[float, float], ...] = ()
    over: int = 1  # periods after which `pulses` repeat
    delay: float = 0.0  # of this record [s]; positive samples late
    gain: float = 1.0  # of the amplifier
    # corner of a further filter of first order before the converter [Hz], if any
    lowpass: float | None = None
    antialias: float = CORNER  # corner of the anti-alias filter, relative to the sample rate
    sampling_jitter: float = 0.0  # standard deviation of the time of every single sample [s]
    added: tuple[Added, ...] = ()  # voltages that are added at the converter
    # coefficients of the terminal voltage by sampler, where the load is not linear
    voltage: Callable[[TransformerDriver, Sampler], Complex[np.ndarray, " f"]] | None = None
    # number of a sample that the recorder loses; all later ones are one early
    lost: int | None = None
    # number of a sample that it stores twice; all later ones are one late
    doubled: int | None = None

    def sampler(self, sample_rate: float) -> Sampler:
        """Samples its waveform."""
        return _sampler(sample_rate, self.pulse_rate / self.over, self.antialias)

    def coefficients(self, load: Impedance, sampler: Sampler) -> Complex[np.ndarray, " f"]:
        """Fourier coefficients [V] with a load, before the anti-alias filter."""
        if self.voltage is not None:
            found = self.voltage(self.driver, sampler)
        else:
            v_th, z_th = _thevenin(self.driver, sampler)
            found = v_th * loading(np.asarray(load(sampler.f), complex), z_th)
        if self.pulses:
            turns = np.outer(sampler.harmonics, [time / self.over for time, _ in self.pulses])
            found = found * (np.exp(-2j * np.pi * turns) @ [height for _, height in self.pulses])
        if self.lowpass is not None:
            found = found / (1 + 1j * sampler.f / self.lowpass)
        return self.gain * found

    def volts(
        self, sample_rate: float, samples: int, rng: np.random.Generator
    ) -> Float[np.ndarray, " time"]:
        """Voltage at the converter [V], without noise."""
        if self.lost is not None:
            whole = dataclasses.replace(self, lost=None).volts(sample_rate, samples + 1, rng)
            return np.delete(whole, self.lost)
        if self.doubled is not None:
            whole = dataclasses.replace(self, doubled=None).volts(sample_rate, samples, rng)
            return np.insert(whole, self.doubled, whole[self.doubled])[:samples]
        sampler, time = self.sampler(sample_rate), np.arange(samples) / sample_rate
        early = self.sampling_jitter * rng.standard_normal(samples)
        of_load = []
        for load in self.loads:
            coefficients = self.coefficients(load, sampler)
            total = np.zeros(samples)
            for power in range(TAYLOR if self.sampling_jitter else 1):
                term = sampler.sample(coefficients, samples, self.delay)
                total += term * early**power / max(power, 1)  # 0!, 1!, 2!
                coefficients = coefficients * 2j * np.pi * sampler.f
            of_load.append(total)
        pulse = np.floor((time + self.delay) * self.pulse_rate).astype(int)
        used = np.clip(pulse, 0, len(of_load) - 1)
        volts = SCALE * np.stack(of_load)[used, np.arange(samples)]
        for added in self.added:
            volts = volts + added(time, rng)
        return volts


@dataclasses.dataclass(frozen=True)
class Record:
    """One recording to be made."""

    path: str  # its name in the study
    th: Output  # the unloaded voltage
    out: Output  # the loaded one
    sigma: float  # standard deviation of the noise of a sample [V at the converter]
    r_load: float | None = None  # resistor of a calibration [ohm], as the file tells it
    sample_rate: float = 200e3  # true samples per second [Hz]
    samples: int = 10_000  # length of the record
    full_scale: float = 10.0  # the converter clips at ± this voltage [V at the converter]
    bits: int = 16  # resolution of the converter
    codes: bool = True  # whether the file holds codes; else it holds volts, rounded as they are
    digits: int | None = None  # significant digits of volts in the file; None for all
    # what the file says in place of the truth, such as its sample rate
    told: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    swapped: bool = False  # whether the file has the two voltages in each other's place
    copied: bool = False  # whether the file has the loaded voltage in both places

    def recording(self, seed: int) -> Recording:
        """The recording; its random numbers depend on the seed and its path only."""
        # Noise has draws of its own, so that records with and without a fault have the same noise.
        rngs = np.random.default_rng([seed, *self.path.encode()]).spawn(2)
        th, out = (self._stored(of, rng) for of, rng in zip((self.th, self.out), rngs, strict=True))
        if self.copied:
            th = out
        if self.swapped:
            th, out = out, th
        half = 2.0 ** (self.bits - 1)
        step = self.full_scale / half / SCALE
        said = {
            "sample_rate": self.sample_rate,
            "pulse_rate": 60.0,
            "r_load": self.r_load,
            "adc_range": (-half * step, (half - 1) * step),
        }
        return Recording(th, out, **{**said, **self.told}, path=self.path)

    def _stored(self, output: Output, rng: np.random.Generator) -> Samples:
        noise, other = rng.spawn(2)
        volts = output.volts(self.sample_rate, self.samples, other)
        volts = volts + self.sigma * noise.standard_normal(self.samples)
        half = 2 ** (self.bits - 1)
        step = self.full_scale / half
        codes = np.clip(np.rint(volts / step), -half, half - 1)
        if self.digits is not None:
            return Samples(
                np.array([float(f"{one:.{self.digits}g}") for one in codes * step / SCALE])
            )
        if not self.codes:
            return Samples(codes * step / SCALE)
        return Samples(codes.astype(np.int16), step / SCALE)


@functools.lru_cache(maxsize=16)
def _sampler(sample_rate: float, pulse_rate: float, antialias: float = CORNER) -> Sampler:
    return Sampler(sample_rate, pulse_rate, antialias * sample_rate)


@functools.lru_cache(maxsize=64)
def _thevenin(
    driver: TransformerDriver, sampler: Sampler
) -> tuple[Complex[np.ndarray, " f"], Complex[np.ndarray, " f"]]:
    """Coefficients of V_th [V], one pulse in each of the sampler's periods, and Z_th [ohm]."""
    return sampler.pulse_rate * driver.v_th_spectrum(sampler.f), driver.z_th(sampler.f)


def noise(driver: TransformerDriver, sample_rate: float, snr_db: float) -> float:
    """Standard deviation of white noise [V at the converter], as `Scene.snr_db` defines it."""
    sampler = _sampler(sample_rate, 60.0)
    return SCALE * sampler.rms(_thevenin(driver, sampler)[0]) * 10 ** (-snr_db / 20)
