"""Mapping files: they assign the channels of a file to signals, and contain the other fields.

A mapping is a TOML file. Each `[[recording]]` is a recording or a stack of trials. Keys above the
first `[[recording]]` apply to all of them.
"""

import dataclasses
import os
import pathlib
import re
import tomllib
from collections.abc import Mapping, Sequence
from typing import Any

from etid.files.channel import UNITS, chosen, listed, parse_unit
from etid.files.pattern import pattern
from etid.recordings import limits
from etid.recordings.errors import RecordingError, located
from etid.recordings.fields import DECLARED, LABELS, SIGNALS, real, tidy_path
from etid.recordings.labels import check_names

CHANNELS = (*SIGNALS, "time")
FIELDS = (*DECLARED, "scale", "split")
PAUSES = "pulses"  # a record that is split at the pauses between its pulses
KINDS = ("loaded", "calibration")  # default paths of recordings without a path
_KEY = "key of a mapping"


@dataclasses.dataclass(frozen=True)
class Signal:
    """One signal of a recording.

    Attributes:
        channel: Name of the channel.
        unit: Unit of the channel's values in the spelling of the mapping; empty if the mapping does
            not name it.
        scale: Volts of the record per volt at the terminal; for the current: volts per ampere.
        rows: Rows of the channel to use as trials, counted from 0; None: all rows.
    """

    channel: str
    unit: str = ""
    scale: float | None = None
    rows: tuple[int, ...] | int | None = None


@dataclasses.dataclass(frozen=True)
class Plan:
    """Plan of one recording or one stack of trials; no samples have been read yet.

    Attributes:
        path: HDF5 path.
        signals: `v_out`, `v_th` or `current` or both, and `time` if the mapping names it.
        fields: All other keys of the mapping except `path`, `scale` and `split`.
        split: `PAUSES`, or the channel of a trigger, if trials are parts of one long record; empty
            otherwise.
        electrodes: Electrodes that fire in turn, in the order of the parts; empty if all parts are
            of one.
    """

    path: str
    signals: Mapping[str, Signal]
    fields: Mapping[str, Any]
    split: str = ""
    electrodes: tuple[str, ...] = ()

    @property
    def channels(self) -> set[str]:
        """Names of all channels that are read."""
        trigger = {self.split} - {"", PAUSES}
        return {one.channel for one in self.signals.values()} | trigger


def read_mapping(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Content of a mapping file, not checked yet."""
    file = pathlib.Path(path)
    if not file.is_file():
        raise RecordingError(
            "there is no such mapping file", file=str(file), remedy="Check the path"
        )
    size = file.stat().st_size
    if size > limits.MAPPING:
        raise RecordingError(
            f"has {size} bytes, more than the {limits.MAPPING} bytes that etid reads",
            file=str(file),
            remedy="Give a mapping file, not a data file",
        )
    try:
        text = file.read_text("utf-8")
        if any(part.count(".") > limits.DEPTH for part in re.split(r"[=,\[\]{}\n]", text)):
            # The time that tomllib needs for a key grows with the square of its length.
            raise ValueError(f"a key has more than {limits.DEPTH} parts")
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # wrong syntax, encoding or depth
        raise RecordingError(f"is not TOML ({error})", file=str(file)) from error


def files_of(mapping: Mapping[str, Any]) -> list[str]:
    """The files of a mapping, in its order."""
    names = [table.get("file") for table in recordings_of(mapping)]
    if not names or not all(isinstance(name, str) for name in names):
        raise RecordingError(
            "is not given for each recording", field="file", remedy="The source is a folder"
        )
    return list(dict.fromkeys(map(str, names)))


def of_files(mapping: Mapping[str, Any], names: Sequence[str]) -> list[Mapping[str, Any]]:
    """The part of a mapping for each file: the recordings whose key `file` has its name."""
    tables = recordings_of(mapping)
    if len(names) == 1 and not any("file" in table for table in tables):
        return [mapping]
    common = {key: value for key, value in mapping.items() if key != "recording"}
    for name in {name for name in names if names.count(name) > 1}:
        raise RecordingError(f"two files have the name {name!r}", field="file")
    tables_of: dict[str, list[dict[str, Any]]] = {name: [] for name in names}
    for table in tables:
        if table.get("file") not in tables_of:
            raise RecordingError(
                f"is {table.get('file')!r}; the files are {listed(names)}",
                field="file",
                remedy="Give each [[recording]] the name of one of these files",
            )
        tables_of[table["file"]].append({key: table[key] for key in table if key != "file"})
    for name in names:
        if not tables_of[name]:
            raise RecordingError(
                f"no recording is in {name!r}", field="file", remedy="Leave the file out"
            )
    return [{**common, "recording": tables_of[name]} for name in names]


def recordings_of(mapping: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """The recordings of a mapping; empty if its keys are those of one recording."""
    tables = mapping.get("recording", [])
    tables = [tables] if isinstance(tables, Mapping) else tables
    if not isinstance(tables, list) or not all(isinstance(table, Mapping) for table in tables):
        raise RecordingError(
            "must be a list of tables", field="recording", remedy="Write [[recording]]"
        )
    return tables


def plans(mapping: Mapping[str, Any], names: Sequence[str], name: str = "") -> list[Plan]:
    """Plans of the recordings of a mapping.

    Args:
        mapping: Content of a mapping, from `read_mapping`.
        names: Names of the channels of the file; the mapping may use only these.
        name: Name below `loaded` or `calibration` of a recording without a path.
    """
    tables = recordings_of(mapping)
    common = {key: value for key, value in mapping.items() if key != "recording"}
    check_names(common, (*CHANNELS, *FIELDS, "recording" if tables else "path"), _KEY)
    recordings = [
        said for table in tables or [{}] for said in _of_channels({**common, **table}, names, name)
    ]
    planned: list[Plan] = []
    for said in recordings:
        check_names(said, (*CHANNELS, *FIELDS, "path"), _KEY)
        path = tidy_path(said.get("path", ""))
        if not path and len(recordings) > 1:
            raise RecordingError(
                "is not given", field="path", remedy="Give each [[recording]] a path of its own"
            )
        path = path or _default_path(said, name)
        if any(plan.path == path for plan in planned):
            raise RecordingError("two recordings have this path", path=path)
        with located(path=path if len(recordings) > 1 else ""):
            planned.append(_plan(path, said, names))
    return planned


def _default_path(said: Mapping[str, Any], name: str) -> str:
    """HDF5 path of a recording without a path, from the name of its file if there are several."""
    return tidy_path(f"{KINDS[said.get('r_load') is not None]}/{name}")


def _of_channels(
    said: Mapping[str, Any], names: Sequence[str], name: str
) -> list[Mapping[str, Any]]:
    """A recording for each channel that a pattern such as `CH{electrode}` matches.

    Without a pattern there is one recording. Other patterns have the labels of that of `v_out`.
    """
    patterns = {
        signal: said[signal]["channel"]
        for signal in CHANNELS
        if isinstance(said.get(signal), Mapping)
        and any(f"{{{label}}}" in str(said[signal].get("channel")) for label in LABELS)
    }
    if "v_out" not in patterns:
        return [said]
    expression = pattern(patterns["v_out"])
    matches = [match.groupdict() for match in map(expression.fullmatch, names) if match]
    if not matches:
        raise RecordingError(
            f"no channel matches {patterns['v_out']!r}; the channels are {listed(names)}",
            field="v_out",
        )
    base = tidy_path(said.get("path", "")) or _default_path(said, name)
    return [
        {
            **said,
            **labels,
            **{
                signal: {**said[signal], "channel": text.format(**labels)}
                for signal, text in patterns.items()
            },
            "path": "/".join([base, *labels.values()]),
        }
        for labels in matches
    ]


def _plan(path: str, said: Mapping[str, Any], names: Sequence[str]) -> Plan:
    _check_complete(said, names)
    signals = {
        name: _signal(name, said[name], said.get("scale")) for name in CHANNELS if name in said
    }
    for name, signal in signals.items():
        chosen(names, signal.channel, name)
    th, out = signals.get("v_th"), signals["v_out"]
    if th is not None and (th.channel, th.rows) == (out.channel, out.rows):
        raise RecordingError(
            f"is channel {out.channel!r}, and so is v_th",
            field="v_out",
            remedy=f"The channels are {listed(names)}: name another for one of the two",
        )
    if "time" in said and "sample_rate" in said:
        raise RecordingError(
            "is given together with time: one of time and sample_rate is needed, not both",
            field="sample_rate",
        )
    split = said.get("split", "")
    if not isinstance(split, str):
        raise RecordingError(
            f"is {split!r}, must be {PAUSES!r} or the channel of a trigger", field="split"
        )
    if split not in ("", PAUSES):
        chosen(names, split, "split")
    electrodes = _electrodes(said.get("electrode"), split)
    said = {name: value for name, value in said.items() if name != "electrode" or not electrodes}
    # The trial of a stack is a list of labels; `sources_of` checks each label.
    fields = {
        name: value if name == "trial" else DECLARED[name].checked(value)
        for name, value in said.items()
        if name in DECLARED
    }
    return Plan(path, signals, fields, split, electrodes)


def _electrodes(said: Any, split: str) -> tuple[str, ...]:
    """The electrodes that fire in turn within one record; empty if it is of one electrode."""
    if not isinstance(said, list):
        return ()
    if not split or not said:
        raise RecordingError(
            f"is the list {said!r}: the electrodes of the parts of one long record, in turn",
            field="electrode",
            remedy=f"Give split too, {PAUSES!r} or the channel of a trigger",
        )
    return tuple(DECLARED["electrode"].checked(one) for one in said)


def _check_complete(said: Mapping[str, Any], names: Sequence[str]) -> None:
    """Raise one error for all that is missing, with the options that would give it."""
    by_current = "current" in said and "r_load" not in said  # a load that needs no v_th
    voltages = ("v_out",) if by_current else ("v_th", "v_out")
    own = [of for name in voltages if isinstance(of := said.get(name, {}), Mapping)]
    missing = [name for name in (*voltages, "pulse_rate") if name not in said]
    if "scale" not in said and any("scale" not in of for of in own):
        missing.append("scale")
    if not missing:
        return
    # No channel is proposed: the first one is often the time.
    example = {"pulse_rate": "60", "scale": "1"}
    options = [f"--{name.replace('_', '-')} {example.get(name, 'NAME')}" for name in missing]
    hints = {
        "v_th": "or name the measured current, with --current",
        "scale": "a scale of 1 is that of values at the terminal",
    }
    one = len(missing) == 1
    raise RecordingError(
        f"{'is' if one else 'are'} not given, and {'is' if one else 'are'} not guessed; "
        f"the channels are {listed(names)}",
        field=", ".join(missing),
        remedy="; ".join(
            [
                f"Give {'it' if one else 'them'} in the mapping, or as in {' '.join(options)}",
                *(hint for name, hint in hints.items() if name in missing),
            ]
        ),
    )


def _signal(name: str, said: Any, common: Any) -> Signal:
    if not isinstance(said, Mapping) or not isinstance(said.get("channel"), str):
        raise RecordingError(
            "names no channel", field=name, remedy=f'Write {name} = {{channel = "…", unit = "…"}}'
        )
    check_names(said, ("channel", "unit", "scale", "rows"), _KEY, f"{name}.")
    unit = said.get("unit", "")
    if "unit" in said and (not isinstance(unit, str) or parse_unit(unit) is None):
        raise RecordingError(
            f"is {unit!r}, which is not a unit of a recording",
            field=f"{name}.unit",
            remedy=f"Units are {', '.join(key for key in UNITS if len(key) < 3)} and their names",
        )
    scale = _scale(f"{name}.scale", said.get("scale"))
    if scale is None and name in ("v_th", "v_out"):
        scale = _scale("scale", common)
    rows = said.get("rows")
    every = rows if isinstance(rows, list) else [rows]
    if rows is not None and (not every or any(type(one) is not int or one < 0 for one in every)):
        raise RecordingError(
            f"is {rows!r}, must be one row number or a list, counted from 0", field=f"{name}.rows"
        )
    return Signal(said["channel"], unit, scale, tuple(rows) if isinstance(rows, list) else rows)


def _scale(field: str, value: Any) -> float | None:
    if value is None:
        return None
    scale = real(field, value)
    if scale == 0:
        raise RecordingError("is 0, must be another number", field=field)
    return scale
