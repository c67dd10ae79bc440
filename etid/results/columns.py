"""The columns of a table of fits, declared once.

`Fit.table`, `Fits.table`, files of fits, exported tables and the recordings of a report are made of
`COLUMNS`. A new column is one declaration there. One that a file shall keep needs a field of `Fit`.
"""

import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from etid.printing import significant
from etid.recordings.fields import DESCRIBING
from etid.recordings.remarks import remarks_of, words
from etid.results.verdicts import verdicts_of

Axis = Literal["element", "moved"]  # along `moved` are the elements and the amplitude


class Column(NamedTuple):
    """A column of a table of fits: a number or a text for each fit.

    Attributes:
        name: Its name. `{}` stands for the items of the axis `each`, which have a column each.
        field: Field of `Fit` that a file keeps in it; empty if it is no field.
        of: Values of a fit or of a batch of fits, None if they have none; default: the field.
        kind: Type of the values in a file: `number`, `integer` or `text`.
        unit: SI unit; `element` for that of the element, empty for none.
        each: Last axis of the values, if it is divided into columns.
        axes: Axes of the values after that of the fits, in one column.
        read: Makes the field of the values in a file; raises KeyError for unknown words.
        needs: Column without which a file does not need this one; empty if it always does.
        shown: Which tables have it: `always`, those of `all` columns, or that of a `file` only.
        heading: Heading in the table of recordings of a report, empty if it is not there.
        text: Text of a value there.
    """

    name: str
    field: str = ""
    of: Callable[[Any], Any] | None = None
    kind: Literal["number", "integer", "text"] = "number"
    unit: str = ""
    each: Axis | Literal[""] = ""
    axes: tuple[Axis, ...] = ()
    read: Callable[[np.ndarray], Any] = lambda values: values
    needs: str = ""
    shown: Literal["always", "all", "file"] = "all"
    heading: str = ""
    text: Callable[[float], str] = significant


# What describes each recording. Like the notes, a table has it beside its fits.
DESCRIBED = {"path": Column("path", kind="text", shown="always")} | {
    name: Column(
        name, kind="text" if of.type == "label" else "number", unit=of.unit, shown="always"
    )
    for name, of in DESCRIBING.items()
}
LABELS = tuple(name for name, column in DESCRIBED.items() if column.kind == "text")

_words, _remarks = np.vectorize(words, otypes=[str]), np.vectorize(remarks_of, otypes=[int])
COLUMNS: tuple[Column, ...] = (
    *DESCRIBED.values(),
    Column(
        "{}", "circuit", lambda fit: fit.circuit.values(),
        each="element", unit="element", shown="always",
    ),
    Column(
        "{}_stderr", "", lambda fit: fit.stderr.values(),
        each="element", unit="element", shown="always",
    ),
    Column("{}_change", "change", lambda fit: fit.known_changes[0], each="moved"),
    Column("rrse", "rrse", heading="RRSE [%]", text=lambda part: significant(100 * part)),
    Column("chi2", "chi2", heading="χ²", text=lambda value: significant(value, 3)),
    Column("steps", "steps", kind="integer"),
    Column("verdict", "result", lambda fit: fit.verdict, "text", read=verdicts_of, shown="always"),
    Column("remarks", "remarks", lambda fit: _words(fit.remarks), "text", read=_remarks),
    Column("at_bound", "", lambda fit: fit.limits and fit.outside, "text", needs="at_bound"),
    Column("note", kind="text", shown="always"),
    Column("cov", "cov", axes=("element", "element"), shown="file"),
    Column("shared_cov", "shared_cov", axes=("element", "element"), shown="file"),
    Column(
        "change_stderr", "change_stderr", lambda fit: fit.known_changes[1],
        axes=("moved",), shown="file",
    ),
    *(
        Column(
            name, name, lambda fit, name=name: getattr(fit.limits, name, None),
            axes=("element",), needs="outside", shown="file",
        )
        for name in ("lower", "upper", "outside")
    ),
)  # fmt: skip


def named(elements: Mapping[str, str]) -> dict[str, tuple[Column, Any, str]]:
    """The columns of fits by name, with the place of each in its values, and its unit.

    Args:
        elements: SI units of the elements by name.
    """
    items = {"": [""], "element": [*elements], "moved": [*elements, "amplitude"]}
    found = {}
    for each, group in itertools.groupby(COLUMNS, lambda column: column.each):
        alike = list(group)
        for at, item in enumerate(items[each]):
            for column in alike:
                unit = elements[item] if column.unit == "element" else column.unit
                found[column.name.format(item)] = column, (..., at) if each else ..., unit
    return found


def table_of(fit: Any, beside: Mapping[str, Any], *, file: bool = False) -> dict[str, np.ndarray]:
    """The columns of a fit, or of a batch of fits, by name.

    Args:
        fit: The `Fit`.
        beside: The columns that are not of the fits, as far as they are known.
        file: Whether those that only a file has are among them.
    """
    found = {}
    for name, (column, place, _) in named(fit.circuit.units()).items():
        if column.of is not None:
            values = column.of(fit)
        else:
            values = getattr(fit, column.field) if column.field else beside.get(name)
        if values is not None and (file or column.shown != "file"):
            found[name] = np.asarray(values)[place]
    return found


def described(recordings: Sequence[Mapping[str, Any]]) -> dict[str, np.ndarray]:
    """The columns of `Fits.labels`.

    Args:
        recordings: Fields of each recording by name. A missing label becomes empty, a missing
            number NaN.
    """
    return {
        name: np.array([one.get(name) or "" for one in recordings], str)
        if column.kind == "text"
        else np.array([one.get(name) for one in recordings], float)
        for name, column in DESCRIBED.items()
    }


def long_form(columns: Mapping[str, np.ndarray], units: Mapping[str, str]) -> dict[str, np.ndarray]:
    """A table of fits with one row per element: `element`, `unit`, `value`, `stderr`, `change`.

    Args:
        columns: The columns of `Fits.table()`, or some of them. Those that are not of an element
            stay.
        units: Units of the elements.
    """
    own = {  # {}_stderr becomes stderr
        column.name[3:] or "value": [column.name.format(name) for name in units]
        for column in COLUMNS
        if column.each
    }
    own = {part: names for part, names in own.items() if columns.keys() >= {*names}}
    rest = columns.keys() - {*itertools.chain(*own.values())}
    count = len(columns["path"])
    return {
        **{name: np.repeat(of, len(units)) for name, of in columns.items() if name in rest},
        "element": np.tile(list(units), count),
        "unit": np.tile(list(units.values()), count),
        **{
            part: np.stack([columns[name] for name in names], axis=1).ravel()
            for part, names in own.items()
        },
    }
