"""The fit of one load that was recorded at several amplitudes."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from etid.estimators.amplitudes.terms import Amplitudes, currents
from etid.estimators.estimate import MAX_STEPS, SOLVER, Estimate
from etid.estimators.maximum_likelihood.terms import denoised, excess, residual
from etid.estimators.sandwich import Curvature, Linear
from etid.estimators.unknowns import LoadUnknowns
from etid.results.fits import complex_rrse
from etid.signals.harmonics import Spectrum
from etid.solvers.levenberg_marquardt import LevenbergMarquardt, NormalEquations, best_start

CURRENTS = (1.0, 10.0)  # levels of I_0 of the starts; a level far too low takes long


def _equations(_, q: Float[Array, " q"], of: Amplitudes) -> NormalEquations:
    part, slopes = of.slopes(q)
    rest, prior = of.priors(q), 1 / of.widths(q)
    return NormalEquations(
        0.5 * (jnp.sum(part**2) + jnp.sum(rest**2)),
        jnp.einsum("rqt,rt->q", slopes, part) + prior * rest,
        jnp.einsum("rqt,rpt->qp", slopes, slopes) + jnp.diag(prior**2),
    ).finite()


ROUGHLY = LevenbergMarquardt(rtol=1e-2, ftol=1e-3, equations=_equations)
WELL = LevenbergMarquardt(rtol=SOLVER.rtol, ftol=SOLVER.ftol, equations=_equations)


def starts(of: Amplitudes) -> Float[Array, "start q"]:
    """The likeliest linear load at the smallest amplitude, with several levels of I_0."""
    smallest = jnp.argmin(jnp.sum(jnp.abs(of.spectra.x) ** 2, axis=-1))
    spectrum = jax.tree.map(lambda leaf: leaf[smallest], of.spectra)
    starts = of.given.starts(spectrum, of.sample_rate, of.circuit).log_elements

    def linear(log_elements: Float[Array, " element"]) -> Float[Array, " part"]:
        own = LoadUnknowns(log_elements, jnp.zeros(())).vector()
        return residual(spectrum, of.gain(spectrum)(own))

    likely = best_start(linear, starts)
    of_current = currents(of.circuit)
    levels = CURRENTS if of_current.any() else CURRENTS[:1]
    by_current = jnp.asarray(np.outer(np.log(levels), of_current))
    levels = likely[None, :] + by_current
    return jax.vmap(of.start)(levels if of.prior is None else of.prior.placed(levels))


def fit_amplitudes(of: Amplitudes) -> Estimate:
    """Identify one load from all its records.

    Returns:
        The estimate, whose parameters are the logarithms of the elements. χ² and RRSE are those of
        the worst record.
    """

    def refined(start: Float[Array, " q"], solver: LevenbergMarquardt) -> optx.Solution:
        return optx.least_squares(
            lambda q, of: of(q), solver, start, args=of, max_steps=MAX_STEPS, throw=False
        )

    # First with Z_th fixed: from a distant start, a joint fit would distort Z_th.
    alone = refined(best_start(of, starts(of)), ROUGHLY).value
    solution = refined(jnp.concatenate([alone, of.given.mean]), WELL)
    q = solution.value
    log_elements, late, z = of.split(q)

    # The derivatives at denoised data: noise in them would count as information.
    def clean(each: tuple[Array, Spectrum]) -> tuple[Spectrum, Array]:
        own, spectrum = each
        [quiet], [share] = denoised([spectrum], [of.gain(spectrum).undelayed(own)])
        quiet = eqx.tree_at(lambda s: s.x, spectrum, quiet.x)
        return eqx.tree_at(lambda s: s.y, quiet, of.predicted(own, quiet)), share

    quiet, share = jax.lax.map(clean, (of.own(q), of.spectra))
    _, slopes = dataclasses.replace(of, spectra=quiet).slopes(q)
    predicted = jax.lax.map(lambda each: of.predicted(*each), (of.own(q), of.spectra))
    part = of.scaled(q, predicted)
    noise = jax.vmap(excess)(part, of.spectra.selected)
    parts = jax.vmap(lambda *linear: Linear(*linear).curvature())(slopes, share, noise)
    prior = 1 / of.widths(q) ** 2
    first = of.elements + of.count
    of_driver = jnp.zeros((q.size, q.size)).at[first:, first:].set(of.given.cov)
    score = parts.score.sum(0) + jnp.diag(prior.at[first:].set(0.0)) + of_driver
    whole = Curvature(parts.expected.sum(0) + jnp.diag(prior), score)
    kept = of.elements
    bread = dataclasses.replace(whole, score=of_driver)
    change = z - of.given.mean
    terms = 2 * jnp.sum(of.spectra.selected, axis=-1, dtype=q.dtype)
    freedom = terms - (of.elements / of.count + 1)
    rrse = jax.vmap(complex_rrse)(predicted, of.spectra.y, of.spectra.selected)
    return Estimate(
        parameters=log_elements,
        delay_samples=late,
        cov=whole.covariance()[:kept, :kept],
        shared_cov=bread.covariance()[:kept, :kept],
        chi2=jnp.max(jnp.sum(part**2, axis=-1) / freedom),
        rrse=jnp.max(rrse),
        result=solution.result,
        steps=solution.stats["num_steps"],
        strain=change @ jnp.linalg.solve(of.given.cov, change),
    )
