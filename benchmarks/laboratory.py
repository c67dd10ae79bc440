"""Recordings as a laboratory makes them: every voltage has its own driver, load, clock and faults.

The waveforms are the exact ones of `etid.simulation.transformer`:

    pulses → driver and load → gain → anti-alias filter → sampling → · scale → + added voltages
    + noise → rounding to a code, clipped at the full scale.

The noise is white, or that of the electronics of an instrument.

Where the load differs from pulse to pulse, the records of each load are joined between the pulses.
The voltage is at rest there but for the 2 % of the droop that the transformer has left.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from jaxtyping import Complex, Float

from etid.circuits.directions import At, simulated
from etid.recordings.recording import Recording, Samples
from etid.simulation.scenes import Electronics, Scene
from etid.simulation.transformer import (
    Impedance,
    OpenLoad,
    Sampler,
    TransformerDriver,
    loading,
)

SCALE = Scene().scale  # volts at the converter per volt at the terminal
CORNER = Scene().antialias  # of the usual anti-alias filter, relative to the sample rate
TAYLOR = 3  # terms of a voltage at jittered times: the next is 1e-4 of a step at half a sample

Volts = Float[np.ndarray, " time"]
Added = Callable[[Volts, np.random.Generator], Volts]
"""A voltage at the converter [V] that does not come from the driver, at times [s]."""


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
    # what the voltage passes, with noise before the filter; white noise behind it if not given
    electronics: Electronics | None = None
    sampling_jitter: float = 0.0  # standard deviation of the time of every single sample [s]
    added: tuple[Added, ...] = ()  # voltages that are added at the converter
    faults: tuple[tuple[str, float], ...] = ()  # of `DIRECTIONS`, and their sizes
    # coefficients of the terminal voltage by sampler, where the load is not linear
    voltage: Callable[[TransformerDriver, Sampler], Complex[np.ndarray, " f"]] | None = None
    # number of a sample that the recorder loses; all later ones are one early
    lost: int | None = None
    # number of a sample that it stores twice; all later ones are one late
    doubled: int | None = None

    def sampler(self, sample_rate: float) -> Sampler:
        """Samples its waveform."""
        rates = sample_rate, self.pulse_rate / self.over
        return _sampler(*rates, self.antialias, self.electronics)

    def coefficients(self, load: Impedance, sampler: Sampler) -> Complex[np.ndarray, " f"]:
        """Fourier coefficients [V] with a load, before the anti-alias filter."""
        if self.voltage is not None:
            found = self.voltage(self.driver, sampler)
        else:
            v_th, z_th = _thevenin(self.driver, sampler)
            if self.faults:
                gain = simulated(At.behind(sampler.f, z_th, load), z_th, self.faults)
            else:
                gain = loading(np.asarray(load(sampler.f), complex), z_th)
            found = v_th * gain
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
        if self.lost is not None and self.lost < samples:
            whole = dataclasses.replace(self, lost=None).volts(sample_rate, samples + 1, rng)
            return np.delete(whole, self.lost)
        if self.doubled is not None and self.doubled < samples:
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
        if output.electronics is None:
            volts = volts + self.sigma * noise.standard_normal(self.samples)
        else:
            rates = output.antialias * self.sample_rate, self.sample_rate
            volts = output.electronics.measured(volts, noise, self.sigma, *rates, self.full_scale)
        half = 2 ** (self.bits - 1)
        step = self.full_scale / half
        codes = np.clip(np.rint(volts / step), -half, half - 1)
        if self.digits is not None:
            return Samples(
                np.array([float(f"{one:.{self.digits}g}") for one in codes * step / SCALE])
            )
        if not self.codes:
            return Samples(codes * step / SCALE)
        return Samples(codes.astype(np.int16 if self.bits <= 16 else np.int32), step / SCALE)


@functools.lru_cache(maxsize=16)
def _sampler(
    sample_rate: float,
    pulse_rate: float,
    antialias: float = CORNER,
    electronics: Electronics | None = None,
) -> Sampler:
    return Sampler(sample_rate, pulse_rate, antialias * sample_rate, electronics)


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


def drawn_noise(
    scene: Scene, sigma: float, rng: np.random.Generator, shape: tuple[int, ...]
) -> Float[np.ndarray, "*record time"]:
    """Noise of records of a scene, in the unit of the standard deviation of a sample."""
    if scene.electronics is None:
        return sigma * rng.standard_normal(shape, np.float32)
    corner = scene.antialias * scene.sample_rate
    return scene.electronics.noise(rng, sigma, shape, corner, scene.sample_rate)


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


def exponential(height: float, time_constant: float, end: float, period: float) -> Added:
    """An exponential [V, s] after the end of every pulse, as dielectric absorption leaves it."""

    def volts(time: Volts, _: np.random.Generator) -> Volts:
        since = np.mod(time - end, period)
        before = 1 - np.exp(-period / time_constant)  # what is left of earlier tails
        return height * np.exp(-since / time_constant) / before

    return volts


@dataclasses.dataclass(frozen=True)
class Flicker:
    """Noise of the power σ² f_c/f, which equals that of white noise at the corner frequency f_c."""

    sigma: float  # standard deviation of a sample of the white noise [V at the converter]
    corner: float  # f_c [Hz]

    def __call__(
        self, time: Float[np.ndarray, " time"], rng: np.random.Generator
    ) -> Float[np.ndarray, " time"]:
        """Volts at these times [s]."""
        white = np.fft.rfft(self.sigma * rng.standard_normal(time.size))
        white[0] = 0.0
        white[1:] *= np.sqrt(self.corner / np.fft.rfftfreq(time.size, time[1])[1:])
        return np.fft.irfft(white, time.size)


def pink(rms: float) -> Added:
    """Noise with a power of 1/f above the first frequency of the record, and this rms [V]."""

    def volts(time: Volts, rng: np.random.Generator) -> Volts:
        found = Flicker(1.0, 1.0)(time, rng)
        return rms * found / np.std(found)

    return volts


def leaky(load: Impedance, r: float) -> Impedance:
    """A load with a resistor [ohm] across it."""
    return lambda f: load(f) * r / (load(f) + r)
