"""The fit of one load that was recorded at several amplitudes."""

import dataclasses

import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float

from etid.estimators.amplitudes.last_step import last_step
from etid.estimators.amplitudes.late import follows_late
from etid.estimators.amplitudes.starts import likeliest, starts
from etid.estimators.amplitudes.terms import Amplitudes
from etid.estimators.estimate import MAX_STEPS, SOLVER, Estimate
from etid.results.fit import complex_rrse
from etid.signals.harmonics import real_parts
from etid.signals.transfer import as_complex
from etid.solvers.least_squares import least_squares
from etid.solvers.levenberg_marquardt import LevenbergMarquardt, NormalEquations, best_start


def _equations(_, q: Float[Array, " q"], of: Amplitudes) -> NormalEquations:
    predicted, slopes = of.slopes(q)
    part = of.scaled(predicted)
    rows = real_parts(slopes * as_complex(of.weight)[:, None])
    rest, prior = of.priors(q), 1 / of.widths(q)
    return NormalEquations(
        0.5 * (jnp.sum(part**2) + jnp.sum(rest**2)),
        -jnp.einsum("rqt,rt->q", rows, part) + prior * rest,
        jnp.einsum("rqt,rpt->qp", rows, rows) + jnp.diag(prior**2),
    ).finite()


ROUGHLY = LevenbergMarquardt(rtol=1e-2, ftol=1e-3, equations=_equations)
# 0.01 standard errors: the slopes of the balance have four digits, and a closer fit would stall.
WELL = LevenbergMarquardt(rtol=1e-4, ftol=SOLVER.ftol, equations=_equations)


def fit_amplitudes(of: Amplitudes) -> Estimate:
    """Identify one load from all its records.

    Returns:
        The estimate, whose parameters are the logarithms of the elements. χ² and RRSE are those of
        the worst record.
    """

    def refined(
        of: Amplitudes, start: Float[Array, " q"], solver: LevenbergMarquardt
    ) -> optx.Solution:
        return least_squares(lambda q, of: of(q), solver, start, of, MAX_STEPS)

    alone = likeliest(of)
    of = of.weighted(alone)
    rough = best_start(of, starts(of, alone))
    # First with Z_th fixed: from a distant start, a joint fit would distort Z_th.
    for _ in range(2):
        rough = refined(of, rough, ROUGHLY).value
        of = of.weighted(of.own(rough))
    solution = refined(of, jnp.concatenate([rough, of.given.mean]), WELL)
    q = solution.value
    predicted = jax.lax.map(lambda each: of.predicted(*each), (of.own(q), of.spectra))
    step = last_step(of, q)
    part = of.scaled(predicted)
    lags = follows_late(of, q, step.slopes, part)
    terms = 2 * jnp.sum(of.spectra.selected, axis=-1, dtype=q.dtype)
    freedom = terms - (of.elements / of.count + 1)
    rrse = jax.vmap(complex_rrse)(predicted, of.spectra.y, of.spectra.selected)
    log_elements, late, z = of.split(q + step.change)
    first, kept = of.elements + of.count, of.elements
    of_driver = jnp.zeros((q.size, q.size)).at[first:, first:].set(of.given.cov)
    prior = jnp.diag((1 / of.widths(q) ** 2).at[first:].set(0.0))
    whole = dataclasses.replace(step.curvature, score=step.curvature.score + prior + of_driver)
    shared = dataclasses.replace(whole, score=of_driver)
    change = z - of.given.mean
    return Estimate(
        parameters=log_elements,
        delay_samples=late,
        cov=whole.covariance()[:kept, :kept],
        shared_cov=shared.covariance()[:kept, :kept],
        chi2=jnp.max(jnp.sum(part**2, axis=-1) / freedom),
        rrse=jnp.max(rrse),
        result=solution.result,
        steps=solution.stats["num_steps"],
        strain=change @ jnp.linalg.solve(of.given.cov, change),
        late=lags,
    )
