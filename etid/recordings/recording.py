"""Recordings of a stimulation experiment in memory.

A recording is two records on one clock. One is `v_out`, the voltage at the load. The other is its
cause: `v_th`, the unloaded output of the driver, or `current`, measured. Samples stay as the
instrument stored them. Their SI values are `conversion * stored + offset`, as in a TimeSeries of
NWB. So integer converter codes stay exact, and the size of a quantisation step is known.
"""

import abc
import dataclasses
import functools
import importlib
import inspect
from collections.abc import Container, Hashable, Iterator, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple, SupportsFloat

import numpy as np
import numpy.typing as npt
from jaxtyping import Float

from etid.precision import unmasked
from etid.printing import UNITS, Overview, Overviewed, several
from etid.recordings.errors import RecordingError as RecordingError
from etid.recordings.errors import located, not_recorded
from etid.recordings.fields import (
    DECLARED,
    LABELS,
    SIGNALS,
    AbstractFields,
    Metadata,
    metadata_from,
    real,
)
from etid.recordings.splitting import split
from etid.signals.pulse_train import find_pulses
from etid.signals.rounding import printed_step

# Infinite samples get a verdict; neighbours of a damaged recording are not concerned.
quietly = functools.partial(np.errstate, invalid="ignore", over="ignore")


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Samples(Overviewed):
    """One record as the instrument stored it.

    value = conversion · stored + offset                    (NWB, TimeSeries)

    Attributes:
        stored: Integer converter codes or real numbers, in their own dtype; read-only. Samples
            under the mask of a masked array are NaN, codes with them real numbers.
        conversion: SI units per stored unit.
        offset: Value of a stored zero, in the SI unit.
    """

    stored: npt.NDArray
    conversion: float = 1.0
    offset: float = 0.0

    def __init__(
        self,
        stored: npt.ArrayLike,
        conversion: SupportsFloat = 1.0,
        offset: SupportsFloat = 0.0,
    ) -> None:
        array = np.asarray(unmasked(stored))
        if array.dtype.kind not in "iuf" or array.dtype.itemsize > 8:
            raise RecordingError(
                f"has dtype {array.dtype}, must be integers or real numbers of at most 64 bits"
            )
        if array.flags.writeable:  # a copy, because the caller may change the original later
            array = array.copy()
            array.flags.writeable = False
        scale = real("conversion", conversion)
        if scale == 0:
            raise RecordingError("is 0, every sample would be equal", field="conversion")
        object.__setattr__(self, "stored", array)
        object.__setattr__(self, "conversion", scale)
        object.__setattr__(self, "offset", real("offset", offset))

    @property
    def values(self) -> Float[np.ndarray, "..."]:
        """The samples in SI units [V or A], read-only."""
        if self.conversion == 1 and self.offset == 0 and self.stored.dtype == np.float64:
            return self.stored
        values = np.empty(self.stored.shape)
        with quietly():
            self.write_to(values)
        values.flags.writeable = False
        return values

    def write_to(self, values: Float[np.ndarray, "..."]) -> None:
        """Write the samples in SI units [V or A] into an array of their shape.

        The caller decides on warnings of infinite samples; `quietly` for each record takes longer
        than short records do.
        """
        values[...] = self.stored
        if self.conversion != 1:
            values *= self.conversion
        if self.offset != 0:
            values += self.offset

    @property
    def resolution(self) -> float | None:
        """Size of one converter step in SI units [V or A]; None if the samples show no step.

        Real numbers of three digits, as a coarse table has them, have the step of the largest.
        """
        step = 1.0 if self.stored.dtype.kind in "iu" else printed_step(self.stored)
        return abs(self.conversion) * step or None

    def _overview(self) -> Overview:
        shape = " x ".join(map(str, self.stored.shape))
        rows = [("conversion", f"{self.conversion:g}"), ("offset", f"{self.offset:g}")]
        return Overview(f"Samples: {shape} of {self.stored.dtype}", rows)

    def __reduce__(self) -> tuple:
        # By default a copy would hold an array that can be written.
        return Samples, (self.stored, self.conversion, self.offset)


@dataclasses.dataclass(frozen=True, eq=False, repr=False, init=False)
class Recording(Overviewed, AbstractFields):
    """Voltage at a load, and its cause, on one clock. It is immutable and equals only itself.

    The cause is the unloaded output of a driver, or the measured current, or both are given.

    Args:
        v_th: Unloaded output [V], real numbers or `Samples`; not needed with `current`.
        v_out: Output with the load [V], real numbers or `Samples`.
        current: Measured current through the load [A], real numbers or `Samples`; not needed with
            `v_th`.
        **fields: All other fields, by name. `sample_rate` [Hz] and `pulse_rate` [Hz] are required.
            Optional are `path`; `r_load` [ohm], which makes the recording a calibration; the labels
            `subject`, `condition`, `electrode` and `trial`; `calibration`, the paths of its
            calibrations; `adc_range` [V]; and `v_out_filter` and `current_filter`, low-pass filters
            that one of the two has passed, such as `"bessel 4 2000"`.

    Raises:
        RecordingError: A field is wrong, or a record has a wrong shape or dtype. The values of the
            samples are not checked: NaN samples raise no error.
    """

    samples: Mapping[str, Samples]
    metadata: Metadata

    def __init__(
        self,
        v_th: npt.ArrayLike | Samples | None = None,
        v_out: npt.ArrayLike | Samples | None = None,
        *,
        current: npt.ArrayLike | Samples | None = None,
        **fields: Any,
    ) -> None:
        try:
            given = {"v_th": v_th, "v_out": v_out, "current": current}
            samples = {name: _samples(name, one) for name, one in given.items() if one is not None}
            _check_signals(samples, is_calibration=fields.get("r_load") is not None)
            lengths = {name: record.stored.size for name, record in samples.items()}
            if len(set(lengths.values())) > 1:
                found = ", ".join(f"{name} {length}" for name, length in lengths.items())
                raise RecordingError(
                    f"numbers of samples differ: {found}",
                    remedy="Cut the records to the same time interval",
                )
            metadata = metadata_from(**fields)
        except RecordingError as error:
            raise error.located(path=str(fields.get("path", ""))) from None
        _fill(self, samples, metadata)

    @property
    def v_th(self) -> Float[np.ndarray, " time"]:
        """Unloaded output [V].

        Raises:
            RecordingError: It was not recorded.
        """
        if "v_th" not in self.samples:
            remedy = "Use `current`, which this recording has"
            raise not_recorded(self.path, "v_th", remedy)
        return self.samples["v_th"].values

    @property
    def cause(self) -> str:
        """Name of the record that causes `v_out`: `v_th` if it was recorded, else `current`."""
        return "v_th" if "v_th" in self.samples else "current"

    @property
    def v_out(self) -> Float[np.ndarray, " time"]:
        """Output with the load [V]."""
        return self.samples["v_out"].values

    @property
    def current(self) -> Float[np.ndarray, " time"] | None:
        """Measured current through the load [A]; None if it was not recorded."""
        return self.samples["current"].values if "current" in self.samples else None

    @property
    def duration(self) -> float:
        """Length of the records [s]."""
        return self.samples["v_out"].stored.size / self.sample_rate

    @property
    def periods(self) -> float:
        """Length of the records in pulse periods; usually not a whole number."""
        return self.duration * self.pulse_rate

    @property
    def time(self) -> Float[np.ndarray, " time"]:
        """Time of each sample relative to the first sample [s]."""
        return np.arange(self.samples["v_out"].stored.size) / self.sample_rate

    @property
    def is_calibration(self) -> bool:
        """Whether the load is a known resistor."""
        return self.r_load is not None

    def replace(self, **changes: Any) -> "Recording":
        """A copy of the recording with other values for some arguments of the constructor.

        Args:
            **changes: New values of arguments, as in `replace(condition="damp")`.

        Raises:
            RecordingError: The new recording would be invalid.
        """
        arguments: dict[str, Any] = {**self.samples, **vars(self.metadata), **changes}
        return Recording(**arguments)

    def without_v_th(self) -> "Recording":
        """The same with the current as the cause of `v_out`.

        Raises:
            RecordingError: The current was not recorded.
        """
        if "current" not in self.samples:
            remedy = "Pass the driver of this recording, from etid.identify_driver"
            raise not_recorded(self.path, "current", remedy)
        return self if "v_th" not in self.samples else self.replace(v_th=None)

    def split(self, trigger: npt.ArrayLike | None = None) -> "list[Recording]":
        """The trials of one long recording.

        Args:
            trigger: Voltage of a trigger channel, as long as the records: a trial has the pulses
                from one rising edge to the next, up to the first pause. If not given, trials are
                the trains of pulses between pauses.

        Returns:
            Recordings with the paths `PATH/0`, `PATH/1`, … and these numbers as `trial`.

        Raises:
            RecordingError: There is no pause and no edge of the trigger, or the trigger has another
                length.
        """
        with located(path=self.path):
            cause = self.v_th if trigger is None else self.samples[self.cause].values
            given = None if trigger is None else np.asarray(unmasked(trigger), float)
            parts = split(cause, self.sample_rate, self.pulse_rate, given).whole
        whole = self.path or self.metadata.kind
        return [
            self.replace(
                **{
                    name: Samples(of.stored[part], of.conversion, of.offset)
                    for name, of in self.samples.items()
                },
                trial=number,
                path=f"{whole}/{number}",
            )
            for number, part in enumerate(parts)
        ]

    def plot(
        self, *, axes: Any = None, size: tuple[float, float] | None = None, title: str | None = ""
    ) -> np.ndarray:
        """Draw the record; the same as `etid.plot(recording)`, with its arguments."""
        drawn = importlib.import_module("etid.plotting")  # a higher layer
        return drawn.plot(self, axes=axes, size=size, title=title)

    def __reduce__(self) -> tuple:
        # A read-only mapping cannot be pickled.
        return functools.partial(Recording, **self.samples, **vars(self.metadata)), ()

    def _overview(self) -> Overview:
        rows = [
            ("samples", str(self.samples["v_out"].stored.size), ""),
            ("duration", f"{self.duration:.6g}", "s"),
            ("periods", f"{self.periods:.4g}", ""),
        ]
        for name, field in DECLARED.items():
            value = getattr(self, name)
            if value != field.empty:
                numbers = field.type in ("number", "range")
                items = value if isinstance(value, tuple) else (value,)
                text = " … ".join(f"{one:g}" for one in items) if numbers else ", ".join(items)
                rows.append((name, text, UNITS.get(field.unit, (0, field.unit))[1]))
        return Overview(f"Recording {self.path!r}", rows)

    def __repr__(self) -> str:
        load = "loaded" if self.r_load is None else f"calibration with {self.r_load:g} ohm"
        labels = " ".join(f"{name}={value!r}" for name in LABELS if (value := getattr(self, name)))
        size = self.samples["v_out"].stored.size
        return (
            f"<Recording {self.path!r}: {load}, {size} samples at {self.sample_rate:g} Hz, "
            f"{several(f'{self.periods:.4g}', 'period')} of {self.pulse_rate:g} Hz"
            f"{', ' if labels else ''}{labels}>"
        )


def check_rates(cause: npt.NDArray, metadata: Metadata) -> None:
    """Raise an error if the distance between the pulses contradicts the two rates.

    Args:
        cause: `v_th` or the current, or its first part, in any unit.
        metadata: Fields of the recording.
    """
    train = find_pulses(cause.astype(float), metadata.sample_rate, metadata.pulse_rate)
    if train.mismatch:
        raise RecordingError(
            train.mismatch.removesuffix("."),
            path=metadata.path,
            field="pulse_rate",
            remedy="Correct sample_rate or pulse_rate",
        )


def of_checked(samples: dict[str, Samples], metadata: Metadata) -> Recording:
    """A recording of parts that were checked before, as those of a file are when it is opened."""
    made = object.__new__(Recording)
    _fill(made, samples, metadata)
    return made


def _fill(recording: Recording, samples: dict[str, Samples], metadata: Metadata) -> None:
    fields = vars(metadata) | {"samples": MappingProxyType(samples), "metadata": metadata}
    vars(recording).update(fields)  # its attributes cannot be set


def _signature() -> inspect.Signature:
    """The signature of `Recording` with the name of each declared field."""
    written = inspect.signature(Recording.__init__).parameters.values()
    samples = [one for one in written if one.name not in ("self", "fields")]
    return inspect.Signature([*samples, *inspect.signature(Metadata).parameters.values()])


# Notebooks and editors show this signature.
setattr(Recording, "__signature__", _signature())  # noqa: B010  # pyright knows no such attribute


def _check_signals(names: Container[str], *, is_calibration: bool) -> None:
    """Raise RecordingError unless these records together are a recording."""
    field, remedy = "v_out", ""
    if "v_out" in names:
        if "v_th" in names or ("current" in names and not is_calibration):
            return
        field, remedy = "v_th", "" if is_calibration else f"; or {SIGNALS['current'].expects}"
    raise RecordingError(
        "is not given", field=field, remedy=f"Add {SIGNALS[field].expects}{remedy}"
    )


def _samples(name: str, record: npt.ArrayLike | Samples) -> Samples:
    """Samples of one record, after a check of shape and dtype."""
    try:
        samples = record if isinstance(record, Samples) else Samples(record)
    except RecordingError as error:
        raise error.located(field=name) from None
    if not isinstance(record, Samples) and samples.stored.dtype.kind in "iu":
        raise RecordingError(
            f"holds integers ({samples.stored.dtype}) without a scale",
            field=name,
            remedy="Wrap converter codes in Samples(codes, conversion=volts_per_code); "
            "convert voltages to floats",
        )
    if samples.stored.ndim != 1 or samples.stored.size == 0:
        raise RecordingError(
            f"has shape {samples.stored.shape}, must be (time,) with at least one sample",
            field=name,
            remedy="Make one Recording per trial",
        )
    return samples


class Layout(NamedTuple):
    """Description of one record without its samples; the fields are those of `Samples`."""

    name: str
    dtype: str
    length: int
    conversion: float
    offset: float


@dataclasses.dataclass(frozen=True, eq=False, slots=True)  # a file may have millions
class AbstractSource(abc.ABC):
    """Source of one recording in a study: it gives metadata at once, and samples on request.

    Attributes:
        layout: Its records. Recordings of equal layout can form one stack.
        unloaded: Identity of `v_th`; it is equal for recordings that share one unloaded record. A
            recording without `v_th` shares none, and its identity is its own.
    """

    layout: tuple[Layout, ...]
    unloaded: Hashable

    @property
    @abc.abstractmethod
    def metadata(self) -> Metadata:
        """All fields except the samples."""

    @abc.abstractmethod
    def blocks(self, name: str) -> Iterator[npt.NDArray]:
        """The stored samples of one record, in order, in blocks that fit into memory."""

    def load(self) -> Recording:
        """The recording with its samples."""
        records = {
            one.name: Samples(np.concatenate([*self.blocks(one.name)]), one.conversion, one.offset)
            for one in self.layout
        }
        return of_checked(records, self.metadata)
