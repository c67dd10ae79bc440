"""Joint maximum-likelihood fit of one driver and many loads; its time is linear in the loads.

`etid.likelihood.joint.minimum` goes to the minimum; `etid.likelihood.joint.errors` has the errors.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from etid.likelihood import scores
from etid.likelihood.calibrations import Calibrations
from etid.likelihood.fit import Estimate, beyond
from etid.likelihood.joint.errors import AtMinimum, Common, Eliminated, at_minimum, tested
from etid.likelihood.joint.loads import Loads
from etid.likelihood.joint.minimum import minimum
from etid.likelihood.linear import diagonal
from etid.likelihood.search import minimum as minimum_alone
from etid.precision import array_function
from etid.results.fit import Support
from etid.results.instrument import LATER, Effects, Instrument
from etid.signals.transfer import AnyArray


class Delays(NamedTuple):
    """The trigger delays of loads and their errors.

    Attributes:
        samples: The delays [samples].
        own_variance: Variances at given common parameters.
        slope: Derivatives with respect to the common parameters.
    """

    samples: Float[np.ndarray, " load"]
    own_variance: Float[np.ndarray, " load"]
    slope: Float[np.ndarray, "load common"]


class Found(NamedTuple):
    """A study at its minimum.

    Attributes:
        common: The common parameters.
        cov: Their covariance.
        strain: Increase of the Σ r² of the calibrations.
        owns: The own parameters of the loads of each length (load, own).
        estimates: The loads of each length. The part of their covariance that comes from `common`
            and from shared unloaded records is `shared_cov`.
        delays: Their trigger delays.
    """

    common: Float[np.ndarray, " common"]
    cov: Float[np.ndarray, "common common"]
    strain: float
    owns: list[AnyArray]
    estimates: list[Estimate]
    delays: list[Delays]


@array_function
def start_of(of: Calibrations, errors: Float[np.ndarray, " error"]) -> Float[np.ndarray, " common"]:
    """Common parameters with errors of the instrument that loads alone show [their std].

    A gain that is 1 % wrong moves R_p by 20 %, too far for the approximations of the search.
    """
    common = of.start()
    if of.instrument is None:
        return common
    more = errors - of.errors(common)
    return common + np.concatenate([of.following(of.linear(of.near(common))) @ more, more])


@array_function
def fit(
    of: Calibrations,
    groups: Sequence[Loads],
    start: Float[np.ndarray, " common"],
    owns: Sequence[AnyArray],
    told: Instrument | None = None,
) -> Found:
    """Identify all loads and their driver.

    Args:
        of: The calibrations.
        groups: The recordings, one group for each length.
        start: Start of the common parameters.
        owns: Starts of the own parameters of all loads, also of those that take no part; one array
            (load, own) for each length.
        told: The instrument as it is stated; that of the calibrations has all errors of a budget.
    """
    used = [loads.of(loads.used) for loads in groups if loads.used.any()]
    starts = [own[of.used] for own, of in zip(owns, groups, strict=True) if of.used.any()]
    # Alone, each load has had a Z_th of its own; behind another one it is far from its minimum.
    starts = [_behind(of, start, *one)[0] for one in zip(used, starts, strict=True)]
    least = minimum(of, used, start, starts)
    found, each = iter(least.owns), []
    for loads, own in zip(groups, owns, strict=True):
        own, settled = own.copy(), loads.used & least.settled
        if loads.used.any():
            own[loads.used] = next(found)
        if not loads.used.all():
            others = _behind(of, least.common, loads.of(~loads.used), own[~loads.used])
            own[~loads.used], settled[~loads.used] = others
        at = at_minimum(of, least.common, loads, own)
        each.append(_Fitted(loads, own, settled, at, Eliminated.of(at, own.shape[1])))
    common = Common.of(of, least.common, groups, [one.eliminated for one in each])
    strain, estimates = float(of.strain(least.common)), []
    for one in each:
        every = np.ones(one.loads.count, int)
        estimate = _estimated(of, common, one)._replace(
            points=least.points * every,
            strain=strain * every,
            effects=_effects(of, told, one.eliminated, common, one.loads.load.gains.elements),
        )
        estimates.append(estimate)
    return Found(
        common.values,
        common.cov,
        strain,
        [one.own for one in each],
        estimates,
        [one.delays() for one in each],
    )


class _Fitted(NamedTuple):
    """Loads of one length at the minimum of the study."""

    loads: Loads
    own: Float[np.ndarray, "load own"]
    settled: Bool[np.ndarray, " load"]
    at: AtMinimum
    eliminated: Eliminated

    @property
    def of_x(self) -> Float[np.ndarray, "load own own"]:
        """Covariance by the noise of an X that several loads share."""
        of_x = self.eliminated.x_by_own.swapaxes(1, 2) @ self.eliminated.x_by_own
        return np.where(self.loads.unloaded[:, None, None] >= 0, of_x, 0.0)

    def delays(self) -> Delays:
        """The trigger delays."""
        e, found = self.loads.load.gains.elements, self.eliminated
        return Delays(self.own[:, e], (found.cov - self.of_x)[:, e, e], found.slope[:, e])


def _estimated(of: Calibrations, common: Common, one: _Fitted) -> Estimate:
    """Estimates of loads of one length, without effects of the instrument."""
    loads, own, settled, at, found = one
    e, every = loads.load.gains.elements, np.ones(loads.count, int)
    shared = found.slope @ common.cov @ found.slope.swapaxes(1, 2)
    whole = found.cov + shared
    tests = tested(at, found, loads.used, common, e)
    seen = scores.seen(tests)
    doubtful, of_doubt = scores.doubt(tests["gain"].of_changes(0), seen["gain"])
    misfit, inconsistent = scores.verdicts(seen)
    late = beyond(own[:, e] / of.delay_width, whole[:, e, e] / of.delay_width**2)
    wrong = beyond(of.errors(common.values), of.errors(diagonal(common.bread))).any()
    support = Support.unknown(e, loads.count)
    return Estimate(
        logs=own[:, :e],
        delays=own[:, e:],
        z=np.zeros((loads.count, 0)),
        cov=whole[:, :e, :e] + of_doubt,
        # The correlation of a shared X with `common` makes less than 3 % of an error.
        shared_cov=(shared + one.of_x)[:, :e, :e] + of_doubt,
        chi2=at.chi2,
        rrse=at.rrse,
        settled=settled,
        points=every,
        strain=0.0 * every,
        hum=every == 0,
        falls=every == 0,
        doubtful=doubtful,
        far=every == 0,
        # A load that takes no part has its own verdict.
        other=misfit & loads.used,
        inconsistent=wrong | ((inconsistent | late) & loads.used),
        biased=every == 0,
        support=dataclasses.replace(support, z=scores.relevant(tests)),
        effects=Effects.unknown(e, loads.count),
        approximate=every == 0,
        tested=tests,
    )


def _behind(
    of: Calibrations,
    common: Float[np.ndarray, " common"],
    loads: Loads,
    starts: Float[np.ndarray, "load own"],
) -> tuple[Float[np.ndarray, "load own"], Bool[np.ndarray, " load"]]:
    """The own parameters of loads behind a given Z_th, and whether they are at their minima."""
    none = np.zeros((common.size, 0))
    source = of.around(common, none, loads.frequency)
    known = None if loads.same is None else of.calibrated(common, none)
    each = [
        minimum_alone(few.behind(source, known), starts[None, rows]) for rows, few in loads.parts()
    ]
    owns, settled = [one.q for one in each], [one.settled for one in each]
    return np.concatenate(owns), np.concatenate(settled)


def _effects(
    of: Calibrations, told: Instrument | None, found: Eliminated, common: Common, elements: int
) -> Effects:
    """Changes of the logarithms of the elements by errors of the instrument."""
    if told is None:
        return Effects.unknown(elements, len(found.slope))
    # The search has the errors that nobody stated with a size that no recording changes.
    sizes = told.complete().deviations(of.calibration.r_load.size) / of.tolerances
    moved = of.errors(found.slope[:, :elements] @ common.bread).swapaxes(1, 2) * sizes[:, None]
    later = np.full((len(moved), len(LATER), elements), np.nan)  # nothing changes between them
    return Effects.of_errors(moved, later, told.budgeted())
