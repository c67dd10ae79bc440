"""Layout of an etid file, version 1.0, as one table.

`FIELDS` contains the fields of a recording (`etid.recordings.fields`) and all other fields of a
file. The reader checks a file against this table. `python data_schema/make_page.py` writes the
table to `recording-1.json` for programs and to `README.md` for people.
"""

import dataclasses
import json

from etid.recordings.fields import DECLARED, KINDS, SIGNALS, Field, Place

NAME = "etid/recording"
VERSION = "1.0"
FITS = "etid/fits"  # of a file of fits, which is no file of recordings

FIELDS: tuple[Field, ...] = (
    Field(
        place="file attribute",
        name="schema",
        type="text",
        values=(NAME,),
        description="States that the file follows this schema.",
        example=NAME,
    ),
    Field(
        place="file attribute",
        name="schema_version",
        type="text",
        description="`major.minor`. A reader of 1.0 accepts every 1.x and refuses 2.0.",
        example=VERSION,
    ),
    Field(
        place="group attribute",
        name="kind",
        type="text",
        values=KINDS,
        description="Marks the group as a recording. The load is a known resistor for "
        "`calibration`, and any other load for `loaded`.",
        example="loaded",
    ),
    *DECLARED.values(),
    *SIGNALS.values(),
    Field(
        place="dataset attribute",
        name="unit",
        type="text",
        values=tuple(dict.fromkeys(signal.unit for signal in SIGNALS.values())),
        description="SI unit of the values after conversion: "
        + ", ".join(f"`{signal.unit}` for {name}" for name, signal in SIGNALS.items())
        + ".",
        example="volt",
    ),
    Field(
        place="dataset attribute",
        name="conversion",
        type="number",
        unit="SI unit per stored unit",
        required="optional",
        description="value = conversion · stored + offset. It must not be 0; it is 1 if absent.",
        example=0.00570422,
    ),
    Field(
        place="dataset attribute",
        name="offset",
        type="number",
        unit="SI unit",
        required="optional",
        description="Value of a stored zero; 0 if absent.",
        example=0.0,
    ),
)


def at(place: Place) -> dict[str, Field]:
    """Fields of one place, by name."""
    return {field.name: field for field in FIELDS if field.place == place}


def version_problem(version: str, own: str = VERSION) -> str | None:
    """Reason why a reader of its own version cannot read a file of a version; None if it can."""
    major, _, minor = version.partition(".")
    if not (major.isascii() and major.isdigit() and minor.isascii() and minor.isdigit()):
        return f"is {version!r}, must be 'major.minor'"
    if major != own.partition(".")[0]:
        return f"is {version}, this version of etid reads {own.partition('.')[0]}.x"
    return None


def as_json() -> str:
    """The table as JSON, for programs."""
    table = {
        "schema": NAME,
        "schema_version": VERSION,
        "fields": [dataclasses.asdict(field) for field in FIELDS],
    }
    return json.dumps(table, indent=2, ensure_ascii=False) + "\n"
