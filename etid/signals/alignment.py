"""By how many samples the loaded record is later than the unloaded one.

Two records with a trigger of their own may begin hundreds of samples apart. Whole samples are taken
out here, before a fit; what is left, half a sample or so, is fitted with the elements.
"""

import math

import numpy as np
from jaxtyping import Complex, Float

from etid.signals.pulse_train import PulseTrain, highest, rise_time, rises

LAGS = 400  # samples by which v_out may be late or early
PART = 1 / 4  # of a period, by which it may be at most
AROUND = 1 / 8  # of a period, before and after an edge, that is looked for
DELAYED = 1.0  # samples that a fit takes as they are: it knows delays of one, and skin delays too
NEAR = 16  # samples by which a record that was aligned may still be late
FINE = 0.5  # samples, the grid on which that is looked for


def lag_of(
    v_th: Float[np.ndarray, " time"], v_out: Float[np.ndarray, " time"], train: PulseTrain
) -> float | None:
    """By how many samples `v_out` is late, from the edges of one pulse.

    The load smoothes the edges, by which it is found up to a sample too late.

    Args:
        v_th: Unloaded voltage [V].
        v_out: Loaded voltage [V].
        train: The pulses of `v_th`.

    Returns:
        The lag [samples]; None if the records are of opposite polarity, or too far apart.
    """
    period = train.spacing or train.sample_rate / train.pulse_rate
    rise, edges = rise_time(train.sample_rate), train.edges
    edge = edges[edges.size // 2] if edges.size else np.argmax(np.abs(rises(v_th, rise)))
    first = max(0, int(edge) - int(AROUND * period))
    template = rises(v_th[first : int(edge) + int(AROUND * period) + rise], rise)
    reach = int(period / 2)
    where = np.zeros(template.size + 2 * reach)
    start = max(0, first - reach)
    found = rises(v_out[start : first + reach + template.size + rise], rise)
    begin = start - (first - reach)
    where[begin : begin + found.size] = found
    size = _fast(where.size)
    product = np.fft.rfft(where, size) * np.conj(np.fft.rfft(template, size))
    correlation = np.fft.irfft(product, size)[: 2 * reach + 1]
    if correlation.max() <= -correlation.min():
        return None
    lag = highest(correlation) - reach
    return lag if abs(lag) <= min(LAGS, PART * period) else None


def whole_lag(lag: float) -> int:
    """Samples by which the records are shifted; none if a fit takes the lag as it is."""
    return 0 if abs(lag) <= DELAYED else round(lag)


def shifted(
    v_th: Float[np.ndarray, " time"], v_out: Float[np.ndarray, " time"], late: int
) -> tuple[Float[np.ndarray, " overlap"], Float[np.ndarray, " overlap"]]:
    """Both records where they overlap, `v_out` being late by whole samples."""
    if late < 0:
        return v_th[-late:], v_out[:late]
    return v_th[: v_th.size - late], v_out[late:]


def _fast(size: int) -> int:
    """A size not below, of which the Fourier transform is fast: 2ⁿ, 3 · 2ⁿ or 5 · 2ⁿ."""
    return min(part << max(0, math.ceil(math.log2(size / part))) for part in (1, 3, 5))


def rest(
    predicted: Complex[np.ndarray, " frequency"],
    measured: Complex[np.ndarray, " frequency"],
    weight: Float[np.ndarray, " frequency"],
    turn: Float[np.ndarray, " frequency"],
) -> float:
    """By how many samples a record is later than its prediction, up to `NEAR`.

    Args:
        predicted: Fourier coefficients of the prediction.
        measured: Those of the record.
        weight: Of each, such as the reciprocal of its variance.
        turn: By which one sample turns each [rad].
    """
    turned = np.conj(predicted) * measured * weight * np.exp(-1j * NEAR * turn)
    step, correlation = np.exp(1j * FINE * turn), []
    for _ in range(round(2 * NEAR / FINE) + 1):
        correlation.append(turned.sum().real)
        turned = turned * step
    return FINE * highest(np.array(correlation)) - NEAR
