"""Output error: Levenberg-Marquardt on the simulated terminal voltage.

V_out is predicted from the recorded V_th through the loaded driver, a continuous-time system run
exactly for band-limited samples (`etid.filtering`), so that discretisation costs no accuracy at the
recorder's own rate. The parameters are the logarithms of the circuit elements or the modal
parameters of Z_th; the state at the start of the record, an offset of V_out and its trigger delay
are nuisances.

**Noise on both records.** The residual r = V_out_predicted − V_out contains the noise of V_out and
the noise of V_th filtered by the loaded driver G. For white noise its variance is

    s(θ) = σ_out² Σ k² + σ_th² Σ h²,

k being the impulse response of the interpolation, h that of G after it,

and minimising Σ r²/s(θ) is consistent, because E Σ r² = |noise-free misfit|² + N s(θ); minimising Σ
r² alone is not (at 30 dB it drives Z_th to −90 kΩ). χ² = Σ r²/s per degree of freedom is 1 when the
model is right.

**Covariance.** r is coloured (G filters the noise of V_th), and the recorded noise inflates JᵀJ.
Both are accounted for,

    cov = H⁻¹ (Jᵀ Σ J) H⁻¹,      Σ = (σ_out² K Kᵀ + σ_th² G Gᵀ)/s,
    H   = JᵀJ − N (σ_th² Σ ∂h ∂hᵀ/s − ∂s ∂sᵀ/(4 s²)),

H being the curvature of the *expected* objective, and a skin adds what it inherits from its driver,
K cov(Z_th) Kᵀ with K = −H⁻¹ ∂²/∂θ∂Z_th. If χ² > 1 the covariance is multiplied by it.
"""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int

from etid.circuits import AbstractCircuit, resistor
from etid.driver import SourceImpedance, loaded
from etid.filtering import CUTOFF, TAPS, StateSpace, band_limited, hold, shiftable, simulate
from etid.levenberg_marquardt import LevenbergMarquardt
from etid.results import rrse
from etid.transfer import Rational

MAX_STEPS = 500
IMPULSE = 256  # samples of the impulse response whose squares are summed
PASSIVE_BAND = np.geomspace(1e-4, 10.0, 128)  # of the sample rate
DELAY_WIDTH = 0.5  # [samples] of the weak prior of a delay; one sample is as far as it may go
SOLVER = LevenbergMarquardt(rtol=1e-5, ftol=1e-6)  # 1e-3 standard errors at 10 000 samples
EIGENVALUE_FLOOR = (
    1e-12  # of the scaled curvature; directions below carry no information in double precision
)


class Records(eqx.Module):
    """What one fit sees of a recording: the interpolated V_th, the measured V_out, and their noise.

    Attributes:
        hold: Polynomial coefficients of the band-limited V_th.
        v_out: Measured voltage [V] as polynomials of a delay, filtered like V_th.
        sigma_th: Noise of V_th [V].
        sigma_out: Noise of V_out [V].
        sample_rate: Sampling rate [Hz].
    """

    hold: Float[Array, "interval degree"]
    v_out: Float[Array, "interval shift"]
    sigma_th: Float[Array, ""]
    sigma_out: Float[Array, ""]
    sample_rate: Float[Array, ""]


def prepare(
    v_th: Float[Array, " time"],
    v_out: Float[Array, " time"],
    sigma_th: Float[Array, ""],
    sigma_out: Float[Array, ""],
    sample_rate: Float[Array, ""],
    cutoff: float = CUTOFF,
) -> Records:
    """Interpolate V_th once; the edges, where its neighbours are missing, are left out."""
    held, delayed = band_limited(v_th, cutoff), shiftable(v_out, cutoff)
    return Records(held, delayed, sigma_th, sigma_out, sample_rate)


def loaded_filter(
    source: SourceImpedance, load: Rational, sample_rate: Float[Array, ""]
) -> StateSpace:
    """Discrete filter from the interpolated V_th to V_out."""
    return hold(loaded(source, load, sample_rate), sample_rate)


def predict(
    system: StateSpace, records: Records, nuisance: Float[Array, " nuisance"]
) -> Float[Array, " interval"]:
    """Terminal voltage [V]; `nuisance` is the initial state, the offset [V] and the delay."""
    return simulate(system, records.hold, nuisance[:-2])[0] + nuisance[-2]


def measured(records: Records, nuisance: Float[Array, " nuisance"]) -> Float[Array, " interval"]:
    """Measured voltage [V] at the instants of V_th; it was sampled `nuisance[-1]` samples late.

    50 ns between the triggers of two records are 0.01 samples, and spread R_s by 8 %.
    """
    late = -nuisance[-1]
    value = records.v_out[:, -1]
    for k in range(records.v_out.shape[1] - 2, -1, -1):  # Horner
        value = value * late + records.v_out[:, k]
    return value


def impulse_response(system: StateSpace) -> Float[Array, " lag"]:
    """Response h of the loaded driver to one sample of V_th, interpolation included."""
    return simulate(system, _impulse(), jnp.zeros_like(system.C))[0]


def _impulse() -> Float[Array, "lag degree"]:
    """One sample of noise, interpolated."""
    return band_limited(jnp.zeros(IMPULSE + 2 * TAPS).at[2 * TAPS].set(1.0))


def residual_variance(records: Records, h: Float[Array, " lag"]) -> Float[Array, ""]:
    """Variance s = σ_out² Σ k² + σ_th² Σ h² of the residual [V²]."""
    k = _impulse()[:, 0]
    return records.sigma_out**2 * jnp.sum(k**2) + records.sigma_th**2 * jnp.sum(h**2)


def scaled_residual(
    records: Records, source: SourceImpedance, load: Rational, nuisance: Float[Array, " nuisance"]
) -> Float[Array, " interval"]:
    """(Predicted − measured) / √s."""
    system = loaded_filter(source, load, records.sample_rate)
    s = residual_variance(records, impulse_response(system))
    return (predict(system, records, nuisance) - measured(records, nuisance)) / jnp.sqrt(s)


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
    """

    parameters: Float[Array, " parameter"]
    nuisance: Float[Array, "record nuisance"]
    cov: Float[Array, "parameter parameter"]
    chi2: Float[Array, ""]
    rrse: Float[Array, ""]
    result: optx.RESULTS
    steps: Int[Array, ""]
    shared_cov: Float[Array, "parameter parameter"]


def _inverse(matrix: Float[Array, "n n"], *, drop: bool = False) -> Float[Array, "n n"]:
    """Inverse of a symmetric matrix, in its own scaling.

    Directions without information keep an enormous variance, or with `drop` none: nuisances that
    the data do not determine have no effect either.
    """
    scale = jnp.sqrt(jnp.maximum(jnp.diagonal(matrix), 0.0))
    scale = jnp.where(scale > 0, scale, 1.0)
    values, vectors = jnp.linalg.eigh(matrix / scale[:, None] / scale[None, :])
    inverse = 1 / jnp.maximum(values, EIGENVALUE_FLOOR)
    inverse = jnp.where(values > EIGENVALUE_FLOOR, inverse, 0.0 if drop else inverse)
    return (vectors * inverse[None, :]) @ vectors.T / scale[:, None] / scale[None, :]


class _Curvature(eqx.Module):
    """H and Jᵀ Σ J of one record, over (parameters, nuisance)."""

    expected: Float[Array, "n n"]
    score: Float[Array, "n n"]


def _curvature(records: Records, model: Any, q: Float[Array, " n"]) -> _Curvature:
    """Evaluate H and JᵀΣJ; `model(q)` returns the source, the load and the nuisance."""

    def response(q):
        source, load, _ = model(q)
        return impulse_response(loaded_filter(source, load, records.sample_rate))

    h = response(q)
    s = residual_variance(records, h)
    jacobian = jax.jacfwd(lambda q: scaled_residual(records, *model(q)))(q)
    slope = jax.jacfwd(response)(q)
    s_slope = 2 * records.sigma_th**2 * h @ slope
    samples = jacobian.shape[0]
    noise = records.sigma_th**2 * slope.T @ slope / s
    noise = noise - jnp.outer(s_slope, s_slope) / (4 * s**2)
    # Jᵀ Σ J by Parseval; J is padded, so that the filters do not wrap around.
    size = 2 ** math.ceil(math.log2(samples + IMPULSE))
    weight = jnp.full(size // 2 + 1, 2.0 / size).at[0].set(1.0 / size).at[-1].set(1.0 / size)
    power_out = records.sigma_out**2 * jnp.abs(jnp.fft.rfft(_impulse()[:, 0], size)) ** 2
    weight = weight * (power_out + records.sigma_th**2 * jnp.abs(jnp.fft.rfft(h, size)) ** 2)
    spectrum = jnp.fft.rfft(jacobian, size, axis=0)
    real, imaginary = spectrum.real, spectrum.imag
    score = real.T @ (weight[:, None] * real) + imaginary.T @ (weight[:, None] * imaginary)
    information = jacobian.T @ jacobian
    expected = (information - samples * noise).at[-1, -1].add(1 / DELAY_WIDTH**2)
    return _Curvature(expected, score / s)


def _eliminate(curvature: _Curvature, kept: int) -> _Curvature:
    """Project out the nuisances of one record, which no other record shares."""
    h, m = curvature.expected, curvature.score
    k = -_inverse(h[kept:, kept:], drop=True) @ h[kept:, :kept]
    reduced = h[:kept, :kept] + h[:kept, kept:] @ k
    score = (
        m[:kept, :kept] + m[:kept, kept:] @ k + k.T @ m[kept:, :kept] + k.T @ m[kept:, kept:] @ k
    )
    return _Curvature(reduced, score)


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


def fit_source(
    records: Records,
    r_load: Float[Array, " record"],
    start: SourceImpedance,
) -> tuple[SourceImpedance, Estimate]:
    """Identify Z_th from one or several records with known resistors.

    Args:
        records: Stacked along a leading axis.
        r_load: The resistors [Ω].
        start: Initial Z_th; its structure is the order.

    Returns:
        Z_th and the estimate, whose parameters are `start` flattened.
    """
    start_vector, unflatten = ravel_pytree(start)
    kept, count, states = start_vector.shape[0], r_load.shape[0], start.order + 2

    def one(record, r, parameters, nuisance):
        return scaled_residual(record, unflatten(parameters), resistor(r), nuisance)

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

    def curvature(record, r, nuisance):
        def model(p):
            return unflatten(p[:kept]), resistor(r), p[kept:]

        return _eliminate(_curvature(record, model, jnp.concatenate([q[:kept], nuisance])), kept)

    def error(record, r, nuisance):
        system = loaded_filter(unflatten(q[:kept]), resistor(r), record.sample_rate)
        return rrse(predict(system, record, nuisance), measured(record, nuisance))

    parts = jax.vmap(curvature)(records, r_load, nuisance)
    weak = jax.jacfwd(regularise)(q[:kept])
    inverse = _inverse(parts.expected.sum(0) + weak.T @ weak)
    chi2 = (
        2
        * solution.stats["normal_equations"].objective
        / (math.prod(records.hold.shape[:-1]) - q.shape[0])
    )
    cov = inverse @ parts.score.sum(0) @ inverse * jnp.maximum(chi2, 1.0)
    estimate = Estimate(
        q[:kept],
        nuisance,
        cov,
        chi2,
        jax.vmap(error)(records, r_load, nuisance).max(),
        solution.result,
        solution.stats["num_steps"],
        jnp.zeros_like(cov),
    )
    return unflatten(q[:kept]), estimate


def fit_circuit(
    records: Records,
    source: SourceImpedance,
    source_cov: Float[Array, "m m"],
    starts: AbstractCircuit,
) -> tuple[AbstractCircuit, Estimate]:
    """Identify the load of one recording.

    Args:
        records: One recording.
        source: Known Z_th.
        source_cov: Covariance of its flattened parameters.
        starts: Candidate starts, stacked along a leading axis; the one that predicts best is
            refined.

    Returns:
        The circuit and the estimate, whose parameters are the logarithms of the elements.
    """
    source_vector, unflatten = ravel_pytree(source)
    candidates = starts.log_values()
    kept = candidates.shape[-1]
    circuit = jax.tree.map(lambda leaf: leaf[0], starts)
    states = jax.eval_shape(lambda: loaded(source, circuit.impedance(), 1.0).C).shape[0]

    def residual(q, _):
        load = circuit.with_log_values(q[:kept]).impedance()
        scaled = scaled_residual(records, source, load, q[kept:])
        return jnp.append(scaled, q[-1] / DELAY_WIDTH)

    q0 = jnp.concatenate([candidates, jnp.zeros((candidates.shape[0], states + 2))], axis=-1)
    objectives = jax.lax.map(lambda q: jnp.sum(residual(q, None) ** 2), q0)
    best = jnp.argmin(jnp.where(jnp.isfinite(objectives), objectives, jnp.inf))
    solution = optx.least_squares(residual, SOLVER, q0[best], max_steps=MAX_STEPS, throw=False)
    q = solution.value

    def model(p):  # (elements, source, nuisance)
        load = circuit.with_log_values(p[:kept]).impedance()
        return (
            unflatten(p[kept : kept + source_vector.shape[0]]),
            load,
            p[kept + source_vector.shape[0] :],
        )

    both = kept + source_vector.shape[0]
    curvature = _curvature(records, model, jnp.concatenate([q[:kept], source_vector, q[kept:]]))
    curvature = _eliminate(curvature, both)
    inverse = _inverse(curvature.expected[:kept, :kept])
    chi2 = (
        2
        * solution.stats["normal_equations"].objective
        / (math.prod(records.hold.shape[:-1]) - q.shape[0])
    )
    inflation = jnp.maximum(chi2, 1.0)
    inherited = -inverse @ curvature.expected[:kept, kept:]
    shared = inherited @ source_cov @ inherited.T
    load = circuit.with_log_values(q[:kept]).impedance()
    system = loaded_filter(source, load, records.sample_rate)
    cov = inverse @ curvature.score[:kept, :kept] @ inverse * inflation + shared
    estimate = Estimate(
        q[:kept],
        q[None, kept:],
        cov,
        chi2,
        rrse(predict(system, records, q[kept:]), measured(records, q[kept:])),
        solution.result,
        solution.stats["num_steps"],
        shared,
    )
    return circuit.with_log_values(q[:kept]), estimate


def fitted_voltage(
    records: Records, source: SourceImpedance, load: Rational
) -> Float[Array, " interval"]:
    """Terminal voltage [V] with `load`; initial state, offset and delay fitted to the record."""
    system = loaded_filter(source, load, records.sample_rate)
    nuisance = jnp.zeros(system.C.shape[0] + 2)

    def residual(nuisance):
        return predict(system, records, nuisance) - measured(records, nuisance)

    for _ in range(3):  # linear but for the delay, which is a small fraction of a sample
        basis = jax.jacfwd(residual)(nuisance)
        nuisance = nuisance - jnp.linalg.lstsq(basis, residual(nuisance))[0]
    return residual(nuisance) + records.v_out[:, 0]
