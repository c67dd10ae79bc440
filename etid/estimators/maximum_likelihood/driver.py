"""Maximum likelihood on the harmonics of the pulse rate: the driver, from its calibrations.

`etid.estimators.maximum_likelihood.calibrations` has the likelihood.
"""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Complex, Float, Int

from etid.estimators.estimate import (
    MAX_STEPS,
    SOLVER,
    Estimate,
    delay_std,
    delay_width,
)
from etid.estimators.maximum_likelihood.calibrations import Calibrations
from etid.estimators.maximum_likelihood.condensed import Condensed, Near, apart
from etid.estimators.maximum_likelihood.profile import Profile, Records, total
from etid.estimators.sandwich import Linear
from etid.estimators.unknowns import DriverUnknowns
from etid.results.driver import Calibration, SourceImpedance
from etid.results.instrument import Instrument
from etid.signals.harmonics import Spectrum, as_list
from etid.signals.transfer import as_complex
from etid.solvers import least_squares, successive
from etid.solvers.levenberg_marquardt import LevenbergMarquardt, NormalEquations
from etid.solvers.matrices import inverse


def _equations_of_terms(_: Any, q: Float[Array, " common"], model: Calibrations) -> NormalEquations:
    """Normal equations with the derivatives of the terms themselves, which contain their noise."""
    slopes, unit = apart(model.slopes, q), jnp.array([[1.0], [1.0j]])
    gains, by_common = slopes.gains, slopes.by_unknown

    def of_gains(_) -> tuple[Array, Array]:
        ways = as_complex(jnp.eye(gains.shape[0]))[:, None, :, None] * unit[None, :, None]

        def along(way: Complex[Array, "record 1"]) -> Float[Array, "record part"]:
            return jax.jvp(model.terms, (gains,), (jnp.broadcast_to(way, gains.shape),))[1]

        return model.terms(gains), jax.vmap(jax.vmap(along))(ways)

    # A term depends on the gains at its own harmonic only.
    (terms, by_gain), rows = apart(of_gains, q), []
    by_gain = by_gain.reshape(*by_gain.shape[:2], -1, by_common.shape[-1])
    for slope, (real, imaginary) in zip(jnp.moveaxis(by_common, 1, 0), by_gain, strict=True):
        rows.append(slope.real[:, None] * real[None] + slope.imag[:, None] * imaginary[None])
    weak, by_weak = model.weak(q)
    terms = jnp.concatenate([terms.ravel(), weak])
    rows = jnp.concatenate([total(rows).reshape(q.size, -1), by_weak], axis=1)
    return NormalEquations.of(terms, rows)


def _equations_at_knots(
    _: Any, q: Float[Array, " common"], of: tuple[Calibrations, Condensed]
) -> NormalEquations:
    """Normal equations of the condensed terms."""
    model, condensed = of
    slopes = apart(lambda q: model.slopes(q, model.knots), q)
    weak, by_weak = model.weak(q)
    terms = jnp.concatenate([condensed.terms(slopes.gains), weak])
    rows = jnp.concatenate([condensed.rows(slopes.by_unknown), by_weak], axis=1)
    return NormalEquations.of(terms, rows)


# A first fit with bands, and a fit with all harmonics from its minimum. From a distant start, the
# derivatives of the terms themselves find deeper minima than those with X̂. Z_th and a delay form a
# curved valley. Near its floor, steps with the usual damping are so short that they seem to make no
# progress. A start that still creeps along the valley after `ROUGH_STEPS` is compared as it is.
ROUGHLY = LevenbergMarquardt(rtol=1e-3, ftol=1e-5, equations=_equations_of_terms)
ROUGH_STEPS = 100
WELL = LevenbergMarquardt(rtol=SOLVER.rtol, ftol=3e-7, damping=1e-6, equations=_equations_at_knots)


def _terms(q: Float[Array, " common"], model: Calibrations) -> Float[Array, " term"]:
    return jnp.concatenate([model.terms(model.gains(q)).ravel(), model.weak(q)[0]])


def minimum(
    model: Calibrations, start: Float[Array, " common"]
) -> tuple[Float[Array, " common"], successive.Minimum]:
    """The minimum of the likelihood of all harmonics."""
    return least_squares.minimum(_terms, _search, start, model)


def _search(
    start: Float[Array, " common"], model: Calibrations
) -> tuple[Float[Array, " common"], successive.Minimum]:
    """The minimum, without a derivative."""

    def approximate(q: Float[Array, " common"]) -> tuple[Near, Float[Array, ""]]:
        near, (weak, _) = model.near(q), model.weak(q)
        return near, near.objective + 0.5 * jnp.dot(weak, weak)

    def follow(
        q: Float[Array, " common"], near: Near, _: Float[Array, ""]
    ) -> tuple[Float[Array, " common"], Float[Array, ""]]:
        part, of = jnp.concatenate([near.condensed.part, model.weak(q)[0]]), (model, near.condensed)
        before = 0.5 * jnp.dot(part, part)
        q, (_, result, found) = least_squares.stepped(None, WELL, q, of, MAX_STEPS)
        return q, successive.promised(before - found.objective, result)

    terms = 2 * jnp.sum(model.spectra.selected, dtype=start.dtype)
    return successive.approached(approximate, follow, start, terms)


class Rough(NamedTuple):
    """The minimum with bands of harmonics (`etid.signals.knots`), near that with all harmonics.

    Attributes:
        source: Z_th.
        delay_samples: Trigger delay of each record [samples].
        cov: Covariance of the parameters of `source`.
        cost: −2 ln likelihood per degree of freedom, but for a constant.
        steps: Trial steps of the solver.
    """

    source: SourceImpedance
    delay_samples: Float[Array, " record"]
    cov: Float[Array, "parameter parameter"]
    cost: Float[Array, ""]
    steps: Int[Array, ""]


def rough_source(
    spectra: Spectrum,
    bands: Spectrum,
    r_load: Float[Array, " record"],
    sample_rate: Float[Array, ""],
    start: SourceImpedance,
) -> Rough:
    """Identify Z_th from bands of the harmonics; the structure of `start` is the order."""
    calibration = Calibration(r_load, jnp.zeros(r_load.shape), delay_std(r_load))
    model = Calibrations(start, calibration, bands, sample_rate)
    solution = least_squares.least_squares(_terms, ROUGHLY, model.start(), model, ROUGH_STEPS)
    q, equations = solution.value, solution.stats["normal_equations"]
    kept = model.named(q).source.size
    # A spurious resonance fits noise, so that it lowers Σ r²; but it raises the variances.
    every = dataclasses.replace(model, spectra=spectra)
    logs = [
        jnp.sum(jnp.where(one.selected, jnp.log(Profile.of_output(one, g).expected[0]), 0.0))
        for one, g in zip(as_list(spectra), every.gains(q), strict=True)
    ]
    terms = jnp.sum(spectra.selected, dtype=q.dtype)
    return Rough(
        source=model.source_of(q),
        delay_samples=model.named(q).delay_samples,
        cov=inverse(equations.matrix)[:kept, :kept],
        cost=(equations.objective + sum(logs, jnp.zeros(()))) / terms,
        steps=solution.stats["num_steps"],
    )


class _Tried(eqx.Module):
    """How many fits with all harmonics were tried, and the first of them that converged.

    If none has converged, the result is that of the best start.
    """

    count: Int[Array, ""]
    start: Int[Array, ""]
    common: Float[Array, " common"]
    squares: Float[Array, ""]
    steps: Int[Array, ""]
    settled: Bool[Array, ""]


def fit_source(
    spectra: Spectrum,
    r_load: Float[Array, " record"],
    sample_rate: Float[Array, ""],
    candidates: Rough,
    instrument: Instrument | None = None,
) -> tuple[Calibrations, Estimate, Near, Linear]:
    """Identify Z_th from one or several records with known resistors, stacked.

    The best start is the first; the others are tried only if it does not converge. Several records
    show errors of the instrument, which are then unknowns, too; behind one record they are 0.

    Returns:
        The calibrations with Z_th and their delays; the estimate, with parameters in the order of
        the flattened source; and the calibrations at their minimum, also as linear terms.
    """
    best = jax.tree.map(lambda leaf: leaf[0], candidates)
    calibration = Calibration(r_load, best.delay_samples, delay_std(r_load))
    width = delay_width(instrument, sample_rate)
    told = instrument if r_load.size > 1 else None
    model = Calibrations(best.source, calibration, spectra, sample_rate, width, told)
    none = jnp.zeros_like(model.tolerances)

    def fit(tried: _Tried) -> _Tried:
        start = jax.tree.map(lambda leaf: leaf[tried.count], candidates)
        q = DriverUnknowns(ravel_pytree(start.source)[0], start.delay_samples).vector()
        q, least = minimum(model, jnp.concatenate([q, none]))
        new = _Tried(
            count=tried.count + 1,
            start=tried.count,
            common=q,
            squares=2 * least.objective,
            steps=start.steps + least.points,
            settled=least.result == optx.RESULTS.successful,
        )
        kept = new.settled | (tried.count == 0)
        old = dataclasses.replace(tried, count=new.count)
        return jax.tree.map(lambda one, other: jnp.where(kept, one, other), new, old)

    zero = jnp.zeros_like(best.steps)
    tried = _Tried(zero, zero, model.start(), jnp.zeros(()), zero, jnp.array(False))
    tried = jax.lax.while_loop(
        lambda tried: ~tried.settled & (tried.count < candidates.cost.size), fit, tried
    )
    q, found = tried.common, model.named(tried.common)
    kept = found.source.size
    near = model.near(q)
    linear = model.linear(near)
    cov = linear.first(model.unknowns).covariance()[:kept, :kept]  # at these errors
    freedom = 2 * jnp.sum(spectra.selected, dtype=q.dtype) - model.unknowns
    each = [
        (Records.of(s), Profile.of_output(s, g))
        for s, g in zip(as_list(spectra), near.profiles[0].gains, strict=True)
    ]
    errors = jnp.stack([profile.rrse(records, records.x) for records, profile in each])
    estimate = Estimate(
        parameters=found.source,
        delay_samples=found.delay_samples,
        cov=cov,
        shared_cov=jnp.zeros_like(cov),
        chi2=tried.squares / freedom,
        rrse=errors.max(),
        result=optx.RESULTS.where(
            tried.settled, optx.RESULTS.successful, optx.RESULTS.nonlinear_max_steps_reached
        ),
        steps=tried.steps,
        start=tried.start,
        hum=jnp.stack([profile.shows_hum(records) for records, profile in each]).any(),
    )
    errors = None if told is None else model.errors(q)
    calibration = dataclasses.replace(calibration, delay_samples=found.delay_samples, errors=errors)
    model = dataclasses.replace(model, source=model.source_of(q), calibration=calibration)
    return model, estimate, near, linear
