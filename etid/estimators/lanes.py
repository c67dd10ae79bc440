"""Lanes: the arrays of a recording that an estimator fits, its harmonics or its samples.

NumPy prepares them. Records of most lengths have the same number of harmonics, so that they are
rows of one call.
"""

import abc
import dataclasses
import math
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float

from etid.circuits.circuit import AbstractCircuit
from etid.precision import Module, namespace
from etid.printing import several
from etid.recordings.preflight import Inspected
from etid.results.feed import AbstractFeed
from etid.signals import mains
from etid.signals.harmonics import (
    ALIASED,
    Spectrum,
    aliases,
    filled,
    harmonics,
    harmonics_of,
    joins_aliases,
)
from etid.signals.hold import of_hold
from etid.signals.lags import rest
from etid.signals.low_pass import Filters
from etid.signals.noise import Measurement, Noise, floor, noise_of
from etid.signals.rounding import rounding_variance
from etid.signals.transfer import AnyArray, power

LEFT = 0.75  # samples; a larger delay needs a second fit. The prior of a delay is 0.5 wide
_Harmonics = TypeVar("_Harmonics", bound="Harmonics")
LANES = 64  # recordings that are fitted together


class Lags(NamedTuple):
    """Lags behind `v_th`, or `v_out` behind the current if that is the cause [whole samples].

    Attributes:
        v_out: Lag of `v_out`.
        current: Lag of a current that was measured beside `v_th`.
    """

    v_out: int
    current: int = 0

    @classmethod
    def of(cls, *late: float, left: float = LEFT) -> "Lags":
        """Delays rounded to whole samples; those of at most `left`, or not finite, become 0."""
        return cls(*(round(by) if left < abs(by) < math.inf else 0 for by in late))


class AbstractLane(Module):
    """The arrays that an estimator fits: of one recording, or of several along a leading axis.

    Attributes:
        periodic: Whether the recording must hold whole pulse periods.
    """

    periodic: ClassVar[bool] = False

    @classmethod
    @abc.abstractmethod
    def of(cls, seen: Inspected) -> "AbstractLane":
        """The lane of a recording that has passed the preflight checks."""

    @classmethod
    def of_several(cls, seen: Sequence[Inspected]) -> "list[AbstractLane]":
        """The lane of each recording."""
        return [cls.of(one) for one in seen]

    @classmethod
    @abc.abstractmethod
    def of_samples(cls, m: Measurement, periods: tuple[int, int]) -> "AbstractLane":
        """The lane of bare arrays, `periods` from `whole_periods`; JAX can trace this function."""

    @property
    def size(self) -> int:
        """Length of the arrays."""
        return jax.tree.leaves(self)[0].shape[-1]

    @property
    def shapes(self) -> tuple[Any, ...]:
        """Shapes of all arrays; lanes with the same shapes are rows of one call."""
        return tuple(leaf.shape for leaf in jax.tree.leaves(self))

    def realigned(self, late: Lags) -> "AbstractLane":
        """The lane with its records advanced by whole samples."""
        del late
        return self

    def late_by(self, circuit: AbstractCircuit, driver: AbstractFeed) -> Lags:
        """Whole samples by which records are later than this load predicts; 0 for small delays.

        A load smooths the edges, so its record seems later than it is. If the alignment is wrong by
        a sample or more, the fit finds the elements, but its verdict is `misfit`.
        """
        del circuit, driver
        return Lags(0)

    def without_mains(self) -> "AbstractLane | None":
        """The same without the harmonics on which mains hum may fall; None if there is none."""
        return None


class Harmonics(AbstractLane):
    """Fourier coefficients of whole pulse periods: the fields of a `Spectrum` and the sample rate.

    Attributes:
        sample_rate: Sampling rate [Hz].
        filters: The known filters of V_out and of the current that causes it; None without any.
            Both records have passed both.
        exact_input: Whether the weights leave out the noise of X.
    """

    periodic = True
    exact_input: ClassVar[bool] = False

    frequency: Float[Array | np.ndarray, "*lane harmonic"]
    x: Complex[Array | np.ndarray, "*lane harmonic"]
    y: Complex[Array | np.ndarray, "*lane harmonic"]
    variance_x: Float[Array | np.ndarray, "*lane harmonic"]
    variance_y: Float[Array | np.ndarray, "*lane harmonic"]
    selected: Bool[Array | np.ndarray, "*lane harmonic"]
    sample_rate: Float[Array | np.ndarray, "*lane"]
    filters: Filters | None = eqx.field(kw_only=True, default=None)

    @classmethod
    def of(cls, seen: Inspected) -> "Harmonics":
        """Aligned harmonics of a recording; its noise may be 1/f or rounding too."""
        return cls(*cls._fields(seen))._filtered(seen)

    @classmethod
    def of_several(cls, seen: Sequence[Inspected]) -> "list[AbstractLane]":
        """The lane of each recording.

        They are made from the structure of the first one: the constructor takes a third of the time
        of all that `_fields` computes.
        """
        fields = [cls._fields(one) for one in seen]
        structure = jax.tree.structure(cls(*fields[0]))
        lanes = [structure.unflatten(one) for one in fields]
        return [one._filtered(of) for one, of in zip(lanes, seen, strict=True)]

    def _filtered(self: _Harmonics, seen: Inspected) -> _Harmonics:
        """The same after each record has passed the known filter of the other one."""
        filters = seen.recording.filters if seen.has_current else None
        if filters is None:
            return self
        of_v_out, of_current = filters(self.frequency)
        return dataclasses.replace(
            self,
            x=self.x * of_v_out,
            y=self.y * of_current,
            variance_x=self.variance_x * power(of_v_out),
            variance_y=self.variance_y * power(of_current),
            filters=filters,
        )

    @staticmethod
    def _fields(seen: Inspected) -> tuple[np.ndarray, ...]:
        """The fields of a lane, in their order."""
        rate = np.asarray(seen.recording.sample_rate)
        frequency, x, y, *variances, selected = seen.spectrum
        for number, (recorded, step) in enumerate(zip(seen.recorded, seen.coarse, strict=True)):
            if step > 0:
                rounded = rounding_variance(recorded, float(step), *seen.periods)
                variances[number] = np.append(rounded, variances[number][rounded.size :])
        if joins_aliases(*seen.periods) and not seen.has_no_aliases:
            of_both = zip((x, y), variances, strict=True)
            variances = [v + aliases(of, v, *seen.periods).variance for of, v in of_both]
        selected = selected & ~seen.covered
        y = y * _turn(frequency, rate, seen.lag) if seen.lag else y
        return frequency, x, y, *variances, selected, rate

    @classmethod
    def of_samples(cls, m: Measurement, periods: tuple[int, int]) -> "Harmonics":
        """The harmonics of bare arrays.

        Raises:
            ValueError: The arrays hold no whole period.
        """
        if periods[0] == 0:
            raise ValueError(f"no whole pulse period in {several(m.v_out.shape[0], 'sample')}")
        records = m.records
        both = harmonics(records[..., : periods[1]], *periods)
        noise = _least(noise_of(records, *periods), m, periods[1])
        frequency, x, y, of_x, of_y, selected = filled(both, noise, _rate(m), *periods)
        if joins_aliases(*periods):
            # As the noise, they are no data of the fit: derivatives by the records hold them.
            of_x, of_y = (
                of + constant(aliases(record, of, *periods).variance)
                for record, of in ((x, of_x), (y, of_y))
            )
        of = _alike(frequency, x, y, of_x, of_y, selected)
        return cls(*[*of, m.sample_rate])

    @property
    def noise_of_x(self) -> tuple[AnyArray, AnyArray | None]:
        """E|noise|² of X that the weights contain, and what they leave out; None if nothing."""
        of = self.variance_x
        return (0 * of, of) if self.exact_input else (of, None)

    @property
    def fields(self) -> Spectrum:
        """The harmonics without the sample rate."""
        of = (self.frequency, self.x, self.y, self.variance_x, self.variance_y, self.selected)
        return Spectrum(*of, whole=self.periodic, held=isinstance(self, Held))

    @property
    def spectrum(self) -> Spectrum:
        """The same as arrays of JAX."""
        return jax.tree.map(jnp.asarray, self.fields)

    def realigned(self, late: Lags) -> "Harmonics":
        """The lane with `v_out` advanced by whole samples: multiplied by e^(jω late / fs)."""
        if late.v_out == 0:
            return self
        turn = _turn(self.frequency, self.sample_rate, late.v_out)
        return dataclasses.replace(self, y=self.y * turn)

    def late_by(self, circuit: AbstractCircuit, driver: AbstractFeed) -> Lags:
        """Whole samples by which `v_out` is later than with this load; 0 if they are few."""
        gain = _gain(circuit, driver, self.frequency)
        return Lags.of(self._behind(gain, self.y, self.variance_y))

    def _behind(
        self,
        gain: Complex[np.ndarray, " harmonic"],
        record: Complex[Array | np.ndarray, " harmonic"],
        variance: Float[Array | np.ndarray, " harmonic"],
    ) -> float:
        """Lag [samples] of a record with this noise behind `gain` times X."""
        weight = self.selected / (variance + np.abs(gain) ** 2 * self.variance_x)
        turn = 2 * np.pi * self.frequency / self.sample_rate
        return rest(gain * self.x, *map(np.asarray, (record, weight, turn)))

    def without_mains(self) -> "Harmonics | None":
        """The same without the harmonics on which mains hum may fall; None if there is none."""
        suspect = mains.lines(self.frequency)
        if not (self.selected & suspect).any():
            return None
        return dataclasses.replace(self, selected=self.selected & ~suspect)


class Bins(Harmonics):
    """The same of a record of any length and start: the bins of its own transform, but for bin 0.

    The records are cut to their overlap, so that the frequencies depend on the lag.
    """

    periodic = False

    @staticmethod
    def _fields(seen: Inspected) -> tuple[np.ndarray, ...]:
        """The fields of a lane, in their order."""
        return *seen.bins.fields, np.asarray(seen.recording.sample_rate)

    @classmethod
    def of_first(cls, seen: Inspected, samples: int) -> "Bins":
        """The lane of the first samples of the overlap."""
        of = seen.bins_of_first(samples).fields
        return cls(*[*of, np.asarray(seen.recording.sample_rate)])._filtered(seen)

    @classmethod
    def of_samples(cls, m: Measurement, periods: tuple[int, int]) -> "Bins":
        """The bins of bare arrays."""
        del periods
        records, size = m.records, m.v_out.shape[-1]
        noise = _least(noise_of(records, 1, size, whole=False), m, size)
        count = math.ceil(ALIASED * size)
        of = harmonics_of(records, 1)[..., :count], noise[..., :count]
        return cls(*[*_alike(*filled(*of, _rate(m), 1, size)), m.sample_rate])

    @property
    def shapes(self) -> tuple[Any, ...]:
        """The same, and the distance of two bins: rows of one call have equal frequencies."""
        return *super().shapes, float(np.asarray(self.frequency).reshape(-1)[0])

    def realigned(self, late: Lags) -> "Bins":
        """Refused: samples at one end would have to come from the other."""
        raise NotImplementedError("make the lane of the realigned recording")


class Held(Bins):
    """The same of a command that a converter holds between samples: X is that of the staircase.

    It is the command itself, so that it has no noise but its rounding.
    """

    @staticmethod
    def _fields(seen: Inspected) -> tuple[np.ndarray, ...]:
        """The fields of a lane, in their order."""
        return *_held(seen.bins.fields, seen), np.asarray(seen.recording.sample_rate)

    @classmethod
    def of_first(cls, seen: Inspected, samples: int) -> "Held":
        """The lane of the first samples of the overlap."""
        of = _held(seen.bins_of_first(samples).fields, seen)
        return cls(*[*of, np.asarray(seen.recording.sample_rate)])

    def late_by(self, circuit: AbstractCircuit, driver: AbstractFeed) -> Lags:
        """No samples: an output shows its command within the sample in which this is held."""
        del circuit, driver
        return Lags(0)


def _held(fields: tuple[AnyArray, ...], seen: Inspected) -> tuple[AnyArray, ...]:
    """The fields of a `Spectrum` of samples of a command, as those of its staircase."""
    frequency, x, y, variance_x, *rest = fields
    hold = of_hold(np.asarray(frequency) / seen.recording.sample_rate)
    samples = seen.aligned[0].size
    (least, _) = floor(seen.limits, seen.inspection.step[seen.row]) ** 2 / samples
    return frequency, x * hold, y, least + 0 * variance_x, *rest


class HarmonicsWithCurrent(Harmonics):
    """The same with the measured current, of recordings that have both.

    Attributes:
        i: Fourier coefficients of the current [A].
        variance_i: E|noise|² of each of them [A²].
    """

    i: Complex[Array | np.ndarray, "*lane harmonic"]
    variance_i: Float[Array | np.ndarray, "*lane harmonic"]

    @staticmethod
    def _fields(seen: Inspected) -> tuple[np.ndarray, ...]:
        """The fields of a lane, in their order; `v_out` and the current are aligned with `v_th`.

        Raises:
            ValueError: The recording lacks `v_th` or the current.
        """
        if seen.by_current is None:
            raise ValueError(f"recording {seen.recording.path!r} has not both v_th and current")
        *of_voltages, selected, rate = Harmonics._fields(seen)
        _, i, _, variance_i, _, usable, _ = Harmonics._fields(seen.by_current)
        turned = i * _turn(of_voltages[0], rate, seen.current_lag)
        return *of_voltages, selected & usable, rate, turned, variance_i

    @classmethod
    def of_both(cls, voltages: Harmonics, current: Harmonics) -> "HarmonicsWithCurrent":
        """The lane of bare arrays, from those of `v_th` with `v_out`, and with the current."""
        *of_voltages, selected, rate, _ = (
            getattr(voltages, one.name) for one in dataclasses.fields(voltages)
        )
        selected = selected & current.selected
        return cls(*[*of_voltages, selected, rate, current.y, current.variance_y])

    @classmethod
    def of_samples(cls, m: Measurement, periods: tuple[int, int]) -> "HarmonicsWithCurrent":
        """Refused: bare arrays have no current."""
        raise ValueError("arrays have no current; use etid.Likelihood with current=")

    def realigned(self, late: Lags) -> "HarmonicsWithCurrent":
        """The lane with `v_out` and the current advanced by whole samples, each by its own lag."""
        if not any(late):
            return self
        y, i = (
            record * _turn(self.frequency, self.sample_rate, by)
            for record, by in ((self.y, late.v_out), (self.i, late.current))
        )
        return dataclasses.replace(self, y=y, i=i)

    def late_by(self, circuit: AbstractCircuit, driver: AbstractFeed) -> Lags:
        """Whole samples by which `v_out` and the current are later than with this load."""
        gain = _gain(circuit, driver, self.frequency)
        flowing = gain / np.asarray(circuit.response(jax.device_put(self.frequency)))  # I / V_th
        of_current = self._behind(flowing, self.i, self.variance_i)
        return Lags.of(self._behind(gain, self.y, self.variance_y), of_current)


class AlignedSamples(AbstractLane):
    """The overlap of both records after the alignment.

    Attributes:
        v_th: Unloaded voltage [V].
        v_out: Loaded voltage [V].
        sigma_th: Noise of `v_th` [V].
        sigma_out: Noise of `v_out` [V].
        sample_rate: Sampling rate [Hz].
    """

    v_th: Float[Array | np.ndarray, "*lane time"]
    v_out: Float[Array | np.ndarray, "*lane time"]
    sigma_th: Float[Array | np.ndarray, "*lane"]
    sigma_out: Float[Array | np.ndarray, "*lane"]
    sample_rate: Float[Array | np.ndarray, "*lane"]

    @classmethod
    def of(cls, seen: Inspected) -> "AlignedSamples":
        """The aligned records of a recording."""
        v_th, v_out = seen.aligned
        of_th, of_out = map(np.asarray, seen.trusted)
        rate = np.asarray(seen.recording.sample_rate)
        return cls(v_th, v_out, of_th, of_out, rate)

    @classmethod
    def of_samples(cls, m: Measurement, periods: tuple[int, int]) -> "AlignedSamples":
        """The lane of bare arrays."""
        del periods
        return cls(m.v_th, m.v_out, m.sigma_th, m.sigma_out, m.sample_rate)

    def measure(self) -> Measurement:
        """Both records and their noise."""
        return Measurement(self.v_th, self.v_out, self.sigma_th, self.sigma_out, self.sample_rate)


def _least(noise: Noise, m: Measurement, samples: int) -> AnyArray:
    """The noise of the coefficients, at least that of the samples; no data of the fit."""
    xp = namespace(m.v_out)
    least = xp.stack([m.sigma_th, m.sigma_out], -1)[..., None] ** 2 / samples
    return constant(xp.maximum(noise.variance, least))


def _alike(frequency: AnyArray, x: AnyArray, *of: AnyArray) -> tuple[AnyArray, ...]:
    """Fields of a `Spectrum`, of which all recordings have one frequency and one selection."""
    xp, (*rest, selected) = namespace(x), of
    frequency, selected = (xp.broadcast_to(one, x.shape) for one in (frequency, selected))
    return frequency, x, *rest, selected


def _rate(m: Measurement) -> Float[AnyArray, ""]:
    """The sample rate, which is one for all recordings."""
    return m.sample_rate.reshape(-1)[0]


def constant(of: AnyArray) -> AnyArray:
    """The same without a derivative."""
    return of if namespace(of) is np else jax.lax.stop_gradient(of)


def _gain(
    circuit: AbstractCircuit,
    driver: AbstractFeed,
    frequency: Float[Array | np.ndarray, " frequency"],
) -> Complex[np.ndarray, " frequency"]:
    """V_out per input at these frequencies [Hz]."""
    at = jax.device_put(frequency)
    return np.asarray(driver.gain(circuit.response(at), at))


def _turn(
    frequency: Float[Array | np.ndarray, " harmonic"],
    sample_rate: Float[Array | np.ndarray, ""],
    late: int,
) -> Complex[np.ndarray, " harmonic"]:
    """Factor that advances a record by whole samples."""
    return np.exp(2j * np.pi * late / sample_rate * frequency)


_Tree = TypeVar("_Tree")


def stacked(parts: Sequence[_Tree]) -> _Tree:
    """Lanes of the same size, or fits, stacked along a leading axis as arrays of NumPy."""
    return jax.tree.map(lambda *fields: np.stack(fields), *parts)


def taken(whole: _Tree, rows: int | Sequence[int] | np.ndarray) -> _Tree:
    """One of the lanes or fits along the leading axis, or several."""
    return jax.tree.map(lambda leaf: np.asarray(leaf[rows]), whole)


def replaced(whole: _Tree, rows: Sequence[int] | np.ndarray, others: _Tree) -> _Tree:
    """The lanes or fits along the leading axis, some of them replaced."""

    def one(leaf: np.ndarray, other: np.ndarray) -> np.ndarray:
        leaf = np.array(leaf)
        leaf[rows] = other
        return leaf

    return jax.tree.map(one, whole, others)


def unstacked(whole: _Tree) -> list[_Tree]:
    """The lanes or fits along the leading axis, as arrays of NumPy."""
    leaves, structure = jax.tree.flatten(whole)
    return [structure.unflatten(map(np.asarray, one)) for one in zip(*leaves, strict=True)]
