"""The fit of one load that was recorded at several amplitudes, and its starts.

To a pulse of the current I, a resistor R / (1 + |i| / I_0) looks like the resistance R_I with

    1 / R_I = 1 / R + I / (R I_0).

The records show R_I for each amplitude. A straight line gives R and I_0, even if R_I is far below R
in all of them. A linear fit of such a record would not do: it ends anywhere.
"""

import dataclasses

import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float

from etid.circuits.current_dependent import current_dependent
from etid.estimators.amplitudes.last_step import last_step
from etid.estimators.amplitudes.late import follows_late
from etid.estimators.amplitudes.terms import STILL, Amplitudes
from etid.estimators.estimate import MAX_STEPS, SOLVER, Estimate
from etid.likelihood.profile import Records
from etid.likelihood.search import Load
from etid.likelihood.starts import starts
from etid.results.fit import complex_rrse
from etid.signals.harmonics import Spectrum, real_parts
from etid.signals.transfer import as_complex, power
from etid.solvers.harmonic_balance import to_time
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

    alone = _likeliest(of)
    of = of.weighted(alone)
    rough = best_start(of, _starts(of, alone))
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


def _likeliest(of: Amplitudes) -> Float[Array, "record own"]:
    """The likeliest linear load for each record alone, without a delay, in the order of `Gains`."""

    def one(spectrum: Spectrum) -> Float[Array, " own"]:
        of_y = spectrum.y[None], spectrum.variance_y[None], spectrum.selected[None]
        records = Records(spectrum.frequency, spectrum.x, spectrum.variance_x, *of_y)
        delay, z = jnp.zeros(1), of.given.mean
        centre = jnp.concatenate([jnp.zeros(of.elements), delay, z])
        width = jnp.where(jnp.arange(centre.size) < of.elements, jnp.inf, 1.0)
        load = Load(of.gain(spectrum), records, centre, width)
        each = jnp.where(jnp.isinf(width), starts(load), centre)
        found = load.objective(each)
        return each[jnp.argmin(jnp.where(jnp.isfinite(found), found, jnp.inf))]

    return jax.lax.map(one, of.spectra)


def _starts(of: Amplitudes, alone: Float[Array, "record own"]) -> Float[Array, "start q"]:
    """Starts of a fit of all records, from the likeliest linear load of each of them alone."""
    logs = alone[:, : of.elements]
    if current_dependent(of.circuit.impedance()) is not None:
        size = jnp.sum(power(of.spectra.x), axis=-1)
        ends = logs[jnp.stack([jnp.argmin(size), jnp.argmax(size)])]
        # Of the other elements: those of the likeliest linear load are far too large.
        levels, times = jnp.array([1.0, 0.1]), jnp.array([1.0, 0.1, 0.01, 0.001])
        scales = jnp.log(jnp.stack([jnp.repeat(levels, 4), jnp.tile(times, 2)], axis=1))
        others = ends[None] + (scales @ of.circuit.scaling())[:, None]
        resistance, i_0 = _line(*_seen(of, alone))
        each = others.reshape(-1, of.elements)
        logs = jax.vmap(lambda one: _moved(of, one, resistance, i_0))(each)
    return jax.vmap(of.start)(logs if of.prior is None else of.prior.placed(logs))


def _seen(
    of: Amplitudes, alone: Float[Array, "record own"]
) -> tuple[Float[Array, " record"], Float[Array, " record"]]:
    """Current [A] and resistance [Ω] of each record: Σ |i|³ / Σ i² and Σ v i / Σ i²."""

    def one(each: tuple[Array, Spectrum]) -> tuple[Float[Array, ""], Float[Array, ""]]:
        own, spectrum = each
        still = STILL * spectrum.frequency[:1]
        source = of.source(own, spectrum, jnp.concatenate([still, spectrum.frequency]))
        y = jnp.pad(spectrum.y, (1, 0))  # of all harmonics, like the source
        points = 2 * spectrum.frequency.size
        i = to_time(source.current - source.admittance * y, points)
        squares = jnp.sum(i**2)
        found = jnp.sum(jnp.abs(i) ** 3), jnp.sum(i * to_time(y, points))
        return found[0] / squares, found[1] / squares

    return jax.lax.map(one, (alone, of.spectra))


def _line(
    current: Float[Array, " record"], resistance: Float[Array, " record"]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """R and I_0 that give the resistances at these currents best, in relative terms."""
    levels = jnp.geomspace(jnp.min(current) / 100, jnp.max(current) * 100, 200)  # of I_0
    small = jnp.maximum(jnp.max(resistance) * jnp.finfo(resistance.dtype).eps, resistance)
    logs = jnp.log(small)[None] + jnp.log1p(current[None] / levels[:, None])  # of R
    best = jnp.argmin(jnp.var(logs, axis=1))
    return jnp.exp(jnp.mean(logs[best])), levels[best]


def _element(of: Amplitudes, logs: Float[Array, " element"]) -> Float[Array, "2"]:
    """Logarithms of R and I_0 of the resistor that depends on its current."""
    element = current_dependent(of.circuit.with_log_values(logs).impedance())
    assert element is not None
    return jnp.log(jnp.stack([jnp.asarray(element.r), jnp.asarray(element.i_0)]))


def _moved(
    of: Amplitudes,
    logs: Float[Array, " element"],
    resistance: Float[Array, ""],
    i_0: Float[Array, ""],
) -> Float[Array, " element"]:
    """The elements with the smallest change that gives the resistor this R and I_0."""
    wanted = jnp.log(jnp.stack([resistance, i_0])) - _element(of, logs)
    by_logs = jax.jacfwd(lambda logs: _element(of, logs))(logs)
    return logs + jnp.linalg.pinv(by_logs) @ wanted
