"""Measured impedances from a table of text, or from the file of a potentiostat.

A table is read as it is written: only one choice of delimiter and decimal sign makes numbers of its
cells. The names of its columns say what they are; a table without names has frequency, real and
imaginary part. What the names leave open is an error.
"""

import math
import os
import pathlib
import re
from collections.abc import Sequence

import numpy as np
from jaxtyping import Complex, Float

from etid.files.channel import listed, located
from etid.files.readers.delimited import Dialect, likely_dialect
from etid.printing import several
from etid.recordings import limits
from etid.recordings.errors import RecordingError, optional, require_file

INSTRUMENTS = (
    "gamry", "autolab", "parstat", "zplot", "versastudio", "powersuite", "biologic",
    "chinstruments",
)  # fmt: skip
WITHOUT_NAMES = ("frequency", "real", "imaginary")
REMEDY = (
    "Name the columns frequency [Hz], Re [ohm] and Im [ohm], or |Z| [ohm] and phase [deg]; or name "
    "the instrument"
)
# Names of columns in small letters, without blanks, dots, lines and what is in brackets.
_NAMES = {
    "frequency": ("f", "freq", "frequency", "frequenz"),
    "real": ("re", "rez", "real", "realz", "zre", "zreal", "zr", "z'", "r", "rs", "resistance"),
    "imaginary": ("im", "imz", "imag", "imagz", "imaginary", "zim", "zimag", "zimg", "zi", "z''",
                  "x", "xs", "reactance"),
    "magnitude": ("|z|", "z", "absz", "abs", "zabs", "zmod", "zmag", "mag", "magnitude", "modulus"),
    "phase": ("phase", "phasez", "zphase", "zphz", "phi", "φ", "theta", "θ", "arg", "argz", "zarg",
              "phaseangle"),
}  # fmt: skip
_SIGNS = {
    "\N{DOUBLE PRIME}": "''",
    "\N{PRIME}": "'",
    "\N{RIGHT SINGLE QUOTATION MARK}": "'",
    "\N{MINUS SIGN}": "-",
    '"': "''",
}
_ROLES = {name: role for role, names in _NAMES.items() for name in names}
_PREFIXES = {"": 1.0, "m": 1e-3, "k": 1e3, "K": 1e3, "M": 1e6, "G": 1e9}
_ANGLES = {"deg": math.pi / 180, "degree": math.pi / 180, "degrees": math.pi / 180,
           "°": math.pi / 180, "rad": 1.0, "radian": 1.0, "radians": 1.0}  # fmt: skip


def read_impedance(
    path: str | os.PathLike[str], instrument: str | None = None
) -> tuple[Float[np.ndarray, " frequency"], Complex[np.ndarray, " frequency"]]:
    """Frequencies [Hz] and impedance [Ω] of a file, for `identify_impedance`.

    Args:
        path: The file.
        instrument: Program that wrote it: `gamry`, `autolab`, `parstat`, `zplot`, `versastudio`,
            `powersuite`, `biologic` or `chinstruments`. If not given, the file is a table of text
            with the columns frequency, real and imaginary part, or |Z| and phase, named as in
            `f [kHz], |Z| (ohm), phase (deg)`; without names, it has the first three. Its cells may
            have commas, semicolons, tabs or blanks between them, and decimal commas. The imaginary
            part has a minus in front of its name where the file contains −Im Z.

    Raises:
        RecordingError: The file cannot be read, a column is missing or unclear, the instrument is
            not known, or the package impedance, which reads files of instruments, is not installed.
    """
    file = pathlib.Path(path)
    if instrument is not None and instrument not in INSTRUMENTS:
        raise RecordingError(
            f"is {instrument!r}", field="instrument", remedy=f"Use one of {', '.join(INSTRUMENTS)}"
        )
    require_file(str(file))
    if instrument is None:
        with located(str(file)):
            return _of_table(file)
    readers = optional("impedance.preprocessing", "eis", str(file), "impedance")
    # The readers raise any error for a file of another instrument, even UnboundLocalError.
    with located(str(file), remedy="Name its instrument"):
        frequency, impedance = readers.readFile(str(file), instrument)
        frequency, z = np.asarray(frequency, float), np.asarray(impedance, complex)
        if frequency.size == 0 or frequency.shape != z.shape:
            raise RecordingError("holds no impedances", remedy="Name the instrument")
    return frequency, z


def _of_table(
    path: pathlib.Path,
) -> tuple[Float[np.ndarray, " frequency"], Complex[np.ndarray, " frequency"]]:
    size = path.stat().st_size
    if size > limits.MAPPING:
        raise RecordingError(
            f"has {size} bytes, more than the {limits.MAPPING} bytes of a table of impedances",
            remedy="Give a spectrum, not a recording",
        )
    dialect = likely_dialect(path)
    if dialect is None:
        raise RecordingError("holds no table of numbers", remedy=REMEDY)
    lines = path.read_text(dialect.encoding).splitlines()
    names, first = _names(lines, dialect)
    columns: dict[str, int] = {}
    for place, name in enumerate(names):
        role = _role(name)[0]
        if role in columns:
            twice = listed(names[one] for one in (columns[role], place))
            raise RecordingError(f"has two columns of the {role}: {twice}", remedy="Remove one")
        if role:
            columns[role] = place
    given = [roles for roles in (("real", "imaginary"), ("magnitude", "phase"))
             if columns.keys() >= {*roles}]  # fmt: skip
    if "frequency" not in columns or not given:
        raise RecordingError(
            f"its columns {listed(names)} do not say the frequency, and real and imaginary part or "
            "magnitude and phase",
            remedy=REMEDY,
        )
    numbers = _numbers(lines, first, dialect, [*columns.values()])
    values = dict(zip(columns, numbers.T, strict=True))
    for role, place in columns.items():
        values[role] = values[role] * _factor(role, names[place], values[role])
    found = [
        values["real"] + 1j * values["imaginary"]
        if roles[0] == "real"
        else values["magnitude"] * np.exp(1j * values["phase"])
        for roles in given
    ]
    # Printed angles have one or two digits behind the point; a wrong sign or unit is far more.
    if len(found) == 2 and (np.abs(found[0] - found[1]) > 0.05 * np.abs(found[0])).any():
        raise RecordingError(
            "real and imaginary part contradict magnitude and phase",
            remedy="Correct the sign or the unit in the names of the columns, or remove two",
        )
    return values["frequency"], found[0]


def _names(lines: Sequence[str], dialect: Dialect) -> tuple[list[str], int]:
    """Names of the columns, and the number of lines above the numbers.

    A line of units, or one that ends the comments, may stand below the names.
    """
    if not dialect.header_line:
        first = next(i for i, line in enumerate(lines) if dialect.are_numbers(dialect.cells(line)))
        width = len(dialect.cells(lines[first]))
        if first:  # names with blanks, in a table with blanks between its cells
            cells = dialect.cells(re.sub(r"\s+([\[(])", r"\1", lines[first - 1]))
            if len(cells) == width:
                return cells, first
            raise _blanks(first, cells, width)
        if width == len(WITHOUT_NAMES):
            return [*WITHOUT_NAMES], first
        raise RecordingError(f"has {several(width, 'column')} without names", remedy=REMEDY)
    header = dialect.header_line - 1
    for place in (header, header - 1):
        cells = dialect.cells(lines[place]) if place >= 0 else []
        if any(_role(cell)[0] == "frequency" for cell in cells):
            width = len(dialect.cells(lines[header + 1]))
            if dialect.delimiter == " " and len(cells) != width:
                raise _blanks(place + 1, cells, width)
            below = dialect.cells(lines[header]) if place < header else []
            units = [cell.strip("()[] ") for cell in below]
            if len(units) == len(cells) and all(_is_unit(unit) for unit in units if unit):
                cells = [
                    f"{cell} [{unit}]" if unit else cell
                    for cell, unit in zip(cells, units, strict=True)
                ]
            return cells, header + 1
    return dialect.cells(lines[header]), header + 1


def _blanks(line: int, cells: Sequence[str], width: int) -> RecordingError:
    """The error for names with blanks, in a table with blanks between its cells."""
    return RecordingError(
        f"line {line} names {several(len(cells), 'column')}, but there are {width} columns of "
        "numbers",
        remedy="Separate the cells by commas or semicolons in place of blanks",
    )


def _numbers(
    lines: Sequence[str], first: int, dialect: Dialect, places: list[int]
) -> Float[np.ndarray, "row column"]:
    rows: list[list[float]] = []
    for number, line in enumerate(lines[first:], first + 1):
        if not line.strip():
            continue
        cells = dialect.cells(line)
        row = [dialect.number(cells[place]) if place < len(cells) else None for place in places]
        for place, value in zip(places, row, strict=True):
            if value is None or not math.isfinite(value):
                cell = cells[place] if place < len(cells) else ""
                raise RecordingError(
                    f"line {number} has {cell!r} in column {place + 1}, must be a number",
                    remedy="Correct or remove this line",
                )
        rows.append([value for value in row if value is not None])
    return np.array(rows)


def _role(name: str) -> tuple[str, str, bool]:
    """What a column is, the unit in its name, and whether it has a minus in front."""
    text = name.strip()
    for written, usual in _SIGNS.items():
        text = text.replace(written, usual)
    negative = text.startswith("-")
    match = re.fullmatch(r"(.*?)\s*(?:\[([^\]]*)\]|\(([^()]*)\)|/\s*([^/\s]+))", text)
    base, unit = (text, "") if match is None else (match[1], match[2] or match[3] or match[4] or "")
    *words, last = re.split(r"[\s_]+", base)
    if words and not unit and _is_unit(last):  # as in phase_deg
        base, unit = " ".join(words), last
    if _is_unit(unit):
        return _plain(base), unit, negative
    # What is in brackets is no unit, as in Re(Z) and Z'(a).
    role = _plain(text) or _plain(base)
    return role, "" if _plain(text) or len(unit) == 1 else unit, negative


def _plain(name: str) -> str:
    """What a column of this name is, without unit and sign."""
    plain = re.sub(r"\(([a-z])\)", r"\1", name.lower().lstrip("-"))
    plain = re.sub(r"[\s_.\-]", "", plain)
    for word in ("impedance", "trace"):
        plain = plain.removeprefix(word) or ("|z|" if word == "impedance" else "")
    return _ROLES.get(plain, "")


def _is_unit(text: str) -> bool:
    return text.lower() in _ANGLES or _scale(text, ("hz", "ohm", "ohms", "Ω", "ω")) is not None


def _scale(unit: str, known: Sequence[str]) -> float | None:
    """Size of a unit with its prefix; None if it is none of the known ones, in small letters."""
    unit = unit.strip().replace("\N{OHM SIGN}", "Ω")
    for size in range(2):
        if unit[size:].lower() in known and unit[:size] in _PREFIXES:
            return _PREFIXES[unit[:size]]
    return None


def _factor(role: str, name: str, values: Float[np.ndarray, " row"]) -> float:
    """What a column is multiplied with: its unit, and −1 for a name with a minus."""
    _, unit, negative = _role(name)
    sign = -1.0 if negative else 1.0
    if role != "phase":
        scale = _scale(unit, ("hz",) if role == "frequency" else ("ohm", "ohms", "Ω", "ω"))
        if unit and scale is None:
            raise RecordingError(f"column {name!r} has the unit {unit!r}", remedy=REMEDY)
        return sign * (1.0 if scale is None else scale)
    if not unit and np.max(np.abs(values)) <= 2 * math.pi:
        raise RecordingError(
            f"the unit of the column {name!r} is not said, and it may be degrees or radians",
            remedy="Name it phase [deg] or phase [rad]",
        )
    if unit and unit.lower() not in _ANGLES:
        raise RecordingError(f"column {name!r} has the unit {unit!r}", remedy=REMEDY)
    return sign * _ANGLES[unit.lower() or "deg"]
