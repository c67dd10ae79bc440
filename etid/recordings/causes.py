"""Probable causes of verdicts of the pre-flight, with the numbers that show them."""

import numpy as np
from jaxtyping import Float

from etid.circuits.display import several
from etid.recordings.preflight import Inspected
from etid.signals.pulse_train import lags_of, shifted, whole_lag

UNIT = 30.0  # ratio of v_out to v_th beyond which their units differ, not only their order
FITTED = 3.0  # [samples] lag behind a current that a fit finds by itself
# Largest fraction of the power that may flow out of a passive load. It is below 0.01 for skin and
# electrodes down to 20 dB, 0.04 to 0.17 if v_out is late by the width of one phase of a pulse, and
# 0.5 for unrelated records.
RETURNED = 0.03
# Least correlation of current and v_out that shows a sign. A capacitor has none, and a delay of one
# sample looks there like the wrong sign.
RELATED = 0.2


def why_implausible(seen: Inspected) -> str:
    """The sizes that give the verdict `wrong_unit`."""
    current, voltage = seen.spans
    return sizes(voltage, current)


def sizes(voltage: float, current: float) -> str:
    """Peak-to-peak v_out [V] and current [A], and their ratio, as a sentence."""
    return f"v_out spans {voltage:.3g} V and current {current:.3g} A, {voltage / current:.3g} ohm."


def why_misaligned(seen: Inspected) -> str:
    """The probable cause of the verdict `misaligned`, with numbers; empty if it is not known."""
    if seen.shifts is not None and seen.kept is None:
        return (
            f"v_out or {seen.recording.cause} lost or doubled samples within pulses, and too few "
            "pulses without a fault remain."
        )
    if seen.has_current:
        return _why_no_power(seen)
    ratio = float(np.std(seen.v_out) / np.std(seen.v_th))
    if ratio > UNIT:
        return (
            f"v_out is {ratio:.3g} times as large as v_th. Their units or scales differ; is one of "
            "them in mV and the other in V?"
        )
    reversed_lag = _lag(seen, -seen.v_out)
    if seen.correlated is None and reversed_lag is not None and abs(reversed_lag) <= 1:
        return (
            "v_out falls where v_th rises, at the same times. The polarity of one record is "
            "reversed; change its sign, or exchange the two wires of the probe."
        )
    return ""


def how_shifted(seen: Inspected) -> str:
    """Which periods of v_out are shifted, and by how much; empty if none is."""
    if seen.shifts is None:
        return ""
    found, before = [], None
    for number, (late, bad) in enumerate(zip(*seen.shifts, strict=True), start=1):
        if bad:
            found.append(f"the fault is in the pulse of period {number}")
            continue
        if before is not None and late != before:
            count = several(int(abs(late - before)), "sample")
            word = "later" if late > before else "earlier"
            found.append(f"from period {number} on, v_out is {count} {word}")
        before = late
    return f"v_out or {seen.recording.cause} lost or doubled samples: {'; '.join(found)}."


def _why_no_power(seen: Inspected) -> str:
    """Why a load takes no power from a measured current: the sign, a shift, or both."""
    for sign in (1, -1):
        lag = _lag(seen, sign * seen.v_out)
        late = 0 if lag is None or abs(lag) <= FITTED else whole_lag(lag)
        if lag is None or not _is_passive(*shifted(seen.v_th, sign * seen.v_out, late)):
            continue
        causes = []
        if late:
            apart = f"{abs(late)} samples ({abs(late) / seen.recording.sample_rate:.3g} s)"
            word = "late" if late > 0 else "early"
            causes.append(f"v_out is {word} by {apart}; shift one of the two records.")
        if sign < 0:
            causes.append("v_out falls where the current rises; change the sign of one of them.")
        return " ".join(causes)
    return (
        "The cause is not clear: a wrong sign, a shift in time, or records of different electrodes "
        "or pulses."
    )


def _lag(seen: Inspected, v_out: Float[np.ndarray, " time"]) -> float | None:
    (lag,) = lags_of(np.stack([seen.v_th, v_out])[None], [seen.train])
    return lag


def _is_passive(current: Float[np.ndarray, " time"], v_out: Float[np.ndarray, " time"]) -> bool:
    """Whether a passive load may have both records: Re Z ≥ 0 at every frequency."""
    x, y = current - current.mean(), v_out - v_out.mean()
    if x @ y <= RELATED * np.sqrt((x @ x) * (y @ y)):
        return False
    power = (np.conj(np.fft.rfft(x)) * np.fft.rfft(y)).real
    return bool(-power[power < 0].sum() <= RETURNED * np.abs(power).sum())
