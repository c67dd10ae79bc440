"""The verdicts that forbid a fit, as far as what an inspection finds in recordings gives them."""

import math
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Int

from etid.recordings import faults
from etid.signals.filtering import TAPS
from etid.signals.pulse_train import rise_time

if TYPE_CHECKING:
    from etid.recordings.inspection import Inspection

_Rows = Int[np.ndarray, " row"]
_Holds = Bool[np.ndarray, " row"]
SHORTEST = 4 * TAPS + 104  # [samples] edges of the interpolation, and 104 samples for the fit


def refused(seen: "Inspection") -> list[str | None]:
    """Names of the verdicts that forbid any fit, the first that applies; None if it is allowed.

    Properties of a recording with one fault may have no meaning, and are not asked for.
    """
    names: list[str | None] = [None] * len(seen.recordings)
    left = np.arange(len(names))
    for name, applies in _VERDICTS.items():
        if left.size:
            found = applies(seen, left)
            for row in left[found]:
                names[row] = name
            left = left[~found]
    return names


def _too_short(seen: "Inspection", rows: _Rows) -> _Holds:
    shortest = max(SHORTEST, rise_time(seen.sample_rate) + 1)
    return np.full(rows.size, seen.recorded.shape[2] < shortest)


def _saturated(seen: "Inspection", rows: _Rows) -> _Holds:
    nothing = math.nan, math.nan
    ranges = [seen.recordings[row].adc_range or nothing for row in rows]
    adc_range = np.repeat(np.array(ranges)[:, None], 2, axis=1)
    if seen.has_current:
        adc_range[:, 0] = nothing  # it is one of volts
    records, limits = faults.part(seen.recorded, rows), seen.recorded_limits[rows]
    sigma, step = seen.sigma[rows], seen.step[rows]
    found = faults.saturated(records, limits, step, adc_range)
    found[:, 0] &= ~seen.held[rows]  # a command may rest at its limits
    if seen.has_current:
        found[:, 0] &= ~faults.held(sigma[:, 0], step[:, 0], seen.spans[rows, 0])
        return np.asarray(found.any(1))  # a stimulator that holds its voltage is no fault
    unit = np.maximum(np.maximum(sigma, step), seen.coarse[rows])[:, 1]
    of = limits[:, 1], unit, seen.correlated[rows], seen.sample_rate
    return found.any(1) | faults.limited(records, *of)


def _implausible(seen: "Inspection", rows: _Rows) -> _Holds:
    found = [seen.has_current and not faults.is_plausible(*seen.spans[row, ::-1]) for row in rows]
    return np.array(found, bool)


def _unconnected(seen: "Inspection", rows: _Rows) -> _Holds:
    if seen.has_current:
        return np.zeros(rows.size, bool)
    of = seen.covariance[rows], seen.sigma[rows], seen.correlated[rows]
    return faults.unconnected(faults.part(seen.quiet, rows), *of)


def _misaligned(seen: "Inspection", rows: _Rows) -> _Holds:
    both = zip(seen.kept, seen.shifts, strict=True)
    hopeless = [kept is None and found is not None for kept, found in both]
    of_th, of_both, of_out = (seen.covariance[rows, i, j] for i, j in ((0, 0), (0, 1), (1, 1)))
    wrong = np.array(hopeless, bool)[rows]
    if seen.has_current:
        return np.asarray(wrong | (of_both <= 0))  # a passive load takes power
    noise = np.square(seen.sigma[rows])
    power = np.stack([of_th, of_out], axis=1)  # with the noise
    by_chance = np.sqrt((4 * power * noise).sum(1) / seen.recorded.shape[2])
    more = of_out > 1.01 * of_th + faults.BY_CHANCE * by_chance
    return np.asarray(wrong | more | np.isnan(seen.correlated[rows]))


_VERDICTS = {
    "too_short": _too_short,
    "nonfinite_samples": lambda seen, rows: (
        ~(np.isfinite(seen.limits[rows]).all((1, 2)) & np.isfinite(seen.spans[rows]).all(1))
    ),
    "flat": lambda seen, rows: seen.is_flat[rows].any(1),
    "saturated": _saturated,
    "wrong_unit": _implausible,
    "unconnected": _unconnected,
    "rate_mismatch": lambda seen, rows: seen.mismatch | seen.clocks_differ[rows],
    "misaligned": _misaligned,
}
