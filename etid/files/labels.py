"""Labels in the names of the files of a folder, and resistors in its table `calibrations.csv`."""

import math
import pathlib
import re
from collections.abc import Mapping, Sequence
from typing import Any

from etid.files.channel import located
from etid.files.pattern import pattern
from etid.printing import several
from etid.recordings.errors import RecordingError
from etid.recordings.resistance import resistance
from etid.recordings.tables import rows_of

TABLE = "calibrations.csv"


def labelled(
    root: pathlib.Path, patterns: Sequence[str], further: Sequence[str] = ()
) -> tuple[dict[str, dict[str, Any]], list[str]]:
    """Labels of each file of a folder that matches a pattern, and the other files.

    Args:
        root: The folder.
        patterns: Patterns of names; the first that matches counts.
        further: Names or patterns of files with channels of other recordings. They are in neither
            result.

    Raises:
        RecordingError: As `import_folder`.
    """
    if not root.is_dir():
        raise RecordingError("there is no such folder", file=str(root), remedy="Check the path")
    expressions = [pattern(text, ("r_load",)) for text in patterns]
    known = _table(root)
    deep = any("/" in text for text in patterns)
    others = {path.resolve() for text in further for path in _of_pattern(root, text)}
    others |= {pathlib.Path(text).resolve() for text in further}
    files = sorted(
        path.relative_to(root).as_posix()
        for path in root.glob("**/*" if deep else "*")
        if path.is_file() and path.name != TABLE and path.resolve() not in others
    )
    found: dict[str, dict[str, Any]] = {}
    for file in files:
        match = next(filter(None, (each.fullmatch(file) for each in expressions)), None)
        if match is None and file not in known:
            continue
        of: dict[str, Any] = {} if match is None else match.groupdict()
        if "r_load" in of:
            with located(str(root / file)):
                of["r_load"] = _resistor(of["r_load"])
        if file in known:
            named = of.setdefault("r_load", known[file])
            if not math.isclose(named, known[file]):
                raise RecordingError(
                    f"says {known[file]:g} ohm of {file!r}, whose name says {named:g} ohm",
                    file=str(root / TABLE),
                    field="ohm",
                    remedy="Correct the one that is wrong",
                )
        found[file] = of
    for missing in known.keys() - found.keys():
        raise RecordingError(
            f"names {missing!r}, which is not in the folder", file=str(root / TABLE), field="file"
        )
    if not files:
        raise RecordingError("holds no file", file=str(root), remedy="Name the folder of the files")
    if not found:
        raise RecordingError(
            f"none of its {several(len(files), 'file')} matches {' or '.join(map(repr, patterns))}",
            file=str(root),
            field="labels",
            remedy=f"Write the names as they are, with labels in braces; the first file is "
            f"{files[0]!r}",
        )
    calibrations_first = dict(sorted(found.items(), key=lambda one: "r_load" not in one[1]))
    return calibrations_first, [file for file in files if file not in found]


def _of_pattern(root: pathlib.Path, text: str) -> dict[pathlib.Path, dict[str, Any]]:
    """Labels of the files of a folder that match one pattern, which may be a name without any."""
    if "{" not in text:
        return {root / text: {}}
    expression = pattern(text, ("r_load",))
    found = {}
    for path in sorted(root.glob("**/*" if "/" in text else "*")):
        match = expression.fullmatch(path.relative_to(root).as_posix())
        if match is not None:
            found[path] = match.groupdict()
            if "r_load" in found[path]:
                with located(str(path)):
                    found[path]["r_load"] = _resistor(found[path]["r_load"])
    return found


def further_files(
    root: pathlib.Path, text: str, signal: str, found: Mapping[str, Mapping[str, Any]]
) -> dict[str, str]:
    """The further file of each file: the one of a pattern whose labels are its own.

    That of a calibration may have its resistor in the place of a label that the calibration lacks:
    of `open_{trial}.csv`, the file of `cal_98k8.csv` is `open_98k8.csv`.

    Raises:
        RecordingError: A file has none of its own.
    """
    others = _of_pattern(root, text)
    if not others:
        raise RecordingError(
            f"no file of the folder matches {text!r}",
            file=str(root),
            field=signal,
            remedy="Write the name of the further file as seen from the folder",
        )
    own: dict[str, str] = {}
    for file, of in found.items():
        fitting = [
            path
            for path, its in others.items()
            if all(_same(label, value, of) for label, value in its.items())
        ]
        if len(fitting) != 1:
            labels = re.findall(r"\{(\w+)\}", text)
            lacking = [label for label in labels if label not in of]
            raise RecordingError(
                f"none of the {len(others)} files {text!r} has the {' and '.join(labels)} of this "
                "file" + f", whose name tells no {' and '.join(lacking)}" * bool(lacking),
                file=str(root / file),
                field=signal,
                remedy="Add the file that is missing, or name the further file of each recording "
                "in a mapping",
            )
        own[file] = fitting[0].relative_to(root).as_posix()
    return own


def _same(label: str, value: Any, of: Mapping[str, Any]) -> bool:
    """Whether a file has a label with this value, or this resistor in its place."""
    if label in of or "r_load" not in of:
        return of.get(label) == value
    try:
        return resistance(value) == of["r_load"]
    except RecordingError:
        return False


def _resistor(text: str) -> float:
    """Resistance [ohm] of a part of a name."""
    try:
        return resistance(text)
    except RecordingError as error:
        error.remedy += f", or list the file in {TABLE}"
        raise


def _table(root: pathlib.Path) -> dict[str, float]:
    """Resistors [ohm] of the files that `calibrations.csv` lists; none without this file."""
    table = root / TABLE
    if not table.is_file():
        return {}
    with located(str(table)):
        found = {}
        for row in rows_of(table, ("file", "ohm")):
            if row["file"] in found:
                raise RecordingError(
                    f"lists {row['file']!r} twice", field="file", remedy="Keep one of the rows"
                )
            found[row["file"]] = resistance(row["ohm"], "ohm")
        return found
