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

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from etid.circuits.circuit import AbstractCircuit
from etid.circuits.elements import resistor
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
from etid.results.driver import Calibration, SourceImpedance, loaded
from etid.results.fits import rrse
from etid.signals.transfer import Rational
from etid.solvers.levenberg_marquardt import LevenbergMarquardt, best_start
from etid.solvers.matrices import inverse

MAX_STEPS = 500
PASSES = 3  # of a skin's fit
PASSIVE_BAND = np.geomspace(1e-4, 10.0, 128)  # of the sample rate
DELAY_WIDTH = 0.5  # [samples] of the weak prior of a delay; one sample is as far as it may go
KNOWN_DELAY = 1e-9  # [samples] by which several different resistors leave it in doubt, or so
SAME_LOAD = 0.01  # resistors closer than this do not resolve the delay of their records
SOLVER = LevenbergMarquardt(rtol=1e-5, ftol=1e-6)  # 1e-3 standard errors at 10 000 samples


class Estimate(eqx.Module):
    """What a fit returns before it is judged.

    Attributes:
        parameters: Estimated parameters.
        nuisance: Initial state, offset [V] and delay [samples] of each record.
        cov: Covariance of `parameters`.
        chi2: Σ r²/s per degree of freedom.
        rrse: Root relative squared error of V_out, the largest over the records.
        result: Verdict of the solver.
        steps: Trial steps of the solver.
        shared_cov: The part of `cov` that comes from the driver, common to all skins identified
            with it.
        strain: By how much the calibrations' own Σ r² grew in a joint fit; 0 without one.
        hum: Whether mains hum is seen in the residual; a fit in time does not look for it.
    """

    parameters: Float[Array, " parameter"]
    nuisance: Float[Array, "record nuisance"]
    cov: Float[Array, "parameter parameter"]
    chi2: Float[Array, ""]
    rrse: Float[Array, ""]
    result: optx.RESULTS
    steps: Int[Array, ""]
    shared_cov: Float[Array, "parameter parameter"]
    strain: Float[Array, ""]
    hum: Bool[Array, ""] = eqx.field(default_factory=lambda: jnp.zeros((), bool))


def prior(start: SourceImpedance, sample_rate: Float[Array, ""], r_load: Float[Array, ""]):
    """Weak prior of the modal parameters, as additional residuals.

    A pole that a noisy recording cannot determine would otherwise run away, to Q = ∞ for instance,
    and take the solver with it. At 60 dB a recording carries 1e4 and more times the information of
    this prior. What it allows (one standard deviation) is, for the first section, the resonance, a
    frequency within e^3 of half the Nyquist frequency and a damping ratio of 0.7 within e^1.5; for
    further ones an overdamped tail above the band, 1.5 times the Nyquist frequency within e^1.5 and
    1.5 within e^0.5: a second sharp resonance beside the first is what noise makes when the trigger
    delay is fitted too. Slow real poles lie within e^3 of 1/500 of half the Nyquist frequency, and
    impedances below 10 times the known resistor.

    A transformer is passive, so Re Z_th ≥ 0 at all frequencies, inside the recorded band and above
    it; otherwise some skin would make the loaded driver oscillate. Each frequency where it is not
    adds Re Z_th / (10⁻³ R_L).
    """
    half = 0.5 * jnp.pi * sample_rate
    wide = 10 * r_load
    pairs, reals = start.log_omega.shape[0], start.log_omega_real.shape[0]
    first = jnp.zeros(pairs).at[:1].set(1.0)
    centre = SourceImpedance(
        log_resistance=jnp.log(0.01 * r_load),
        log_omega=jnp.log(half) + (1 - first) * math.log(3.0),
        log_zeta=first * math.log(0.7) + (1 - first) * math.log(1.5),
        gain=jnp.zeros(pairs),
        slope=jnp.zeros(pairs),
        log_omega_real=jnp.full(reals, jnp.log(half)).at[0].add(-math.log(500.0)),
        gain_real=jnp.zeros(reals),
    )
    width = SourceImpedance(
        log_resistance=jnp.array(3.0),
        log_omega=1.5 + 1.5 * first,
        log_zeta=0.5 + first,
        gain=jnp.full(pairs, wide),
        slope=jnp.full(pairs, wide),
        log_omega_real=jnp.full(reals, 3.0),
        gain_real=jnp.full(reals, wide),
    )
    centre, width = ravel_pytree(centre)[0], ravel_pytree(width)[0]
    _, unflatten = ravel_pytree(start)
    frequency = jnp.asarray(PASSIVE_BAND) * sample_rate

    def regularise(parameters):
        active = jnp.minimum(unflatten(parameters).response(frequency).real, 0.0)
        return jnp.concatenate([(parameters - centre) / width, active / (1e-3 * r_load)])

    return regularise


def delay_std(r_load: Float[Array, " record"]) -> Float[Array, ""]:
    """Standard deviation [samples] to which calibrations with these resistors know their delay.

    Records with one and the same resistor share its ambiguity, others resolve it.
    """
    same = jnp.ptp(r_load) < SAME_LOAD * r_load.mean()
    return jnp.where(same, DELAY_WIDTH, KNOWN_DELAY)


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
        q[:kept],
        nuisance,
        cov,
        chi2,
        jax.vmap(error)(records, r_load, nuisance).max(),
        solution.result,
        solution.stats["num_steps"],
        jnp.zeros_like(cov),
        jnp.zeros(()),
    )
    return (
        unflatten(q[:kept]),
        estimate,
        Calibration(
            r_load,
            delay_std(r_load) / records.sample_rate[0],
            nuisance[:, -1],
            spectra=None,
            mismatch=mismatch,
        ),
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
    source: SourceImpedance,
    source_cov: Float[Array, "m m"],
    calibration: Calibration,
    starts: AbstractCircuit,
) -> tuple[AbstractCircuit, Estimate, Bool[Array, ""]]:
    """Identify the load of one recording.

    Args:
        records: One recording.
        source: Known Z_th.
        source_cov: Covariance of its flattened parameters.
        calibration: What else is in doubt.
        starts: Candidate starts, stacked along a leading axis; the one that predicts best is
            refined.

    Returns:
        The circuit; the estimate, whose parameters are the logarithms of the elements; and whether
        the load is seen to be another circuit.
    """
    source_vector, unflatten = ravel_pytree(source)
    candidates = starts.log_values()
    kept, sources = candidates.shape[-1], source_vector.shape[0]
    circuit = jax.tree.map(lambda leaf: leaf[0], starts)
    states = jax.eval_shape(lambda: loaded(source, circuit.impedance().rational(), 1.0).C).shape[0]
    late_std = calibration.delay_std * records.sample_rate  # [samples]

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
        q[:kept],
        q[None, kept:-1],
        cov * jnp.maximum(chi2, 1.0) + shared,
        chi2,
        rrse(jnp.where(used, predicted, mean), jnp.where(used, seen, mean)),
        result,
        steps.sum(),
        shared,
        jnp.zeros(()),
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
