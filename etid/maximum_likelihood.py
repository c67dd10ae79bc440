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
from etid.levenberg_marquardt import LevenbergMarquardt, best_start
from etid.output_error import DELAY_WIDTH, MAX_STEPS, SOLVER, Estimate, delay_std, prior
from etid.results import complex_rrse
from etid.spectra import Spectrum, signal_share
from etid.transfer import Rational, as_complex, frequency_variable

# Z_th and a delay bend each other's valley; a load alone has none.
CURVED = LevenbergMarquardt(rtol=SOLVER.rtol, ftol=SOLVER.ftol, geodesic=True)


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
    spectrum: Spectrum,
    others: Sequence[Spectrum],
    gains: Sequence[Complex[Array, " harmonic"]],
) -> Spectrum:
    """A recording with what others of the same unloaded record tell of its X."""
    known = spectrum
    for other, g in zip(others, gains, strict=True):
        same = _same_unloaded(spectrum, other)
        if same is not False:
            known = _learn(known, other, g, same)
    return known


def denoised(
    spectra: Sequence[Spectrum], gains: Sequence[Complex[Array, " harmonic"]]
) -> tuple[list[Spectrum], list[Float[Array, " part"]]]:
    """The same with X by its maximum-likelihood estimate from all recordings, and Y = G X.

    The Jacobian J there has no noise of the residual, which would count as information. What is
    left in it of the noise of X makes the score noisier but is no information either, so that

        cov = H⁻¹ (Jᵀ J) H⁻¹,      H = Jᵀ W J,

    W being the share of signal in the power of X, which is returned for every residual.
    """
    found, shares = [], []
    for one, g in zip(spectra, gains, strict=True):
        known = informed(one, spectra, gains)
        found.append(eqx.tree_at(lambda s: (s.x, s.y), one, (known.x, g * known.x)))
        shares.append(jnp.tile(signal_share(known.x, known.variance_x), 2))
    return found, shares


def residuals(
    spectra: Sequence[Spectrum], gains: Sequence[Complex[Array, " harmonic"]]
) -> list[Float[Array, " part"]]:
    """`residual` of each recording given those before it: all are independent."""
    return [
        residual(informed(one, spectra[:i], gains[:i]), g)
        for i, (one, g) in enumerate(zip(spectra, gains, strict=True))
    ]


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
        of_all, CURVED, q0, args=records, max_steps=MAX_STEPS, throw=False
    )
    q = solution.value
    clean, shares = denoised(records, gains(q))
    jacobian = jax.jacfwd(of_all)(q, clean)
    weight = jnp.concatenate([*shares, jnp.ones(jacobian.shape[0] - 2 * spectra.x.size)])
    by_term = inverse((jacobian.T * weight[None, :]) @ jacobian) @ jacobian.T
    freedom = 2 * jnp.sum(spectra.selected, dtype=q.dtype) - q.shape[0]
    chi2 = 2 * solution.stats["normal_equations"].objective / freedom
    cov = (by_term @ by_term.T)[:kept, :kept] * jnp.maximum(chi2, 1.0)
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
        jnp.zeros(()),
    )
    calibration = Calibration(r_load, delay_std(r_load) / sample_rate, q[kept:], spectra)
    return unflatten(q[:kept]), estimate, calibration


class Joint(eqx.Module):
    """The likelihood of loads and of the calibrations of their driver, term by term.

    Everywhere `common` are the parameters of Z_th and the delays of the calibrations, `own` the
    logarithms of a load's elements and its delay; delays are in samples.

    Attributes:
        circuit: Structure of the loads.
        source: Z_th as identified from the calibrations.
        calibration: The calibrations, with their harmonics.
        rate: Their sampling rate [Hz].
    """

    circuit: AbstractCircuit
    source: SourceImpedance
    calibration: Calibration
    rate: Float[Array, ""]

    @property
    def sources(self) -> int:
        """Number of parameters of Z_th."""
        return ravel_pytree(self.source)[0].shape[0]

    @property
    def records(self) -> list[Spectrum]:
        """The calibrations one by one."""
        assert self.calibration.spectra is not None  # check_driver
        return _as_list(self.calibration.spectra)

    def start(self) -> Float[Array, " common"]:
        """The common parameters as the calibrations alone have them."""
        return jnp.concatenate([ravel_pytree(self.source)[0], self.calibration.delay])

    def z_th(self, common: Float[Array, " common"]) -> SourceImpedance:
        """Z_th of the common parameters."""
        return ravel_pytree(self.source)[1](common[: self.sources])

    def known_gains(self, common: Float[Array, " common"]) -> list[Complex[Array, " harmonic"]]:
        """Gains with the known resistors."""
        spectra = self.calibration.spectra
        assert spectra is not None
        delay = common[self.sources :]
        return _calibration_gains(
            spectra, self.z_th(common), self.calibration.r_load, delay, self.rate
        )

    def gain(
        self,
        own: Float[Array, " own"],
        common: Float[Array, " common"],
        spectrum: Spectrum,
        sample_rate: Float[Array, ""],
    ) -> Complex[Array, " harmonic"]:
        """Gain with a load."""
        load = self.circuit.with_log_values(own[:-1]).impedance()
        return delayed_gain(self.z_th(common), load, spectrum.frequency, own[-1] / sample_rate)

    def of_calibrations(
        self, common: Float[Array, " common"], records: Sequence[Spectrum]
    ) -> Float[Array, " term"]:
        """Terms of the calibrations and of the weak prior."""
        regularise = prior(self.source, self.rate, self.calibration.r_load.mean())
        parts = residuals(records, self.known_gains(common))
        weak = [regularise(common[: self.sources]), common[self.sources :] / DELAY_WIDTH]
        return jnp.concatenate(parts + weak)

    def of_load(
        self,
        own: Float[Array, " own"],
        common: Float[Array, " common"],
        spectrum: Spectrum,
        sample_rate: Float[Array, ""],
        records: Sequence[Spectrum],
    ) -> Float[Array, " term"]:
        """Terms of one recording, given the calibrations; the last is the prior of its delay."""
        known = informed(spectrum, records, self.known_gains(common))
        part = residual(known, self.gain(own, common, spectrum, sample_rate))
        return jnp.append(part, own[-1] / DELAY_WIDTH)

    def strain(self, common: Float[Array, " common"]) -> Float[Array, ""]:
        """By how much Σ r² of the calibrations has grown from what they alone have.

        About as much as there are common parameters, if loads and calibrations agree on them.
        """
        alone = jnp.sum(self.of_calibrations(self.start(), self.records) ** 2)
        freedom = sum(2 * jnp.sum(s.selected, dtype=alone.dtype) for s in self.records)
        now = jnp.sum(self.of_calibrations(common, self.records) ** 2)
        return (now - alone) / jnp.maximum(alone / freedom, 1.0)


def fit_load(
    model: Joint,
    spectrum: Spectrum,
    sample_rate: Float[Array, ""],
    candidates: Float[Array, "start element"],
) -> tuple[Float[Array, " own"], optx.RESULTS, Float[Array, ""], Float[Array, ""]]:
    """Identify the load of one recording with Z_th as the calibrations have it.

    Args:
        model: Calibrations and kind of circuit.
        spectrum: The recording.
        sample_rate: Its sampling rate [Hz].
        candidates: Logarithms of elements to start from; the start that predicts best is refined.

    Returns:
        Elements and delay, how the solver ended, χ² per degree of freedom, and RRSE.
    """
    records, common = model.records, model.start()

    def terms(own, spectrum):
        return model.of_load(own, common, spectrum, sample_rate, records)

    starts = jnp.pad(candidates, ((0, 0), (0, 1)))
    best = best_start(lambda own: terms(own, spectrum), starts)
    solution = optx.least_squares(
        terms, SOLVER, best, args=spectrum, max_steps=MAX_STEPS, throw=False
    )
    own = solution.value
    squares = 2 * solution.stats["normal_equations"].objective
    chi2 = squares / (2 * jnp.sum(spectrum.selected, dtype=own.dtype) - own.shape[0])
    g = model.gain(own, common, spectrum, sample_rate)
    return own, solution.result, chi2, complex_rrse(g * spectrum.x, spectrum.y)


def fit_circuit(
    model: Joint,
    spectrum: Spectrum,
    sample_rate: Float[Array, ""],
    candidates: Float[Array, "start element"],
) -> Estimate:
    """Identify the load of one recording, jointly with the calibrations of its driver.

    Args:
        model: Calibrations and kind of circuit.
        spectrum: The recording.
        sample_rate: Its sampling rate [Hz].
        candidates: As in `fit_load`.

    Returns:
        The estimate, whose parameters are the logarithms of the elements.
    """
    # First with Z_th as it is: from a start far away, a joint fit would bend Z_th to meet it.
    alone, *_ = fit_load(model, spectrum, sample_rate, candidates)
    split = alone.shape[0]

    def terms(q, records):
        own, common = q[:split], q[split:]
        of_load = model.of_load(own, common, records[-1], sample_rate, records[:-1])
        return jnp.concatenate([of_load, model.of_calibrations(common, records[:-1])])

    solution = optx.least_squares(
        terms,
        CURVED,
        jnp.concatenate([alone, model.start()]),
        args=[*model.records, spectrum],
        max_steps=MAX_STEPS,
        throw=False,
    )
    own, common = solution.value[:split], solution.value[split:]
    g = model.gain(own, common, spectrum, sample_rate)
    gains = [*model.known_gains(common), g]
    clean, shares = denoised([*model.records, spectrum], gains)
    jacobian = jax.jacfwd(terms)(solution.value, clean)
    weight = jnp.concatenate([shares[-1], jnp.ones(1), *shares[:-1]])
    weight = jnp.pad(weight, (0, jacobian.shape[0] - weight.size), constant_values=1.0)  # priors
    by_term = inverse((jacobian.T * weight[None, :]) @ jacobian)[: split - 1] @ jacobian.T
    # What is the trial's own among the noise of its terms: all, or that of V_out if V_th is shared.
    known = informed(spectrum, model.records, gains[:-1])
    part = jnp.where(
        jnp.any(known.variance_x != spectrum.variance_x),
        spectrum.variance_y / _variance(known, g),
        1.0,
    )
    private = (
        jnp.zeros(by_term.shape[1])
        .at[: 2 * part.size + 1]
        .set(jnp.concatenate([part, part, jnp.ones(1)]))
    )
    own_cov = (by_term * private[None, :]) @ by_term.T
    shared = (by_term * (1 - private)[None, :]) @ by_term.T
    chi2 = jnp.sum(residual(known, g) ** 2) / (
        2 * jnp.sum(spectrum.selected, dtype=g.real.dtype) - split
    )
    return Estimate(
        own[:-1],
        own[None, -1:],
        own_cov * jnp.maximum(chi2, 1.0) + shared,
        chi2,
        complex_rrse(g * spectrum.x, spectrum.y),
        solution.result,
        solution.stats["num_steps"],
        shared,
        model.strain(common),
    )
