"""A driver whose Z_th no order explains: with a smooth unknown relative error of Z_th.

No transformer is a few poles to the noise of a good converter. Then all calibrations, and all loads
behind the driver, have the same

    Z_th e^δ,      δ = u + j v,      u, v ~ GP(0, κ) in ln f

(`etid.signals.departure`), of the size that the calibrations say (`etid.likelihood.restricted`).

**Whether there is one** the likelihood ratio of δ tells. The size of the residual tells it late: a
dozen parameters of Z_th and the delays of the calibrations follow a smooth error, and are then
wrong by many standard errors. Two causes have a name. Further sections may explain the
calibrations; and resistors that do not show one Z_th leave a smooth residual with δ, too.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from etid.likelihood import discrepancy, driver
from etid.likelihood.calibrations import Calibrations, Near
from etid.likelihood.discrepancy import root_of, splines
from etid.likelihood.linear import LevenbergMarquardt
from etid.likelihood.noise import is_smooth
from etid.likelihood.of_calibrations import likeliest_section
from etid.likelihood.restricted import Restricted, restricted
from etid.likelihood.source_prior import same_load
from etid.results.driver import LARGEST
from etid.signals.departure import Departure

# χ² of the condensed terms, up to which no likelihood ratio is asked for; of good drivers it is 0.7
PERHAPS = 0.78
# Likelihood ratio of δ. Of 60 good drivers at 40 to 80 dB the largest is 8.
SURE = 25.0
ROUNDS = 2  # the size of δ is chosen again where its first choice has led
STEPS = 60  # with one more section; what it explains is seen earlier
SMALLEST = 1e-3  # size of a function relative to the largest, below which it makes no difference


class Approximation(NamedTuple):
    """A driver with δ.

    Attributes:
        model: The calibrations, with δ among the parameters of Z_th.
        least: The minimum.
        near: The likelihood near it.
        explains: Whether δ explains the calibrations.
    """

    model: Calibrations
    least: driver.Minimum
    near: Near
    explains: bool


def departs(model: Calibrations, near: Near) -> bool:
    """Whether the calibrations show a δ, near their minimum without δ.

    One resistor does not tell whether Z_th or a channel is the cause. Nor do records that are not
    of whole periods: what δ does to the states at their ends is no function of a few of them. A
    held command needs Z_th beyond the band, where nothing tells of δ.
    """
    s = model.spectra
    if same_load(model.calibration.r_load) or not s.whole or s.held:
        return False
    if not is_smooth(near.condensed.part, model.unknowns, PERHAPS):
        return False
    return bool(_restricted(model, near).shown[0] > SURE)


def needs_order(model: Calibrations, near: Near) -> bool:
    """Whether a Z_th of higher order shows no δ."""
    while model.source.order + 2 <= LARGEST:
        model, q = _with_section(model, near)
        at, enough = driver.AtKnots(model, model.near(q)), near.objective / model.terms
        search = LevenbergMarquardt(1e-6, STEPS, driver.PATIENCE, True)
        near = model.near(search(at, q, at.equations(q), enough).q)
        if not departs(model, near):
            return True
    return False


def _with_section(model: Calibrations, near: Near) -> tuple[Calibrations, np.ndarray]:
    """The calibrations with one more section of Z_th, which is nothing at the parameters."""
    of = model.source_of(near.q)
    place = likeliest_section(model, near, model.linear(near))
    new = dict(
        zip(("log_omega", "log_zeta", "gain", "slope"), (*np.log(place), 0.0, 0.0), strict=True)
    )
    new = {name: np.append(getattr(of, name), value) for name, value in new.items()}
    of = dataclasses.replace(of, **new)
    q = np.concatenate([of.vector(), near.q[model.source.modes :]])
    return dataclasses.replace(model, source=of), q


def approximated(model: Calibrations, near: Near) -> Approximation:
    """The driver with δ, from the likelihood near its minimum without δ."""
    of, least = model, None
    for _ in range(ROUNDS):
        covariance = _restricted(of, near).covariance[0]
        before, of = of, with_departure(model, covariance)
        start = nearest(of, before, near.q)
        least = driver.Minimum(*(one[0] for one in driver.minimum(of, start[None])))
        near = of.near(least.q)
    assert least is not None
    explains = least.settled and not is_smooth(near.condensed.part, of.unknowns)
    return Approximation(of, least, near, bool(explains))


def with_departure(model: Calibrations, covariance: Float[np.ndarray, "node node"]) -> Calibrations:
    """The calibrations with a δ that has this covariance between the nodes."""
    functions = root_of(covariance)
    size = np.sqrt((functions**2).sum(0))
    functions = functions[:, size > SMALLEST * size.max()]
    ends = np.log(model.spectra.frequency[0, [0, -1]])
    delta = Departure(ends, functions, np.zeros(2 * functions.shape[1]))
    return dataclasses.replace(model, source=dataclasses.replace(model.source, departure=delta))


def nearest(
    of: Calibrations, before: Calibrations, q: Float[np.ndarray, " q"]
) -> Float[np.ndarray, " every"]:
    """Parameters whose δ is nearest to that of parameters with other functions, or with no δ."""
    delta, other, modes = of.source.departure, before.source.departure, of.source.modes
    assert delta is not None
    c, rest = np.zeros(delta.coefficients.size), q[modes:]
    if other is not None:
        own, rest = np.split(rest, [other.coefficients.size])
        c = discrepancy.nearest(delta.functions, own.reshape(2, 1, -1) @ other.functions.T)
    return np.concatenate([q[:modes], c, rest])


def _restricted(of: Calibrations, near: Near) -> Restricted:
    """What the restricted likelihood says of δ near a point."""
    modes, delta, harmonics = of.source.modes, of.source.departure, of.spectra.x.shape[-1]
    own = np.arange(modes, modes + (0 if delta is None else delta.coefficients.size))
    jacobian, (weak, by_weak) = near.jacobian, of.weak(near.q)
    terms = near.condensed.part - near.q[own] @ jacobian[own]
    known = np.concatenate([np.delete(jacobian, own, 0), terms[None]])
    others = (by_weak[own] == 0).all(0)  # terms of the priors, but for those of δ
    priors = np.concatenate([np.delete(by_weak, own, 0), weak[None]])[:, others]
    by_log: Complex[np.ndarray, "record knot"] = near.slopes.z * near.slopes.by_z
    unit = splines(harmonics)[:, of.knots.index][:, None] * by_log
    unit = near.condensed.rows(np.concatenate([unit, 1j * unit]))
    signal = near.condensed.rows(by_log[None])
    # δ that moves each term by what it has; without any, by its noise.
    size = np.sqrt((terms**2).sum(-1) / (signal**2).sum(-1))
    count = len(known) - 1
    none = np.zeros((1, count, count)), np.zeros((1, count))  # the priors are among the terms
    known = np.concatenate([known, priors], 1)
    unit = np.pad(unit, ((0, 0), (0, priors.shape[1])))
    return restricted(known[None], unit[None], *none, size, harmonics)
