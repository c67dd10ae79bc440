"""Import of files of other formats into files of recordings.

A reader for each format (`etid.files.readers`) lists the channels of a file. A mapping
(`etid.files.mapping`) assigns channels to signals. `etid.files.assemble` makes recordings from the
channels. The recordings are written while they are read.
"""

import contextlib
import dataclasses
import os
import pathlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Literal

from etid.files import formats
from etid.files.assemble import Imported, sources_of
from etid.files.channel import Channel, Contents, located
from etid.files.mapping import (
    CHANNELS,
    KINDS,
    files_of,
    of_files,
    plans,
    read_mapping,
    recordings_of,
)
from etid.files.readers import delimited
from etid.recordings.errors import require_file
from etid.recordings.fields import DECLARED, Metadata
from etid.recordings.recording import AbstractSource, RecordingError, check_rates
from etid.recordings.study import Study, refuse_nested


def import_file(
    source: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    target: str | os.PathLike[str],
    mapping: str | os.PathLike[str] | Mapping[str, Any] | None = None,
    *,
    calibrations: Mapping[str | os.PathLike[str], float | str] | None = None,
    **given: Any,
) -> list[Imported]:
    """Convert one or several files of other formats into one etid file.

    The suffix of a file gives its format; data_schema/README.md lists the formats.

    With `split`, one long record becomes several trials: `"pulses"` splits it at the pauses between
    its pulses, the name of a trigger channel at the rising edges of the trigger. Files of
    `calibrations` are not split, and get none of the electrodes of the parts.

    A channel may be in another file, as when V_th was recorded once for all trials: `FILE:NAME` is
    channel `NAME` of `FILE`, a path from the current folder, or from the folder that is imported.

    A channel may be a pattern, as in `v_out="CH{electrode}"`: each channel that matches becomes a
    recording with this label. So a file with a channel for each electrode of an array is imported.
    Of a file of `calibrations` with several electrodes, a recording names that of its own; of one
    electrode, all recordings name it.

    A mapping assigns channels to signals; data_schema/README.md lists its keys. For one recording,
    arguments with the same names can replace the mapping. With arguments, a channel without a unit
    in the file is in volt, ampere or second. The trials of a recording without a path become
    `loaded/0`, … or, with `r_load`, `calibration/0`, …. If several files are imported, such a
    recording has the name of its file: `loaded/finger` from `finger.csv`. In a mapping, each
    recording then has the key `file`, the name of its file without the folder.

    Only a part of a record is in memory at a time, except for MATLAB files before version 7.3,
    `.npz`, and records that are split.

    Args:
        source: File or files to import; the suffix of a file gives its format. With a mapping it
            may be a folder, which contains the files that the mapping names.
        target: etid file to write. An existing file is replaced.
        mapping: TOML file, or its content as a mapping. It replaces all other arguments.
        calibrations: More files to import, each with its known resistor, `r_load` [ohm], a number
            or a text such as `98k8`. All other arguments apply to them too. The other recordings
            name them as their calibrations.
        **given: Keys of a mapping for one recording: for a table of text, `delimiter`, `decimal`,
            `header_line` and `encoding` if they are not `,`, `.`, 1 and UTF-8; the channel names
            `v_th`, `v_out`, `current` and `time`; `scale`; and fields such as `pulse_rate` [Hz].

    Returns:
        Sources of each recording or stack of trials: channels, units and sample rate.

    Raises:
        RecordingError: The file cannot be read, or a fact about it is missing or wrong.
    """
    single = isinstance(source, str | os.PathLike)
    paths = [pathlib.Path(os.fspath(one)) for one in ([source] if single else source)]
    known = resistors((calibrations or {}).items())
    paths = [*known, *(path for path in paths if path not in known)]  # loaded ones name the others
    given = {name: value for name, value in given.items() if value is not None}
    if mapping is None:
        common = channels_of(given)
        turns = ("split", "electrode") if "split" in common else ()
        whole = {name: value for name, value in common.items() if name not in turns}
        named = {"calibration": [f"{KINDS[1]}/{path.stem}" for path in known]} if known else {}
        said = {
            path: whole | {"r_load": known[path]} if path in known else common | named
            for path in paths
        }
        return converted(said, target)
    more = {"calibrations": known} if known else {}
    _refuse(given | more, str(paths[0]), "cannot be an argument together with a mapping")
    inside = isinstance(mapping, Mapping)
    place = "" if inside else f"{os.fspath(mapping)} of "
    with located(place + str(paths[0])):
        content = mapping if inside else read_mapping(mapping)
        root = paths[0] if len(paths) == 1 and paths[0].is_dir() else None
        if root is not None:
            names = files_of(content)
            paths = [root / name for name in names]
        else:
            names = [path.name for path in paths]
        tables = of_files(content, names)
    said = dict(zip(paths, tables, strict=True))
    return converted(said, target, place=place, by="mapping", root=root)


import_file.__doc__ = (import_file.__doc__ or "").replace(
    "data_schema/README.md lists the formats.",
    "the formats are\n\n    " + formats.as_list().replace("\n", "\n    "),
)


def resistors(
    calibrations: Iterable[tuple[str | os.PathLike[str], float | str]],
) -> dict[pathlib.Path, float]:
    """The known resistor of each file of calibrations [ohm].

    Raises:
        RecordingError: A file occurs twice.
    """
    known: dict[pathlib.Path, float] = {}
    for one, r_load in calibrations:
        path = pathlib.Path(os.fspath(one))
        if path in known:
            raise RecordingError(
                f"is given with two resistors, {known[path]:.9g} and {r_load} ohm",
                file=str(path),
                field="calibrations",
                remedy="Give each file once, with the resistor with which it was recorded",
            )
        with located(str(path)):
            known[path] = DECLARED["r_load"].checked(r_load)
    return known


def channels_of(given: Mapping[str, Any]) -> dict[str, Any]:
    """The keys of a mapping from the arguments of a call."""
    return {
        name: {"channel": value} if name in CHANNELS else value for name, value in given.items()
    }


def converted(
    said: Mapping[pathlib.Path, Mapping[str, Any]],
    target: str | os.PathLike[str],
    *,
    place: str = "",
    by: Literal["command", "mapping"] = "command",
    root: pathlib.Path | None = None,
) -> list[Imported]:
    """Convert files, each with a mapping of its own, into one etid file.

    Args:
        said: The mapping of each file; calibrations come before the recordings that name them.
        target: etid file to write.
        place: Text before the name of a file in errors.
        by: Source of the mappings. Channels that a command names without a unit are in volt,
            ampere or second.
        root: Folder that is imported, in which further files of channels may be.

    Returns:
        Sources of each recording or stack of trials.

    Raises:
        RecordingError: As `import_file`.
    """
    folder = pathlib.Path(os.fspath(target)).parent
    if not folder.is_dir():
        raise RecordingError("the folder of this file does not exist", file=os.fspath(target))
    for path in said:
        require_file(str(path))
        formats.reader_of(path)
    sources: dict[str, AbstractSource] = {}
    used: list[Imported] = []
    calibrations: dict[str, Metadata] = {}
    with contextlib.ExitStack() as files:
        for path, table in said.items():
            file = str(path)
            written = {name: table[name] for name in delimited.DIALECT if name in table}
            told = {name: value for name, value in table.items() if name not in written}
            if not formats.reader_of(path).dialect:
                _refuse(written, file, f"is only for tables of text: {', '.join(formats.OF_TEXT)}")
            with located(file):

                def opened(one: pathlib.Path, written: Mapping[str, Any] = written) -> Contents:
                    its = formats.reader_of(one)
                    own = written if its.dialect else {}
                    return files.enter_context(its.open(one, folder, **own))

                contents = opened(path)
                with located(place + file):
                    contents = with_others(contents, told, opened, root)
                    planned = plans(told, contents.names, path.stem if len(said) > 1 else "")
                contents.prepare({name for plan in planned for name in plan.channels})
                for plan in planned:
                    with located(file, path=plan.path if len(planned) > 1 else ""):
                        found, made_of = sources_of(plan, contents.channel, file, by, calibrations)
                    for each in found.values():
                        with located(file):
                            names = {record.name for record in each.layout}
                            cause = "v_th" if "v_th" in names else "current"
                            check_rates(next(each.blocks(cause)), each.metadata)
                    for twice in sources.keys() & found.keys():
                        raise RecordingError(
                            "another recording has this path",
                            path=twice,
                            remedy="Rename the file, or give each recording a path in a mapping",
                        )
                    sources |= found
                    if plan.fields.get("r_load") is not None:
                        calibrations |= {path: one.metadata for path, one in found.items()}
                    used.append(made_of)
        with located(str(next(iter(said)))):
            refuse_nested(sources)
            Study(sources).write(target)
    return used


def _refuse(given: Mapping[str, Any], file: str, reason: str) -> None:
    for name in given:
        raise RecordingError(reason, file=file, field=name, remedy="Remove the argument")


# --- Channels of other files ----------------------------------------------------------------------


def other_file(name: str) -> tuple[str, str]:
    """File and channel of a name such as `open.csv:CH1`; the file is empty in another name."""
    places = [place for place, character in enumerate(name) if character == ":"]
    for place in places:
        if pathlib.Path(name[:place]).suffix.lower() in formats.SUFFIXES:
            return name[:place], name[place + 1 :]
    return "", name


def with_others(
    contents: Contents,
    mapping: Mapping[str, Any],
    opened: Callable[[pathlib.Path], Contents],
    root: pathlib.Path | None,
) -> Contents:
    """The contents of a file, together with the channels of other files that a mapping names.

    A mapping names such a channel `FILE:NAME`: channel `NAME` of the file with this path, from the
    folder that is imported or from the current one. So V_th may be recorded once for all trials.
    """
    others: dict[str, Contents] = {}
    for said in (mapping, *recordings_of(mapping)):
        for signal in CHANNELS:
            name = str(of.get("channel")) if isinstance(of := said.get(signal), Mapping) else ""
            file, _ = other_file(name)
            if file and name not in contents.names and file not in others:
                with located(field=signal):
                    path = _found(file, root)
                with located(str(path)):
                    others[file] = opened(path)
    if not others:
        return contents

    def channel(name: str) -> Channel:
        if name in contents.names:
            return contents.channel(name)
        file, own = other_file(name)
        with located(file):
            return dataclasses.replace(others[file].channel(own), name=name)

    def prepare(names: Iterable[str]) -> None:
        wanted = set(names)
        contents.prepare(wanted.intersection(contents.names))
        for file, other in others.items():
            with located(file):
                other.prepare({one for one in other.names if f"{file}:{one}" in wanted})

    foreign = (f"{file}:{name}" for file, other in others.items() for name in other.names)
    return Contents((*contents.names, *foreign), channel, prepare)


def _found(file: str, root: pathlib.Path | None) -> pathlib.Path:
    """Path of a further file, in the folder that is imported or in the current one."""
    folders = [pathlib.Path()] if root is None else [root, pathlib.Path()]
    paths = [folder / file for folder in folders if (folder / file).is_file()]
    if not paths:
        where = "" if root is None else f"the folder {str(root)!r} or in "
        raise RecordingError(
            f"there is no file {file!r} in {where}the current folder",
            remedy="Labels in the name of a further file are for a folder, with --labels"
            if "{" in file
            else "Write its path as seen from there",
        )
    if not paths[0].samefile(paths[-1]):
        raise RecordingError(
            f"there is a file {file!r} in the folder {str(root)!r} and in the current folder",
            remedy="Write the path of the one that is meant in full",
        )
    return paths[0]
