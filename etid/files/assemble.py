"""Recordings from the channels of a file: units, scales and trials come from file or mapping.

Nothing is guessed. It is an error if a fact is missing in both the file and the mapping. It is also
an error if the file and the mapping disagree.
"""

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from etid.files.channel import UNITS, Channel, located, parse_unit
from etid.files.clock import sample_rate
from etid.files.mapping import KINDS, PAUSES, Plan, Signal
from etid.printing import rounded, several
from etid.recordings.fields import LABELS, SIGNALS, Metadata, metadata_from
from etid.recordings.recording import AbstractSource, Layout, RecordingError
from etid.recordings.splitting import split


@dataclasses.dataclass(frozen=True)
class Used:
    """The channel that became a signal, and the meaning of its values.

    Attributes:
        channel: Name of the channel in the file.
        unit: Unit of the channel's values.
        unit_by: Source of the unit: `file`, `mapping`, both, or the `command`.
        scale: Divisor of the values.
    """

    channel: str
    unit: str
    unit_by: str
    scale: float

    def __str__(self) -> str:
        divided = f", divided by {self.scale:g}" if self.scale != 1 else ""
        return f"{self.channel!r} in {self.unit} ({self.unit_by}){divided}"


@dataclasses.dataclass(frozen=True)
class Imported:
    """The sources of one imported recording, or of a stack of trials.

    Attributes:
        file: The file.
        paths: HDF5 paths of the recordings.
        samples: Number of samples of each recording.
        sample_rate: Samples per second [Hz].
        rate_by: Source of the sample rate: `file`, `mapping`, both, or the `time` channel.
        pulse_rate: Pulses per second [Hz].
        signals: Channel of each signal.
        notices: Signs that the file is not whole; empty if there are none.
    """

    file: str
    paths: tuple[str, ...]
    samples: int
    sample_rate: float
    rate_by: str
    pulse_rate: float
    signals: Mapping[str, Used]
    notices: tuple[str, ...] = ()

    def __str__(self) -> str:
        ends = self.paths if len(self.paths) < 3 else (self.paths[0], self.paths[-1])
        lines = [
            f"{' … '.join(ends)}: {several(self.samples, 'sample')} at {self.sample_rate:.9g} Hz "
            f"({self.rate_by}), pulses at {self.pulse_rate:.9g} Hz"
        ]
        return "\n".join([*lines, *self.channels, *self.notes])

    @property
    def channels(self) -> list[str]:
        """A line of text for each signal, with its channel and unit."""
        return [f"  {name:<8}{used}" for name, used in self.signals.items()]

    @property
    def notes(self) -> list[str]:
        """A line of text for each notice."""
        return [f"  note: {notice}" for notice in self.notices]


@dataclasses.dataclass(frozen=True, eq=False)
class _Source(AbstractSource):
    """A recording in a file of another format; `records` are channels and their trials."""

    file: str
    described: Metadata
    records: Mapping[str, tuple[Channel, int]]

    @property
    def metadata(self) -> Metadata:
        return self.described

    def blocks(self, name: str) -> Iterator[np.ndarray]:
        channel, trial = self.records[name]
        with located(self.file, self.metadata.path, name):
            yield from channel.blocks(trial)


def sources_of(
    plan: Plan,
    channel: Callable[[str], Channel],
    file: str,
    by: str,
    known: Mapping[str, Metadata],
) -> tuple[dict[str, AbstractSource], Imported]:
    """The recordings of a plan by path, and a summary of their sources.

    Args:
        plan: Plan of one recording or one stack of trials, from a mapping.
        channel: Function that returns the channel of a name.
        file: Path of the file.
        by: Source of the plan, for errors: `mapping` or `command`.
        known: The calibrations that the plan can name, by path.
    """
    channels: dict[str, Channel] = {}
    used: dict[str, Used] = {}
    factors: dict[str, float] = {}  # SI units per unit of the channel
    for name, signal in plan.signals.items():
        with located("", field=name):
            channels[name] = channel(signal.channel)
        used[name], factors[name] = _used(name, signal, channels[name].unit, by)
    rows = _rows(plan.signals, channels)
    length = channels["v_out"].length
    rate, rate_by = sample_rate(plan, channels, factors.get("time", 1.0), by)
    common = metadata_from(**{**plan.fields, "sample_rate": rate, "trial": "", "path": plan.path})
    trials = rows["v_out"]
    stacked = len(channels["v_out"].shape) == 2 and not isinstance(plan.signals["v_out"].rows, int)
    periods = length * common.pulse_rate / rate
    if stacked and len(trials) > length and periods < 0.1:  # it must be transposed
        raise RecordingError(
            f"{plan.signals['v_out'].channel!r} would be {len(trials)} trials of {length} samples, "
            f"{rounded(periods)} pulse periods each",
            field="v_out",
            remedy="Rows are trials, columns are times: transpose the variables, or name one "
            "column, as in m(:,2) of a MATLAB file",
        )
    parts, electrodes, cut = _parts(plan, channels, channel, common)
    several = stacked or bool(parts)
    if parts:  # the trials are the rounds of each electrode
        trials = [electrodes[:i].count(one) for i, one in enumerate(electrodes)]
    labels = _labels(plan.fields.get("trial"), trials, several)
    sources: dict[str, AbstractSource] = {}
    for index, label in enumerate(labels):
        records: dict[str, tuple[Channel, int]] = {}
        layout: list[Layout] = []
        for name in SIGNALS:
            if name in channels:
                part = channels[name].part(parts[index]) if parts else channels[name]
                trial = rows[name][index if len(rows[name]) > 1 else 0]
                with located("", field=name):
                    layout.append(_layout(name, part, factors[name]))
                records[name] = part, trial
        path = f"{plan.path}/{index}" if several or plan.path in KINDS else plan.path
        own = {"trial": label}
        if parts and electrodes[index]:
            own["electrode"] = electrodes[index]
            path = f"{plan.path}/{electrodes[index]}/{trials[index]}"
        metadata = metadata_from(**{**vars(common), **own, "path": path})
        metadata = dataclasses.replace(metadata, calibration=_calibrations(metadata, known))
        th = records.get("v_th")
        unloaded = (file, path) if th is None else (file, th[0].name, th[1])
        sources[path] = _Source(tuple(layout), unloaded, file, metadata, records)
    samples = parts[0].stop - parts[0].start if parts else length
    notices = dict.fromkeys(own.notice for own in channels.values() if own.notice)
    if cut:
        trains = "1 train of pulses, which is" if cut == 1 else f"{cut} trains of pulses, which are"
        notices[f"the end of the record cuts {trains} left out"] = None
    return sources, Imported(
        file, tuple(sources), samples, rate, rate_by, common.pulse_rate, used, (*notices,)
    )


def _calibrations(of: Metadata, known: Mapping[str, Metadata]) -> tuple[str, ...]:
    """Paths of the calibrations of a recording.

    A path that it names may be that of a `[[recording]]` that became several calibrations. Where
    their labels differ, as those of electrodes do, it gets those with its own. The trial does not
    count: trials of one resistor are of one driver.

    Raises:
        RecordingError: None of several calibrations has its labels.
    """
    paths: list[str] = []
    for name in of.calibration:
        under = [one for path, one in known.items() if f"{path}/".startswith(f"{name}/")]
        differing = [
            label
            for label in LABELS
            if label != "trial" and len({getattr(one, label) for one in under}) > 1
        ]
        own = {label: getattr(of, label) for label in differing}
        found = [one.path for one in under if own == {n: getattr(one, n) for n in differing}]
        if under and not found:
            raise RecordingError(
                f"none of the {several(len(under), 'calibration')} in {name!r} has its "
                + ", ".join(f"{label} {value!r}" for label, value in own.items()),
                path=of.path,
                field="calibration",
                remedy="Add the one that is missing, or name one for all in a mapping",
            )
        paths += found or [name]
    return tuple(paths)


def _layout(name: str, channel: Channel, factor: float) -> Layout:
    """A record in SI units; an error if the file scales its samples to nothing."""
    conversion, offset = channel.conversion * factor, channel.offset * factor
    if not math.isfinite(conversion) or conversion == 0 or not math.isfinite(offset):
        raise RecordingError(
            f"channel {channel.name!r} is scaled with slope {channel.conversion:g} and offset "
            f"{channel.offset:g}, from which no samples follow",
            remedy="Correct the scaling in the file, or the scale",
        )
    dtype = channel.dtype.newbyteorder("=").str
    return Layout(name, dtype, channel.length, conversion, offset)


def _parts(
    plan: Plan,
    channels: Mapping[str, Channel],
    channel: Callable[[str], Channel],
    common: Metadata,
) -> tuple[list[slice], list[str], int]:
    """The parts of one long record, the electrode of each, and how many an end of it cuts.

    An electrode is empty if all are of one. Both lists are empty if nothing is to be split.
    """
    if not plan.split:
        return [], [], 0
    by_pulses = plan.split == PAUSES
    if by_pulses and "v_th" not in channels:
        raise RecordingError(
            "needs v_th, whose pauses separate the trials",
            field="split",
            remedy="Name the channel of a trigger",
        )
    separating = channels["v_th"] if by_pulses else channel(plan.split)
    for own in (*channels.values(), separating):
        if len(own.shape) != 1:
            raise RecordingError(
                f"channel {own.name!r} has {own.size}; only one long record can be split",
                field="split",
                remedy="Remove split, or name a channel with one record",
            )

    def samples(own: Channel) -> np.ndarray:
        return np.concatenate(list(own.blocks())).astype(float)

    cause = channels["v_th"] if "v_th" in channels else channels["current"]
    more = None if by_pulses else samples(separating)
    order, rates = plan.electrodes, (common.sample_rate, common.pulse_rate)
    parts, cut = split(samples(cause), *rates, more, cut=not order)
    if order and len(parts) % len(order):
        raise RecordingError(
            f"names {several(len(order), 'electrode')}, but the record has "
            f"{several(len(parts), 'train')} of pulses",
            field="electrode",
            remedy="Name them in the order in which they fire, and record whole rounds",
        )
    return parts, [order[i % len(order)] if order else "" for i in range(len(parts))], cut


def _used(name: str, signal: Signal, said: str, by: str) -> tuple[Used, float]:
    """The meaning of a channel's values, and the size of 1 in its SI unit.

    Args:
        name: Name of the signal.
        signal: The signal in the plan.
        said: Unit of the channel in the spelling of the file; empty if the file names none.
        by: Source of the plan. A command that names no unit means volt, ampere or second.
    """
    field, where = f"{name}.unit", f"of channel {signal.channel!r}"
    ours, theirs = parse_unit(signal.unit), parse_unit(said)
    if said and theirs is None:
        raise RecordingError(
            f"the file says {said!r} {where}, which is neither volts, amperes nor seconds",
            field=field,
            remedy="Correct it in the file, as in mV, uA or ms",
        )
    if ours and theirs and ours != theirs:
        raise RecordingError(
            f"the mapping says {signal.unit!r} {where}, the file says {said!r}",
            field=field,
            remedy="Correct the one that is wrong",
        )
    wanted = {"time": "s", "current": "A"}.get(name, "V")
    unit, text = ours or theirs, signal.unit or said
    unit_by = " and ".join(["file"] * (theirs is not None) + ["mapping"] * (ours is not None))
    if unit is None and by == "command":
        unit, text, unit_by = UNITS[wanted], wanted, by
    if unit is None:
        raise RecordingError(
            f"is not given {where}, the file does not contain it, and it is not guessed",
            field=field,
            remedy=f'Write {name} = {{channel = "{signal.channel}", unit = "…"}}',
        )
    over_a_shunt = name == "current" and unit.si == "volt"
    if unit.si != UNITS[wanted].si and not (over_a_shunt and signal.scale is not None):
        raise RecordingError(
            f"channel {signal.channel!r} is in {unit.si} ({unit_by}), must be in "
            f"{UNITS[wanted].si}",
            field=field,
            remedy="Add a scale in volts per ampere, if this voltage represents the current"
            if over_a_shunt
            else "Name another channel",
        )
    scale = signal.scale or 1.0
    return Used(signal.channel, text, unit_by, scale), unit.factor / scale


def _rows(signals: Mapping[str, Signal], channels: Mapping[str, Channel]) -> dict[str, list[int]]:
    """Rows of each signal, one per trial of `v_out`; `v_th` may have one row for all trials."""
    rows_of: dict[str, list[int]] = {}
    for name in SIGNALS:
        if name not in channels:
            continue
        shape, rows = channels[name].shape, signals[name].rows
        count = shape[0] if len(shape) == 2 else 1
        every = tuple(range(count)) if rows is None else (rows,) if isinstance(rows, int) else rows
        if max(every) >= count:
            raise RecordingError(
                f"row {max(every)} does not exist: channel {signals[name].channel!r} has "
                f"{several(count, 'row')}, counted from 0",
                field=f"{name}.rows",
            )
        rows_of[name] = list(every)
    trials = len(rows_of["v_out"])
    length = channels["v_out"].length
    fits = all(
        len(channels[name].shape) in (1, 2)
        and channels[name].length == length
        and (len(rows) == trials or (name == "v_th" and len(rows) == 1))
        for name, rows in rows_of.items()
    )
    if not fits:
        sizes = ", ".join(
            f"{name}: {channels[name].size} ({signals[name].channel!r})"
            if signals[name].rows is None
            else f"{name}: {several(len(rows), 'row')} of {signals[name].channel!r} with "
            f"{several(channels[name].length, 'sample')}"
            for name, rows in rows_of.items()
        )
        raise RecordingError(
            f"the channels do not fit each other: {sizes}",
            remedy="All have equally many samples, from the same instant on, and equally many "
            "trials; only v_th may have one for all trials",
        )
    return rows_of


def _labels(said: Any, trials: list[int], stacked: bool) -> list[Any]:
    """The trial label of each recording."""
    if said is None:
        return list(trials) if stacked else [""]
    labels = said if isinstance(said, list) else [said]
    if len(labels) != len(trials):
        raise RecordingError(
            f"has {several(len(labels), 'label')} for {several(len(trials), 'trial')}",
            field="trial",
        )
    return labels
