"""The layout of an etid file, version 1.0: one table, from which everything else is made.

`FIELDS` is what the reader checks a file against, and what `python data_schema/make_page.py`
turns into `recording-1.json`, for machines, and `README.md`, for people.
"""

import dataclasses
import difflib
import json
from collections.abc import Iterable
from typing import Any, Literal

import numpy as np

NAME = "etid/recording"
VERSION = "1.0"
KINDS = ("calibration", "loaded")

Place = Literal["file attribute", "group attribute", "dataset", "dataset attribute"]
Type = Literal["text", "texts", "label", "number", "numbers", "samples"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Field:
    """One line of the schema.

    Attributes:
        place: What it is and what it belongs to.
        name: Its name in the file.
        type: `text`; `texts`, one or more of them; `label`, text or an integer; `number`;
            `numbers`; `samples`, integers or real numbers.
        shape: Its dimensions; `()` is a scalar, and so is an array of one element.
        unit: SI unit; empty for what has none.
        required: Where it must be present: `always`, `optional`, or a kind of recording.
        forbidden: The kind of recording that must not have it.
        values: The only texts allowed; empty if any is.
        description: What it means.
        example: A value.
    """

    place: Place
    name: str
    type: Type
    shape: str
    unit: str = ""
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

    def parse(self, value: Any) -> Any:
        """An attribute's value as plain Python: str, float, tuple of either.

        Raises:
            ValueError: It is not what the schema says; the text says what it is instead.
        """
        array = np.asarray(value)
        if array.size == 0 or "Empty" in type(value).__name__:
            raise ValueError("is empty")
        if array.dtype.names is not None:
            raise ValueError("is a compound value")
        if array.dtype.hasobject and any(_is_reference(item) for item in array.flat):
            raise ValueError("is an HDF5 reference, write the path as text")
        items = [_plain(item, self.type) for item in array.flat]
        if self.values and items[0] not in self.values:
            raise ValueError(f"is {items[0]!r}")
        many = self.type in ("texts", "numbers") or ("(trial,)" in self.shape and array.ndim == 1)
        if array.ndim > 1 or (len(items) > 1 and not many):
            raise ValueError(f"has shape {array.shape}")
        if self.shape == "(2,)" and len(items) != 2:
            raise ValueError(f"has {len(items)} elements, must have 2")
        return tuple(items) if many else items[0]


def _is_reference(item: object) -> bool:
    return type(item).__module__.startswith("h5py")


def _plain(item: Any, kind: Type) -> str | float:
    """One element of an attribute, in the Python type of its field."""
    if kind in ("number", "numbers"):
        if not isinstance(item, int | float | np.integer | np.floating) or isinstance(item, bool):
            raise ValueError(f"is {_shown(item)}, must be a number")
        return float(item)
    if isinstance(item, bytes):
        try:
            item = item.decode("utf-8")
        except UnicodeDecodeError:
            raise ValueError(f"is {item!r}, which is not UTF-8 text") from None
    if kind == "label" and isinstance(item, int | np.integer) and not isinstance(item, bool):
        return str(int(item))
    if not isinstance(item, str):
        what = "text or an integer" if kind == "label" else "text"
        raise ValueError(f"is {_shown(item)}, must be {what}")
    return str(item)


def _shown(item: Any) -> str:
    kind = "text " if isinstance(item, str | bytes) else ""
    return f"{kind}{item.item() if isinstance(item, np.generic) else item!r}"


FIELDS: tuple[Field, ...] = (
    Field(
        place="file attribute",
        name="schema",
        type="text",
        shape="()",
        values=(NAME,),
        description="Says that the file follows this schema.",
        example=NAME,
    ),
    Field(
        place="file attribute",
        name="schema_version",
        type="text",
        shape="()",
        description="`major.minor`. A reader of 1.0 accepts every 1.x and refuses 2.0.",
        example=VERSION,
    ),
    Field(
        place="group attribute",
        name="kind",
        type="text",
        shape="()",
        values=KINDS,
        description="Makes the group a recording: `calibration` has a known resistor as its load, "
        "`loaded` anything else.",
        example="loaded",
    ),
    Field(
        place="group attribute",
        name="sample_rate",
        type="number",
        shape="()",
        unit="hertz",
        description="Samples per second, > 0.",
        example=200000.0,
    ),
    Field(
        place="group attribute",
        name="pulse_rate",
        type="number",
        shape="()",
        unit="hertz",
        description="Stimulation pulses per second, > 0 and below half the sample rate.",
        example=60.0,
    ),
    Field(
        place="group attribute",
        name="r_load",
        type="number",
        shape="()",
        unit="ohm",
        required="calibration",
        forbidden="loaded",
        description="The known resistor, > 0. Its error passes one to one into every impedance "
        "that is identified with it.",
        example=98800.0,
    ),
    Field(
        place="group attribute",
        name="subject",
        type="label",
        shape="()",
        required="optional",
        description="Who.",
        example="s01",
    ),
    Field(
        place="group attribute",
        name="condition",
        type="label",
        shape="()",
        required="optional",
        description="Which state of the skin, or which circuit.",
        example="dry",
    ),
    Field(
        place="group attribute",
        name="electrode",
        type="label",
        shape="()",
        required="optional",
        description="Which electrode of the display.",
        example="E17",
    ),
    Field(
        place="group attribute",
        name="trial",
        type="label",
        shape="() or (trial,)",
        required="optional",
        description="Which repetition; one label per row in a stacked group.",
        example=["0", "1", "2"],
    ),
    Field(
        place="group attribute",
        name="calibration",
        type="texts",
        shape="() or (calibration,)",
        required="optional",
        forbidden="calibration",
        description="HDF5 paths of the calibration groups that belong to the recording; "
        "each must exist in the file.",
        example=["calibration/0"],
    ),
    Field(
        place="group attribute",
        name="adc_range",
        type="numbers",
        shape="(2,)",
        unit="volt",
        required="optional",
        description="Lowest and highest voltage at the terminal that the converter can tell; "
        "samples at these limits are saturated.",
        example=[-186.9, 186.9],
    ),
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
    Field(
        place="dataset attribute",
        name="unit",
        type="text",
        shape="()",
        values=("volt", "ampere"),
        description="SI unit of the values after conversion: `volt` for v_th and v_out, "
        "`ampere` for current.",
        example="volt",
    ),
    Field(
        place="dataset attribute",
        name="conversion",
        type="number",
        shape="()",
        unit="SI unit per stored unit",
        required="optional",
        description="value = conversion · stored + offset; 1 if absent, not 0.",
        example=0.00570422,
    ),
    Field(
        place="dataset attribute",
        name="offset",
        type="number",
        shape="()",
        unit="SI unit",
        required="optional",
        description="Value of a stored zero; 0 if absent.",
        example=0.0,
    ),
)


def at(place: Place) -> dict[str, Field]:
    """The fields of one place, by name."""
    return {field.name: field for field in FIELDS if field.place == place}


def near_miss(name: str, known: Iterable[str]) -> str | None:
    """The known name that an unknown one was probably meant to be."""
    simple = {_simple(other): other for other in known}
    close = difflib.get_close_matches(_simple(name), simple, n=1, cutoff=0.8)
    return simple[close[0]] if close else None


def _simple(name: str) -> str:
    return name.lower().replace("_", "").replace("-", "").replace(" ", "")


def version_problem(version: str) -> str | None:
    """Why this reader cannot read a file of that version, if it cannot."""
    major, _, minor = version.partition(".")
    if not (major.isascii() and major.isdigit() and minor.isascii() and minor.isdigit()):
        return f"is {version!r}, must be 'major.minor'"
    if major != VERSION.partition(".")[0]:
        return f"is {version}, this version of etid reads {VERSION.partition('.')[0]}.x"
    return None


def as_json() -> str:
    """The table for machines."""
    table = {
        "schema": NAME,
        "schema_version": VERSION,
        "fields": [dataclasses.asdict(field) for field in FIELDS],
    }
    return json.dumps(table, indent=2, ensure_ascii=False) + "\n"
