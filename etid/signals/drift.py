"""Drift of one record against the other: their converters have clocks of their own."""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from etid.signals.pulse_train import PulseTrain, coarse_step, likeness_of, rise_time, rises, room_of

# Drift of V_out against V_th from the first pulse to the last, above which clocks differ; of both,
# the larger counts. 0.33 µs from one pulse to the next make R_s of dry skin 1.5 % wrong. Aliases of
# edges that are shorter than a sample look like 0.05 samples.
DRIFT, DRIFT_SAMPLES = 0.5e-6, 0.1  # [s], [samples]
SURE = 5.0  # that drift must have so many standard errors, or noise hides it
STEADY = 0.25  # part of the drift by which a pulse in the middle may be off its place
TINY = 1e-300  # replaces the power of an edge of zeros


def largest_drift(sample_rate: float) -> float:
    """Drift above which clocks differ [samples]."""
    return max(DRIFT * sample_rate, DRIFT_SAMPLES)


def clocks_apart(
    records: Float[np.ndarray, "recording 2 time"],
    sigma: Float[np.ndarray, "recording 2"],
    trains: Sequence[PulseTrain],
    lags: Float[np.ndarray, " recording"],
) -> Float[np.ndarray, " recording"]:
    """How far `v_out` drifts from `v_th` between the first and the last pulse [samples].

    Three pulses are compared, the first, one in the middle and the last, of those that have room on
    both sides. A drift is 0 with fewer pulses, if it is small in all recordings that are alike, if
    noise hides it, or if it is not steady: of a lost sample or a disturbed period.

    Args:
        records: Unloaded and loaded voltage [V] of recordings with equal rates.
        sigma: Standard deviations of their noise [V].
        trains: The pulses of each `v_th`.
        lags: Lags of `v_out` [samples], as `lags_of` finds them; NaN if they are not known.
    """
    apart, alike = np.zeros(len(records)), dict[tuple[bytes, int], list[int]]()
    for row, (train, lag) in enumerate(zip(trains, lags.tolist(), strict=True)):
        if train.spacing is not None and math.isfinite(lag):
            alike.setdefault((train.edges.tobytes(), round(lag)), []).append(row)
    for (_, late), rows in alike.items():
        apart[rows] = _drifts(records, sigma, rows, trains[rows[0]], late)
    return apart


def _drifts(
    records: Float[np.ndarray, "recording 2 time"],
    sigma: Float[np.ndarray, "recording 2"],
    rows: list[int],
    train: PulseTrain,
    late: int,
) -> Float[np.ndarray, " row"]:
    """`clocks_apart` of recordings with the same edges and the same lag in whole samples."""
    rise, step = rise_time(train.sample_rate), coarse_step(train.sample_rate / train.pulse_rate)
    width, off = room_of(step, rise), 2 * step + 2
    room = train.edges + np.array([[min(late, 0)], [max(late, 0)]])
    least = step + 1 + off  # an edge is within a step before its coarse place
    fits = (room[0] >= least) & (room[1] + width + off + rise <= records.shape[2])
    edges = train.edges[fits]
    if edges.size < 3:
        return np.zeros(len(rows))
    first, middle, last = edges[[0, edges.size // 2, -1]].tolist()
    window = int(min(width, room[0][fits][0] - off)), width

    def drift(later: int) -> tuple[Float[np.ndarray, " row"], Float[np.ndarray, " row"]]:
        (of_th, error_th), (of_out, error_out) = (
            _moved(records[:, which], rows, (first + by, later + by), window, off, rise)
            for which, by in enumerate((0, late))
        )
        return of_out - of_th, np.hypot(error_th * sigma[rows, 0], error_out * sigma[rows, 1])

    whole, error = drift(last)
    every = (train.edges[-1] - train.edges[0]) / (last - first) * whole
    largest = largest_drift(train.sample_rate)
    if (np.abs(every) <= largest).all():  # nearly all recordings
        return np.zeros(len(rows))
    half, _ = drift(middle)
    steady = np.abs(half - whole * (middle - first) / (last - first)) < STEADY * np.abs(whole)
    return np.where(steady & (SURE * error < largest), every, 0.0)


def _moved(
    v: Float[np.ndarray, "record time"],
    rows: Sequence[int],
    at: tuple[int, int],
    window: tuple[int, int],
    off: int,
    rise: int,
) -> tuple[Float[np.ndarray, " row"], Float[np.ndarray, " row"]]:
    """How much later than expected the second of two edges is [samples], up to `off`.

    The second result is the standard error for white noise of standard deviation 1.
    """
    (first, later), (before, after) = at, window
    template = rises(v[rows, first - before : first + after + rise], rise)
    where = rises(v[rows, later - before - off : later + after + off + rise], rise)
    parts, likeness = likeness_of(template, where)
    top = np.argmax(likeness, axis=1)
    lag, error = _within_a_sample(template, parts[np.arange(len(rows)), top], rise)
    return top - off + lag, error


def _within_a_sample(
    one: Float[np.ndarray, "record time"], other: Float[np.ndarray, "record time"], rise: int
) -> tuple[Float[np.ndarray, " record"], Float[np.ndarray, " record"]]:
    """Lag of the other of two records that differ by less than a sample, and by a factor.

    It is that of least squares. Aliases of a steep edge would move it by a tenth of a sample, so
    that only frequencies below a quarter of the sample rate count. The second result is the lag's
    standard error if both are rises of records with white noise of standard deviation 1.
    """
    count = 1 + one.shape[1] // 4
    turn = 2j * np.pi * np.fft.rfftfreq(one.shape[1])[:count]
    aim, turned = (np.fft.rfft(of)[:, :count] for of in (one, other))
    size, power = (np.square(np.abs(of)) for of in (turned, turn * turned))
    lag, total = np.zeros(len(one)), np.maximum(power.sum(1), TINY)
    for _ in range(3):  # of half a sample, the third step is below 1e-4 samples
        moved = turned * np.exp(turn * lag[:, None])
        factor = (np.conj(moved) * aim).real.sum(1) / np.maximum(size.sum(1), TINY)
        step = (np.conj(turn * moved) * aim).real.sum(1) / total
        lag = np.clip(lag + step / np.where(factor > 0.1, factor, np.inf), -1.0, 1.0)
    noise = one.shape[1] * np.square(np.abs(np.exp(turn * rise) - 1))
    return lag, np.sqrt((power * noise).sum(1)) / total
