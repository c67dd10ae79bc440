"""Maximum likelihood on the harmonics of the pulse rate, with noise on both records.

In the periodic steady state Y = G e^(−jωτ) X holds exactly at every harmonic, with continuous R_s,
R_p, C_p and Z_th(s): nothing is discretised, no initial state is unknown, and the likelihood is
(Pintelon and Schoukens, System Identification, 2012, ch. 9)

    Σ_k |Y_k − G_k e^(−jω_k τ) X_k|² / (σ_y² + |G_k|² σ_x²),      G = Z_L / (Z_L + Z_th),

of which the unknown true X has been eliminated. σ² are the variances of one coefficient.

A skin is identified *jointly* with the calibrations of its driver: what a skin's record says about
Z_th, and about the delay of a calibration that one known resistor leaves open, is used.

**One unloaded record for several loaded ones** is one noise in all of them, and they all tell of
the same X. Record by record, X and σ_x² are then replaced by what the earlier ones with the same X
leave of them (`_learn`, one step of a Kalman filter): the likelihood of all, in independent terms.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Complex, Float

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


def _learn(
    spectrum: Spectrum,
    other: Spectrum,
    g: Complex[Array, " harmonic"],
    same: Bool[Array, ""] | bool = True,
) -> Spectrum:
    """What is known of the X of `spectrum` after Y = `g` X of another record, if X is the same."""
    total = other.variance_y + jnp.abs(g) ** 2 * spectrum.variance_x
    used = other.selected & same
    share = jnp.where(used, spectrum.variance_x / total, 0.0)
    x = spectrum.x + jnp.conj(g) * as_complex(share) * (other.y - g * spectrum.x)
    variance = jnp.where(used, share * other.variance_y, spectrum.variance_x)
    return eqx.tree_at(lambda s: (s.x, s.variance_x), spectrum, (x, variance))


def _same_unloaded(one: Spectrum, other: Spectrum) -> Bool[Array, ""] | bool:
    """Whether two recordings have one and the same unloaded record."""
    if one is other:
        return True
    if one.x.shape != other.x.shape:
        return False
    return jnp.all(one.x == other.x)


def _as_list(spectra: Spectrum) -> list[Spectrum]:
    return [jax.tree.map(lambda leaf, i=i: leaf[i], spectra) for i in range(spectra.x.shape[0])]


def informed(
    spectra: Sequence[Spectrum], gains: Sequence[Complex[Array, " harmonic"]]
) -> list[Spectrum]:
    """Each recording with what the earlier ones with its unloaded record tell of its X."""
    known = list(spectra)
    for i in range(len(known)):
        for j in range(i):
            same = _same_unloaded(spectra[i], spectra[j])
            if same is not False:
                known[i] = _learn(known[i], spectra[j], gains[j], same)
    return known


def _denoised(
    spectra: Sequence[Spectrum], gains: Sequence[Complex[Array, " harmonic"]]
) -> list[Spectrum]:
    """The same with X by its maximum-likelihood estimate from all recordings, and Y = G X.

    The Jacobian at these has the noise of no record, which would count as information.
    """
    found = []
    for one, g in zip(spectra, gains, strict=True):
        known = one
        for other, other_gain in zip(spectra, gains, strict=True):
            same = _same_unloaded(one, other)
            if same is not False:
                known = _learn(known, other, other_gain, same)
        found.append(eqx.tree_at(lambda s: (s.x, s.y), one, (known.x, g * known.x)))
    return found


def residuals(
    spectra: Sequence[Spectrum], gains: Sequence[Complex[Array, " harmonic"]]
) -> list[Float[Array, " part"]]:
    """`residual` of each recording, all of them independent."""
    known = informed(spectra, gains)
    return [residual(s, g) for s, g in zip(known, gains, strict=True)]


def _calibration_gains(
    spectra: Spectrum,
    source: SourceImpedance,
    r_load: Float[Array, " record"],
    delay: Float[Array, " record"],
    sample_rate: Float[Array, ""],
) -> list[Complex[Array, " harmonic"]]:
    """Delayed gains of all calibrations, for delays in samples."""
    gains = jax.vmap(lambda f, r, d: delayed_gain(source, resistor(r), f, d))(
        spectra.frequency, r_load, delay / sample_rate
    )
    return list(gains)


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

    def of_all(q, records):
        weak = [regularise(q[:kept]), q[kept:] / DELAY_WIDTH]
        return jnp.concatenate(residuals(records, gains(q)) + weak)

    records = _as_list(spectra)
    q0 = jnp.concatenate([start_vector, jnp.zeros(count)])
    solution = optx.least_squares(
        of_all, SOLVER, q0, args=records, max_steps=MAX_STEPS, throw=False
    )
    q = solution.value
    jacobian = jax.jacfwd(of_all)(q, _denoised(records, gains(q)))
    freedom = 2 * jnp.sum(spectra.selected, dtype=q.dtype) - q.shape[0]
    chi2 = 2 * solution.stats["normal_equations"].objective / freedom
    cov = inverse(jacobian.T @ jacobian)[:kept, :kept] * jnp.maximum(chi2, 1.0)
    errors = jnp.stack([complex_rrse(g * s.x, s.y) for s, g in zip(records, gains(q), strict=True)])
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
    records = [*_as_list(references), spectrum]
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

    def priors(q):
        weak = regularise(q[kept + 1 : both])
        return jnp.concatenate([q[kept : kept + 1] / DELAY_WIDTH, weak, q[both:] / DELAY_WIDTH])

    def of_all(q, records):
        parts = residuals(records, [*common_gains(q), own_gain(q)])
        return jnp.concatenate([*parts, priors(q)])

    def own(q, spectrum):
        return jnp.append(residual(spectrum, own_gain(q)), q[kept] / DELAY_WIDTH)

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
        args=records,
        max_steps=MAX_STEPS,
        throw=False,
    )
    q = solution.value
    g = own_gain(q)
    gains = [*common_gains(q), g]
    jacobian = jax.jacfwd(of_all)(q, _denoised(records, gains))
    influence = inverse(jacobian.T @ jacobian)[:kept]
    # What is the trial's own among the noise of its terms: all, or that of V_out if V_th is shared.
    known = informed(records, gains)[-1]
    part = spectrum.variance_y / _variance(known, g)
    part = jnp.where(jnp.any(known.variance_x != spectrum.variance_x), part, 1.0)
    size = 2 * part.size
    first = sum(2 * s.x.size for s in records[:-1])
    private = jnp.zeros(jacobian.shape[0]).at[first : first + size].set(jnp.tile(part, 2))
    private = private.at[first + size].set(1.0)  # the prior of its delay
    by_term = influence @ jacobian.T
    own_cov = (by_term * private[None, :]) @ by_term.T
    shared = (by_term * (1 - private)[None, :]) @ by_term.T
    freedom = 2 * jnp.sum(spectrum.selected, dtype=q.dtype) - kept - 1
    chi2 = jnp.sum(residual(known, g) ** 2) / freedom
    return circuit.with_log_values(q[:kept]), Estimate(
        q[:kept],
        q[None, kept : kept + 1],
        own_cov * jnp.maximum(chi2, 1.0) + shared,
        chi2,
        complex_rrse(g * spectrum.x, spectrum.y),
        solution.result,
        solution.stats["num_steps"],
        shared,
    )
