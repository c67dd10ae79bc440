"""Test whether the load or the driver changed during the record, and which element changed.

The harmonics of a record show its mean only. Skin whose R_p falls by 20 % over the record ends 58
of its standard errors away, and χ² is still 1. The change appears between the harmonics.
`etid.recordings.repeats` measures it as the deviation η of the logarithm of the gain, for each
period and each band. A change θ of the logarithms of the elements gives

    η = Σ θ_i ∂ ln G/∂ ln q_i + a − jωτ,      ∂ ln G/∂Z_L = Z_th / (Z_L (Z_L + Z_th)),

where a is a change of the amplitude and τ a drift of the clock. The drift does no harm. Linear
least squares estimates θ and a for several courses over the periods: a line, a step after each
period, and one period that differs from all others. χ² of θ and a tells whether there is such a
change.

**Does the change matter?** A fit that ignores the change of the amplitude shows how far the change
moves the elements. The change matters if an element moves by more than its standard error in the
fit: at one end of the record it is then more than half a standard error away from its mean. Smaller
changes do not matter. They occur in long records with little noise and a less certain driver. The
standard errors of the fit are then right.
"""

import dataclasses
import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Complex, Float

from etid.circuits.circuit import AbstractCircuit, with_slopes
from etid.circuits.directions import FALSE_ALARMS
from etid.recordings.repeats import Repeats
from etid.results.driver import Driver
from etid.results.feed import AbstractFeed
from etid.results.fit import Fit
from etid.results.verdicts import verdict
from etid.signals.deviations import ALIGNED
from etid.signals.harmonics import real_parts
from etid.signals.transfer import reciprocal

UNEQUAL = 5e-4  # largest change of the amplitude of V_th; cuts between samples cause 1e-4
RIDGE = 1e-10  # added to the diagonal, for elements without effect


class Change(NamedTuple):
    """Change of the elements and of the amplitude during a record, or during each of several.

    Attributes:
        size: Relative change of each element and, last, of the amplitude, over the record.
        stderr: Standard errors of `size`.
        seen: Whether a change was detected that matters.
    """

    size: Float[np.ndarray, "*lane moved"]
    stderr: Float[np.ndarray, "*lane moved"]
    seen: Bool[np.ndarray, "*lane"]


def unknown(*shape: int) -> Change:
    """Unknown changes, all NaN; `shape` ends with the number of elements."""
    *lanes, elements = shape
    nothing = np.full((*lanes, elements + 1), np.nan)
    return Change(nothing, nothing.copy(), np.zeros(lanes, bool))


@np.errstate(all="ignore")  # elements of a fit that failed may be 0
def log_slopes(
    circuits: AbstractCircuit, driver: AbstractFeed, frequency: Float[np.ndarray, " band"]
) -> Complex[np.ndarray, "row element band"]:
    """∂ ln G/∂ ln q of the elements of circuits along a leading axis."""
    logs = np.log(np.asarray(circuits.values()))
    load, by_element = with_slopes(circuits, logs, frequency)
    return by_element * (driver.sensitivity(load, frequency) * reciprocal(load))[:, None, :]


@functools.lru_cache(maxsize=64)
def courses(periods: int) -> Float[np.ndarray, "course period"]:
    """Courses of a change over the periods, of norm 1 and mean 0; the line comes first."""
    p = np.arange(periods)
    rows = [p, *(p >= first for first in range(1, periods))]
    rows += [p == one for one in range(1, periods - 1)]
    found = np.array(rows, float)[: 1 if periods == 2 else None]
    found -= found.mean(axis=1, keepdims=True)
    return found / np.linalg.norm(found, axis=1, keepdims=True)


def unlikely(square: Float[np.ndarray, "..."], freedom: int, count: int) -> Bool[np.ndarray, "..."]:
    """Whether χ² is so large that the largest of `count` exceeds it by chance in `FALSE_ALARMS`."""
    if not np.any(square > freedom + 12.0):  # never unlikely
        return np.zeros(square.shape, bool)
    import scipy.special  # takes a fifth of a second, which few recordings need

    return scipy.special.chdtrc(freedom, square) < FALSE_ALARMS / count


def found(
    repeats: Sequence[Repeats | None],
    slopes: Complex[np.ndarray, "lane element band"] | None,
    allowed: Float[np.ndarray, "lane element"],
) -> Change:
    """Changes of loads during their records; NaN where there are none to compare.

    Args:
        repeats: The periods of each record; None if there are less than two.
        slopes: ∂ ln G/∂ ln q; None if no record has periods.
        allowed: Largest changes of the logarithms of the elements that do not matter.
    """
    changes = unknown(*allowed.shape)
    if slopes is None:
        return changes
    alike: dict[int, list[int]] = {}
    for lane, of in enumerate(repeats):
        if of is not None and np.isfinite(slopes[lane]).all():
            alike.setdefault(len(of.gain), []).append(lane)
    for lanes in alike.values():
        group = [of for lane in lanes if (of := repeats[lane]) is not None]
        of = Repeats(*(np.stack(parts) for parts in zip(*group, strict=True)))
        moved = _changes(of, slopes[lanes], allowed[lanes])
        for whole, part in zip(changes, moved, strict=True):
            whole[lanes] = part
    return changes


def _changes(of: Repeats, slopes: np.ndarray, allowed: np.ndarray) -> Change:
    """The changes of recordings with the same number of periods."""
    elements, course = slopes.shape[1], courses(of.gain.shape[1])
    whole, normal, right, plain, unit, total = _equations(of, slopes, course)
    tested = elements + 1  # and the amplitude; not the delays
    fitted = _solved(normal, right, tested)
    # Coloured noise differs from period to period too, but not as an element does. The residual of
    # the parameters gives its size.
    freedom = 2 * of.frequency.shape[1] - right.shape[-1]
    noise = np.maximum(1.0, (total - fitted.explained) / freedom)
    # Half of the false alarms are allowed to elements that change alone: a test of four elements
    # together would hide such a change.
    alone = (fitted.alone / noise[..., None]).max((1, 2))
    seen = unlikely((fitted.square / noise).max(1), tested, 2 * len(course))
    seen |= unlikely(alone, 1, 2 * len(course) * tested)
    cov = np.broadcast_to(fitted.cov, (*noise.shape, tested, tested)) * noise[..., None, None]
    # Without aliases the courses do not mix: the course that fits best is the most likely one.
    likely = np.argmax(_solved(whole[:, None], plain, tested).square, axis=1)
    best = np.where(seen, likely, 0)
    lane, reach = np.arange(len(best)), np.ptp(course, axis=1)[best][:, None]
    # How far the elements move if they are fitted without the amplitude.
    others = np.arange(normal.shape[-1]) != elements
    normal, right = normal[lane, best][:, others], right[lane, best][:, others]
    blind = np.linalg.inv(normal[:, :, others] + RIDGE * np.eye(others.sum()))[:, :elements]
    units = unit[:, :elements]
    moved = np.abs((blind * right[:, None]).sum(2)) / units * reach
    by_amplitude = np.abs((blind * normal[:, None, :, elements]).sum(2)) / units
    uneven = _uneven(of, course)
    other = by_amplitude * uneven[:, None] * unit[:, elements, None]
    matters = seen & (moved > allowed).any(1)
    matters |= (uneven > UNEQUAL) & (other > allowed).any(1)
    units = unit[:, :tested]
    log = fitted.theta[lane, best] / units * reach
    factor = np.exp(np.clip(log, -20.0, 20.0))  # an undetermined change can be arbitrary
    error = np.sqrt(np.diagonal(cov[lane, best], axis1=1, axis2=2)) / units * reach
    return Change(factor - 1, factor * error, matters)


def _equations(
    of: Repeats, slopes: np.ndarray, course: Float[np.ndarray, "course period"]
) -> tuple[np.ndarray, ...]:
    """Normal equations of the elements, the amplitude and the delay.

    Returns:
        Matrix of a course that aliases cannot imitate; matrix of each course; right sides for each
        course, without aliases and with them; units of the parameters, which make the diagonal of
        the equations 1; Σ η² / variance for each course.
    """
    plain = course @ of.gain
    along = course @ of.turn.swapaxes(1, 2)
    lost = np.einsum("lcd,lbde->lcbe", along, of.removed)
    # The share of each course that aliases cannot imitate, in each band.
    share = 1 - np.einsum("lcbe,lce->lcb", lost, along.conj()).real
    share = np.where(share > ALIGNED, share, 0.0)
    turned = plain - np.einsum("lcbe,leb->lcb", lost, of.turn.conj() @ of.gain)
    turned = np.where(share > 0, turned, 0.0)
    late = -2j * np.pi * of.frequency / of.sample_rate[:, None]
    # Where aliases are removed, delays along other courses leak into this one.
    cross = np.where(np.any(of.removed, axis=(2, 3)), 1j * late, 0)
    nuisance = np.stack([np.ones_like(late), late, cross], axis=1)
    rows = np.concatenate([slopes, nuisance], axis=1)
    # As for the deviations, polynomials are projected out.
    smooth = np.real(rows @ of.smooth.conj().swapaxes(1, 2)) @ of.smooth
    rows = real_parts(rows - smooth / of.power[:, None])
    weight = np.tile(1 / of.variance, 2)[:, None]
    unit = np.sqrt((rows**2 * weight).sum(2))
    unit = np.where(unit > 0, unit, 1.0)
    rows = rows / unit[:, :, None]
    weighted = (rows * weight).swapaxes(1, 2)
    of_bands = rows[:, :, None] * (rows * weight)[:, None]
    normal = np.tile(share, 2) @ of_bands.reshape(len(rows), -1, rows.shape[2]).swapaxes(1, 2)
    normal = normal.reshape(*share.shape[:2], rows.shape[1], rows.shape[1])
    right, deviation = real_parts(turned), np.abs(turned) ** 2 / np.where(share > 0, share, 1.0)
    total = (deviation / of.variance[:, None]).sum(2)
    return rows @ weighted, normal, right @ weighted, real_parts(plain) @ weighted, unit, total


class _Fitted(NamedTuple):
    """Least squares of each recording and course.

    Attributes:
        theta: The first parameters.
        cov: Their covariance.
        square: Their χ².
        alone: χ² of each of them if it changes alone; the other parameters, the delays, are fitted
            with it.
        explained: Reduction of Σ η² / variance by all parameters.
    """

    theta: np.ndarray
    cov: np.ndarray
    square: np.ndarray
    alone: np.ndarray
    explained: np.ndarray


def _solved(normal: np.ndarray, right: np.ndarray, tested: int) -> _Fitted:
    """Solve normal equations; the parameters after the first `tested` ones are eliminated."""
    normal = normal + RIDGE * np.eye(right.shape[-1])
    cross, others = normal[..., :tested, tested:], np.linalg.inv(normal[..., tested:, tested:])
    removed, of_others = cross @ others, right[..., None, tested:]
    own = normal[..., :tested, :tested] - removed @ cross.swapaxes(-1, -2)
    score = right[..., :tested] - (removed * of_others).sum(-1)
    cov = np.linalg.inv(own)
    theta = (cov * score[..., None, :]).sum(-1)
    square = (theta * score).sum(-1)
    alone = score**2 / np.maximum(np.diagonal(own, axis1=-2, axis2=-1), RIDGE)
    explained = square + ((of_others @ others)[..., 0, :] * of_others[..., 0, :]).sum(-1)
    return _Fitted(theta, cov, square, alone, explained)


def _uneven(of: Repeats, course: Float[np.ndarray, "course period"]) -> np.ndarray:
    """Change of the amplitude of V_th in each recording; 0 where it is not significant."""
    along = np.abs(of.unloaded @ course.T)
    worst = np.argmax(along, axis=1)
    largest = along[np.arange(len(worst)), worst]
    with np.errstate(divide="ignore", invalid="ignore"):  # a record without noise
        seen = unlikely(largest**2 / of.unloaded_variance, 1, len(course))
    return np.where(seen, largest * np.ptp(course, axis=1)[worst], 0.0)


def of_fits(fits: Fit, driver: AbstractFeed, repeats: Sequence[Repeats | None]) -> Change:
    """The change during the record of each fit.

    Args:
        fits: Fits along a leading axis.
        driver: The driver of these fits.
        repeats: The periods of the records, with equal bands; None if there are less than two.
    """
    values = np.stack(jax.tree.leaves(fits.circuit), axis=1)
    variance = np.diagonal(np.asarray(fits.cov), axis1=1, axis2=2)
    usable = np.isfinite(values) & (values != 0) & (variance >= 0)
    allowed = np.sqrt(np.where(usable, variance, 0.0)) / np.where(usable, np.abs(values), 1.0)
    frequency = bands(repeats)
    slopes = log_slopes(fits.circuit, driver, frequency) if frequency.size else None
    return found(repeats, slopes, allowed)


def driver_judged(
    driver: Driver,
    r_load: Float[np.ndarray, " record"],
    repeats: Sequence[Repeats | None],
    z_th: Complex[np.ndarray, " band"],
) -> Driver:
    """The driver, with the verdict `changed` if it or its pulses changed during a calibration.

    Args:
        driver: The driver.
        r_load: The resistors of its calibrations [Ω].
        repeats: The periods of its calibrations.
        z_th: Source impedance at the `bands` of these periods [Ω].
    """
    if not z_th.size or not driver.usable:
        return driver
    slopes = z_th / (r_load[:, None] + z_th)  # ∂ ln G/∂ ln R: as if the resistor had changed
    if found(repeats, slopes[:, None, :], np.full((len(repeats), 1), 2e-3)).seen.any():
        return dataclasses.replace(driver, result=verdict("changed"))
    return driver


def bands(repeats: Sequence[Repeats | None]) -> Float[np.ndarray, " band"]:
    """Middle frequencies of the bands of records [Hz]; none if no record has several periods."""
    return next((np.asarray(of.frequency) for of in repeats if of is not None), np.zeros(0))
