"""Lanes: the arrays of a recording that an estimator fits, its harmonics or its samples.

They are prepared with NumPy: JAX would compile for every length of a record. Records of most
lengths have equally many harmonics, and samples are filled up to one of few lengths, so that one
compiled function serves many recordings.
"""

import abc
import dataclasses
import math
from collections.abc import Sequence
from typing import ClassVar, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int

from etid.circuits.circuit import AbstractCircuit
from etid.recordings.preflight import Inspected
from etid.results.driver import Driver
from etid.signals import mains, rounding
from etid.signals.alignment import rest, shifted
from etid.signals.harmonics import ALIASED, Spectrum, spectrum
from etid.signals.measurement import Measurement, measure, noise, trusted

LEFT = 0.75  # samples that are worth another fit; the delay that a fit allows for is 0.5
STEPS = 4  # lengths in an octave: the longest filling is a fifth


class AbstractLane(eqx.Module):
    """The arrays of one recording that an estimator fits, or of several along a leading axis.

    Attributes:
        periodic: Whether the recording must hold whole pulse periods.
    """

    periodic: ClassVar[bool] = False

    @classmethod
    @abc.abstractmethod
    def of(cls, seen: Inspected) -> "AbstractLane":
        """The lane of a recording that has passed the pre-flight."""

    @classmethod
    @abc.abstractmethod
    def of_samples(
        cls,
        v_th: Float[Array, " time"],
        v_out: Float[Array, " time"],
        resolution: Float[Array, ""],
        sample_rate: Float[Array, ""],
        periods: tuple[int, int],
    ) -> "AbstractLane":
        """The lane of bare arrays, which JAX may trace.

        Args:
            v_th: Unloaded voltage [V].
            v_out: Loaded voltage [V].
            resolution: Step of the converter [V], 0 if not known.
            sample_rate: Sampling rate [Hz].
            periods: From `whole_periods`.
        """

    @property
    def size(self) -> int:
        """Length of the arrays: lanes of one size share a compiled function."""
        return jax.tree.leaves(self)[0].shape[-1]

    def realigned(self, late: int) -> "AbstractLane":
        """The same with a `v_out` that is earlier by whole samples."""
        del late
        return self

    def late_by(self, circuit: AbstractCircuit, driver: Driver) -> int:
        """Whole samples by which `v_out` is later than with this load; 0 if they are few.

        Edges that the load smoothes let its record look later than it is. A fit that is a sample or
        more away from the alignment finds the elements, but calls it a misfit.
        """
        del circuit, driver
        return 0

    def without_mains(self) -> "AbstractLane | None":
        """The same without the harmonics on which mains hum may fall; None if there is none."""
        return None


class Harmonics(AbstractLane):
    """Fourier coefficients of whole pulse periods: the fields of a `Spectrum`, and the rate.

    Attributes:
        sample_rate: Sampling rate [Hz].
    """

    periodic = True

    frequency: Float[Array | np.ndarray, "*lane harmonic"]
    x: Complex[Array | np.ndarray, "*lane harmonic"]
    y: Complex[Array | np.ndarray, "*lane harmonic"]
    variance_x: Float[Array | np.ndarray, "*lane harmonic"]
    variance_y: Float[Array | np.ndarray, "*lane harmonic"]
    selected: Bool[Array | np.ndarray, "*lane harmonic"]
    sample_rate: Float[Array | np.ndarray, "*lane"]

    @classmethod
    def of(cls, seen: Inspected) -> "Harmonics":
        """The harmonics of a recording, aligned; a coarse converter's noise is its rounding."""
        rate = np.asarray(seen.recording.sample_rate)
        sigma_th = np.asarray(trusted(seen.v_th, seen.sigma_th))
        sigma_out = np.asarray(trusted(seen.v_out, seen.sigma_out))
        fields = spectrum(seen.v_th, seen.v_out, sigma_th, sigma_out, rate, *seen.periods)
        frequency, x, y, variance_x, variance_y, selected = map(np.asarray, fields)
        for v, step, variance in (
            (seen.recorded_th, seen.coarse_th, variance_x),
            (seen.recorded_out, seen.coarse_out, variance_y),
        ):
            if step > 0:
                rounded = rounding.variance(v, step, *seen.periods)
                variance[: rounded.size] = rounded
        selected = selected & ~seen.covered(frequency)
        one = cls(frequency, x, y, variance_x, variance_y, selected, rate)
        return one.realigned(seen.lag)

    @classmethod
    def of_samples(
        cls,
        v_th: Float[Array, " time"],
        v_out: Float[Array, " time"],
        resolution: Float[Array, ""],
        sample_rate: Float[Array, ""],
        periods: tuple[int, int],
    ) -> "Harmonics":
        """The harmonics of bare arrays.

        Raises:
            ValueError: They hold no whole period.
        """
        if periods[0] == 0:
            raise ValueError(f"{v_out.shape[0]} samples hold no whole pulse period")
        sigmas = noise(v_th, resolution), noise(v_out, resolution)
        fields = map(jnp.asarray, spectrum(v_th, v_out, *sigmas, sample_rate, *periods))
        return cls(*fields, sample_rate)  # pyright: ignore[reportCallIssue]

    @property
    def spectrum(self) -> Spectrum:
        """The harmonics without the rate, as arrays of JAX."""
        fields = (self.frequency, self.x, self.y, self.variance_x, self.variance_y, self.selected)
        return Spectrum(*map(jnp.asarray, fields))

    def realigned(self, late: int) -> "Harmonics":
        """The same with a `v_out` that is earlier by whole samples: turned by e^(jω late / fs)."""
        if late == 0:
            return self
        turn = np.exp(2j * np.pi * late / self.sample_rate * self.frequency)
        return dataclasses.replace(self, y=self.y * turn)

    def late_by(self, circuit: AbstractCircuit, driver: Driver) -> int:
        """Whole samples by which `v_out` is later than with this load; 0 if they are few."""
        gain = _gain(circuit, driver, self.frequency)
        variance = self.variance_y + np.abs(gain) ** 2 * self.variance_x
        weight, turn = self.selected / variance, 2 * np.pi * self.frequency / self.sample_rate
        return _whole(rest(gain * self.x, *map(np.asarray, (self.y, weight, turn))))

    def without_mains(self) -> "Harmonics | None":
        """The same without the harmonics on which mains hum may fall; None if there is none."""
        suspect = mains.lines(self.frequency)
        if not (self.selected & suspect).any():
            return None
        return dataclasses.replace(self, selected=self.selected & ~suspect)


class PaddedSamples(AbstractLane):
    """Samples, filled up with zeros to one of few lengths.

    Attributes:
        v_th: Unloaded voltage [V].
        v_out: Loaded voltage [V].
        sigma_th: Noise of `v_th` [V].
        sigma_out: Noise of `v_out` [V].
        sample_rate: Sampling rate [Hz].
        samples: How many of the first samples were recorded.
    """

    v_th: Float[Array | np.ndarray, "*lane time"]
    v_out: Float[Array | np.ndarray, "*lane time"]
    sigma_th: Float[Array | np.ndarray, "*lane"]
    sigma_out: Float[Array | np.ndarray, "*lane"]
    sample_rate: Float[Array | np.ndarray, "*lane"]
    samples: Int[Array | np.ndarray, "*lane"]

    @classmethod
    def of(cls, seen: Inspected) -> "PaddedSamples":
        """The samples of a recording, aligned."""
        size = seen.v_th.size
        room = math.ceil(2 ** (math.ceil(STEPS * math.log2(size)) / STEPS)) - size
        one = cls(
            v_th=np.pad(seen.v_th, (0, room)),
            v_out=np.pad(seen.v_out, (0, room)),
            sigma_th=np.asarray(trusted(seen.v_th, seen.sigma_th)),
            sigma_out=np.asarray(trusted(seen.v_out, seen.sigma_out)),
            sample_rate=np.asarray(seen.recording.sample_rate),
            samples=np.asarray(size),
        )
        return one.realigned(seen.lag)

    @classmethod
    def of_samples(
        cls,
        v_th: Float[Array, " time"],
        v_out: Float[Array, " time"],
        resolution: Float[Array, ""],
        sample_rate: Float[Array, ""],
        periods: tuple[int, int],
    ) -> "PaddedSamples":
        """Bare arrays, to which nothing is added."""
        del periods
        sigmas = jnp.asarray(noise(v_th, resolution)), jnp.asarray(noise(v_out, resolution))
        return cls(v_th, v_out, *sigmas, sample_rate, jnp.asarray(v_out.shape[0]))

    @property
    def measurement(self) -> Measurement:
        """Both records and their noise, as arrays of JAX."""
        fields = (self.v_th, self.v_out, self.sigma_th, self.sigma_out, self.sample_rate)
        return Measurement(*map(jnp.asarray, fields))

    def realigned(self, late: int) -> "PaddedSamples":
        """The same with a `v_out` that is earlier by whole samples, where the two overlap."""
        if late == 0:
            return self
        samples = int(self.samples)
        v_th, v_out = (np.asarray(v)[:samples] for v in (self.v_th, self.v_out))
        v_th, v_out = shifted(v_th, v_out, late)
        room = (0, self.v_th.size - v_th.size)
        return dataclasses.replace(
            self,
            v_th=np.pad(v_th, room),
            v_out=np.pad(v_out, room),
            samples=np.asarray(v_th.size),
        )

    def late_by(self, circuit: AbstractCircuit, driver: Driver) -> int:
        """Whole samples by which `v_out` is later than with this load; 0 if they are few."""
        rate = self.sample_rate
        frequency = np.fft.rfftfreq(self.v_th.size, 1 / rate)[1:]
        x, y = np.fft.rfft(self.v_th)[1:], np.fft.rfft(self.v_out)[1:]
        gain = _gain(circuit, driver, frequency)
        # Edges, as if both had been differentiated.
        weight = (frequency < ALIASED * rate) / (frequency**-2.0 * (1 + np.abs(gain) ** 2))
        return _whole(rest(gain * x, y, weight, 2 * np.pi * frequency / rate))


class AlignedSamples(AbstractLane):
    """Both records as they are, where they overlap after the alignment.

    Attributes:
        v_th: Unloaded voltage [V].
        v_out: Loaded voltage [V].
        resolution_th: Converter step of `v_th` [V], 0 if not known.
        resolution_out: The same of `v_out`.
        sample_rate: Sampling rate [Hz].
    """

    v_th: Float[Array | np.ndarray, "*lane time"]
    v_out: Float[Array | np.ndarray, "*lane time"]
    resolution_th: Float[Array | np.ndarray, "*lane"]
    resolution_out: Float[Array | np.ndarray, "*lane"]
    sample_rate: Float[Array | np.ndarray, "*lane"]

    @classmethod
    def of(cls, seen: Inspected) -> "AlignedSamples":
        """The records of a recording, aligned."""
        steps = np.asarray(seen.step_th), np.asarray(seen.step_out)
        return cls(*seen.aligned, *steps, np.asarray(seen.recording.sample_rate))

    @classmethod
    def of_samples(
        cls,
        v_th: Float[Array, " time"],
        v_out: Float[Array, " time"],
        resolution: Float[Array, ""],
        sample_rate: Float[Array, ""],
        periods: tuple[int, int],
    ) -> "AlignedSamples":
        """Bare arrays."""
        del periods
        return cls(v_th, v_out, resolution, resolution, sample_rate)

    def measure(self) -> Measurement:
        """Both records and their noise, which JAX estimates."""
        fields = self.v_th, self.v_out, self.resolution_th, self.resolution_out, self.sample_rate
        return measure(*map(jnp.asarray, fields))


def _gain(
    circuit: AbstractCircuit, driver: Driver, frequency: Float[Array | np.ndarray, " frequency"]
) -> Complex[np.ndarray, " frequency"]:
    at = jnp.asarray(frequency)
    z = np.asarray(circuit.response(at))
    return z / (z + np.asarray(driver.response(at)))


def _whole(late: float) -> int:
    return round(late) if abs(late) > LEFT else 0


_Lane = TypeVar("_Lane", bound=AbstractLane)


def stacked(lanes: Sequence[_Lane]) -> _Lane:
    """Lanes of one size along a leading axis, as arrays of JAX."""
    return jax.tree.map(lambda *fields: jnp.asarray(np.stack(fields)), *lanes)
