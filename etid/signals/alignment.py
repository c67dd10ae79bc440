"""The lag of the loaded record behind the unloaded record.

Two records with separate triggers may start hundreds of samples apart. This module removes whole
samples before a fit. The fit then estimates the rest, about half a sample, with the elements.
"""

import numpy as np
from jaxtyping import Complex, Float

from etid.signals.harmonics import fast_length
from etid.signals.pulse_train import PulseTrain, highest, rise_time, rises

LAGS = 400  # [samples] largest lag, late or early
PART = 1 / 4  # largest lag as a fraction of the period
AROUND = 1 / 8  # fraction of a period before and after an edge that is correlated
DELAYED = 1.0  # [samples] a fit takes smaller lags as they are: it fits delays, and skin delays too
NEAR = 16  # [samples] largest lag that an aligned record may still have
FINE = 0.5  # [samples] grid of the search for that lag


def lag_of(
    v_th: Float[np.ndarray, " time"], v_out: Float[np.ndarray, " time"], train: PulseTrain
) -> float | None:
    """Lag of `v_out` behind `v_th`, from the edges of one pulse.

    The load smooths the edges. The lag found is therefore up to one sample too large.

    Args:
        v_th: Unloaded voltage [V].
        v_out: Loaded voltage [V].
        train: The pulses of `v_th`.

    Returns:
        The lag [samples]; None if the records have opposite polarity or are too far apart.
    """
    period = train.spacing or train.sample_rate / train.pulse_rate
    rise, edges = rise_time(train.sample_rate), train.edges[train.edges < v_th.size]
    edge = edges[edges.size // 2] if edges.size else np.argmax(np.abs(rises(v_th, rise)))
    first = max(0, int(edge) - int(AROUND * period))
    template = rises(v_th[first : int(edge) + int(AROUND * period) + rise], rise)
    reach = int(period / 2)
    where = np.zeros(template.size + 2 * reach)
    start = max(0, first - reach)
    found = rises(v_out[start : first + reach + template.size + rise], rise)
    begin = start - (first - reach)
    where[begin : begin + found.size] = found
    size = fast_length(where.size)
    product = np.fft.rfft(where, size) * np.conj(np.fft.rfft(template, size))
    correlation = np.fft.irfft(product, size)[: 2 * reach + 1]
    if correlation.max() <= -correlation.min():
        return None
    lag = highest(correlation) - reach
    return lag if abs(lag) <= min(LAGS, PART * period) else None


def whole_lag(lag: float) -> int:
    """Lag to be removed [samples]; 0 if a fit takes the lag as it is."""
    return 0 if abs(lag) <= DELAYED else round(lag)


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
    """Lag of a record behind its prediction [samples], between −`NEAR` and `NEAR`.

    Args:
        predicted: Fourier coefficients of the prediction.
        measured: Fourier coefficients of the record.
        weight: Weight of each coefficient, such as the reciprocal of its variance.
        turn: Phase by which a delay of one sample turns each coefficient [rad].
    """
    turned = np.conj(predicted) * measured * weight * np.exp(-1j * NEAR * turn)
    step, correlation = np.exp(1j * FINE * turn), []
    for _ in range(round(2 * NEAR / FINE) + 1):
        correlation.append(turned.sum().real)
        turned = turned * step
    return FINE * highest(np.array(correlation)) - NEAR
