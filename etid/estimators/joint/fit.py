"""Joint maximum-likelihood fit of one driver and many loads; its time is linear in the loads.

`etid.estimators.joint.near` goes to the minimum; the own parameters of each load are eliminated
(Pintelon and Schoukens, System Identification, 2012, ch. 9). A few loads at a time are evaluated in
parallel.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float

from etid.estimators.joint.errors import Found, estimates
from etid.estimators.joint.near import minimum
from etid.estimators.joint.terms import Current, Joint, Loads, in_turn
from etid.estimators.maximum_likelihood import load_fit, search
from etid.estimators.maximum_likelihood.given_driver import GivenDriver
from etid.estimators.unknowns import LoadUnknowns
from etid.signals.harmonics import Spectrum


class Alone(NamedTuple):
    """What is found of one load alone.

    Attributes:
        own: Its unknowns.
        result: Result of the solver.
        chi2: χ² per degree of freedom.
        rrse: RRSE.
        hum: Whether mains hum is seen.
        other: Whether the record shows another circuit, or another gain of V_out.
        errors: Errors of the instrument [their standard deviations].
    """

    own: LoadUnknowns
    result: optx.RESULTS
    chi2: Float[Array, ""]
    rrse: Float[Array, ""]
    hum: Bool[Array, ""]
    other: Bool[Array, ""]
    errors: Float[Array, " error"]


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
        `shared_cov` of an estimate comes from the uncertainty of `common`, and from the noise of
        shared unloaded records.
    """
    common, owns = model.calibrations.start(), [loads.own.vector() for loads in groups]
    if model.calibrations.instrument is not None:
        common = _start(model, groups)
        found = [_refitted(model, common, *group) for group in zip(groups, owns, strict=True)]
        owns = [own.vector() for own, _ in found]
    common, parts, least = minimum(model, groups, common, owns)
    # The loads that take no part are fitted now, with the final Z_th.
    refitted = [_refitted(model, common, *group) for group in zip(groups, parts, strict=True)]
    cov, found = estimates(model, groups, common, refitted, several, least)
    return common, cov, found


def _start(model: Joint, groups: Sequence[Loads]) -> Float[Array, " common"]:
    """Common parameters with the mean errors of the instrument that the loads alone show.

    A gain that is 1 % wrong moves R_p by 20 %, too far for the approximations of the search.
    """
    of = model.calibrations
    shown = jnp.concatenate([loads.errors for loads in groups])
    used = jnp.concatenate([loads.used for loads in groups])
    count = jnp.maximum(jnp.sum(used, dtype=shown.dtype), 1.0)
    errors = jnp.sum(jnp.where(used[:, None], shown, 0.0), axis=0) / count
    common = of.start()
    more = errors - of.errors(common)
    return common + jnp.concatenate([of.following(of.linear(of.near(common))) @ more, more])


def _refitted(
    model: Joint,
    common: Float[Array, " common"],
    loads: Loads,
    starts: Float[Array, "load own"],
) -> tuple[LoadUnknowns, optx.RESULTS]:
    """Unknowns of each load at its minimum with this Z_th, and the results of the solver."""
    driver = model.around(common, loads.frequency[0], slopes=False)

    def one(load: Loads, start: Float[Array, " own"]) -> tuple[LoadUnknowns, optx.RESULTS]:
        q, least = search.minimum(load.behind(driver, model), start)
        return LoadUnknowns.of(q, load.current is not None), least.result

    return in_turn(one, loads, starts)


def fit_alone(
    model: Joint,
    driver: GivenDriver,
    uncertain: GivenDriver,
    spectrum: Spectrum,
    sample_rate: Float[Array, ""],
    candidates: LoadUnknowns,
    current: Current | None = None,
) -> Alone:
    """Identify the load of one recording from the best of several starts.

    Args:
        model: The likelihood.
        driver: The driver of the fit. Z_th may be fixed, but not with a current: the three records
            may know it better than the calibrations, whose error would be a misfit. With an
            instrument that has tolerances it is not fixed either.
        uncertain: The driver with its distribution, of the test for another circuit.
        spectrum: Harmonics of the recording.
        sample_rate: Its sampling rate [Hz].
        candidates: The starts.
        current: Its measured current.
    """
    lane = model.lane(driver, spectrum, sample_rate, current)
    start = search.best_start(lane, candidates)
    q, least = search.minimum(lane, jnp.concatenate([start, driver.mean]))
    records, profile = lane.known(q), least.near.profile
    chi2 = 2 * least.objective / (lane.terms - start.size)
    error, hum = profile.rrse(records, spectrum.x), profile.shows_hum(records)
    own, z = LoadUnknowns.of(q[: start.size], current is not None), q[start.size :]
    tested = model.lane(uncertain, spectrum, sample_rate, current)
    at = jnp.concatenate([own.vector(), z if uncertain is driver else uncertain.mean])
    other = load_fit.scores_at(tested, at).misfit
    errors = jnp.zeros(0)
    if model.calibrations.instrument is not None and driver.errors is not None:
        errors = driver.errors.values(z)
    return Alone(own, least.result, chi2, error, hum, other, errors)
