"""A folder of files whose names contain the labels of their recordings.

A pattern such as `{subject}_{session}_{condition}_{trial}.csv` says which part of a name is which
label. `{r_load}` is a known resistor [ohm]: 98800, 98k8 or 98.8k. A file has the labels of the
first pattern that its name matches. What the pattern cannot tell is not guessed: a label contains
none of the characters that separate the labels, and files that match no pattern are left out and
listed.

The table `calibrations.csv` of a folder, with the columns `file` and `ohm`, names resistors too.
"""

import dataclasses
import os
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import tomli_w

from etid.files.assemble import Imported
from etid.files.channel import listed
from etid.files.importing import channels_of, converted, other_file
from etid.files.labels import further_files, labelled
from etid.files.mapping import CHANNELS
from etid.printing import several
from etid.recordings.errors import RecordingError
from etid.recordings.fields import LABELS
from etid.recordings.replacing import replacing


@dataclasses.dataclass(frozen=True)
class ImportedFolder:
    """What became of the files of a folder.

    Attributes:
        imported: Sources of the recordings of each file, by its path from the folder.
        labels: Labels of each file, and its `r_load` [ohm].
        unmatched: Files that match no pattern.
        mapping: The mapping that imports the same files again.
    """

    imported: Mapping[str, Sequence[Imported]]
    labels: Mapping[str, Mapping[str, Any]]
    unmatched: Sequence[str]
    mapping: pathlib.Path

    def __str__(self) -> str:
        lines = []
        files_of: dict[str, list[str]] = {}  # the files with a line about a channel
        for file, labels in self.labels.items():
            of = self.imported[file]
            said = [f"{n} {labels[n]}" for n in labels if n != "r_load"]
            said += [f"{labels[n] / 1e3:g} kΩ" for n in labels if n == "r_load"]
            paths = [path for one in of for path in one.paths]
            where = paths[0] + (f" … {paths[-1]}" if len(paths) > 1 else "")
            sizes = " or ".join(dict.fromkeys(str(one.samples) for one in of))
            lines.append(f"{file} → {where}: {', '.join(said)}; {several(sizes, 'sample')}")
            lines += dict.fromkeys(note for one in of for note in one.notes)
            for line in dict.fromkeys(line for one in of for line in one.channels):
                files_of.setdefault(line, []).append(file)
        channels = [  # files differ where only some name a unit
            line if len(files) == len(self.labels) else f"{line}: {listed(files)}"
            for line, files in files_of.items()
        ]
        known = sum("r_load" in of for of in self.labels.values())
        files = several(len(self.labels), "file")
        lines += [*channels, f"{files}, {known} of them with a known resistor"]
        if known == len(self.labels):
            lines.append("no file of skin: none without a resistor matches a pattern")
        if self.unmatched:
            lines.append(f"left out, matches no pattern: {', '.join(self.unmatched)}")
        return "\n".join([*lines, f"mapping: {self.mapping}"])


def import_folder(
    folder: str | os.PathLike[str],
    target: str | os.PathLike[str],
    labels: str | Sequence[str],
    **given: Any,
) -> ImportedFolder:
    """Convert the files of a folder into one etid file, with labels from their names.

    A recording names the calibrations whose labels do not contradict its own as its calibrations:
    with `{session}` in both patterns, those of its session; and of several electrodes in one file,
    that of its own. A channel of a further file, `FILE:NAME`, may have labels in the name of this
    file: `v_th="open_{trial}.csv:CH1"` is in a file for each trial, and that of the calibration
    `cal_98k8.csv`, which has no trial, in `open_98k8.csv`.

    Beside the target, the mapping `TARGET.toml` is written: `import_file(FOLDER, target, mapping)`
    imports the same files again.

    Args:
        folder: Folder of the files; files of folders in it match patterns with a `/`.
        target: etid file to write. An existing file is replaced.
        labels: One or several patterns of names with `{subject}`, `{session}`, `{site}`,
            `{condition}`, `{electrode}`, `{trial}` and `{r_load}`. The first that matches counts.
        **given: Channels, rates and the dialect of tables, as for `import_file`; they apply to all
            files.

    Returns:
        The labels and sources of each file, and the files that were left out.

    Raises:
        RecordingError: A pattern is wrong, no file matches, a calibration is missing, or a file
            cannot be read.
    """
    root = pathlib.Path(os.fspath(folder))
    common = channels_of({name: value for name, value in given.items() if value is not None})
    further = {
        name: file
        for name in CHANNELS
        if name in common and (file := other_file(str(common[name]["channel"]))[0])
    }
    patterns = [labels] if isinstance(labels, str) else labels
    found, unmatched = labelled(root, patterns, [*further.values()])
    turns = {name: common.pop(name) for name in ("split", "electrode") if name in common}
    tables = {file: {**of, "path": _path(of)} for file, of in found.items()}
    for file, of in tables.items():
        if "r_load" not in of:  # calibrations are not split
            of.update(turns)
        names = _calibrations(file, of, tables)
        if names:
            of["calibration"] = names
    for name, text in further.items():
        if "{" in text:
            _, channel = other_file(common.pop(name)["channel"])
            for file, own in further_files(root, text, name, found).items():
                tables[file][name] = {"channel": f"{own}:{channel}"}
    said = {root / file: {**common, **of} for file, of in tables.items()}
    imported = converted(said, target, root=root)
    mapping = pathlib.Path(os.fspath(target)).with_suffix(".toml")
    files = {file: [one for one in imported if one.file == str(root / file)] for file in tables}
    _say_units(common, tables, files)
    content = {**common, "recording": [{"file": file, **of} for file, of in tables.items()]}
    with replacing(mapping) as partial:
        partial.write_text(tomli_w.dumps(content), "utf-8")
    return ImportedFolder(files, found, unmatched, mapping)


def _say_units(
    common: dict[str, Any],
    tables: Mapping[str, dict[str, Any]],
    files: Mapping[str, Sequence[Imported]],
) -> None:
    """Add the units that the command implied, because a mapping implies none.

    They come into the table of each file that names none itself, or into `common` if no file does.
    """
    for name in CHANNELS:
        implied = {
            file: {**(tables[file].get(name) or common[name]), "unit": one.signals[name].unit}
            for file, of in files.items()
            for one in of
            if name in one.signals and one.signals[name].unit_by == "command"
        }
        if name in common and len(implied) == len(files):
            common[name] = next(iter(implied.values()))
        else:
            for file, channel in implied.items():
                tables[file][name] = channel


def _path(of: Mapping[str, Any]) -> str:
    """HDF5 path of a recording: its labels, and the resistor of a calibration."""
    parts = [str(value) for name, value in of.items() if name != "r_load"]
    if "r_load" in of:
        return "/".join(["calibration", *parts, f"{of['r_load']:.9g}"])
    return "/".join(parts if len(parts) > 1 else ["loaded", *parts])


def _calibrations(file: str, of: Mapping[str, Any], tables: Mapping[str, Any]) -> list[str]:
    """Paths of the calibrations of a recording; none for a calibration.

    Raises:
        RecordingError: There are calibrations, but none of this recording.
    """
    known = {name: one for name, one in tables.items() if "r_load" in one}
    if "r_load" in of or not known:
        return []

    def fits(one: Mapping[str, Any]) -> bool:
        return all(of.get(name, one[name]) == one[name] for name in LABELS if name in one)

    found = [str(one["path"]) for one in known.values() if fits(one)]
    if not found:
        raise RecordingError(
            f"no calibration has its labels {', '.join(str(of[n]) for n in LABELS if n in of)}",
            file=file,
            remedy="Label the calibrations by fewer labels, or add the one that is missing",
        )
    return found
