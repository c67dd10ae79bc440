"""One driver, many loads: a joint maximum-likelihood fit whose cost is linear in the loads.

Only Z_th and the delays of the calibrations, `common`, tie the loads together; the elements and
the delay of each, `own`, appear in its terms alone, and the normal equations are an arrowhead
(`etid.arrowhead`; Pintelon and Schoukens, System Identification, 2012, ch. 9).
"""

import dataclasses
import itertools
import math
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float

from etid.arrowhead import Arrowhead, ArrowheadEquations, EliminationDescent, join, split
from etid.information import Curvature, eliminate, inverse
from etid.levenberg_marquardt import LevenbergMarquardt, normal_equations, second_order
from etid.likelihood import denoised, weights
from etid.maximum_likelihood import Joint
from etid.output_error import MAX_STEPS, SOLVER, Estimate
from etid.results import complex_rrse
from etid.spectra import Spectrum

SIDE_BY_SIDE = 8  # loads of one vectorised step
NEAR = 0.05  # standard errors of all parameters together from their minimum


class Loads(eqx.Module):
    """Recordings of one length with one driver, stacked along a leading axis.

    Attributes:
        spectrum: Their harmonics.
        sample_rate: Their sampling rates [Hz].
        own: Elements (logarithms) and delay of each, identified alone.
        used: Whether the recording takes part; the others are fitted, but tell nothing of Z_th.
    """

    spectrum: Spectrum
    sample_rate: Float[Array, "*load"]
    own: Float[Array, "*load own"]
    used: Bool[Array, "*load"]


class _Eliminated(eqx.Module):
    """What one load tells of `common`; its own covariance at a given `common`; and its slope."""

    rest: Curvature
    cov: Float[Array, "own own"]
    slope: Float[Array, "own common"]


def _curvature(
    terms: Callable[[Float[Array, " n"]], Float[Array, " term"]],
    q: Float[Array, " n"],
    shares: Sequence[Float[Array, " part"]],
) -> Curvature:
    """H and Jᵀ J of `likelihood.denoised`, at denoised records."""
    jacobian = jax.jacfwd(terms)(q)
    weight = weights(shares, jacobian.shape[0])
    return Curvature((jacobian.T * weight[None, :]) @ jacobian, jacobian.T @ jacobian)


def _without_own(of: Curvature, common: int) -> _Eliminated:
    """Eliminate a load's own parameters, which come after the `common` ones."""
    bread = inverse(of.expected[common:, common:])
    slope = -bread @ of.expected[common:, :common]
    return _Eliminated(eliminate(of, common), bread @ of.score[common:, common:] @ bread, slope)


class _Study(eqx.Module):
    """All that the fit of a driver and its loads depends on."""

    model: Joint
    groups: list[Loads]

    def __call__(self, y: Float[Array, " parameter"]) -> list[Float[Array, "..."]]:
        """Terms of the calibrations, and of each group."""
        common, parts = self.split(y)

        def one(load, own):
            return jnp.where(load.used, self.of_load(load, common, own), 0.0)

        loaded = [jax.vmap(one)(loads, own) for loads, own in zip(self.groups, parts, strict=True)]
        return [self.of_calibrations(common), *loaded]

    def of_load(self, load, common, own):
        records = self.model.records
        return self.model.of_load(own, common, load.spectrum, load.sample_rate, records)

    def of_calibrations(self, common):
        return self.model.of_calibrations(common, self.model.records)

    def start(self) -> Float[Array, " parameter"]:
        own = jnp.concatenate([loads.own for loads in self.groups])
        return join(self.model.start(), own)

    def split(self, y: Float[Array, " parameter"]):
        """Common parameters, and the own ones of each group."""
        counts = [loads.own.shape[0] for loads in self.groups]
        common, own = split(y, sum(counts), self.groups[0].own.shape[1])
        ends = list(itertools.accumulate(counts))
        return common, jnp.split(own, ends[:-1])


def _over(one, *lanes):
    """`one` over the leading axis of `lanes`, a few at a time."""
    count = jax.tree.leaves(lanes)[0].shape[0]
    return jax.lax.map(lambda lane: one(*lane), lanes, batch_size=min(SIDE_BY_SIDE, count))


def _equations(_, y: Float[Array, " parameter"], study: _Study) -> ArrowheadEquations:
    """Normal equations of a study, load by load."""
    common, parts = study.split(y)
    c = common.size

    def one(load, own):
        found = normal_equations(
            lambda q, _: study.of_load(load, q[:c], q[c:]), jnp.concatenate([common, own])
        )
        return jax.tree.map(lambda leaf: jnp.where(load.used, leaf, 0.0), found)

    found = [_over(one, loads, own) for loads, own in zip(study.groups, parts, strict=True)]
    loads = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *found)
    known = normal_equations(lambda q, _: study.of_calibrations(q), common)
    return ArrowheadEquations(
        known.objective + loads.objective.sum(),
        join(known.gradient + loads.gradient[:, :c].sum(0), loads.gradient[:, c:]),
        Arrowhead(
            known.matrix + loads.matrix[:, :c, :c].sum(0),
            loads.matrix[:, c:, :c],
            loads.matrix[:, c:, c:],
        ),
    )


def _second_order(_, y, step, study: _Study) -> Float[Array, " parameter"]:
    """Jᵀ r″ of a study, load by load."""
    (common, parts), (towards, steps) = study.split(y), study.split(step)
    c = common.size

    def one(load, own, step):
        bent = second_order(
            lambda q, _: study.of_load(load, q[:c], q[c:]),
            jnp.concatenate([common, own]),
            jnp.concatenate([towards, step]),
        )
        return jnp.where(load.used, bent, 0.0)

    found = [_over(one, *lanes) for lanes in zip(study.groups, parts, steps, strict=True)]
    loads = jnp.concatenate(found)
    known = second_order(lambda q, _: study.of_calibrations(q), common, towards)
    return join(known + loads[:, :c].sum(0), loads[:, c:])


def fit(
    model: Joint, groups: list[Loads]
) -> tuple[Float[Array, " common"], Float[Array, "common common"], list[Estimate]]:
    """Identify all loads and their driver.

    Args:
        model: Calibrations, kind of circuit, and the driver to start from.
        groups: The recordings, one group for each length.

    Returns:
        Common parameters, their covariance, and the estimates of each group, stacked. In them
        `shared_cov` is what the uncertainty of `common` adds: every load has it in common.
    """
    study, records = _Study(model, groups), model.records
    # The sum of squares grows with the number of loads, what can be seen in it does not.
    terms = sum(2 * loads.spectrum.x.size for loads in groups)
    count = sum(loads.sample_rate.shape[0] for loads in groups)
    solver = LevenbergMarquardt(
        rtol=NEAR / math.sqrt(terms),
        ftol=SOLVER.ftol / (1 + count),
        geodesic=True,
        descent=EliminationDescent(),
        equations=_equations,
        second_order=_second_order,
    )
    solution = optx.least_squares(
        lambda y, study: study(y), solver, study.start(), study, max_steps=MAX_STEPS, throw=False
    )
    common, parts = study.split(solution.value)
    known_gains, strain = model.known_gains(common), model.strain(common)

    def at_minimum(load, own):
        # The loads that take no part have been waiting for Z_th.
        alone = optx.least_squares(
            lambda own, _: study.of_load(load, common, own),
            SOLVER,
            own,
            max_steps=MAX_STEPS,
            throw=False,
        )
        own, result = alone.value, alone.result
        p = own.shape[0]
        g = model.gain(own, common, load.spectrum, load.sample_rate)
        (*known, spectrum), shares = denoised([*records, load.spectrum], [*known_gains, g])
        curvature = _curvature(
            lambda q: model.of_load(q[-p:], q[:-p], spectrum, load.sample_rate, known),
            jnp.concatenate([common, own]),
            shares[-1:],
        )
        freedom = 2 * jnp.sum(load.spectrum.selected, dtype=own.dtype) - p
        nothing = jnp.zeros((p - 1, p - 1))
        estimate = Estimate(
            own[:-1],
            own[None, -1:],
            nothing,
            jnp.sum(study.of_load(load, common, own)[:-1] ** 2) / freedom,
            complex_rrse(g * load.spectrum.x, load.spectrum.y),
            optx.RESULTS.where(result == optx.RESULTS.successful, solution.result, result),
            solution.stats["num_steps"],
            nothing,
            strain,
        )
        return estimate, _without_own(curvature, common.shape[0])

    clean, shares = denoised(records, known_gains)
    total = _curvature(lambda c: model.of_calibrations(c, clean), common, shares)
    found = [_over(at_minimum, loads, own) for loads, own in zip(groups, parts, strict=True)]
    for loads, (_, parts) in zip(groups, found, strict=True):
        used = jax.tree.map(
            lambda leaf, loads=loads: jnp.where(loads.used[:, None, None], leaf, 0.0).sum(0),
            parts.rest,
        )
        total = jax.tree.map(jnp.add, total, used)
    bread = inverse(total.expected)
    cov = bread @ total.score @ bread

    def with_errors(estimate, eliminated):
        shared = eliminated.slope @ cov @ eliminated.slope.T
        total = eliminated.cov * jnp.maximum(estimate.chi2, 1.0) + shared
        return dataclasses.replace(estimate, cov=total[:-1, :-1], shared_cov=shared[:-1, :-1])

    return common, cov, [jax.vmap(with_errors)(*parts) for parts in found]
