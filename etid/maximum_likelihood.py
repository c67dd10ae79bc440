"""Maximum likelihood on the harmonics of the pulse rate, with noise on both records.

In the periodic steady state Y = G e^(−jωτ) X holds exactly at every harmonic, with continuous R_s,
R_p, C_p and Z_th(s): nothing is discretised, no initial state is unknown, and the likelihood is
(Pintelon and Schoukens, System Identification, 2012, ch. 9)

    Σ_k |Y_k − G_k e^(−jω_k τ) X_k|² / (σ_y² + |G_k|² σ_x²),      G = Z_L / (Z_L + Z_th),

of which the unknown true X has been eliminated. σ² are the variances of one coefficient.

A skin is identified *jointly* with the calibrations of its driver: what a skin's record says about
Z_th, and about the delay of a calibration that one known resistor leaves open, is used.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Complex, Float

from etid.circuits import AbstractCircuit, resistor
from etid.driver import Calibration, SourceImpedance
from etid.information import inverse
from etid.levenberg_marquardt import best_start
from etid.output_error import DELAY_WIDTH, MAX_STEPS, SOLVER, Estimate, delay_std, prior
from etid.results import complex_rrse
from etid.spectra import Spectrum
from etid.transfer import Rational, as_complex, frequency_variable


def gain(
    source: SourceImpedance, load: Rational, frequency: Float[Array, " harmonic"]
) -> Complex[Array, " harmonic"]:
    """G = Z_L / (Z_L + Z_th)."""
    z_load = load(frequency_variable(frequency))
    return z_load / (z_load + source.response(frequency))


def delayed_gain(
    source: SourceImpedance,
    load: Rational,
    frequency: Float[Array, " harmonic"],
    delay: Float[Array, ""],
) -> Complex[Array, " harmonic"]:
    """G e^(−jωτ), for a delay τ in seconds."""
    turn = -frequency_variable(frequency) * as_complex(delay)
    return gain(source, load, frequency) * jnp.exp(turn)


def _variance(spectrum: Spectrum, g: Complex[Array, " harmonic"]) -> Float[Array, " harmonic"]:
    """E|Y − g X|² of the noise."""
    return spectrum.variance_y + jnp.abs(g) ** 2 * spectrum.variance_x


def residual(spectrum: Spectrum, g: Complex[Array, " harmonic"]) -> Float[Array, " part"]:
    """Real and imaginary parts of Y − g X, scaled to unit variance; 0 if not selected."""
    weight = jnp.where(spectrum.selected, jnp.sqrt(2 / _variance(spectrum, g)), 0.0)
    difference = (spectrum.y - g * spectrum.x) * as_complex(weight)
    return jnp.concatenate([difference.real, difference.imag])


def _denoised(spectrum: Spectrum, g: Complex[Array, " harmonic"]) -> Spectrum:
    """The same with X by its maximum-likelihood estimate and Y = g X.

    The Jacobian at these has the noise of neither record, which would count as information.
    """
    share = jnp.conj(g) * as_complex(spectrum.variance_x / _variance(spectrum, g))
    x = spectrum.x + share * (spectrum.y - g * spectrum.x)
    return eqx.tree_at(lambda s: (s.x, s.y), spectrum, (x, g * x))


def _calibration_gains(
    spectra: Spectrum,
    source: SourceImpedance,
    r_load: Float[Array, " record"],
    delay: Float[Array, " record"],
    sample_rate: Float[Array, ""],
) -> Complex[Array, "record harmonic"]:
    """Delayed gains of all calibrations, for delays in samples."""
    return jax.vmap(lambda f, r, d: delayed_gain(source, resistor(r), f, d))(
        spectra.frequency, r_load, delay / sample_rate
    )


def fit_source(
    spectra: Spectrum,
    r_load: Float[Array, " record"],
    sample_rate: Float[Array, ""],
    start: SourceImpedance,
) -> tuple[SourceImpedance, Estimate, Calibration]:
    """Identify Z_th from one or several records with known resistors.

    Args:
        spectra: Stacked along a leading axis.
        r_load: The resistors [Ω].
        sample_rate: Sampling rate [Hz].
        start: Initial Z_th; its structure is the order.

    Returns:
        Z_th, the estimate, whose parameters are `start` flattened, and what its skins need.
    """
    start_vector, unflatten = ravel_pytree(start)
    kept, count = start_vector.shape[0], r_load.shape[0]
    regularise = prior(start, sample_rate, r_load.mean())

    def gains(q):
        return _calibration_gains(spectra, unflatten(q[:kept]), r_load, q[kept:], sample_rate)

    def of_all(q, spectra):
        parts = jax.vmap(residual)(spectra, gains(q))
        return jnp.concatenate([parts.reshape(-1), regularise(q[:kept]), q[kept:] / DELAY_WIDTH])

    q0 = jnp.concatenate([start_vector, jnp.zeros(count)])
    solution = optx.least_squares(
        of_all, SOLVER, q0, args=spectra, max_steps=MAX_STEPS, throw=False
    )
    q = solution.value
    jacobian = jax.jacfwd(of_all)(q, jax.vmap(_denoised)(spectra, gains(q)))
    freedom = 2 * jnp.sum(spectra.selected, dtype=q.dtype) - q.shape[0]
    chi2 = 2 * solution.stats["normal_equations"].objective / freedom
    cov = inverse(jacobian.T @ jacobian)[:kept, :kept] * jnp.maximum(chi2, 1.0)
    errors = jax.vmap(complex_rrse)(gains(q) * spectra.x, spectra.y)
    estimate = Estimate(
        q[:kept],
        q[kept:, None],
        cov,
        chi2,
        errors.max(),
        solution.result,
        solution.stats["num_steps"],
        jnp.zeros_like(cov),
    )
    calibration = Calibration(r_load, delay_std(r_load) / sample_rate, q[kept:], spectra)
    return unflatten(q[:kept]), estimate, calibration


def fit_circuit(
    spectrum: Spectrum,
    sample_rate: Float[Array, ""],
    calibration: Calibration,
    rate: Float[Array, ""],
    source: SourceImpedance,
    starts: AbstractCircuit,
) -> tuple[AbstractCircuit, Estimate]:
    """Identify the load of one recording, jointly with the calibrations of its driver.

    Args:
        spectrum: One recording.
        sample_rate: Its sampling rate [Hz].
        calibration: The driver's, with their harmonics.
        rate: Their sampling rate [Hz].
        source: Z_th as identified from them.
        starts: Candidate starts, stacked along a leading axis; the one that predicts best is
            refined.

    Returns:
        The circuit and the estimate, whose parameters are the logarithms of the elements.
    """
    source_vector, unflatten = ravel_pytree(source)
    candidates = starts.log_values()
    kept, sources = candidates.shape[-1], source_vector.shape[0]
    circuit = jax.tree.map(lambda leaf: leaf[0], starts)
    references, r_load = calibration.spectra, calibration.r_load
    assert references is not None  # check_driver
    regularise = prior(source, rate, r_load.mean())
    both = kept + 1 + sources

    # q holds the elements, the delay, Z_th, and the delays of the calibrations.
    def own_gain(q):
        load = circuit.with_log_values(q[:kept]).impedance()
        z_th = unflatten(q[kept + 1 : both])
        return delayed_gain(z_th, load, spectrum.frequency, q[kept] / sample_rate)

    def common_gains(q):
        z_th = unflatten(q[kept + 1 : both])
        return _calibration_gains(references, z_th, r_load, q[both:], rate)

    def own(q, spectrum):
        return jnp.append(residual(spectrum, own_gain(q)), q[kept] / DELAY_WIDTH)

    def common(q, spectra):
        parts = jax.vmap(residual)(spectra, common_gains(q)).reshape(-1)
        weak = regularise(q[kept + 1 : both])
        return jnp.concatenate([parts, weak, q[both:] / DELAY_WIDTH])

    def of_all(q, spectra):
        return jnp.concatenate([own(q, spectra[0]), common(q, spectra[1])])

    def at(candidate):
        return jnp.concatenate([candidate, jnp.zeros(1), source_vector, calibration.delay])

    q0 = jax.vmap(at)(candidates)
    best = best_start(lambda q: own(q, spectrum), q0)
    # First with Z_th as it is: from a start far away, a joint fit would bend Z_th to meet it.
    alone = optx.least_squares(
        lambda p, spectrum: own(best.at[: kept + 1].set(p), spectrum),
        SOLVER,
        best[: kept + 1],
        args=spectrum,
        max_steps=MAX_STEPS,
        throw=False,
    )
    solution = optx.least_squares(
        of_all,
        SOLVER,
        best.at[: kept + 1].set(alone.value),
        args=(spectrum, references),
        max_steps=MAX_STEPS,
        throw=False,
    )
    q = solution.value
    g = own_gain(q)
    j_own = jax.jacfwd(own)(q, _denoised(spectrum, g))
    j_common = jax.jacfwd(common)(q, jax.vmap(_denoised)(references, common_gains(q)))
    influence = inverse(j_own.T @ j_own + j_common.T @ j_common)[:kept]
    chi2 = jnp.sum(own(q, spectrum) ** 2) / (
        2 * jnp.sum(spectrum.selected, dtype=q.dtype) - kept - 1
    )
    shared = influence @ (j_common.T @ j_common) @ influence.T
    private = influence @ (j_own.T @ j_own) @ influence.T
    return circuit.with_log_values(q[:kept]), Estimate(
        q[:kept],
        q[None, kept : kept + 1],
        private * jnp.maximum(chi2, 1.0) + shared,
        chi2,
        complex_rrse(g * spectrum.x, spectrum.y),
        solution.result,
        solution.stats["num_steps"],
        shared,
    )
