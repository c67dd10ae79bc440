"""One driver, many loads: a joint maximum-likelihood fit whose cost is linear in the loads.

Only Z_th and the delays of the calibrations, `common`, tie the loads together; the elements and
the delay of each, `own`, appear in its terms alone. The normal equations are an arrowhead,

    [ A₁          B₁ ]
    [    …        …  ]      without the own parameters:      S = Σ_i C_i − B_iᵀ A_i⁻¹ B_i,
    [       A_T   B_T]
    [ B₁ᵀ …  B_Tᵀ  C ]

of the size of `common`. The objective is profiled: at every `common` each load is fitted anew, from
where its slope K_i = −A_i⁻¹ B_i predicts it, and Levenberg-Marquardt sees `common` only, with S as
its matrix (Golub and Pereyra 1973; Pintelon and Schoukens 2012, ch. 9).
"""

import dataclasses
import math
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float

from etid.information import Curvature, eliminate, inverse
from etid.levenberg_marquardt import LevenbergMarquardt, NormalEquations, normal_equations
from etid.likelihood import denoised, weights
from etid.maximum_likelihood import Joint
from etid.output_error import MAX_STEPS, SOLVER, Estimate
from etid.results import complex_rrse
from etid.spectra import Spectrum

SIDE_BY_SIDE = 8  # loads of one vectorised step
NEAR = 0.05  # standard errors of the common parameters from their minimum


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


def _reduce(
    terms: Callable[[Float[Array, " n"]], Float[Array, " term"]],
    own: Float[Array, " own"],
    common: Float[Array, " common"],
) -> tuple[NormalEquations, Float[Array, "own common"]]:
    """Normal equations in `common` of a load at its minimum, and how its minimum depends on it."""
    p = own.shape[0]
    full = normal_equations(terms, jnp.concatenate([own, common]))
    slope = -inverse(full.matrix[:p, :p]) @ full.matrix[:p, p:]
    equations = NormalEquations(
        full.objective,
        full.gradient[p:] + slope.T @ full.gradient[:p],
        full.matrix[p:, p:] + full.matrix[p:, :p] @ slope,
    )
    return equations, slope


def fit(
    model: Joint, groups: Sequence[Loads]
) -> tuple[Float[Array, " common"], Float[Array, "common common"], list[Estimate]]:
    """Identify all loads and their driver.

    Args:
        model: Calibrations, kind of circuit, and the driver to start from.
        groups: The recordings, one group for each length.

    Returns:
        Common parameters, their covariance, and the estimates of each group, stacked. In them
        `shared_cov` is what the uncertainty of `common` adds: every load has it in common.
    """
    start, records = model.start(), model.records

    def refit(load, common, own):
        solution = optx.least_squares(
            lambda own, _: model.of_load(own, common, load.spectrum, load.sample_rate, records),
            SOLVER,
            own,
            max_steps=MAX_STEPS,
            throw=False,
        )
        return solution.value, solution.result

    def reduced(load, common, own):
        p = own.shape[0]
        return _reduce(
            lambda q: model.of_load(q[:p], q[p:], load.spectrum, load.sample_rate, records),
            own,
            common,
        )

    def over(one, loads, *more):
        return jax.lax.map(lambda lane: one(*lane), (loads, *more), batch_size=SIDE_BY_SIDE)

    slopes = [over(lambda load: reduced(load, start, load.own)[1], loads) for loads in groups]

    def profile(common, _):
        def one(load, slope):
            own, _ = refit(load, common, load.own + slope @ (common - start))
            found, _ = reduced(load, common, own)
            return jax.tree.map(lambda leaf: jnp.where(load.used, leaf, 0.0), found)

        total = normal_equations(lambda c: model.of_calibrations(c, records), common)
        for loads, slope in zip(groups, slopes, strict=True):
            parts = over(one, loads, slope)
            total = jax.tree.map(lambda a, b: a + b.sum(0), total, parts)
        return total

    # The sum of squares grows with the number of loads, what can be seen in it does not.
    terms = sum(2 * loads.spectrum.x.size for loads in groups)
    count = sum(loads.sample_rate.shape[0] for loads in groups)
    solver = LevenbergMarquardt(
        rtol=NEAR / math.sqrt(terms),
        ftol=SOLVER.ftol / (1 + count),
        equations=lambda profile, common: profile(common),
    )
    solution = optx.least_squares(profile, solver, start, max_steps=MAX_STEPS, throw=False)
    common = solution.value
    known_gains, strain = model.known_gains(common), model.strain(common)

    def at_minimum(load, slope):
        own, result = refit(load, common, load.own + slope @ (common - start))
        p = own.shape[0]
        g = model.gain(own, common, load.spectrum, load.sample_rate)
        (*known, spectrum), shares = denoised([*records, load.spectrum], [*known_gains, g])
        curvature = _curvature(
            lambda q: model.of_load(q[-p:], q[:-p], spectrum, load.sample_rate, known),
            jnp.concatenate([common, own]),
            shares[-1:],
        )
        terms = model.of_load(own, common, load.spectrum, load.sample_rate, records)[:-1]
        freedom = 2 * jnp.sum(load.spectrum.selected, dtype=own.dtype) - p
        nothing = jnp.zeros((p - 1, p - 1))
        estimate = Estimate(
            own[:-1],
            own[None, -1:],
            nothing,
            jnp.sum(terms**2) / freedom,
            complex_rrse(g * load.spectrum.x, load.spectrum.y),
            optx.RESULTS.where(result == optx.RESULTS.successful, solution.result, result),
            solution.stats["num_steps"],
            nothing,
            strain,
        )
        return estimate, _without_own(curvature, common.shape[0])

    clean, shares = denoised(records, known_gains)
    total = _curvature(lambda c: model.of_calibrations(c, clean), common, shares)
    found = [over(at_minimum, loads, slope) for loads, slope in zip(groups, slopes, strict=True)]
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
