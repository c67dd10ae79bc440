"""Synthetic recordings: a transformer driver, loads, and the imperfections of a laboratory.

    study = etid.scenes.paper(snr_db=60).simulate(seed=0)

Each function named `paper…` returns a `Scene`, one experiment of the paper. `PRESETS` lists these
functions by name. Their keywords are the fields of `Scene`: noise, jitter, window, converter. A
scene is a frozen description. `Scene.simulate` makes the records; `Scene.truth` gives the true
elements.

As in the paper, every trial has its own unloaded record v_th. It is recorded at another pulse than
v_out, with its own noise, trigger delay and offset. Alternatively, all trials share one unloaded
record. The chain from circuit to file is

    exact periodic waveform → anti-alias filter → sampling at start + delay + n / sample_rate
    → · scale → + offset + white noise → rounding to a code, clipped at the full scale.

With `Electronics` the noise comes before the filter, and an instrument has hum, a drifting gain, a
nonlinearity and noise of its own; `INSTRUMENTS` has some that exist:

    study = etid.scenes.paper_dry(**etid.scenes.INSTRUMENTS["delta_sigma_card"]).simulate(seed=0)

A scene may also record the current through the load of each trial, with a delay and white noise of
its own.
"""

import collections
import dataclasses
import math
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float

from etid.circuits.circuit import AbstractCircuit
from etid.precision import in_float64, namespace
from etid.printing import Overview, Overviewed, several
from etid.recordings.fields import LABELS, tidy_path
from etid.recordings.recording import Recording, Samples
from etid.recordings.study import Study
from etid.signals.transfer import AnyArray
from etid.simulation.electronics import INSTRUMENTS as INSTRUMENTS
from etid.simulation.electronics import Electronics as Electronics
from etid.simulation.published import BUILT, FINGERTIPS, REFERENCE, TABLE_1, TYPICAL
from etid.simulation.transformer import (
    Impedance,
    Number,
    OpenLoad,
    ResistorLoad,
    Sampler,
    SkinLoad,
    TransformerDriver,
    loading,
)


@dataclasses.dataclass(frozen=True)
class Trial:
    """One recording to simulate.

    Args:
        path: Name of the recording in its study, such as `s01/dry/03`.
        load: The load: one of `etid.simulation.transformer`, a circuit, or any function from
            frequencies [Hz] to impedance [ohm].
        subject: Label of the person.
        session: Label of the day.
        site: Label of the finger.
        condition: State of the skin.
        electrode: Label of the electrode.
        trial: Label of the repetition.
    """

    path: str
    load: Impedance | AbstractCircuit
    subject: str = ""
    condition: str = ""
    electrode: str = ""
    trial: str = ""
    session: str = ""
    site: str = ""

    def __post_init__(self) -> None:
        if not self.path or tidy_path(self.path) != self.path:
            raise ValueError(
                f"{self.path!r} cannot name a trial; use a path without a slash at its start or "
                "end, such as 's01/dry/03'"
            )


@dataclasses.dataclass(frozen=True)
class Waveform:
    """Noise-free harmonics of a scene, and its noise.

    Attributes:
        f: Harmonics of the pulse rate [Hz], far beyond half the sample rate.
        v_th: Fourier coefficients of the unloaded voltage after the anti-alias filter [V].
        z_th: Source impedance [ohm].
        noise: Noise and rounding together, as the standard deviation of samples of white noise with
            their power at a harmonic [V].
        sigma: Standard deviation of a sample, from noise and rounding together, 1/f noise aside
            [V].
    """

    f: Float[np.ndarray, " f"]
    v_th: Complex[AnyArray, " f"]
    z_th: Complex[AnyArray, " f"]
    noise: Float[AnyArray, " f"]
    sigma: Number


@dataclasses.dataclass(frozen=True, repr=False)
class Scene(Overviewed):
    """A set of recordings with one driver.

    Args:
        trials: The recordings to identify.
        calibration: Recordings with known resistors; every trial refers to all of them.
        driver: The pulse transformer.
        sample_rate: Samples per second [Hz].
        pulse_rate: Nominal pulses per second [Hz]; the files contain this rate.
        pulse_rate_ppm: Deviation of the true pulse rate from the nominal one, measured by the
            converter's clock [1e-6]. The files do not contain it.
        samples: Length of a record [samples]; 10 000 are three periods.
        start: Time of the first sample after the start of a period [s].
        antialias: Corner of the anti-alias filter, relative to `sample_rate`. It is a Butterworth
            filter of 4th order if `electronics` does not say otherwise.
        snr_db: Effective value of the unloaded voltage over one period, after the anti-alias
            filter, relative to that of the noise of every record there [dB]; None for no noise.
        current_snr_db: The same ratio for the current through each trial, which is then recorded;
            None if it is not. The current is not rounded.
        trigger_jitter_rms: Standard deviation of the delay, drawn for each record [s]. A positive
            delay means late sampling.
        offset_rms: Standard deviation of the offset, drawn for each record [V at the converter].
        shared_v_th: Whether all trials and calibrations share one unloaded record and its noise.
        full_scale: The converter clips at ± this voltage [V at the converter].
        bits: Resolution of the converter [bit]; None stores unrounded volts at the converter.
        scale: Volts at the converter per volt at the terminal.
        electronics: The amplifier, whose noise passes the filter, and the errors of filter and
            converter. If None, the noise is white, as behind the filter.
    """

    trials: tuple[Trial, ...] = ()
    calibration: tuple[Trial, ...] = ()
    driver: TransformerDriver = dataclasses.field(default_factory=TransformerDriver)
    sample_rate: float = 200e3
    pulse_rate: float = 60.0
    pulse_rate_ppm: float = 0.0
    samples: int = 10_000
    start: float = 0.0
    antialias: float = 0.4
    snr_db: Number | None = 60.0
    current_snr_db: Number | None = None
    trigger_jitter_rms: float = 0.0
    offset_rms: float = 0.0
    shared_v_th: bool = False
    full_scale: float = 10.0
    bits: int | None = 16
    scale: float = 0.0535
    electronics: Electronics | None = None

    def _overview(self) -> Overview:
        labels = ("subject", "session", "site", "condition", "electrode", "trial")
        every = self.calibration + self.trials
        known = [name for name in labels if any(getattr(one, name) for one in every)]
        rows = [(one.path, str(one.load), *(getattr(one, name) for name in known)) for one in every]
        where = "" if self.electronics is None else " before the filter"
        noise = "no noise" if self.snr_db is None else f"noise at {self.snr_db:g} dB{where}"
        title = (
            f"Scene: {several(len(self.calibration), 'calibration')}, "
            f"{several(len(self.trials), 'trial')}, {several(self.samples, 'sample')} at "
            f"{self.sample_rate:g} Hz, pulses at {self.pulse_rate:g} Hz, {noise}"
        )
        return Overview(title, rows, ("path", "load", *known))

    def __post_init__(self) -> None:
        counts = collections.Counter(trial.path for trial in self.calibration + self.trials)
        twice = sorted(path for path, count in counts.items() if count > 1)
        if twice:
            raise ValueError(f"paths {twice} occur more than once; name each trial differently")
        for trial in self.calibration:
            if not isinstance(trial.load, ResistorLoad):
                raise ValueError(
                    f"calibration {trial.path!r} has the load {trial.load!r}; a calibration needs "
                    "a ResistorLoad. Move other loads to `trials`"
                )
        for name in ("sample_rate", "pulse_rate", "antialias", "full_scale", "scale"):
            value = getattr(self, name)
            if not (value > 0 and math.isfinite(value)):
                raise ValueError(f"{name} is {value}; it must be positive and finite")
        if self.antialias > 20:  # the number of harmonics grows with it
            raise ValueError(
                f"antialias is {self.antialias}; it is relative to sample_rate, at most 20, where "
                "the filter passes all that a pulse has"
            )
        for name in ("snr_db", "current_snr_db"):
            value = getattr(self, name)
            if value is not None and namespace(value) is np and not value > -math.inf:
                raise ValueError(f"{name} is {value}; give a number, or None")
        for name in ("trigger_jitter_rms", "offset_rms"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} is {getattr(self, name)}; it must not be negative")
        if not self.trigger_jitter_rms * self.pulse_rate < 0.5:
            raise ValueError(
                f"trigger_jitter_rms is {self.trigger_jitter_rms:g} s; it must be below half a "
                f"pulse period, {0.5 / self.pulse_rate:.3g} s"
            )
        if self.samples < 1:
            raise ValueError(f"samples is {self.samples}; a record has at least one sample")
        if self.bits is not None and not 2 <= self.bits <= 32:
            raise ValueError(f"bits is {self.bits}; use 2 to 32, or None to store volts")

    def truth(self) -> dict[str, dict[str, float]]:
        """Elements of every load by path [SI]; empty for an open circuit or a plain function."""
        return {trial.path: _elements(trial.load) for trial in self.calibration + self.trials}

    @in_float64
    def simulate(self, seed: int) -> Study:
        """Make the recordings.

        The random numbers of a record depend only on `seed` and its path. The same trial in two
        scenes therefore has the same draws, and differs only by the settings of the scenes.

        Args:
            seed: Seed of noise, delays and offsets.

        Returns:
            A study with one recording for each calibration and trial.
        """
        _, v_th, z_th, _ = self._exact()
        return self.record(seed, lambda trial, f: v_th * loading(_impedance(trial, f), z_th))

    @in_float64
    def record(
        self,
        seed: int,
        voltage: Callable[[Trial, Float[np.ndarray, " f"]], Complex[np.ndarray, " f"]],
    ) -> Study:
        """Make recordings of given terminal voltages, for example from a circuit simulator.

        Noise, delays and offsets are those of `simulate` with the same seed. The two studies differ
        only in the voltage.

        Args:
            seed: Seed of noise, delays and offsets.
            voltage: Function of a trial and the harmonics of the true pulse rate [Hz]. It returns
                the Fourier coefficients of the terminal voltage before the anti-alias filter [V].
                For the unloaded voltage it is called with a trial whose load is open.

        Returns:
            A study with one recording for each calibration and trial.
        """
        if seed < 0:
            raise ValueError(f"seed is {seed}; it must not be negative")
        sampler, _, _, sigma = self._exact()
        v_th = voltage(Trial("unloaded", OpenLoad()), sampler.f)
        resistances = {
            trial.path: trial.load.r
            for trial in self.calibration
            if isinstance(trial.load, ResistorLoad)  # always true; the type checker needs it
        }
        step, lowest, highest = self._converter()

        recordings = []
        common = np.random.default_rng([seed, *b"v_th"])
        unloaded = self._convert(sampler, v_th, sigma, common) if self.shared_v_th else None
        for trial in self.calibration + self.trials:
            draws = np.random.default_rng([seed, *trial.path.encode()]).spawn(3)
            r_load = resistances.get(trial.path)
            v_out = voltage(trial, sampler.f)
            current = None
            if self.current_snr_db is not None and r_load is None:
                flowing = v_out / _impedance(trial, sampler.f)
                current = self._measured_current(sampler, flowing, draws[2])
            recordings.append(
                Recording(
                    unloaded or self._convert(sampler, v_th, sigma, draws[0]),
                    self._convert(sampler, v_out, sigma, draws[1]),
                    current=current,
                    sample_rate=self.sample_rate,
                    pulse_rate=self.pulse_rate,
                    r_load=r_load,
                    **{name: getattr(trial, name) for name in LABELS},
                    calibration=tuple(resistances) if r_load is None else (),
                    adc_range=(lowest * step / self.scale, highest * step / self.scale),
                    path=trial.path,
                )
            )
        return Study.from_recordings(recordings)

    def waveform(self) -> "Waveform":
        """Noise-free harmonics of the records, and the noise of a sample."""
        sampler, v_th, z_th, sigma = self._exact()
        step = self._converter()[0] if self.bits is not None else 0.0
        own = 0.0 if self.electronics is None else self.electronics.converter_noise
        own = math.hypot(own, step / math.sqrt(12))
        xp = namespace(sigma)
        noise = xp.hypot(sigma * self.colour(sampler.f), own) / self.scale
        total = xp.hypot(sigma, own) / self.scale
        return Waveform(sampler.f, v_th * sampler.antialias, z_th, noise, total)

    def colour(self, f: Float[np.ndarray, " f"]) -> Float[np.ndarray, " f"]:
        """Amplitude of the noise of `snr_db` at frequencies [Hz], relative to white noise."""
        if self.electronics is None:
            return np.ones(f.shape)
        corner = self.antialias * self.sample_rate
        return np.sqrt(self.electronics.noise_power(f, corner, self.sample_rate))

    def noise(
        self, rng: np.random.Generator, shape: tuple[int, ...]
    ) -> Float[np.ndarray, "*record time"]:
        """Noise of records without their rounding, for a stream of one's own.

        Args:
            rng: Source of random numbers.
            shape: Of the records; the last axis is time.

        Returns:
            Records [V].
        """
        *_, sigma = self._exact()
        noise = self._noise(rng, sigma, shape)
        if self.electronics is not None:
            noise = noise + self.electronics.converter_noise * rng.standard_normal(shape)
        return noise / self.scale

    def _noise(
        self, rng: np.random.Generator, sigma: float, shape: tuple[int, ...]
    ) -> Float[np.ndarray, "*record time"]:
        """The noise of `snr_db`, in the unit of its standard deviation."""
        if self.electronics is None:
            return sigma * rng.standard_normal(shape)
        corner = self.antialias * self.sample_rate
        return self.electronics.noise(rng, sigma, shape, corner, self.sample_rate)

    def current_noise(self, current: Complex[AnyArray, " f"]) -> Number:
        """Standard deviation of the noise of a recorded current.

        Args:
            current: Fourier coefficients of the current after the anti-alias filter [A].

        Raises:
            ValueError: The scene records no current.
        """
        if self.current_snr_db is None:
            raise ValueError("the scene records no current; set current_snr_db")
        xp = namespace(current)
        effective = xp.sqrt(2 * xp.sum(xp.abs(current) ** 2))
        return effective * 10 ** (-self.current_snr_db / 20)

    def _measured_current(
        self, sampler: Sampler, coefficients: Complex[np.ndarray, " f"], rng: np.random.Generator
    ) -> Float[np.ndarray, " samples"]:
        """A record of the current [A] from its Fourier coefficients."""
        delay = self.trigger_jitter_rms * rng.standard_normal()
        noise = self.current_noise(coefficients * sampler.antialias)
        exact = sampler.sample(coefficients, self.samples, self.start + delay)
        return exact + self._noise(rng, noise, (self.samples,))

    def _exact(self) -> tuple[Sampler, AnyArray, AnyArray, Number]:
        """Sampler, Fourier coefficients of V_th [V], Z_th [ohm] and noise [V at the converter]."""
        sampler = Sampler(
            self.sample_rate,
            self.pulse_rate * (1 + 1e-6 * self.pulse_rate_ppm),
            self.antialias * self.sample_rate,
            self.electronics,
        )
        v_th = sampler.pulse_rate * self.driver.v_th_spectrum(sampler.f)
        sigma = 0.0
        if self.snr_db is not None:
            sigma = self.scale * sampler.rms(v_th) * 10 ** (-self.snr_db / 20)
        return sampler, v_th, self.driver.z_th(sampler.f), sigma

    def _converter(self) -> tuple[float, float, float]:
        """Volts at the converter per stored unit, and the lowest and highest stored value."""
        if self.bits is None:
            return 1.0, -self.full_scale, self.full_scale
        half = 2.0 ** (self.bits - 1)
        return self.full_scale / half, -half, half - 1

    def _convert(
        self,
        sampler: Sampler,
        coefficients: Complex[np.ndarray, " f"],
        sigma: float,
        rng: np.random.Generator,
    ) -> Samples:
        """One record as the converter stores it, from Fourier coefficients at the terminal [V]."""
        # Draw also if the factor is 0: scenes with and without an effect then have the same noise.
        delay = self.trigger_jitter_rms * rng.standard_normal()
        offset = self.offset_rms * rng.standard_normal()
        volts = self.scale * sampler.sample(coefficients, self.samples, self.start + delay)
        volts += offset
        if self.electronics is None:
            volts += self._noise(rng, sigma, (self.samples,))
        else:
            corner = self.antialias * self.sample_rate
            volts = self.electronics.measured(
                volts, rng, sigma, corner, self.sample_rate, self.full_scale
            )
        step, lowest, highest = self._converter()
        if self.bits is None:
            return Samples(np.clip(volts, lowest, highest), 1 / self.scale)
        codes = np.clip(np.rint(volts / step), lowest, highest)
        return Samples(codes.astype(np.int16 if self.bits <= 16 else np.int32), step / self.scale)


def _elements(load: Impedance | AbstractCircuit) -> dict[str, float]:
    """Elements of a load by name [SI]; empty if it has none."""
    if isinstance(load, AbstractCircuit):
        return dict(zip(load.names(), load.values().tolist(), strict=True))
    known = isinstance(load, OpenLoad | ResistorLoad | SkinLoad)
    return dataclasses.asdict(load) if known else {}


def _impedance(trial: Trial, f: Float[np.ndarray, " f"]) -> Complex[np.ndarray, " f"]:
    """Impedance of the load; checked, because the load may be any function."""
    if isinstance(trial.load, AbstractCircuit):
        z = np.asarray(trial.load.response(jnp.asarray(f)))
    else:
        z = np.asarray(trial.load(f), complex)
    if z.shape != f.shape or np.isnan(z).any():
        raise ValueError(
            f"the load of {trial.path!r} returned shape {z.shape} with {np.isnan(z).sum()} NaN for "
            f"{f.size} frequencies from {f[0]:g} to {f[-1]:g} Hz; it must return one impedance "
            "[ohm] for each frequency (infinite if the circuit is open)"
        )
    return z


def resistor_label(r: float) -> str:
    """A resistance as printed on the part: 98800 becomes `98k8`, 555000 becomes `555k`.

    Args:
        r: Resistance [ohm].
    """
    whole, _, decimals = f"{r / 1e3:.12g}".partition(".")
    return f"{whole}k{decimals}"


def _resistors(folder: str, values: tuple[float, ...]) -> tuple[Trial, ...]:
    return tuple(
        Trial(f"{folder}/{resistor_label(r)}", ResistorLoad(r), condition=folder) for r in values
    )


def _repeated(folder: str, load: SkinLoad, count: int, **labels: str) -> tuple[Trial, ...]:
    return tuple(
        Trial(f"{folder}/{i:02d}", load, trial=f"{i:02d}", **labels) for i in range(1, count + 1)
    )


def _typical(condition: str) -> tuple[Trial, ...]:
    return _repeated(
        f"typical/{condition}",
        TYPICAL[condition],
        _TYPICAL_TRIALS,
        subject="typical",
        condition=condition,
    )


_CALIBRATION = _resistors("calibration", (REFERENCE,))
_RESISTORS = _resistors("resistors", tuple(TABLE_1))
_TYPICAL_TRIALS = 10
_SUBJECTS = 10
_SUBJECT_TRIALS = 5
_POPULATION_SEED = 10


def paper_calibration(**settings: Any) -> Scene:
    """Only the reference resistor, 98.8 kΩ. Keywords are fields of `Scene`."""
    return Scene((), _CALIBRATION, **settings)


def paper_resistors(**settings: Any) -> Scene:
    """The five resistors of Table I. Keywords are fields of `Scene`."""
    return Scene(_RESISTORS, _CALIBRATION, **settings)


def paper_built(**settings: Any) -> Scene:
    """The soldered circuit of Table IV, 23 trials. Keywords are fields of `Scene`."""
    trials = _repeated("built", BUILT, 23, condition="built")
    return Scene(trials, _CALIBRATION, **settings)


def paper_dry(**settings: Any) -> Scene:
    """The typical dry fingertip of Table II, ten trials. Keywords are fields of `Scene`."""
    return Scene(_typical("dry"), _CALIBRATION, **settings)


def paper_damp(**settings: Any) -> Scene:
    """The typical damp fingertip of Table III, ten trials. Keywords are fields of `Scene`."""
    return Scene(_typical("damp"), _CALIBRATION, **settings)


def paper_subjects(**settings: Any) -> Scene:
    """Ten subjects, dry and damp, five trials each.

    The elements are log-uniform in the ranges of Tables II and III. They are drawn with a fixed
    seed, so every scene has the same people. All trials of a subject and condition have the same
    elements, so any spread between them comes from the estimator. Keywords are fields of `Scene`.
    """
    rng = np.random.default_rng(_POPULATION_SEED)
    trials: tuple[Trial, ...] = ()
    for number in range(1, _SUBJECTS + 1):
        subject = f"s{number:02d}"
        for condition, elements in FINGERTIPS.items():
            drawn = {
                name: float(np.exp(rng.uniform(*np.log(limits))))
                for name, (_, *limits) in elements.items()
            }
            trials += _repeated(
                f"{subject}/{condition}",
                SkinLoad(**drawn),
                _SUBJECT_TRIALS,
                subject=subject,
                condition=condition,
            )
    return Scene(trials, _CALIBRATION, **settings)


def paper(**settings: Any) -> Scene:
    """All experiments of the paper in one study, 149 recordings. Keywords are fields of `Scene`."""
    parts = (paper_resistors, paper_built, paper_dry, paper_damp, paper_subjects)
    trials = tuple(trial for part in parts for trial in part().trials)
    return Scene(trials, _CALIBRATION, **settings)


PRESETS: Mapping[str, Callable[..., Scene]] = MappingProxyType(
    {
        preset.__name__: preset
        for preset in (
            paper_calibration,
            paper_resistors,
            paper_built,
            paper_dry,
            paper_damp,
            paper_subjects,
            paper,
        )
    }
)
