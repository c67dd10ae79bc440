"""The fields of a recording, declared once.

`SIGNALS` declares the samples of a recording. `AbstractFields` declares all other fields. The
schema and its page, the reader, the writer, `Recording`, mappings, the command line, the table of
fits and the report use these declarations. A new field needs one declaration here and no other
change.
"""

import dataclasses
import math
from typing import Any, Literal

import numpy as np

from etid.recordings import limits
from etid.recordings.errors import RecordingError
from etid.recordings.labels import check_names, text
from etid.recordings.resistance import resistance
from etid.signals.low_pass import Filters, LowPass

Type = Literal["text", "paths", "label", "number", "range", "samples"]


def real(field: str, value: object) -> float:
    """A finite real number; text and booleans are an error."""
    number = isinstance(value, int | float | np.integer | np.floating) or (
        getattr(value, "shape", None) == () and getattr(value, "dtype", np.dtype("O")).kind in "iuf"
    )
    if not number or isinstance(value, bool) or not math.isfinite(float(value)):  # type: ignore[arg-type]  # checked on this line
        raise RecordingError(f"is {value!r}, must be a finite real number", field=field)
    return float(value)  # type: ignore[arg-type]  # checked above


def several(field: str, value: object) -> list[Any]:
    """The items of a sequence; a text is one item."""
    if isinstance(value, str):
        return [value]
    try:
        return list(value)  # type: ignore[call-overload]  # other types raise TypeError
    except TypeError:
        raise RecordingError(f"is {value!r}, must be a sequence", field=field) from None


def plain(item: Any) -> Any:
    """One element of an attribute of a file as a Python object; bytes become text."""
    if isinstance(item, bytes):
        try:
            return item.decode("utf-8")
        except UnicodeDecodeError:
            raise RecordingError(f"is {item!r}, which is not UTF-8 text") from None
    return item.item() if isinstance(item, np.generic) else item


KINDS = ("calibration", "loaded")

Place = Literal["file attribute", "group attribute", "dataset", "dataset attribute"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Field:
    """One field of the schema.

    Attributes:
        place: Kind of HDF5 object: an attribute of a file, group or dataset, or a dataset.
        name: Name of the field in the file.
        type: `text`; `paths`, one or more paths of recordings; `label`, text or an integer;
            `number`; `range`, two increasing numbers; `samples`, integers or real numbers.
        shape: Shape of the value; `()` is a scalar or an array of one element.
        unit: SI unit; empty if the field has no unit.
        positive: Whether a number must be > 0.
        required: Whether the field must be present: `always`, `optional`, or the kind of recording
            that needs it.
        forbidden: Kind of recording that must not have the field; empty if there is none.
        values: Allowed texts; empty if every text is allowed.
        description: Meaning of the field.
        example: Example of a value.
    """

    place: Place
    name: str
    type: Type
    shape: str = "()"
    unit: str = ""
    positive: bool = False
    required: str = "always"
    forbidden: str = ""
    values: tuple[str, ...] = ()
    description: str
    example: Any

    @property
    def expects(self) -> str:
        """Text for errors: name, unit, type, shape and allowed values."""
        unit = f" [{self.unit}]" if self.unit else ""
        values = f", one of {', '.join(map(repr, self.values))}" if self.values else ""
        shape = "" if self.shape == "()" else f" of shape {self.shape}"
        return f"{self.name}{unit}: {self.type}{shape}{values}"

    @property
    def empty(self) -> Any:
        """Value of the field if a recording does not have it."""
        return {"label": "", "paths": ()}.get(self.type)

    def parse(self, value: Any) -> Any:
        """Value of an attribute of a file, as `checked`; labels of a stack become a tuple."""
        array = np.asarray(value)
        if array.size == 0 or "Empty" in type(value).__name__:
            raise RecordingError("is empty")
        if array.dtype.names is not None:
            raise RecordingError("is a compound value")
        if array.dtype.hasobject and any(type(x).__module__.startswith("h5py") for x in array.flat):
            raise RecordingError("is an HDF5 reference; write the path as text")
        items = [plain(item) for item in array.flat]
        many = self.type in ("paths", "range") or ("(trial,)" in self.shape and array.ndim == 1)
        if array.ndim > 1 or (len(items) > 1 and not many):
            raise RecordingError(f"has shape {array.shape}")
        if many and self.type == "label":
            return tuple(map(self.checked, items))
        if self.type == "number":  # in a file it is none as text
            items[0] = real(self.name, items[0])
        if self.values and isinstance(items[0], str) and items[0] not in self.values:
            raise RecordingError(f"is {items[0]!r}")
        return self.checked(items if many else items[0])

    def checked(self, value: Any) -> Any:
        """Value that a caller gives, as Python types; a resistance may be a text such as 98k8."""
        if value is None:
            return self.empty
        if self.type == "text" and not isinstance(value, str):
            raise RecordingError(f"is {value!r}, must be text", field=self.name)
        if self.values and value not in self.values:
            known = " or ".join(map(repr, self.values))
            raise RecordingError(f"is {value!r}, must be {known}", field=self.name)
        if self.type in ("text", "label"):
            return text(self.name, value)
        if self.type == "paths":
            return tuple(tidy_path(path) for path in several(self.name, value))
        if self.type == "range":
            ends = tuple(real(self.name, end) for end in several(self.name, value))
            if len(ends) != 2 or not ends[0] < ends[1]:
                raise RecordingError(f"is {ends}, must be two increasing numbers", field=self.name)
            return ends
        if self.unit == "ohm" and isinstance(value, str):
            value = resistance(value, self.name)
        number = real(self.name, value)
        if self.positive and number <= 0:
            raise RecordingError(f"is {number:g} {self.unit}, must be > 0", field=self.name)
        return number


SIGNALS = {
    field.name: field
    for field in (
        Field(
            place="dataset",
            name="v_th",
            type="samples",
            shape="(time,) or (trial, time)",
            unit="volt",
            required="calibration",
            description="Unloaded output voltage of the driver. It may be missing in a recording "
            "with `current`. If `v_out` is stacked, the shape "
            "`(time,)` means one unloaded record for all trials.",
            example=[0, -3, 812],
        ),
        Field(
            place="dataset",
            name="v_out",
            type="samples",
            shape="(time,) or (trial, time)",
            unit="volt",
            description="Output voltage of the driver with the load connected.",
            example=[0, -2, 640],
        ),
        Field(
            place="dataset",
            name="current",
            type="samples",
            shape="the shape of v_out",
            unit="ampere",
            required="optional",
            description="Measured current through the load. A recording without `v_th` needs it.",
            example=[0.0, 0.0, 0.0011],
        ),
    )
}


def tidy_path(path: str) -> str:
    """HDF5 path of a recording, without slashes at its ends; raises an error if it is invalid."""
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


def _field(kind: Type, *, required: str = "optional", **declared: Any) -> Any:
    """Declare a field of a recording; in a file it is an attribute of the recording's group."""
    field = Field(place="group attribute", name="", type=kind, required=required, **declared)
    default = dataclasses.MISSING if required == "always" else field.empty
    return dataclasses.field(default=default, metadata={"declared": field})


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class AbstractFields:
    """All fields of a recording except its samples.

    Attributes:
        path: HDF5 path in the study, such as `s01/dry/03`. It is not stored as a field.
    """

    path: str = ""
    sample_rate: float = _field(
        "number",
        unit="hertz",
        positive=True,
        required="always",
        description="Samples per second, > 0.",
        example=200000.0,
    )
    pulse_rate: float = _field(
        "number",
        unit="hertz",
        positive=True,
        required="always",
        description="Stimulation pulses per second, > 0 and below half the sample rate.",
        example=60.0,
    )
    r_load: float | None = _field(
        "number",
        unit="ohm",
        positive=True,
        required="calibration",
        forbidden="loaded",
        description="Resistance of the known resistor, > 0. A relative error of this value causes "
        "the same relative error in every impedance that is identified with this calibration.",
        example=98800.0,
    )
    subject: str = _field("label", description="Person whose skin was recorded.", example="s01")
    session: str = _field(
        "label", description="Session or day of the measurement.", example="2026-03-02"
    )
    site: str = _field("label", description="Finger and hand, or place on it.", example="index")
    condition: str = _field(
        "label", description="State of the skin, or name of the circuit.", example="dry"
    )
    electrode: str = _field("label", description="Electrode of the display.", example="E17")
    trial: str = _field(
        "label",
        shape="() or (trial,)",
        description="Repetition of the measurement; a stacked group has one label per row.",
        example=["0", "1", "2"],
    )
    calibration: tuple[str, ...] = _field(
        "paths",
        shape="() or (calibration,)",
        forbidden="calibration",
        description="HDF5 paths of the calibration groups of this recording; "
        "each must exist in the file.",
        example=["calibration/0"],
    )
    adc_range: tuple[float, float] | None = _field(
        "range",
        shape="(2,)",
        unit="volt",
        description="Lowest and highest voltage at the terminal that the converter can measure; "
        "samples at these limits are saturated.",
        example=[-186.9, 186.9],
    )
    hold: str | None = _field(
        "text",
        values=("zero",),
        description="How the converter of a command holds it. With `zero`, `v_th` or `current` is "
        "the command itself, which is held from each sample until the next, and no filter follows. "
        "A sample of `v_out` is taken right after the step to the command of the same number. "
        "Without it, all are samples of voltages or currents that end below half the sample rate.",
        example="zero",
    )
    instrument: str | None = _field(
        "text",
        forbidden="loaded",
        description="Tolerances of the instrument: standard deviations by name, as in "
        "`etid.Instrument`. All calibrations of a driver state the same.",
        example="gain=1e-3 r_load=1e-3",
    )
    v_out_filter: str | None = _field(
        "text",
        forbidden="calibration",
        description="Low-pass that `v_out` has passed and `current` has not: kind (bessel or "
        "butterworth), order, corner of -3 dB [Hz], and the corner's standard deviation [Hz] if it "
        "is uncertain. It counts for a recording without `v_th`.",
        example="butterworth 1 80000",
    )
    current_filter: str | None = _field(
        "text",
        forbidden="calibration",
        description="Low-pass that `current` has passed and `v_out` has not, in the same words.",
        example="bessel 4 2000 100",
    )

    @property
    def filters(self) -> Filters | None:
        """The filters of `v_out` and `current`; None if neither is stated."""
        stated = [getattr(self, name) for name in FILTERS]
        if stated == [None, None]:
            return None
        return Filters.of(*(None if one is None else LowPass.read(one) for one in stated))


DECLARED: dict[str, Field] = {
    field.name: dataclasses.replace(field.metadata["declared"], name=field.name)
    for field in dataclasses.fields(AbstractFields)
    if "declared" in field.metadata
}
LABELS = tuple(name for name, field in DECLARED.items() if field.type == "label")
# Fields that a table of fits contains for each recording: labels and optional numbers.
DESCRIBING = {
    name: field
    for name, field in DECLARED.items()
    if field.type in ("label", "number") and field.required == "optional"
}


FILTERS = "v_out_filter", "current_filter"  # known filters of one channel


@dataclasses.dataclass(frozen=True, kw_only=True)
class Metadata(AbstractFields):
    """All fields of a recording except its samples, with checked values."""

    def __post_init__(self) -> None:
        if self.pulse_rate >= self.sample_rate / 2:
            raise RecordingError(
                f"is {self.pulse_rate:g} Hz, must be below half the sample rate of "
                f"{self.sample_rate:g} Hz",
                field="pulse_rate",
            )
        if self.sample_rate > limits.SAMPLES * self.pulse_rate:
            raise RecordingError(
                f"is {self.pulse_rate:g} Hz; at {self.sample_rate:g} Hz one period would be longer "
                f"than a record may be ({limits.SAMPLES} samples)",
                field="pulse_rate",
            )
        if self.r_load is not None and self.calibration:
            raise RecordingError(
                "a recording with a known resistor (r_load) is a calibration; it has none itself",
                field="calibration",
            )
        if self.hold is not None and (self.v_out_filter or self.current_filter):
            raise RecordingError(
                "no filter may follow a command that a converter holds",
                field="hold",
                remedy="Remove v_out_filter and current_filter, or measure what passes them",
            )
        if self.r_load is None and self.instrument is not None:
            raise RecordingError(
                "only a calibration, which has a known resistor (r_load), states the instrument",
                field="instrument",
                remedy="State it in the calibrations of this recording",
            )
        for name in FILTERS:
            if (stated := getattr(self, name)) is None:
                continue
            if self.r_load is not None:
                raise RecordingError(
                    "a calibration has none: V_th and V_out pass the same filter", field=name
                )
            try:
                LowPass.read(stated)
            except ValueError as error:
                raise RecordingError(str(error), field=name) from None

    def of_trial(self, path: str, trial: str) -> "Metadata":
        """The same with the path and the label of a trial, which no check concerns."""
        made = object.__new__(Metadata)
        vars(made).update(vars(self), path=path, trial=trial)
        return made

    @property
    def kind(self) -> str:
        """`calibration` or `loaded`."""
        return "loaded" if self.r_load is None else "calibration"


def metadata_from(*, path: str = "", **fields: Any) -> Metadata:
    """Metadata from unchecked values; only this function checks and converts their types."""
    check_names(fields, tuple(DECLARED), "field of a recording")
    for name, field in DECLARED.items():
        if field.required == "always" and fields.get(name) is None:
            raise RecordingError("is not given", field=name, remedy=f"Add {field.expects}")
    known = {name: DECLARED[name].checked(value) for name, value in fields.items()}
    return Metadata(path=tidy_path(path), **known)
