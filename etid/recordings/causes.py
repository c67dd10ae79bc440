"""Probable causes of verdicts of the pre-flight, and what it changed, with numbers."""

import logging

import numpy as np
from jaxtyping import Float

from etid.printing import rounded, several
from etid.recordings.preflight import Inspected
from etid.signals.lags import lags_of, shifted, whole_lag

NOISY = 10.0  # signal over noise, in power; noise hides edges at 5 dB in a third of records
LOG = logging.getLogger("etid")


def log_changes(inspected: Inspected) -> None:
    """Log how a recording was changed before its fit."""
    lines = [how_shifted(inspected)]
    if inspected.kept is not None:
        whole, spacing = inspected.whole_periods[0], inspected.spacing
        left = set(range(whole)) - {round(first / spacing) for first in inspected.kept.first}
        numbers = ", ".join(str(number + 1) for number in sorted(left))
        lines.append(f"left out of {several(whole, 'period')}: {numbers}." if left else "")
    if inspected.lag:
        lines.append(f"v_out was taken {several(inspected.lag, 'sample')} earlier.")
    if inspected.hums:
        found = {f"{hum.frequency:.2f} Hz" for hum in inspected.hum if hum is not None}
        lines.append(f"hum of {' and '.join(sorted(found))} was subtracted.")
    for line in filter(None, lines):
        LOG.info("%s: %s", inspected.recording.path or "recording", line)


def why_implausible(inspected: Inspected) -> str:
    """The sizes that give the verdict `wrong_unit`."""
    current, voltage = inspected.spans
    return sizes(voltage, current)


def sizes(voltage: float, current: float) -> str:
    """Peak-to-peak v_out [V] and current [A], and their ratio, as a sentence."""
    return f"v_out spans {voltage:.3g} V and current {current:.3g} A, {voltage / current:.3g} ohm."


def why_rates_differ(inspected: Inspected) -> str:
    """How the pulses contradict the rates, or those of one record those of the other."""
    if inspected.train.mismatch:
        return inspected.train.mismatch
    word = "farther" if inspected.apart > 0 else "less far"
    between = inspected.spacing * (inspected.train.edges.size - 1)
    ppm = float(f"{1e6 * abs(inspected.apart) / between:.1g}")  # the edges tell no more
    return (
        f"The last pulse of v_out is {rounded(abs(inspected.apart))} samples {word} from "
        f"the first than that of v_th: their clocks differ by about {ppm:g} ppm."
    )


def why_misaligned(inspected: Inspected) -> str:
    """The probable cause of the verdict `misaligned`, with numbers; empty if it is not known."""
    if inspected.shifts is not None and inspected.kept is None:
        return (
            f"v_out or {inspected.recording.cause} lost or doubled samples within pulses, and too "
            "few pulses without a fault remain."
        )
    if inspected.has_current:
        return _why_no_power(inspected)
    ratio = float(np.std(inspected.v_out) / np.std(inspected.v_th))
    if ratio > 30:  # they are not only in the wrong order
        return (
            f"v_out is {rounded(ratio, 3)} times as large as v_th. Their units or scales "
            "differ; is one of them in mV and the other in V?"
        )
    power = np.diagonal(inspected.covariance) / np.square(inspected.sigma) - 1
    if np.isnan(inspected.correlated) and power.min() < NOISY:
        return (
            f"The signal has {rounded(float(power.min()))} times the power of the noise: it may "
            "hide the edges. Reduce the noise, or average, before you look for another cause."
        )
    reversed_lag = _lag(inspected, -inspected.v_out)
    if np.isnan(inspected.correlated) and reversed_lag is not None and abs(reversed_lag) <= 1:
        return (
            "v_out falls where v_th rises, at the same times. The polarity of one record is "
            "reversed; change its sign, or exchange the two wires of the probe."
        )
    return ""


def how_shifted(inspected: Inspected) -> str:
    """Which periods of v_out are shifted, and by how much; empty if none is."""
    if inspected.shifts is None:
        return ""
    faults, before = [], None
    for number, (late, bad) in enumerate(zip(*inspected.shifts, strict=True), start=1):
        if bad:
            faults.append(f"the fault is in the pulse of period {number}")
            continue
        if before is not None and late != before:
            count = several(int(abs(late - before)), "sample")
            word = "later" if late > before else "earlier"
            faults.append(f"from period {number} on, v_out is {count} {word}")
        before = late
    return f"v_out or {inspected.recording.cause} lost or doubled samples: {'; '.join(faults)}."


def _why_no_power(inspected: Inspected) -> str:
    """Why a load takes no power from a measured current: the sign, a shift, or both."""
    for sign in (1, -1):
        v_out = sign * inspected.v_out
        lag = _lag(inspected, v_out)
        late = 0 if lag is None or abs(lag) <= 3 else whole_lag(lag)  # a fit finds smaller lags
        if lag is None or not _is_passive(*shifted(inspected.v_th, v_out, late)):
            continue
        causes = []
        if late:
            seconds = abs(late) / inspected.recording.sample_rate
            size = f"{several(abs(late), 'sample')} ({seconds:.3g} s)"
            word = "late" if late > 0 else "early"
            causes.append(f"v_out is {word} by {size}; shift one of the two records.")
        if sign < 0:
            causes.append("v_out falls where the current rises; change the sign of one of them.")
        return " ".join(causes)
    return (
        "The cause is not clear: a wrong sign, a shift in time, or records of different electrodes "
        "or pulses."
    )


def _lag(inspected: Inspected, v_out: Float[np.ndarray, " time"]) -> float | None:
    (lag,) = lags_of(np.stack([inspected.v_th, v_out])[None], [inspected.train])
    return float(lag) if np.isfinite(lag) else None


def _is_passive(current: Float[np.ndarray, " time"], v_out: Float[np.ndarray, " time"]) -> bool:
    """Whether a passive load may have both records: Re Z ≥ 0 at every frequency."""
    x, y = current - current.mean(), v_out - v_out.mean()
    # At a capacitor they are not correlated, and a delay of one sample looks like the wrong sign.
    if x @ y <= 0.2 * np.sqrt((x @ x) * (y @ y)):
        return False
    power = (np.conj(np.fft.rfft(x)) * np.fft.rfft(y)).real
    # The part that flows out is below 0.01 for skin and electrodes down to 20 dB, 0.04 to 0.17 if
    # v_out is late by the width of one phase of a pulse, and 0.5 for unrelated records.
    return bool(-power[power < 0].sum() <= 0.03 * np.abs(power).sum())
