"""The lag between two records.

Two records with separate triggers may start hundreds of samples apart. `lags_of` finds this lag.
Whole samples are removed before a fit. The fit then estimates the rest, about half a sample, with
the elements.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from etid.signals.periods import fast_length
from etid.signals.pulse_train import PulseTrain, coarse_step, highest, rise_time, rises, room_of


def lags_of(
    records: Float[np.ndarray, "recording 2 time"], trains: Sequence[PulseTrain]
) -> Float[np.ndarray, " recording"]:
    """Lag of `v_out` behind `v_th` of each recording, from the edges of one period.

    The load smooths the edges. The lag found is therefore up to one sample too large.

    Args:
        records: Unloaded and loaded voltage [V] of recordings with equal rates.
        trains: The pulses of each `v_th`.

    Returns:
        The lags [samples]; NaN if both records have opposite polarity, are more than 400 samples
        or a quarter of a period apart, or are shorter than an edge.
    """
    lags = np.full(len(records), np.nan)
    if not trains or records.shape[2] <= rise_time(trains[0].sample_rate):
        return lags
    for window, rows in _windows(records[:, 0], trains).items():
        found = _lags(records, rows, window)
        lags[rows] = np.where(np.abs(found) <= window.largest, found, np.nan)
    return lags


class _Window(NamedTuple):
    """Which samples are correlated.

    Attributes:
        first: First sample of the template.
        last: Sample after the template, with the rise.
        reach: Largest lag that is searched [samples].
        rise: Samples over which edges rise.
        largest: Largest lag that is accepted [samples].
    """

    first: int
    last: int
    reach: int
    rise: int
    largest: int


def _windows(
    records: Float[np.ndarray, "record time"], trains: Sequence[PulseTrain]
) -> dict[_Window, list[int]]:
    """The records of each window, of unloaded records with equal rates.

    A window holds the pulse in the middle of a record, and half a period on both sides. With only
    one edge of a pulse, the other edge would look like this one with the wrong polarity. Of a whole
    period, the noise beside the pulse would hide it at 10 dB.
    """
    size, rise = records.shape[1], rise_time(trains[0].sample_rate)
    alike: dict[tuple[int, int, int, int], list[int]] = {}
    for row, train in enumerate(trains):
        period = train.spacing or train.sample_rate / train.pulse_rate
        edges = train.edges[train.edges < size]
        if not edges.size:
            edges = np.array([np.argmax(np.abs(rises(records[row], rise)))])
        reach = int(period / 2), min(400, int(period / 4))
        alike.setdefault((int(edges[edges.size // 2]), coarse_step(period), *reach), []).append(row)
    windows: dict[_Window, list[int]] = {}
    for (edge, step, around, largest), rows in alike.items():
        begin = max(0, edge - around)
        number = (min(edge + around, size) - begin) // step
        coarse = records[rows, begin : begin + number * step].reshape(len(rows), number, step)
        coarse = np.einsum("rps->rp", coarse)
        coarse = np.abs(coarse - coarse.mean(1, keepdims=True))
        high = ~(coarse < 0.5 * coarse.max(1, keepdims=True))
        firsts, lasts = high.argmax(1), number - high[:, ::-1].argmax(1)
        beside = room_of(step, rise)
        for row, first, last in zip(rows, firsts.tolist(), lasts.tolist(), strict=True):
            of = max(0, begin + step * first - beside), min(begin + step * last + beside, size)
            windows.setdefault(_Window(*of, around, rise, largest), []).append(row)
    return windows


def _lags(
    records: Float[np.ndarray, "recording 2 time"], rows: Sequence[int], window: _Window
) -> Float[np.ndarray, " row"]:
    """The lags with the highest correlation; infinite if the polarity is wrong."""
    first, last, reach, rise, largest = window
    template = rises(records[rows, 0, first:last], rise)
    begin = first - reach
    start = max(0, begin)
    searched = rises(records[rows, 1, start : last + reach], rise)
    size = fast_length(template.shape[1] + 2 * reach)
    both = np.zeros((len(rows), 2, size))
    both[:, 0, start - begin : start - begin + searched.shape[1]] = searched
    both[:, 1, : template.shape[1]] = template
    transforms = np.fft.rfft(both)
    products = np.fft.irfft(transforms[:, 0] * np.conj(transforms[:, 1]), size)
    correlation = products[:, : 2 * reach + 1]
    lag = highest(correlation) - reach
    # At half a period, pulses that last half of it have the other polarity.
    accepted = correlation[:, reach - largest : reach + largest + 1]
    return np.where(accepted.max(1) > -accepted.min(1), lag, np.inf)


def whole_lag(lag: float) -> int:
    """Lag to be removed [samples]; 0 up to one sample: a fit finds it, and skin delays too."""
    return 0 if abs(lag) <= 1 else round(lag)


def shifted(
    v_th: Float[np.ndarray, " time"], v_out: Float[np.ndarray, " time"], late: int
) -> tuple[Float[np.ndarray, " overlap"], Float[np.ndarray, " overlap"]]:
    """Both records, cut to their overlap; `late` is the lag of `v_out` in whole samples."""
    if late < 0:
        return v_th[-late:], v_out[:late]
    return v_th[: v_th.size - late], v_out[late:]


def rest(
    predicted: Complex[np.ndarray, " frequency"],
    measured: Complex[np.ndarray, " frequency"],
    weight: Float[np.ndarray, " frequency"],
    turn: Float[np.ndarray, " frequency"],
) -> float:
    """Lag of an aligned record behind its prediction [samples], between −16 and 16.

    Args:
        predicted: Fourier coefficients of the prediction.
        measured: Fourier coefficients of the record.
        weight: Weight of each coefficient, such as the reciprocal of its variance.
        turn: Phase by which a delay of one sample turns each coefficient [rad].
    """
    largest, grid = 16, 0.5
    turned = np.conj(predicted) * measured * weight * np.exp(-1j * largest * turn)
    step, correlation = np.exp(1j * grid * turn), []
    for _ in range(round(2 * largest / grid) + 1):
        correlation.append(turned.sum().real)
        turned = turned * step
    return grid * float(highest(np.array(correlation))) - largest
