"""The fit of one load that was recorded at several amplitudes."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Complex, Float

from etid.estimators.amplitudes.late import follows_late
from etid.estimators.amplitudes.starts import likeliest, starts
from etid.estimators.amplitudes.terms import Amplitudes
from etid.estimators.estimate import MAX_STEPS, SOLVER, Estimate
from etid.estimators.maximum_likelihood.terms import excess
from etid.estimators.sandwich import Curvature
from etid.results.fit import complex_rrse
from etid.signals.harmonics import Spectrum, real_parts, signal_share
from etid.signals.transfer import as_complex, power
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
        return optx.least_squares(
            lambda q, of: of(q), solver, start, args=of, max_steps=MAX_STEPS, throw=False
        )

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
    curvature, slopes = _curvature(of, q, predicted)
    part = of.scaled(predicted)
    lags = follows_late(of, q, slopes, part)
    terms = 2 * jnp.sum(of.spectra.selected, axis=-1, dtype=q.dtype)
    freedom = terms - (of.elements / of.count + 1)
    rrse = jax.vmap(complex_rrse)(predicted, of.spectra.y, of.spectra.selected)
    q = q + jnp.linalg.solve(curvature.expected, jax.grad(_amplified)(q, of))
    log_elements, late, z = of.split(q)
    first, kept = of.elements + of.count, of.elements
    of_driver = jnp.zeros((q.size, q.size)).at[first:, first:].set(of.given.cov)
    prior = jnp.diag((1 / of.widths(q) ** 2).at[first:].set(0.0))
    whole = dataclasses.replace(curvature, score=curvature.score + prior + of_driver)
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


def _amplified(q: Float[Array, " q"], of: Amplitudes) -> Float[Array, ""]:
    """Noise of X in V(X), in the units of Σ r² / 2.

    It is in the residual and in its derivatives. So the gradient of Σ r² / 2 at the true parameters
    is not 0 but the gradient of this sum.
    """

    def one(
        own: Float[Array, " own"], spectrum: Spectrum, weight: Float[Array, " harmonic"]
    ) -> Float[Array, ""]:
        gain = of.gain(spectrum).undelayed(own)
        return 0.5 * jnp.sum(weight**2 * spectrum.variance_x * power(gain))

    return jnp.sum(jax.vmap(one)(of.own(q), of.spectra, of.weight))


def _curvature(
    of: Amplitudes, q: Float[Array, " q"], predicted: Complex[Array, "record harmonic"]
) -> tuple[Curvature, Complex[Array, "record q harmonic"]]:
    """Information of the records and the priors, and covariance of the gradient by the records.

    Beside them the derivatives of the predictions, times the weights.

    The noise of X acts on V(X) through the slope of a resistor that depends on its current: little
    within a pulse, and most between the pulses, where the derivatives of the terms are 0.
    """
    own = of.own(q)

    # The derivatives at denoised data: noise in them would count as information.
    def clean(each: tuple[Array, Spectrum, Array]) -> tuple[Spectrum, Array]:
        own, spectrum, predicted = each
        gain = of.gain(spectrum)(own)
        total = spectrum.variance_y + power(gain) * spectrum.variance_x
        step = jnp.conj(gain) * as_complex(spectrum.variance_x / total)
        x = spectrum.x + step * (spectrum.y - predicted)
        rest = spectrum.variance_x * spectrum.variance_y / total
        return eqx.tree_at(lambda s: s.x, spectrum, x), signal_share(x, rest)

    quiet, share = jax.lax.map(clean, (own, of.spectra, predicted))
    _, slopes = dataclasses.replace(of, spectra=quiet).slopes(q)
    slopes = slopes * as_complex(of.weight)[:, None]
    noise = jax.vmap(excess)(of.scaled(predicted), of.spectra.selected)
    inflation = jnp.sqrt(noise[:, : of.spectra.x.shape[-1]])

    def score(each: tuple[Array, Spectrum, Array, Array]) -> Float[Array, "q q"]:
        own, spectrum, rows, scale = each

        def predicted(x: Complex[Array, " harmonic"]) -> Complex[Array, " harmonic"]:
            return of.predicted(own, eqx.tree_at(lambda s: s.x, spectrum, x))

        back = jax.vjp(predicted, spectrum.x)[1]
        rows = jnp.conj(rows * as_complex(scale)[None])
        of_x = jax.lax.map(lambda row: back(row)[0], rows)
        by_noise = [(rows, spectrum.variance_y), (of_x, spectrum.variance_x)]
        parts = [real_parts(row * as_complex(jnp.sqrt(0.5 * v))[None]) for row, v in by_noise]
        both = jnp.concatenate(parts, axis=-1)
        return both @ both.T

    scores = jax.lax.map(score, (own, quiet, slopes, of.weight * inflation))
    rows = real_parts(slopes)
    expected = jnp.einsum("rqt,rt,rpt->qp", rows, jnp.tile(share, 2), rows)
    prior = jnp.diag(1 / of.widths(q) ** 2)
    return Curvature(expected + prior, scores.sum(0)), slopes
