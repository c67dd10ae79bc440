"""Joint maximum-likelihood fit of one driver and many loads; its time is linear in the loads.

`etid.estimators.joint.near` finds a point close to the minimum. From there the solver takes all
parameters and harmonics, mostly in one step. The matrix of its normal equations is an arrowhead
(`etid.solvers.arrowhead`; Pintelon and Schoukens, System Identification, 2012, ch. 9). A few loads
at a time are evaluated in parallel.
"""

import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float

from etid.estimators.estimate import MAX_STEPS, SOLVER
from etid.estimators.joint.errors import Found, estimates
from etid.estimators.joint.near import approached
from etid.estimators.joint.terms import Current, DriverStudy, Joint, Loads, Own, in_turn
from etid.estimators.maximum_likelihood import load_fit
from etid.estimators.maximum_likelihood.given_driver import GivenDriver
from etid.estimators.maximum_likelihood.load_fit import SLIGHT
from etid.estimators.unknowns import LoadUnknowns, LoadWithCurrentUnknowns
from etid.signals.harmonics import Spectrum
from etid.solvers.arrowhead import Arrowhead, ArrowheadEquations, join
from etid.solvers.least_squares import least_squares
from etid.solvers.levenberg_marquardt import (
    DIFFERENCE,
    LevenbergMarquardt,
    NormalEquations,
    best_start,
)

NEAR = 0.05  # distance of all parameters together from their minimum [standard errors]
WITHIN = 0.2  # of this distance, for the fit that leads there


def _equations(_, y: Float[Array, " parameter"], study: DriverStudy) -> ArrowheadEquations:
    """Normal equations of a study, load by load."""
    common, parts = study.split(y)

    def of_group(loads: Loads, owns: Own) -> NormalEquations:
        driver = study.model.around(common, loads.frequency[0])

        def one(load: Loads, own: Own) -> NormalEquations:
            lane = study.lane(driver, load)
            q = own.vector()
            alone = lane.equations(jnp.concatenate([q, driver.mean]))
            prior = 1 / lane.gains.widths(q)
            rest, others = lane.rest(q), (0, driver.mean.size)
            found = NormalEquations(
                alone.objective + 0.5 * jnp.dot(rest, rest),
                alone.gradient + jnp.pad(prior * rest, others),
                alone.matrix + jnp.diag(jnp.pad(prior**2, others)),
            ).finite()
            found = _with_room(found, q.size, study.owned)
            return jax.tree.map(lambda leaf: jnp.where(load.used, leaf, 0.0), found)

        return in_turn(one, loads, owns)

    found = [of_group(*group) for group in zip(study.groups, parts, strict=True)]
    loads = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *found)
    known = study.model.calibrations.near(common).equations()
    o = study.owned
    return ArrowheadEquations(
        known.objective + loads.objective.sum(),
        join(known.gradient + loads.gradient[:, o:].sum(0), loads.gradient[:, :o]),
        Arrowhead(
            known.matrix + loads.matrix[:, o:, o:].sum(0),
            loads.matrix[:, :o, o:],
            loads.matrix[:, :o, :o],
        ),
    )


def _with_room(found: NormalEquations, own: int, room: int) -> NormalEquations:
    """Equations in (own, common) with room for own parameters that only other loads have."""
    if room == own:
        return found
    at = np.full(room - own, own)
    matrix = jnp.insert(jnp.insert(found.matrix, at, 0.0, axis=0), at, 0.0, axis=1)
    return NormalEquations(found.objective, jnp.insert(found.gradient, at, 0.0), matrix)


def _second_order(
    _, y: Float[Array, " parameter"], step: Float[Array, " parameter"], study: DriverStudy
) -> Float[Array, " parameter"]:
    """Jᵀ r″ of a study, load by load; r″ as in `levenberg_marquardt.second_order`."""
    (common, parts), (towards, steps) = study.split(y), study.split(step)

    def of_group(loads: Loads, owns: Own, steps: Own) -> Float[Array, "load q"]:
        frequency = loads.frequency[0]
        driver = study.model.around(common, frequency)
        ends = []
        for h in (DIFFERENCE, -DIFFERENCE):
            end = study.model.around(common + h * towards, frequency, slopes=False)
            ends.append((h, end))

        def one(load: Loads, own: Own, step: Own) -> Float[Array, " q"]:
            lane = study.lane(driver, load)
            at, way = own.vector(), step.vector()
            bent = sum(study.lane(end, load).residual(at + h * way) for h, end in ends)
            middle, pullback = jax.vjp(lane.residual, jnp.concatenate([at, driver.mean]))
            (found,) = pullback((bent - 2 * middle) / DIFFERENCE**2)
            own_part = study.widened(found[: at.size])
            return jnp.where(load.used, jnp.concatenate([own_part, found[at.size :]]), 0.0)

        return in_turn(one, loads, owns, steps)

    found = [of_group(*group) for group in zip(study.groups, parts, steps, strict=True)]
    loads, o = jnp.concatenate(found), study.owned
    known = study.model.calibrations.second_order(common, towards)
    return join(known + loads[:, o:].sum(0), loads[:, :o])


def fit_together(
    model: Joint, groups: list[Loads], several: Sequence[int]
) -> tuple[
    Float[Array, " common"],
    Float[Array, "common common"],
    list[Found],
]:
    """Identify all loads and their driver.

    Args:
        model: Calibrations, structure of the circuit, and the driver as start.
        groups: The recordings, one group for each length.
        several: Number of unloaded records in each group that several loads share.

    Returns:
        Common parameters, their covariance, and what is found of the loads of each group, stacked.
        In the estimates, `shared_cov` is the
        part that several loads share: from the uncertainty of `common`, and from the noise of
        shared unloaded records.
    """
    study = DriverStudy(model, groups)
    # The sum of squares grows with the number of loads; a detectable change of it does not.
    terms = sum(2 * loads.spectrum.x.size for loads in groups)
    count = sum(loads.sample_rate.shape[0] for loads in groups)
    near = NEAR / math.sqrt(terms)
    ftol = SOLVER.ftol / (1 + count)
    inner = LevenbergMarquardt(rtol=WITHIN * near, ftol=WITHIN**2 * ftol, geodesic=True)
    # With plain instead of bent last steps, 4 of 40 studies whose trials share an unloaded record
    # did not converge.
    solver = LevenbergMarquardt(
        rtol=near,
        ftol=ftol,
        damping=SLIGHT,
        geodesic=True,
        equations=_equations,
        second_order=_second_order,
    )
    solution = least_squares(
        lambda y, _: y,  # not evaluated: the solver takes the equations
        solver,
        approached(study, study.start(), inner),
        study,
        MAX_STEPS,
    )
    common, parts = study.split(solution.value)
    # The loads that take no part are fitted now, with the final Z_th.
    refitted = [_refitted(study, common, *group) for group in zip(groups, parts, strict=True)]
    cov, found = estimates(study, common, refitted, several, solution)
    return common, cov, found


def _refitted(
    study: DriverStudy, common: Float[Array, " common"], loads: Loads, owns: Own
) -> tuple[Own, optx.RESULTS]:
    """Unknowns of each load at its minimum with this Z_th, and the results of the solver."""
    driver = study.model.around(common, loads.frequency[0], slopes=False)

    def one(load: Loads, own: Own) -> tuple[Own, optx.RESULTS]:
        lane, start = study.lane(driver, load), own.vector()
        solution = load_fit.refined(lane, start)
        return type(own).of(solution.value), solution.result

    return in_turn(one, loads, owns)


def fit_alone(
    model: Joint,
    driver: GivenDriver,
    spectrum: Spectrum,
    sample_rate: Float[Array, ""],
    candidates: LoadUnknowns,
    current: Current | None = None,
) -> tuple[Own, optx.RESULTS, Float[Array, ""], Float[Array, ""], Bool[Array, ""]]:
    """Identify the load of one recording; Z_th is fixed.

    With a current Z_th is not fixed: the three records may know it better than the calibrations,
    whose error would be a misfit.

    Args:
        model: Structure of the circuit and its prior.
        driver: The driver at the harmonics of the recording, with z only if there is a current.
        spectrum: The recording.
        sample_rate: Its sampling rate [Hz].
        candidates: Starts, stacked; the start that predicts best is refined.
        current: Harmonics of the measured current [A], and their variances [A²].

    Returns:
        The unknowns, the result of the solver, χ² per degree of freedom, RRSE, and whether mains
        hum is seen.
    """
    lane = model.lane(driver, spectrum, sample_rate, current)
    if model.prior is not None:
        placed = model.prior.placed(candidates.log_elements)
        candidates = LoadUnknowns(placed, candidates.delay_samples)
    outputs = lane.gains.outputs
    start = best_start(lane, jnp.pad(candidates.vector(), ((0, 0), (0, outputs - 1))))
    if current is not None:  # first with Z_th fixed, which a distant start would distort
        start = load_fit.refined(lane, start, load_fit.ROUGHLY).value
    solution = load_fit.refined(lane, jnp.concatenate([start, driver.mean]))
    kind = LoadUnknowns if current is None else LoadWithCurrentUnknowns
    records, profile = lane.known(solution.value), lane.profile(solution.value)
    chi2 = 2 * solution.stats["normal_equations"].objective / (lane.terms - start.size)
    error, hum = profile.rrse(records, spectrum.x), profile.shows_hum(records)
    return kind.of(solution.value[: start.size]), solution.result, chi2, error, hum
