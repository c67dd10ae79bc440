"""Output error: Levenberg-Marquardt on the simulated terminal voltage.

V_out is predicted from the recorded V_th through the loaded driver, a continuous-time system run exactly for band-limited samples
(`etid.filtering`), so that discretisation costs no accuracy at the recorder's own rate. The parameters are the logarithms of the circuit
elements or the modal parameters of Z_th; the state at the start of the record and an offset of V_out are nuisances.

**Noise on both records.** The residual r = V_out_predicted − V_out contains the noise of V_out and the noise of V_th filtered by the
loaded driver G. For white noise its variance is

    s(θ) = σ_out² + σ_th² ⟨|G|²⟩,      ⟨·⟩ the mean over 0 … fs/2,

and minimising Σ r²/s(θ) is consistent, because E Σ r² = |noise-free misfit|² + N s(θ); minimising Σ r² alone is not (at 30 dB it
drives Z_th to −90 kΩ). χ² = Σ r²/s per degree of freedom is 1 when the model is right.

**Covariance.** r is coloured (G filters the noise of V_th), and the recorded noise inflates JᵀJ. Both are accounted for,

    cov = H⁻¹ (Jᵀ Σ J) H⁻¹,      Σ = (σ_out² I + σ_th² G Gᵀ)/s,
    H   = JᵀJ − N (σ_th² ⟨∂G ∂G*⟩/s − ∂s ∂sᵀ/(4 s²)),

H being the curvature of the *expected* objective, and a skin adds what it inherits from its driver, K cov(Z_th) Kᵀ with K = −H⁻¹ ∂²/∂θ∂Z_th.
If χ² > 1 the covariance is multiplied by it.
"""

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
from etid.filtering import TAPS, band_limited, hold, simulate
from etid.levenberg_marquardt import LevenbergMarquardt
from etid.transfer import Rational, frequency_variable

MAX_STEPS = 200
GRID = (
    np.arange(96) + 0.5
) / 192  # frequencies over which |G|² is averaged, in units of the sample rate
EIGENVALUE_FLOOR = (
    1e-12  # of the scaled curvature; directions below carry no information in double precision
)


class Records(eqx.Module):
    """What one fit sees of a recording: the interpolated V_th, the measured V_out, and their noise.

    Attributes:
        hold: Polynomial coefficients of the band-limited V_th.
        v_out: Measured voltage [V] at the start of each interval.
        v_th: Unloaded voltage [V], whole record.
        sigma_th: Noise of V_th [V].
        sigma_out: Noise of V_out [V].
        sample_rate: Sampling rate [Hz].
    """

    hold: Float[Array, "interval degree"]
    v_out: Float[Array, " interval"]
    v_th: Float[Array, " time"]
    sigma_th: Float[Array, ""]
    sigma_out: Float[Array, ""]
    sample_rate: Float[Array, ""]


def prepare(
    v_th: Float[Array, " time"],
    v_out: Float[Array, " time"],
    sigma_th: Float[Array, ""],
    sigma_out: Float[Array, ""],
    sample_rate: Float[Array, ""],
) -> Records:
    """Interpolate V_th once; the edges, where its neighbours are missing, are left out."""
    interpolated = band_limited(v_th)
    first = TAPS - 1
    measured = v_out[first : first + interpolated.shape[0]]
    return Records(interpolated, measured, v_th, sigma_th, sigma_out, sample_rate)


def predict(
    records: Records, source: SourceImpedance, load: Rational, nuisance: Float[Array, " nuisance"]
) -> Float[Array, " interval"]:
    """Terminal voltage [V] with `load`; `nuisance` is the initial state followed by the offset [V]."""
    system = hold(loaded(source, load, records.sample_rate), records.sample_rate)
    voltage, _ = simulate(system, records.hold, nuisance[:-1])
    return voltage + nuisance[-1]


def gain(
    source: SourceImpedance, load: Rational, sample_rate: Float[Array, ""]
) -> Float[Array, " grid"]:
    """Real and imaginary part of G = Z_L / (Z_L + Z_th) over the band, scaled so that its square sums to ⟨|G|²⟩."""
    frequency = jnp.asarray(GRID) * sample_rate
    z_load = load(frequency_variable(frequency))
    g = z_load / (z_load + source.response(frequency))
    return jnp.concatenate([g.real, g.imag]) / np.sqrt(GRID.size)


def residual_variance(records: Records, g: Float[Array, " grid"]) -> Float[Array, ""]:
    """s = σ_out² + σ_th² ⟨|G|²⟩ [V²]."""
    return records.sigma_out**2 + records.sigma_th**2 * jnp.sum(g**2)


class Estimate(eqx.Module):
    """What a fit returns before it is judged.

    Attributes:
        parameters: Estimated parameters.
        nuisance: Initial state and offset of each record.
        cov: Covariance of `parameters`.
        chi2: Σ r²/s per degree of freedom.
        result: Verdict of the solver.
        steps: Trial steps of the solver.
        shared_cov: The part of `cov` that comes from the driver, common to all skins identified with it.
    """

    parameters: Float[Array, " parameter"]
    nuisance: Float[Array, "record nuisance"]
    cov: Float[Array, "parameter parameter"]
    chi2: Float[Array, ""]
    result: optx.RESULTS
    steps: Int[Array, ""]
    shared_cov: Float[Array, "parameter parameter"]


def _inverse(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Inverse of a symmetric matrix in its own scaling, without the directions that carry no information."""
    scale = jnp.sqrt(jnp.maximum(jnp.diagonal(matrix), 0.0))
    scale = jnp.where(scale > 0, scale, 1.0)
    values, vectors = jnp.linalg.eigh(matrix / scale[:, None] / scale[None, :])
    kept = values > EIGENVALUE_FLOOR
    inverse = jnp.where(kept, 1 / jnp.where(kept, values, 1.0), 0.0)
    return (vectors * inverse) @ vectors.T / scale[:, None] / scale[None, :]


class _Curvature(eqx.Module):
    """H and Jᵀ Σ J of one record, over (parameters, nuisance)."""

    expected: Float[Array, "n n"]
    score: Float[Array, "n n"]


def _curvature(records: Records, model: Any, q: Float[Array, " n"]) -> _Curvature:
    """Evaluate H and JᵀΣJ; `model(q)` returns the source, the load and the nuisance."""

    def scaled(q):
        source, load, nuisance = model(q)
        s = residual_variance(records, gain(source, load, records.sample_rate))
        return (predict(records, source, load, nuisance) - records.v_out) / jnp.sqrt(s)

    def band(q):
        source, load, _ = model(q)
        return gain(source, load, records.sample_rate)

    source, load, nuisance = model(q)
    s = residual_variance(records, band(q))
    jacobian = jax.jacfwd(scaled)(q)
    slope = jax.jacfwd(band)(q)
    s_slope = 2 * records.sigma_th**2 * band(q) @ slope
    samples = jacobian.shape[0]
    noise = records.sigma_th**2 * slope.T @ slope / s
    noise = noise - jnp.outer(s_slope, s_slope) / (4 * s**2)

    system = hold(loaded(source, load, records.sample_rate), records.sample_rate)

    def through(v):
        return simulate(system, band_limited(v), jnp.zeros_like(nuisance[:-1]))[0]

    _, adjoint = jax.vjp(through, records.v_th)
    coloured = jax.vmap(lambda column: adjoint(column)[0], in_axes=1, out_axes=1)(jacobian)
    information = jacobian.T @ jacobian
    score = records.sigma_out**2 * information + records.sigma_th**2 * coloured.T @ coloured
    return _Curvature(information - samples * noise, score / s)


def _eliminate(curvature: _Curvature, kept: int) -> _Curvature:
    """Project out the nuisances of one record, which no other record shares."""
    h, m = curvature.expected, curvature.score
    k = -_inverse(h[kept:, kept:]) @ h[kept:, :kept]
    reduced = h[:kept, :kept] + h[:kept, kept:] @ k
    score = (
        m[:kept, :kept] + m[:kept, kept:] @ k + k.T @ m[kept:, :kept] + k.T @ m[kept:, kept:] @ k
    )
    return _Curvature(reduced, score)


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
    kept, count, states = start_vector.shape[0], r_load.shape[0], start.order + 1

    def one(record, r, parameters, nuisance):
        source = unflatten(parameters)
        s = residual_variance(record, gain(source, resistor(r), record.sample_rate))
        return (predict(record, source, resistor(r), nuisance) - record.v_out) / jnp.sqrt(s)

    def residual(q, _):
        nuisance = q[kept:].reshape(count, states)
        parts = jax.vmap(one, in_axes=(0, 0, None, 0))(records, r_load, q[:kept], nuisance)
        return parts.reshape(-1)

    q0 = jnp.concatenate([start_vector, jnp.zeros(count * states)])
    solution = optx.least_squares(
        residual, LevenbergMarquardt(), q0, max_steps=MAX_STEPS, throw=False
    )
    q = solution.value
    nuisance = q[kept:].reshape(count, states)

    def curvature(record, r, nuisance):
        def model(p):
            return unflatten(p[:kept]), resistor(r), p[kept:]

        return _eliminate(_curvature(record, model, jnp.concatenate([q[:kept], nuisance])), kept)

    parts = jax.vmap(curvature)(records, r_load, nuisance)
    inverse = _inverse(parts.expected.sum(0))
    chi2 = 2 * solution.stats["normal_equations"].objective / (records.v_out.size - q.shape[0])
    cov = inverse @ parts.score.sum(0) @ inverse * jnp.maximum(chi2, 1.0)
    estimate = Estimate(
        q[:kept],
        nuisance,
        cov,
        chi2,
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
        starts: Candidate starts, stacked along a leading axis; the one that predicts best is refined.

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
        s = residual_variance(records, gain(source, load, records.sample_rate))
        return (predict(records, source, load, q[kept:]) - records.v_out) / jnp.sqrt(s)

    q0 = jnp.concatenate([candidates, jnp.zeros((candidates.shape[0], states + 1))], axis=-1)
    objectives = jax.lax.map(lambda q: jnp.sum(residual(q, None) ** 2), q0)
    best = jnp.argmin(jnp.where(jnp.isfinite(objectives), objectives, jnp.inf))
    solution = optx.least_squares(
        residual, LevenbergMarquardt(), q0[best], max_steps=MAX_STEPS, throw=False
    )
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
    chi2 = 2 * solution.stats["normal_equations"].objective / (records.v_out.size - q.shape[0])
    inflation = jnp.maximum(chi2, 1.0)
    inherited = -inverse @ curvature.expected[:kept, kept:]
    shared = inherited @ source_cov @ inherited.T
    cov = inverse @ curvature.score[:kept, :kept] @ inverse * inflation + shared
    estimate = Estimate(
        q[:kept],
        q[None, kept:],
        cov,
        chi2,
        solution.result,
        solution.stats["num_steps"],
        shared,
    )
    return circuit.with_log_values(q[:kept]), estimate
