"""Channels of other files, for a V_th that was recorded once for all trials.

A mapping names such a channel `FILE:NAME`: channel `NAME` of the file with this path, from the
current folder.
"""

import dataclasses
import pathlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

from etid.files.channel import Channel, Contents, located
from etid.files.mapping import CHANNELS


def with_others(
    contents: Contents, mapping: Mapping[str, Any], opened: Callable[[pathlib.Path], Contents]
) -> Contents:
    """The contents of a file, together with the channels of other files that a mapping names.

    Args:
        contents: Contents of the file.
        mapping: Content of a mapping, from `etid.files.mapping.read_mapping`.
        opened: Function that opens a file.

    Raises:
        RecordingError: Another file cannot be read.
    """
    others: dict[str, Contents] = {}
    for name in _named(mapping):
        file = name.rpartition(":")[0]
        if name not in contents.names and file not in others and pathlib.Path(file).is_file():
            with located(file):
                others[file] = opened(pathlib.Path(file))
    if not others:
        return contents

    def channel(name: str) -> Channel:
        if name in contents.names:
            return contents.channel(name)
        file, _, own = name.rpartition(":")
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


def _named(mapping: Mapping[str, Any]) -> Iterator[str]:
    """The names of channels in a mapping; `plans` checks its form."""
    tables = mapping.get("recording", [])
    for table in [mapping, *(tables if isinstance(tables, list) else [tables])]:
        for signal in CHANNELS:
            said = table.get(signal) if isinstance(table, Mapping) else None
            if isinstance(said, Mapping) and isinstance(said.get("channel"), str):
                yield said["channel"]
