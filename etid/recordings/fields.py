"""The fields of a recording, declared once.

`AbstractFields` declares everything about a recording but its samples, and `SIGNALS` its samples.
The schema and its page, the reader, the writer, `Recording`, mappings, the command line, the table
of fits and the report take the fields from here. A new field is a line here and nowhere else.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np

from etid.recordings.errors import RecordingError, near_miss
from etid.recordings.values import Type, real, several, stored, text

KINDS = ("calibration", "loaded")

Label = str | int | np.integer
Place = Literal["file attribute", "group attribute", "dataset", "dataset attribute"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Field:
    """One field of the schema.

    Attributes:
        place: What it is and what it belongs to.
        name: Its name in the file.
        type: `text`; `paths`, one or more paths of recordings; `label`, text or an integer;
            `number`; `range`, two increasing numbers; `samples`, integers or real numbers.
        shape: Its dimensions; `()` is a scalar, and so is an array of one element.
        unit: SI unit; empty for what has none.
        positive: Whether a number must be > 0.
        required: Where it must be present: `always`, `optional`, or a kind of recording.
        forbidden: The kind of recording that must not have it.
        values: The only texts allowed; empty if any is.
        description: What it means.
        example: A value.
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
        """What a writer has to put there, in words."""
        unit = f" [{self.unit}]" if self.unit else ""
        values = f", one of {', '.join(map(repr, self.values))}" if self.values else ""
        return f"{self.name}{unit}: {self.type} of shape {self.shape}{values}"

    @property
    def empty(self) -> Any:
        """The value of a recording that has none."""
        return {"label": "", "paths": ()}.get(self.type)

    def parse(self, value: Any) -> Any:
        """The value of an attribute in a file as plain Python: str, float, tuple of either.

        Raises:
            ValueError: It is not what the schema says; the text says what it is instead.
        """
        array = np.asarray(value)
        if array.size == 0 or "Empty" in type(value).__name__:
            raise ValueError("is empty")
        if array.dtype.names is not None:
            raise ValueError("is a compound value")
        if array.dtype.hasobject and any(type(x).__module__.startswith("h5py") for x in array.flat):
            raise ValueError("is an HDF5 reference, write the path as text")
        items = [stored(item, self.type) for item in array.flat]
        if self.values and items[0] not in self.values:
            raise ValueError(f"is {items[0]!r}")
        many = self.type in ("paths", "range") or ("(trial,)" in self.shape and array.ndim == 1)
        if array.ndim > 1 or (len(items) > 1 and not many):
            raise ValueError(f"has shape {array.shape}")
        if self.type == "range" and len(items) != 2:
            raise ValueError(f"has {len(items)} elements, must have 2")
        return tuple(items) if many else items[0]

    def checked(self, value: Any) -> Any:
        """The value of a caller as plain Python.

        Raises:
            RecordingError: It is not what the schema says.
        """
        if value is None:
            return self.empty
        if self.type == "label":
            return text(self.name, value)
        if self.type == "paths":
            return tuple(tidy_path(path) for path in several(self.name, value))
        if self.type == "range":
            ends = tuple(real(self.name, end) for end in several(self.name, value))
            if len(ends) != 2 or not ends[0] < ends[1]:
                raise RecordingError(f"is {ends}, must be two increasing numbers", field=self.name)
            return ends
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
            description="Unloaded output of the driver. `(time,)` beside a stacked `v_out` is one "
            "unloaded record for all its trials.",
            example=[0, -3, 812],
        ),
        Field(
            place="dataset",
            name="v_out",
            type="samples",
            shape="(time,) or (trial, time)",
            unit="volt",
            description="Output with the load connected.",
            example=[0, -2, 640],
        ),
        Field(
            place="dataset",
            name="current",
            type="samples",
            shape="the shape of v_out",
            unit="ampere",
            required="optional",
            description="Measured current through the load.",
            example=[0.0, 0.0, 0.0011],
        ),
    )
}


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


def _field(kind: Type, *, required: str = "optional", **declared: Any) -> Any:
    """A field of a recording: an attribute of its group in a file."""
    field = Field(place="group attribute", name="", type=kind, required=required, **declared)
    default = dataclasses.MISSING if required == "always" else field.empty
    return dataclasses.field(default=default, metadata={"declared": field})


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class AbstractFields:
    """The fields of a recording, but its samples.

    Attributes:
        path: HDF5 path inside a study, such as `s01/dry/03`; not a field of the file.
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
        description="The known resistor, > 0. Its error passes one to one into every impedance "
        "that is identified with it.",
        example=98800.0,
    )
    subject: str = _field("label", description="Who.", example="s01")
    condition: str = _field(
        "label", description="Which state of the skin, or which circuit.", example="dry"
    )
    electrode: str = _field("label", description="Which electrode of the display.", example="E17")
    trial: str = _field(
        "label",
        shape="() or (trial,)",
        description="Which repetition; one label per row in a stacked group.",
        example=["0", "1", "2"],
    )
    calibration: tuple[str, ...] = _field(
        "paths",
        shape="() or (calibration,)",
        forbidden="calibration",
        description="HDF5 paths of the calibration groups that belong to the recording; "
        "each must exist in the file.",
        example=["calibration/0"],
    )
    adc_range: tuple[float, float] | None = _field(
        "range",
        shape="(2,)",
        unit="volt",
        description="Lowest and highest voltage at the terminal that the converter can tell; "
        "samples at these limits are saturated.",
        example=[-186.9, 186.9],
    )


DECLARED: dict[str, Field] = {
    field.name: dataclasses.replace(field.metadata["declared"], name=field.name)
    for field in dataclasses.fields(AbstractFields)
    if "declared" in field.metadata
}
LABELS = tuple(name for name, field in DECLARED.items() if field.type == "label")
# What a table of fits says of each recording besides its path: labels, and measured numbers.
DESCRIBING = {
    name: field
    for name, field in DECLARED.items()
    if field.type in ("label", "number") and field.required == "optional"
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Metadata(AbstractFields):
    """Everything about a recording but its samples."""

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

    @property
    def kind(self) -> str:
        """`calibration` or `loaded`."""
        return "loaded" if self.r_load is None else "calibration"


def metadata_from(*, path: str = "", **fields: Any) -> Metadata:
    """Metadata from unchecked values; the one place where their types are settled.

    Raises:
        RecordingError: A value is not what the schema says, a field is unknown, or one is missing.
    """
    check_names(fields, tuple(DECLARED), "field of a recording")
    for name, field in DECLARED.items():
        if field.required == "always" and fields.get(name) is None:
            raise RecordingError("is not given", field=name, remedy=f"Add {field.expects}")
    known = {name: DECLARED[name].checked(value) for name, value in fields.items()}
    return Metadata(path=tidy_path(path), **known)


def check_names(given: Mapping[str, Any], known: Sequence[str], what: str, of: str = "") -> None:
    """Refuse a name that is not known.

    Args:
        given: Values by name.
        known: Names that there are.
        what: What they are names of.
        of: What stands before the name in the error.

    Raises:
        RecordingError: A name is not known; the error names one that is near.
    """
    for name in given:
        if name not in known:
            near = near_miss(name, known)
            raise RecordingError(
                f"is no {what}{f', did you mean {near}?' if near else ''}",
                field=f"{of}{name}",
                remedy=f"There are {', '.join(known)}",
            )


def wanted_labels(given: Mapping[str, Any], known: Sequence[str]) -> dict[str, str]:
    """Labels by which recordings or fits are chosen, as text; those that are None are left out.

    Raises:
        RecordingError: There is no label of that name, or its value is no label.
    """
    check_names(given, known, "label")
    return {name: text(name, value) for name, value in given.items() if value is not None}
