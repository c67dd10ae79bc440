"""Output error: Levenberg-Marquardt on the simulated terminal voltage.

The parameters are the logarithms of the circuit elements, or the modal parameters of Z_th.
`etid.estimators.output_error.prediction` computes the residual, and
`etid.estimators.output_error.information` the covariance. The covariance of a skin contains the
part from its driver, K cov(Z_th) Kᵀ with K = −H⁻¹ ∂²/∂θ∂Z_th. If χ² > 1, the covariance of the
noise is multiplied by χ².

**The delay of the calibration.** To first order in τ, a calibration that was triggered τ late is
equal to one without a delay whose Z_th is replaced by Z_th + sτ (R_L + Z_th). In a recorded band, a
fast pole of Z_th and a delay have the same effect, so one known resistor cannot separate them. A
delay of 10 ns changes C_p by 3 %. The record of a skin does show τ, through the excess impedance of
`late_calibration`. τ is therefore fitted with every skin.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from etid.circuits.circuit import AbstractCircuit
from etid.circuits.directions import DIRECTIONS
from etid.circuits.elements import resistor
from etid.estimators.element_prior import ElementPrior
from etid.estimators.estimate import MAX_STEPS, SOLVER, Estimate
from etid.estimators.output_error.information import curvature, further, slopes
from etid.estimators.output_error.other_in_time import EXACT, Shown, bends, relaxed, score
from etid.estimators.output_error.prediction import (
    IMPULSE,
    Change,
    Records,
    late_calibration,
    loaded_filter,
    measured,
    predict,
    residual_and_response,
    scaled_residual,
    state_scale,
)
from etid.estimators.unknowns import Nuisance
from etid.likelihood.sandwich import Curvature
from etid.likelihood.source_prior import DELAY_WIDTH, SourcePrior, delay_std
from etid.results.driver import Calibration, ContinuousDriver, SourceImpedance
from etid.results.feed import CurrentSource, MeasuredCurrent, loaded
from etid.results.fit import Support, rrse
from etid.signals.filtering import CUTOFF, StateSpace
from etid.signals.transfer import Rational
from etid.solvers.least_squares import least_squares
from etid.solvers.levenberg_marquardt import best_start
from etid.solvers.matrices import inverse

PASSES = 3  # passes of the fit of a skin, and of that of a voltage


def fit_source(
    records: Records,
    r_load: Float[Array, " record"],
    start: SourceImpedance,
    ftol: Float[Array, ""],
) -> tuple[SourceImpedance, Estimate, Calibration]:
    """Identify Z_th from one or several records with known resistors, stacked.

    The structure of `start` is the order, and `ftol` is that of the solver.

    Returns:
        Z_th; the estimate, with parameters in the order of the flattened `start`; and the data of
        the calibrations.
    """
    start_vector, unflatten = ravel_pytree(start)
    kept, count = start_vector.size, r_load.size

    def one(
        record: Records,
        r: Float[Array, ""],
        nuisance: Nuisance,
        parameters: Float[Array, " parameter"],
    ) -> Float[Array, " interval"]:
        return scaled_residual(record, unflatten(parameters), resistor(r).rational(), nuisance)

    regularise = SourcePrior.of(start, records.sample_rate[0], r_load.mean())

    q0, named = ravel_pytree((start_vector, jnp.zeros((count, start.order + 2))))

    def residual(q: Float[Array, " q"], of: Any) -> Float[Array, " term"]:
        (records, r_load, regularise), (parameters, vectors) = of, named(q)
        nuisance = Nuisance.of(vectors)
        parts = _each(
            lambda record, r, late: one(record, r, late, parameters), records, r_load, nuisance
        )
        late = nuisance.delay_samples / DELAY_WIDTH
        return jnp.concatenate([parts.reshape(-1), regularise(parameters), late])

    solver = dataclasses.replace(SOLVER, ftol=ftol)
    solution = least_squares(residual, solver, q0, (records, r_load, regularise), MAX_STEPS)
    parameters, vectors = named(solution.value)
    nuisance, source = Nuisance.of(vectors), unflatten(parameters)
    weak = jax.jacfwd(regularise)(parameters)
    chi2 = (
        2
        * solution.stats["normal_equations"].objective
        / (math.prod(records.hold.shape[:-1]) - q0.size)
    )

    # Curvature over source, logarithm of the resistor and nuisances, in this order.
    def at_minimum(
        record: Records, r: Float[Array, ""], nuisance: Nuisance
    ) -> tuple[Curvature, Float[Array, ""]]:
        at, named = ravel_pytree((parameters, jnp.zeros(()), nuisance))
        nothing = jax.tree.map(jnp.zeros_like, nuisance)
        towards, _ = ravel_pytree((jnp.zeros_like(parameters), jnp.ones(()), nothing))
        open_delay = dataclasses.replace(nothing, delay_samples=jnp.asarray(1 / DELAY_WIDTH**2))
        precision, _ = ravel_pytree((jnp.zeros_like(parameters), jnp.zeros(()), open_delay))

        def both(p: Float[Array, " p"]) -> tuple[Float[Array, " interval"], Float[Array, " lag"]]:
            parameters, log_r, nuisance = named(p)
            load = resistor(r * jnp.exp(log_r)).rational()
            return residual_and_response(record, unflatten(parameters), load, nuisance)

        found = slopes(both, at)
        return curvature(record, found, precision), found.residual @ (found.jacobian @ towards)

    def error(record: Records, r: Float[Array, ""], nuisance: Nuisance) -> Float[Array, ""]:
        system = loaded_filter(source, resistor(r).rational(), record.sample_rate)
        return rrse(predict(system, record, nuisance), measured(record, nuisance.delay_samples))

    parts, by_resistor = _each(at_minimum, records, r_load, nuisance)
    parts = jax.vmap(lambda part: part.eliminate(kept + 1))(parts)
    whole = Curvature(
        _arrow(parts.expected, weak.T @ weak), _arrow(parts.score, jnp.zeros((kept, kept)))
    )
    of_source = jax.tree.map(lambda leaf: leaf[:kept, :kept], whole)
    cov = of_source.covariance() * jnp.maximum(chi2, 1.0)
    mismatch = None
    if count > 1:
        gradient = jnp.concatenate([jnp.zeros(kept), by_resistor])  # Z_th is at its minimum
        step, error_of_step = further(whole, gradient, kept)
        # The part of χ² that the worst resistor explains is no noise.
        left = chi2 - jnp.max((step / error_of_step) ** 2) / math.prod(records.hold.shape[:-1])
        mismatch = jnp.stack([-step, error_of_step * jnp.sqrt(jnp.maximum(left, 1.0))])
    estimate = Estimate(
        parameters=parameters,
        delay_samples=nuisance.delay_samples,
        cov=cov,
        shared_cov=jnp.zeros_like(cov),
        chi2=chi2,
        rrse=_each(error, records, r_load, nuisance).max(),
        result=solution.result,
        steps=solution.stats["num_steps"],
    )
    return (
        source,
        estimate,
        Calibration(r_load, nuisance.delay_samples, delay_std(r_load), mismatch),
    )


def _each(evaluate: Callable[..., Any], *records: Any) -> Any:
    """`jax.vmap`; a single record is no batch, because conditions of a batch compute both cases."""
    if jax.tree.leaves(records)[0].shape[0] > 1:
        return jax.vmap(evaluate)(*records)
    found = evaluate(*jax.tree.map(lambda leaf: leaf[0], records))
    return jax.tree.map(lambda leaf: leaf[None], found)


def _arrow(
    parts: Float[Array, "record both both"], known: Float[Array, "source source"]
) -> Float[Array, "all all"]:
    """Matrix over source and all resistors, from those over source and one resistor each."""
    kept, count = known.shape[0], parts.shape[0]
    total = jnp.zeros((kept + count, kept + count))
    total = total.at[:kept, :kept].set(parts[:, :kept, :kept].sum(0) + known)
    total = total.at[:kept, kept:].set(parts[:, :kept, kept].T)
    total = total.at[kept:, :kept].set(parts[:, :kept, kept])
    return total.at[jnp.arange(count) + kept, jnp.arange(count) + kept].set(parts[:, kept, kept])


def fit_circuit(
    records: Records,
    driver: ContinuousDriver | MeasuredCurrent,
    starts: AbstractCircuit,
    element_prior: ElementPrior | None = None,
) -> tuple[AbstractCircuit, Estimate, Bool[Array, ""]]:
    """Identify the load of one recording from the best of several starts, stacked.

    Returns:
        The circuit; the estimate, whose parameters are the logarithms of the elements; and whether
        the data show another circuit.
    """
    source, source_cov = driver.source, driver.later_cov()
    source_vector, unflatten = ravel_pytree(source)
    candidates = starts.log_values()
    if element_prior is not None:
        candidates = element_prior.placed(candidates)
    kept, sources = candidates.shape[-1], source_vector.shape[0]
    circuit = jax.tree.map(lambda leaf: leaf[0], starts)
    # [samples] of this record.
    late_std = driver.late_std(records.sample_rate)

    def load(log_elements: Float[Array, " element"]) -> Rational | StateSpace:
        impedance = circuit.with_log_values(log_elements).impedance()
        return impedance.in_time(records.sample_rate, records.hold.shape[0])

    # Logarithms of the elements, the nuisances of the record, and the delay of the calibration.
    # Voltage and impulse response are linear in this delay.
    zero = jnp.zeros(())
    nuisance = Nuisance(jnp.zeros_like(loaded(source, load(candidates[0]), 1.0).C), zero, zero)
    best = best_start(
        lambda logs: scaled_residual(records, source, load(logs), nuisance), candidates
    )
    start_scale = state_scale(records, source, load(best))
    q0, named_scaled = ravel_pytree((best, nuisance, zero))

    def named(q: Float[Array, " q"]) -> tuple[Float[Array, " element"], Nuisance, Float[Array, ""]]:
        log_elements, nuisance, late_samples = named_scaled(q)
        return log_elements, start_scale.state_of(nuisance), late_samples

    def residual(q: Float[Array, " q"], late: Change) -> Float[Array, " term"]:
        log_elements, nuisance, late_samples = named(q)
        change = jax.tree.map(lambda leaf: late_samples * leaf, late)
        terms = scaled_residual(records, source, load(log_elements), nuisance, change)
        delays = jnp.stack([nuisance.delay_samples, late_samples])
        priors = delays / jnp.stack([DELAY_WIDTH, late_std])
        if element_prior is not None:
            rest = (log_elements - element_prior.centre) / element_prior.width
            priors = jnp.concatenate([priors, rest])
        return jnp.concatenate([terms, priors, start_scale.known * named_scaled(q)[1].state])

    def refine(
        carry: tuple[Float[Array, " q"], Change], late_counts: Float[Array, ""]
    ) -> tuple[
        tuple[Float[Array, " q"], Change],
        tuple[Float[Array, ""], optx.RESULTS, Int[Array, ""]],
    ]:
        log_elements, nuisance, _ = named(carry[0])
        late = late_calibration(records, source, load(log_elements), driver.r_known, nuisance.state)
        late = jax.tree.map(lambda leaf: late_counts * leaf, late)
        solution = optx.least_squares(
            residual, SOLVER, carry[0], args=late, max_steps=MAX_STEPS, throw=False
        )
        equations = solution.stats["normal_equations"]
        outcome = equations.objective, solution.result, solution.stats["num_steps"]
        return (solution.value, late), outcome

    nothing = Change(jnp.zeros(records.hold.shape[0]), jnp.zeros(IMPULSE + 1))
    # First without a delay of the calibration, then with it. In one loop, only one solver is
    # compiled.
    counts = jnp.arange(PASSES) > 0
    (q, late), outcomes = jax.lax.scan(refine, (q0, nothing), counts.astype(float))
    objective, result, steps = outcomes
    result = jax.tree.map(lambda leaf: leaf[-1], result)
    log_elements, nuisance, late_samples = named(q)
    fitted = circuit.with_log_values(log_elements)

    # Curvature over elements, delay of the calibration, source and nuisances, in this order.
    both = kept + 1 + sources
    # The directions of the state are orthogonal at these elements, not at those of the start.
    scale = state_scale(records, source, load(log_elements))
    at, named_all = ravel_pytree(
        (log_elements, late_samples, source_vector, scale.eta_of(nuisance))
    )

    def of_all(p: Float[Array, " p"]) -> tuple[Float[Array, " interval"], Float[Array, " lag"]]:
        log_elements, late_samples, vector, nuisance = named_all(p)
        nuisance = scale.state_of(nuisance)
        change = jax.tree.map(lambda leaf: late_samples * leaf, late)
        behind, circuit = unflatten(vector), load(log_elements)
        return residual_and_response(records, behind, circuit, nuisance, change)

    open_delay = Nuisance(scale.known, zero, jnp.asarray(1 / DELAY_WIDTH**2))
    free = jnp.zeros(kept)
    known = free if element_prior is None else element_prior.precision
    priors = (known, 1 / late_std**2, jnp.zeros(sources), open_delay)
    precision, _ = ravel_pytree(priors)
    centre = free if element_prior is None else element_prior.centre
    rest = precision * (at - jnp.pad(centre, (0, at.size - kept)))
    derivatives = slopes(of_all, at)
    full = curvature(records, derivatives, precision).eliminate(both)
    change = relaxed(records, source, fitted.impedance(), nuisance)
    behind_current = isinstance(source, CurrentSource)
    if behind_current:
        more = bends(records, fitted.impedance(), nuisance, derivatives)
        change = jax.tree.map(lambda *of: jnp.concatenate(of, axis=1), change, more)
    found = score(records, change, derivatives, source_cov, kept + 1, rest, precision, kept)
    own = inverse(full.expected[: kept + 1, : kept + 1])
    chi2 = 2 * objective[-1] / (records.intervals - q.size)
    inherited = (-own @ full.expected[: kept + 1, kept + 1 :])[:kept]
    shared = inherited @ source_cov @ inherited.T
    cov = (own @ full.score[: kept + 1, : kept + 1] @ own)[:kept, :kept]
    system = loaded_filter(source, load(log_elements), records.sample_rate)
    predicted = predict(system, records, nuisance) + late_samples * late.v_out
    seen, used = measured(records, nuisance.delay_samples), records.used > 0
    mean = jnp.sum(seen * records.used) / records.intervals
    cov = cov * jnp.maximum(chi2, 1.0) + shared
    error = rrse(jnp.where(used, predicted, mean), jnp.where(used, seen, mean))
    relaxes = jnp.any(DIRECTIONS["relaxation"].seen(*found[:3]))
    shown = Shown(relaxes, jnp.zeros((), bool))
    if behind_current:
        least = EXACT * jnp.sqrt(records.intervals) / error
        shown = Shown.behind_current(found, jnp.sqrt(jnp.diagonal(cov)), chi2, least)
    estimate = Estimate(
        parameters=log_elements,
        delay_samples=nuisance.delay_samples[None],
        cov=cov,
        shared_cov=shared,
        chi2=chi2,
        falls=shown.falls,
        rrse=error,
        result=result,
        steps=steps.sum(),
        support=_support(objective[-1], records, kept),
    )
    return fitted, estimate, shown.other


def _support(objective: Float[Array, ""], records: Records, elements: int) -> Support:
    """The support of a circuit. The interpolation leaves a part 2 · `CUTOFF` of the numbers free.

    The scores of other circuits are not on the scale of those on harmonics; a fit that they
    contradict has the verdict `misfit`.
    """
    free, nothing = 2 * CUTOFF, jnp.zeros(())
    return Support(
        2 * objective * free,
        records.intervals * free,
        jnp.zeros(Support.changes()),
        nothing,
        jnp.zeros(elements),
        jnp.asarray(jnp.nan),
    )
