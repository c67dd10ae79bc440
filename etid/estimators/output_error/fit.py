"""Output error: Levenberg-Marquardt on the simulated terminal voltage.

The parameters are the logarithms of the circuit elements or the modal parameters of Z_th;
`etid.estimators.output_error.prediction` makes the residual,
`etid.estimators.output_error.information` the covariance. A skin adds what it inherits from its
driver, K cov(Z_th) Kᵀ with K = −H⁻¹ ∂²/∂θ∂Z_th. If χ² > 1 the covariance is multiplied by it.

**The calibration's own delay.** A calibration that was triggered τ late looks, to first order in
τ, exactly like one in time with Z_th + sτ (R_L + Z_th) for Z_th: what a recorded band shows of a
fast pole of Z_th and what it shows of a delay are the same, so one known resistor cannot tell them
apart. 10 ns cost 3 % in C_p. A skin's record does show τ, by the excess impedance of
`late_calibration`. It is therefore fitted with every skin.
"""

import math

import jax
import jax.numpy as jnp
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float

from etid.circuits.circuit import AbstractCircuit
from etid.circuits.elements import resistor
from etid.estimators.estimate import (
    DELAY_WIDTH,
    MAX_STEPS,
    SOLVER,
    Estimate,
    delay_std,
    prior,
)
from etid.estimators.output_error.information import curvature, eliminate, further, slopes
from etid.estimators.output_error.prediction import (
    IMPULSE,
    Late,
    Records,
    impulse_response,
    late_calibration,
    loaded_filter,
    measured,
    predict,
    scaled_residual,
)
from etid.estimators.score_tests.other_in_time import relaxed, score
from etid.results.driver import Calibration, ContinuousDriver, SourceImpedance, loaded
from etid.results.fits import rrse
from etid.signals.transfer import Rational
from etid.solvers.levenberg_marquardt import best_start
from etid.solvers.matrices import inverse

PASSES = 3  # of a skin's fit


def fit_source(
    records: Records,
    r_load: Float[Array, " record"],
    start: SourceImpedance,
) -> tuple[SourceImpedance, Estimate, Calibration]:
    """Identify Z_th from one or several records with known resistors.

    Args:
        records: Stacked along a leading axis.
        r_load: The resistors [Ω].
        start: Initial Z_th; its structure is the order.

    Returns:
        Z_th, the estimate, whose parameters are `start` flattened, and what else is in doubt.
    """
    start_vector, unflatten = ravel_pytree(start)
    kept, count, states = start_vector.shape[0], r_load.shape[0], start.order + 2

    def one(record, r, parameters, nuisance):
        return scaled_residual(record, unflatten(parameters), resistor(r).rational(), nuisance)

    regularise = prior(start, records.sample_rate[0], r_load.mean())

    def residual(q, _):
        nuisance = q[kept:].reshape(count, states)
        parts = jax.vmap(one, in_axes=(0, 0, None, 0))(records, r_load, q[:kept], nuisance)
        late = nuisance[:, -1] / DELAY_WIDTH
        return jnp.concatenate([parts.reshape(-1), regularise(q[:kept]), late])

    q0 = jnp.concatenate([start_vector, jnp.zeros(count * states)])
    solution = optx.least_squares(residual, SOLVER, q0, max_steps=MAX_STEPS, throw=False)
    q = solution.value
    nuisance = q[kept:].reshape(count, states)

    states = nuisance.shape[1]
    precision = jnp.zeros(kept + 1 + states).at[-1].set(1 / DELAY_WIDTH**2)
    weak = jax.jacfwd(regularise)(q[:kept])
    chi2 = (
        2
        * solution.stats["normal_equations"].objective
        / (math.prod(records.hold.shape[:-1]) - q.shape[0])
    )

    # Curvature over source, logarithm of the resistor and nuisances, in this order.
    def at_minimum(record, r, nuisance):
        def residual(p):
            return one(record, r * jnp.exp(p[kept]), p[:kept], p[kept + 1 :])

        def response(p):
            load = resistor(r * jnp.exp(p[kept])).rational()
            return impulse_response(loaded_filter(unflatten(p[:kept]), load, record.sample_rate))

        at = jnp.concatenate([q[:kept], jnp.zeros(1), nuisance])
        towards = jnp.zeros_like(at).at[kept].set(1.0)
        value, slope = jax.jvp(residual, (at,), (towards,))
        return curvature(record, slopes(residual, response, at), precision), jnp.vdot(slope, value)

    def error(record, r, nuisance):
        system = loaded_filter(unflatten(q[:kept]), resistor(r).rational(), record.sample_rate)
        return rrse(predict(system, record, nuisance), measured(record, nuisance))

    parts, by_resistor = jax.vmap(at_minimum)(records, r_load, nuisance)
    parts = jax.vmap(lambda part: eliminate(part, kept + 1))(parts)
    information = _arrow(parts.expected, weak.T @ weak)
    spread = _arrow(parts.score, jnp.zeros((kept, kept)))
    bread = inverse(information[:kept, :kept])
    cov = bread @ spread[:kept, :kept] @ bread * jnp.maximum(chi2, 1.0)
    mismatch = None
    if count > 1:
        gradient = jnp.concatenate([jnp.zeros(kept), by_resistor])  # it is at its minimum
        step, error_of_step = further(information, spread, gradient, kept)
        # What the worst of the resistors explains is no noise.
        left = chi2 - jnp.max((step / error_of_step) ** 2) / math.prod(records.hold.shape[:-1])
        mismatch = jnp.stack([-step, error_of_step * jnp.sqrt(jnp.maximum(left, 1.0))])
    estimate = Estimate(
        parameters=q[:kept],
        delay_samples=nuisance[:, -1],
        cov=cov,
        shared_cov=jnp.zeros_like(cov),
        chi2=chi2,
        rrse=jax.vmap(error)(records, r_load, nuisance).max(),
        result=solution.result,
        steps=solution.stats["num_steps"],
    )
    return (
        unflatten(q[:kept]),
        estimate,
        Calibration(r_load, nuisance[:, -1], delay_std(r_load), mismatch),
    )


def _arrow(
    parts: Float[Array, "record both both"], known: Float[Array, "source source"]
) -> Float[Array, "all all"]:
    """Source and all resistors, from source and resistor of each record."""
    kept, count = known.shape[0], parts.shape[0]
    total = jnp.zeros((kept + count, kept + count))
    total = total.at[:kept, :kept].set(parts[:, :kept, :kept].sum(0) + known)
    total = total.at[:kept, kept:].set(parts[:, :kept, kept].T)
    total = total.at[kept:, :kept].set(parts[:, :kept, kept])
    return total.at[jnp.arange(count) + kept, jnp.arange(count) + kept].set(parts[:, kept, kept])


def fit_circuit(
    records: Records,
    driver: ContinuousDriver,
    starts: AbstractCircuit,
) -> tuple[AbstractCircuit, Estimate, Bool[Array, ""]]:
    """Identify the load of one recording.

    Args:
        records: One recording.
        driver: Its driver.
        starts: Candidate starts, stacked along a leading axis; the one that predicts best is
            refined.

    Returns:
        The circuit; the estimate, whose parameters are the logarithms of the elements; and whether
        the load is seen to be another circuit.
    """
    source, source_cov, calibration = driver.source, driver.later_cov(), driver.calibration
    source_vector, unflatten = ravel_pytree(source)
    candidates = starts.log_values()
    kept, sources = candidates.shape[-1], source_vector.shape[0]
    circuit = jax.tree.map(lambda leaf: leaf[0], starts)
    states = jax.eval_shape(lambda: loaded(source, circuit.impedance().rational(), 1.0).C).shape[0]
    # In samples of this record.
    late_std = calibration.delay_std_samples * (records.sample_rate / driver.sample_rate)

    def load(q):
        return circuit.with_log_values(q[:kept]).impedance().rational()

    # q holds the elements, the nuisances of the record, and the delay of the calibration, by which
    # voltage and impulse response change linearly.
    def residual(q, late):
        change = jax.tree.map(lambda leaf: q[-1] * leaf, late)
        scaled = scaled_residual(records, source, load(q), q[kept:-1], change)
        return jnp.concatenate([scaled, q[-2:] / jnp.stack([DELAY_WIDTH, late_std])])

    def refine(carry, _):
        q, late = carry
        solution = optx.least_squares(
            residual, SOLVER, q, args=late, max_steps=MAX_STEPS, throw=False
        )
        q = solution.value
        x0 = q[kept : kept + states]
        late = late_calibration(records, source, load(q), calibration.r_load[0], x0)
        equations = solution.stats["normal_equations"]
        return (q, late), (equations.objective, solution.result, solution.stats["num_steps"])

    nothing = Late(jnp.zeros(records.hold.shape[0]), jnp.zeros(IMPULSE + 1))
    q0 = jnp.concatenate([candidates, jnp.zeros((candidates.shape[0], states + 3))], axis=-1)
    best = best_start(lambda q: residual(q, nothing), q0)
    # First with the calibration in time, then with its delay; one loop, so that one solver is
    # compiled.
    (q, late), outcomes = jax.lax.scan(refine, (best, nothing), length=PASSES)
    objective, result, steps = outcomes
    result = jax.tree.map(lambda leaf: leaf[-1], result)

    # Curvature over elements, delay of the calibration, source and nuisances, in this order.
    both = kept + 1 + sources
    at = jnp.concatenate([q[:kept], q[-1:], source_vector, q[kept:-1]])

    def of_all(p):
        z_th = unflatten(p[kept + 1 : both])
        change = jax.tree.map(lambda leaf: p[kept] * leaf, late)
        return scaled_residual(records, z_th, load(p), p[both:], change)

    def response(p):
        z_th = unflatten(p[kept + 1 : both])
        h = impulse_response(loaded_filter(z_th, load(p), records.sample_rate))
        return h + p[kept] * late.h

    precision = jnp.zeros_like(at).at[kept].set(1 / late_std**2).at[-1].set(1 / DELAY_WIDTH**2)
    derivatives = slopes(of_all, response, at)
    full = eliminate(curvature(records, derivatives, precision), both)
    change = relaxed(records, source, circuit.with_log_values(q[:kept]).impedance(), q[kept:-1])
    found = score(
        records, change, derivatives, source_cov, kept + 1, precision * at, precision, kept
    )
    own = inverse(full.expected[: kept + 1, : kept + 1])
    chi2 = 2 * objective[-1] / (records.intervals - q.shape[0])
    inherited = (-own @ full.expected[: kept + 1, kept + 1 :])[:kept]
    shared = inherited @ source_cov @ inherited.T
    cov = (own @ full.score[: kept + 1, : kept + 1] @ own)[:kept, :kept]
    system = loaded_filter(source, load(q), records.sample_rate)
    predicted = predict(system, records, q[kept:-1]) + q[-1] * late.v_out
    seen, used = measured(records, q[kept:-1]), records.used > 0
    mean = jnp.sum(seen * records.used) / records.intervals
    estimate = Estimate(
        parameters=q[:kept],
        delay_samples=q[-2:-1],
        cov=cov * jnp.maximum(chi2, 1.0) + shared,
        shared_cov=shared,
        chi2=chi2,
        rrse=rrse(jnp.where(used, predicted, mean), jnp.where(used, seen, mean)),
        result=result,
        steps=steps.sum(),
    )
    return circuit.with_log_values(q[:kept]), estimate, found.relaxes()


def fitted_voltage(
    records: Records, source: SourceImpedance, r_load: Float[Array, ""], load: Rational
) -> Float[Array, " interval"]:
    """Terminal voltage [V] with `load`, as far as a record tells.

    Initial state, offset, delay and the delay of the calibration with `r_load` [Ω] are fitted.
    """
    system = loaded_filter(source, load, records.sample_rate)
    states = system.C.shape[0]
    q = jnp.zeros(states + 3)

    def residual(q, late):
        return predict(system, records, q[:-1]) + q[-1] * late - measured(records, q[:-1])

    # Linear but for the delay, which is a small fraction of a sample, and for the state in `late`,
    # which is that of the step before: a state that decays within a sample multiplied by the delay
    # of the calibration would leave the first sample at any voltage.
    late = jnp.zeros_like(records.v_out[:, 0])
    for _ in range(3):
        late = late_calibration(records, source, load, r_load, q[:states]).v_out
        basis = jax.jacfwd(residual)(q, late)
        q = q - jnp.linalg.lstsq(basis, residual(q, late))[0]
    return residual(q, late) + records.v_out[:, 0]
