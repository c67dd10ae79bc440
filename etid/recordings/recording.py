"""Recordings of a stimulation experiment in memory.

A recording is two voltages on one clock: `v_th`, the driver's unloaded output, and `v_out`, its
output with a load.  Samples stay as the instrument stored them; their SI values are
`conversion * stored + offset`, as in NWB's TimeSeries, so integer converter codes lose nothing and
the size of a quantisation step stays known.
"""

import abc
import dataclasses
import math
from collections.abc import Hashable, Iterable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple, SupportsFloat

import numpy as np
import numpy.typing as npt
from jaxtyping import Float

from etid.recordings import schema
from etid.recordings.errors import RecordingError as RecordingError

Label = str | int | np.integer
SIGNALS = ("v_th", "v_out", "current")


def _real(field: str, value: object) -> float:
    """A finite real number, or an error; text and booleans are no numbers."""
    number = isinstance(value, int | float | np.integer | np.floating) or (
        getattr(value, "shape", None) == () and getattr(value, "dtype", np.dtype("O")).kind in "iuf"
    )
    if not number or isinstance(value, bool) or not math.isfinite(float(value)):  # type: ignore[arg-type]  # checked on this line
        raise RecordingError(f"is {value!r}, must be a finite real number", field=field)
    return float(value)  # type: ignore[arg-type]  # checked above


def _positive(field: str, value: object, unit: str) -> float:
    number = _real(field, value)
    if number <= 0:
        raise RecordingError(f"is {number:g} {unit}, must be > 0", field=field)
    return number


def text(field: str, value: object) -> str:
    """A label as text; integers become their decimal digits."""
    if isinstance(value, int | np.integer) and not isinstance(value, bool):
        value = int(value)
    elif not isinstance(value, str):
        raise RecordingError(f"is {value!r}, must be text or an integer", field=field)
    label = str(value)
    if "\0" in label or any("\ud800" <= character <= "\udfff" for character in label):
        raise RecordingError(f"{label!r} cannot be stored as UTF-8 text", field=field)
    return label


def wanted_labels(given: Mapping[str, Any], known: Sequence[str]) -> dict[str, str]:
    """Labels by which recordings or fits are chosen, as text; those that are None are left out.

    Raises:
        RecordingError: There is no label of that name, or its value is no label.
    """
    for name in given:
        if name not in known:
            near = schema.near_miss(name, known)
            raise RecordingError(
                f"is no label{f', did you mean {near}?' if near else ''}",
                field=name,
                remedy=f"The labels are {', '.join(known)}",
            )
    return {name: text(name, value) for name, value in given.items() if value is not None}


def tidy_path(path: str) -> str:
    """An HDF5 path without leading and trailing slashes; refuses what cannot be a recording's."""
    tidy = text("path", path).strip("/")
    parts = tidy.split("/") if tidy else []
    if any(part in ("", ".", "..", *SIGNALS) for part in parts):
        raise RecordingError(
            f"{path!r} cannot be the path of a recording: no part of it may be empty, '.', '..' "
            f"or one of the names {', '.join(SIGNALS)}",
            field="path",
            remedy="Use a path such as 's01/dry/03'",
        )
    return tidy


@dataclasses.dataclass(frozen=True, eq=False)
class Samples:
    """One record as its instrument stored it.

    value = conversion · stored + offset                    (NWB, TimeSeries)

    Attributes:
        stored: Integer converter codes or real numbers, in their own dtype; read-only.
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
        array = np.asarray(stored)
        if array.dtype.kind not in "iuf" or array.dtype.itemsize > 8:
            raise RecordingError(
                f"has dtype {array.dtype}, must be integers or real numbers of at most 64 bits"
            )
        if array.flags.writeable:  # a copy, because the caller may go on writing to the original
            array = array.copy()
            array.flags.writeable = False
        scale = _real("conversion", conversion)
        if scale == 0:
            raise RecordingError("is 0, every sample would be equal", field="conversion")
        object.__setattr__(self, "stored", array)
        object.__setattr__(self, "conversion", scale)
        object.__setattr__(self, "offset", _real("offset", offset))

    @property
    def values(self) -> Float[np.ndarray, "..."]:
        """The samples in SI units [V or A], read-only."""
        if self.conversion == 1 and self.offset == 0 and self.stored.dtype == np.float64:
            return self.stored
        values = self.stored.astype(np.float64)
        with np.errstate(over="ignore", invalid="ignore"):  # infinite samples have a verdict
            values *= self.conversion
            values += self.offset
        values.flags.writeable = False
        return values

    @property
    def resolution(self) -> float | None:
        """Size of one converter step in SI units [V or A]; None for samples that are not codes."""
        return abs(self.conversion) if self.stored.dtype.kind in "iu" else None


@dataclasses.dataclass(frozen=True, kw_only=True)
class Metadata:
    """Everything about a recording but its samples.

    Attributes:
        path: HDF5 path inside a study, such as `s01/dry/03`.
        sample_rate: Samples per second [Hz].
        pulse_rate: Stimulation pulses per second [Hz].
        r_load: Known resistor of a calibration [ohm]; None for an unknown load.
        subject: Who.
        condition: Which state of the skin, or which circuit.
        electrode: Which electrode of the display.
        trial: Which repetition.
        calibration: Paths of the calibration recordings that belong to this one.
        adc_range: Terminal voltages at which the converter saturates [V].
    """

    path: str = ""
    sample_rate: float
    pulse_rate: float
    r_load: float | None = None
    subject: str = ""
    condition: str = ""
    electrode: str = ""
    trial: str = ""
    calibration: tuple[str, ...] = ()
    adc_range: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if self.pulse_rate >= self.sample_rate / 2:
            raise RecordingError(
                f"is {self.pulse_rate:g} Hz, must be below half the sample rate of "
                f"{self.sample_rate:g} Hz",
                field="pulse_rate",
            )
        if self.r_load is not None and self.calibration:
            raise RecordingError(
                "a recording with a known resistor (r_load) is a calibration and has none itself",
                field="calibration",
            )
        if self.adc_range is not None and not self.adc_range[0] < self.adc_range[1]:
            raise RecordingError(
                f"is {self.adc_range}, must be two increasing voltages", field="adc_range"
            )

    @property
    def kind(self) -> str:
        """`calibration` or `loaded`."""
        return "loaded" if self.r_load is None else "calibration"


def metadata_from(**fields: Any) -> Metadata:
    """Metadata from unchecked values; the one place where their types are settled."""
    tidy: dict[str, Any] = {name: text(name, fields.get(name, "")) for name in LABELS}
    tidy["path"] = tidy_path(fields.get("path", ""))
    tidy["sample_rate"] = _positive("sample_rate", fields["sample_rate"], "Hz")
    tidy["pulse_rate"] = _positive("pulse_rate", fields["pulse_rate"], "Hz")
    if fields.get("r_load") is not None:
        tidy["r_load"] = _positive("r_load", fields["r_load"], "ohm")
    calibration = fields.get("calibration", ())
    paths = (calibration,) if isinstance(calibration, str) else calibration
    tidy["calibration"] = tuple(tidy_path(path) for path in paths)
    if fields.get("adc_range") is not None:
        limits = tuple(fields["adc_range"])
        if len(limits) != 2:
            raise RecordingError(f"is {limits}, must be two increasing voltages", field="adc_range")
        tidy["adc_range"] = (_real("adc_range", limits[0]), _real("adc_range", limits[1]))
    return Metadata(**tidy)


LABELS = ("subject", "condition", "electrode", "trial")


@dataclasses.dataclass(frozen=True, eq=False, repr=False, init=False)
class Recording:
    """Unloaded and loaded output of a driver on one clock.  Immutable; equal only to itself.

    Args:
        v_th: Unloaded output [V], real numbers or `Samples`.
        v_out: Output with the load [V], real numbers or `Samples`.
        sample_rate: Samples per second [Hz].
        pulse_rate: Stimulation pulses per second [Hz].
        r_load: Known resistor [ohm]; given, the recording is a calibration.
        current: Measured current through the load [A], optional.
        subject: Who.
        condition: Which state of the skin, or which circuit.
        electrode: Which electrode of the display.
        trial: Which repetition.
        calibration: Path or paths of the calibration recordings that belong to this one.
        adc_range: Terminal voltages at which the converter saturates [V], optional.
        path: HDF5 path inside a study.

    Raises:
        RecordingError: A mistake that can be seen without looking at the values of the samples.
            NaN samples are no such mistake.
    """

    samples: Mapping[str, Samples]
    metadata: Metadata
    sample_rate: float
    pulse_rate: float
    r_load: float | None
    subject: str
    condition: str
    electrode: str
    trial: str
    calibration: tuple[str, ...]
    adc_range: tuple[float, float] | None
    path: str

    def __init__(
        self,
        v_th: npt.ArrayLike | Samples,
        v_out: npt.ArrayLike | Samples,
        *,
        sample_rate: SupportsFloat,
        pulse_rate: SupportsFloat,
        r_load: SupportsFloat | None = None,
        current: npt.ArrayLike | Samples | None = None,
        subject: Label = "",
        condition: Label = "",
        electrode: Label = "",
        trial: Label = "",
        calibration: str | Iterable[str] = (),
        adc_range: Iterable[SupportsFloat] | None = None,
        path: str = "",
    ) -> None:
        try:
            samples = {"v_th": _samples("v_th", v_th), "v_out": _samples("v_out", v_out)}
            if current is not None:
                samples["current"] = _samples("current", current)
            lengths = {name: record.stored.size for name, record in samples.items()}
            if len(set(lengths.values())) > 1:
                found = ", ".join(f"{name} {length}" for name, length in lengths.items())
                raise RecordingError(
                    f"numbers of samples differ: {found}",
                    remedy="Cut the records to the same stretch of time",
                )
            metadata = metadata_from(
                sample_rate=sample_rate,
                pulse_rate=pulse_rate,
                r_load=r_load,
                subject=subject,
                condition=condition,
                electrode=electrode,
                trial=trial,
                calibration=calibration,
                adc_range=adc_range,
                path=path,
            )
        except RecordingError as error:
            raise error.located(path=path) from None
        object.__setattr__(self, "samples", MappingProxyType(samples))
        object.__setattr__(self, "metadata", metadata)
        for field in dataclasses.fields(Metadata):
            object.__setattr__(self, field.name, getattr(metadata, field.name))

    @property
    def v_th(self) -> Float[np.ndarray, " time"]:
        """Unloaded output [V]."""
        return self.samples["v_th"].values

    @property
    def v_out(self) -> Float[np.ndarray, " time"]:
        """Output with the load [V]."""
        return self.samples["v_out"].values

    @property
    def current(self) -> Float[np.ndarray, " time"] | None:
        """Measured current through the load [A], if there is one."""
        return self.samples["current"].values if "current" in self.samples else None

    @property
    def duration(self) -> float:
        """Length of the records [s]."""
        return self.samples["v_out"].stored.size / self.sample_rate

    @property
    def periods(self) -> float:
        """Length of the records in pulse periods; seldom a whole number."""
        return self.duration * self.pulse_rate

    @property
    def time(self) -> Float[np.ndarray, " time"]:
        """Time of each sample after the first [s]."""
        return np.arange(self.samples["v_out"].stored.size) / self.sample_rate

    @property
    def is_calibration(self) -> bool:
        """Whether the load is a known resistor."""
        return self.r_load is not None

    def replace(self, **changes: Any) -> "Recording":
        """A copy with some of the constructor's arguments changed.

        Args:
            **changes: New values of arguments, as in `replace(condition="damp")`.

        Raises:
            RecordingError: The new recording would not be a valid one.
        """
        return Recording(**{**self.samples, **vars(self.metadata), **changes})

    def __repr__(self) -> str:
        load = "loaded" if self.r_load is None else f"calibration with {self.r_load:g} ohm"
        labels = " ".join(f"{name}={value!r}" for name in LABELS if (value := getattr(self, name)))
        size = self.samples["v_out"].stored.size
        return (
            f"<Recording {self.path!r}: {load}, {size} samples at {self.sample_rate:g} Hz, "
            f"{self.periods:.4g} periods of {self.pulse_rate:g} Hz{', ' if labels else ''}{labels}>"
        )


def _samples(name: str, record: npt.ArrayLike | Samples) -> Samples:
    """One record of a recording, checked for its shape and dtype."""
    try:
        samples = record if isinstance(record, Samples) else Samples(record)
    except RecordingError as error:
        raise error.located(field=name) from None
    if not isinstance(record, Samples) and samples.stored.dtype.kind in "iu":
        raise RecordingError(
            f"holds integers ({samples.stored.dtype}) without a scale",
            field=name,
            remedy="Wrap converter codes in Samples(codes, conversion=volts_per_code); "
            "turn numbers that are volts into floats",
        )
    if samples.stored.ndim != 1 or samples.stored.size == 0:
        raise RecordingError(
            f"has shape {samples.stored.shape}, must be (time,) with at least one sample",
            field=name,
            remedy="Make one Recording per trial",
        )
    return samples


class Layout(NamedTuple):
    """One record of a recording without its samples, as in `Samples`."""

    name: str
    dtype: str
    length: int
    conversion: float
    offset: float


class AbstractSource(abc.ABC):
    """What a study holds: metadata now, a `Recording` when asked for."""

    @property
    @abc.abstractmethod
    def metadata(self) -> Metadata:
        """All fields but the samples."""

    @property
    @abc.abstractmethod
    def layout(self) -> tuple[Layout, ...]:
        """Names, dtypes, lengths and scales; recordings of equal layout fit in one stack."""

    @property
    @abc.abstractmethod
    def unloaded(self) -> Hashable:
        """Identity of `v_th`: equal for recordings that share one unloaded record."""

    @abc.abstractmethod
    def blocks(self, name: str) -> Iterator[npt.NDArray]:
        """The stored samples of one record, in order, as much at a time as memory should hold."""

    @abc.abstractmethod
    def load(self) -> Recording:
        """The recording with its samples."""
