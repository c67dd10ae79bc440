"""Sample rate of a recording: from the file, from a mapping, or from time stamps."""

from collections.abc import Iterator, Mapping

import numpy as np

from etid.files.channel import Channel, located
from etid.files.mapping import Plan
from etid.printing import rounded, several
from etid.recordings.recording import RecordingError

QUARTZ = 1e-4  # largest relative error of a quartz clock, so of a measured rate


def sample_rate(
    plan: Plan, channels: Mapping[str, Channel], factor: float, by: str
) -> tuple[float, str]:
    """Sample rate [Hz] of a recording, and the source of this rate.

    Args:
        plan: Plan of the recording.
        channels: Channels of its signals.
        factor: Seconds per unit of the channel of the time.
        by: Source of the plan.
    """
    said = {
        plan.signals[name].channel: channel.sample_rate
        for name, channel in channels.items()
        if channel.sample_rate is not None
    }
    # Channels of one clock have equal rates, except for rounding errors of the reciprocal.
    if said and not _agree(1e-9, *said.values()):
        raise RecordingError(
            "differs between the channels: "
            + ", ".join(f"{name!r} {rate:.9g} Hz" for name, rate in said.items()),
            field="sample_rate",
        )
    theirs = next(iter(said.values()), None)
    ours = plan.fields.get("sample_rate")
    if ours is None and "time" in channels:
        signal = plan.signals["time"]
        with located("", field="time"):
            ours = _clock(channels["time"], factor, channels["v_out"].length)
        by = f"time {signal.channel!r}"
    if ours is None:
        if theirs is None:
            raise RecordingError(
                "is not given, the file does not contain it, and it is not guessed: one of time "
                "and sample_rate is needed",
                field="sample_rate",
                remedy="Give the rate, with --sample-rate, or the channel of the time, with --time",
            )
        return theirs, "file"
    if theirs is None:
        return ours, by
    if not _agree(QUARTZ, ours, theirs):
        raise RecordingError(
            f"is {ours:.9g} Hz from the {by}, but {theirs:.9g} Hz from the file",
            field="sample_rate",
            remedy="Correct the one that is wrong",
        )
    return ours, f"{by}; file {theirs:.9g} Hz"


def _agree(tolerance: float, *rates: float) -> bool:
    return max(rates) - min(rates) <= tolerance * max(rates)


def _clock(time: Channel, factor: float, length: int) -> float:
    """Sample rate [Hz] from the first and the last time stamp; the stamps must be uniform."""
    if time.shape != (length,) or length < 2:
        raise RecordingError(
            f"has {time.size}, but v_out has {several(length, 'sample')}; each sample has one "
            "time, and there are at least two",
            field="time",
        )

    def stamps() -> Iterator[np.ndarray]:
        return (
            (block.astype(np.float64) * time.conversion + time.offset) * factor
            for block in time.blocks()
        )

    first = last = np.nan
    for number, block in enumerate(stamps()):
        first, last = (block[0] if number == 0 else first), block[-1]
    step = (last - first) / (length - 1)
    if not step > 0:
        raise RecordingError("does not increase", field="time", remedy="Times are in seconds")
    start = 0
    for block in stamps():
        distance = np.abs(block - (first + step * np.arange(start, start + block.size))) / step
        worst = int(np.argmax(distance))  # argmax returns the first NaN, if there is one
        # The rounding of a printed time must pass, a missing or repeated sample (1) must not.
        if not distance[worst] <= 0.25:
            gap = _gap(stamps(), step)
            wrong = f"sample {start + worst} is wrong by {rounded(distance[worst])} sample periods"
            raise RecordingError(
                f"is not uniform: {gap or wrong}",
                field="time",
                remedy="Record again, or import a part without a gap"
                if gap
                else "Resample the data, or give the sample_rate of the instrument instead",
            )
        start += block.size
    return float(1 / step)


def _gap(stamps: Iterator[np.ndarray], step: float) -> str:
    """Where the longest time between two samples is, if it is no single sample period."""
    longest, where, before, number = 1.8 * step, "", np.nan, 0
    for block in stamps:
        apart = np.diff(block, prepend=before)
        at = int(np.argmax(np.nan_to_num(apart)))
        if apart[at] > longest:
            longest = apart[at]
            last = block[at] - apart[at]
            where = (
                f"samples are missing before sample {number + at}, from {last:.6g} to "
                f"{block[at]:.6g} s"
            )
        before, number = block[-1], number + block.size
    return where
