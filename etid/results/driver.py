"""Drivers: the source impedance in continuous time, and the loaded terminal voltage.

    V_th(t) --[Z_th]--+-- V_out        V_out = V_th · Z_L / (Z_L + Z_th)
                    [Z_L]

Z_th has *modal* form: a sum of second-order sections with log-frequency and log-damping. With
polynomial coefficients, the Jacobian of the same impedance has condition numbers of 1e4…1e7; with
modal parameters, 50…100. All values of the modal parameters give a stable impedance. A pair of
poles passes from complex to real without a change of branch.
"""

import abc
import dataclasses
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Complex, Float, Int

from etid.circuits.display import plus_minus, several
from etid.circuits.impedance import realise
from etid.circuits.overview import Overview
from etid.numpy_tier.tiers import program
from etid.recordings.remarks import texts
from etid.results.feed import AbstractFeed, CurrentSource
from etid.results.instrument import Instrument
from etid.results.tried_orders import OrderEvidence
from etid.results.verdicts import RESULTS, message
from etid.signals.filtering import StateSpace
from etid.signals.harmonics import Spectrum
from etid.signals.transfer import (
    Rational,
    as_complex,
    delay_variable,
    reciprocal,
)


class SourceImpedance(eqx.Module):
    """Order-n rational Z_th(s) in modal form.

    Z_th = R + Σ_k (g_k + h_k s/ω_k) / (1 + 2 ζ_k s/ω_k + (s/ω_k)²) + Σ_j g_j / (1 + s/ω_j)

    g, h [Ω] may have either sign. R [Ω], ω [rad/s] and ζ are positive and stored as logarithms:
    with R < 0 the driver could not be loaded with a capacitor. ζ > 1 is a pair of real poles. Order
    n has ⌊(n−1)/2⌋ sections, because a transformer always has one slow real pole: its magnetising
    inductance.
    """

    log_resistance: Float[Array, ""]
    log_omega: Float[Array, " section"]
    log_zeta: Float[Array, " section"]
    gain: Float[Array, " section"]
    slope: Float[Array, " section"]
    log_omega_real: Float[Array, " real"]
    gain_real: Float[Array, " real"]

    @property
    def order(self) -> int:
        """Number of poles."""
        return 2 * self.log_omega.shape[0] + self.log_omega_real.shape[0]

    @program
    def response(self, frequency: Float[Array | np.ndarray, "..."]) -> Complex[Array, "..."]:
        """Impedance [Ω] at real frequencies [Hz]."""
        # In real arithmetic, which takes half the time to compile and to run.
        omega = 2 * jnp.pi * jnp.asarray(frequency)
        real = jnp.broadcast_to(jnp.exp(self.log_resistance), omega.shape)
        imaginary = jnp.zeros_like(omega)
        for k in range(self.log_omega.shape[0]):
            turn = omega * jnp.exp(-self.log_omega[k])
            below, damped = 1 - turn * turn, 2 * jnp.exp(self.log_zeta[k]) * turn
            scale = 1 / (below * below + damped * damped)
            gain, slope = self.gain[k] * scale, self.slope[k] * turn * scale
            real = real + gain * below + slope * damped
            imaginary = imaginary + slope * below - gain * damped
        for j in range(self.log_omega_real.shape[0]):
            turn = omega * jnp.exp(-self.log_omega_real[j])
            gain = self.gain_real[j] / (1 + turn * turn)
            real, imaginary = real + gain, imaginary - gain * turn
        return jax.lax.complex(real, imaginary)

    @jax.jit  # JAX remembers its trace
    def slopes(
        self, frequency: Float[Array, " frequency"]
    ) -> Complex[Array, "parameter frequency"]:
        """Derivatives of the impedance [Ω] with respect to the parameters, in field order."""
        omega = 2 * jnp.pi * frequency[None, :]
        gain, slope, gain_real = (
            as_complex(of)[:, None] for of in (self.gain, self.slope, self.gain_real)
        )
        # 1 / (1 + 2ζx + x²) in real arithmetic, which takes half the time.
        turn = omega * jnp.exp(-self.log_omega)[:, None]
        damping = 2 * jnp.exp(self.log_zeta)[:, None]
        real, imaginary = 1 - turn * turn, damping * turn
        scale = 1 / (real * real + imaginary * imaginary)
        shape = jax.lax.complex(real * scale, -imaginary * scale)
        x, damping = jax.lax.complex(jnp.zeros_like(turn), turn), as_complex(damping)
        section = (gain + slope * x) * shape
        turn = omega * jnp.exp(-self.log_omega_real)[:, None]
        scale = 1 / (1 + turn * turn)
        shape_real = jax.lax.complex(scale, -turn * scale)
        constant = as_complex(jnp.full((1, frequency.size), jnp.exp(self.log_resistance)))
        by_omega_real = jax.lax.complex(jnp.zeros_like(turn), turn) * shape_real * shape_real
        return jnp.concatenate(
            [
                constant,
                (section * (damping + 2 * x) - slope) * x * shape,
                -section * damping * x * shape,
                shape,
                x * shape,
                gain_real * by_omega_real,
                shape_real,
            ]
        )

    def state_space(self) -> StateSpace:
        """Realisation from current [A] to voltage drop [V], one balanced 2x2 block per section."""
        order = self.order
        pairs = self.log_omega.shape[0]
        omega, zeta = jnp.exp(self.log_omega), jnp.exp(self.log_zeta)
        rate, zero = jnp.exp(self.log_omega_real), jnp.zeros(1, omega.dtype)
        # The elements of A, and where they are: several changes of a matrix of zeros are slower.
        values = jnp.concatenate([zero, omega, -omega, -2 * zeta * omega, -rate])
        place, i, j = np.zeros((order, order), int), np.arange(pairs), np.arange(2 * pairs, order)
        place[2 * i, 2 * i + 1], place[2 * i + 1, 2 * i] = 1 + i, 1 + pairs + i
        place[2 * i + 1, 2 * i + 1], place[j, j] = 1 + 2 * pairs + i, 1 + pairs + j
        A = jnp.take(values, place, mode="clip")
        none = jnp.zeros_like(omega)
        B = jnp.concatenate([jnp.stack([none, omega], axis=1).reshape(-1), rate])
        C = jnp.concatenate(
            [jnp.stack([self.gain, self.slope], axis=1).reshape(-1), self.gain_real]
        )
        return StateSpace(A, B[:, None], C, jnp.exp(self.log_resistance)[None])

    def connected(self, load: StateSpace) -> StateSpace:
        """The system V_th → V_out with a load, from current [A] to voltage [V], at the terminal.

        The current i = (V_th − C₁x₁ − C₂x₂) / (D₁ + D₂) drives both impedances. x₁ are the states
        of the source, x₂ the states of the load.
        """
        z1, z2 = self.state_space(), load
        total = z1.D[0] + z2.D[0]
        drop = jnp.concatenate([z1.C, z2.C])
        B = jnp.concatenate([z1.B, z2.B]) / total
        n1, n2 = z1.C.shape[0], z2.C.shape[0]
        A = jnp.concatenate([jnp.pad(z1.A, ((0, 0), (0, n2))), jnp.pad(z2.A, ((0, 0), (n1, 0)))])
        share = z2.D[0] / total
        C = jnp.concatenate([jnp.zeros(n1), z2.C]) - share * drop
        return StateSpace(A - B * drop[None, :], B, C, share[None])


def loaded(
    source: SourceImpedance | CurrentSource,
    load: Rational | StateSpace,
    rate: float | Float[Array, ""],
) -> StateSpace:
    """The system input → V_out with `load` at the terminal, in continuous time."""
    return source.connected(load if isinstance(load, StateSpace) else realise(load, rate))


class Calibration(eqx.Module):
    """Results of the calibrations that a skin needs besides Z_th and its covariance.

    Attributes:
        r_load: Known resistors [Ω].
        delay_samples: Trigger delay of each calibration [samples of the calibration].
        delay_std_samples: Standard deviation of the common trigger delay of the calibrations
            [samples]. Only records with different resistors can separate this delay from a fast
            pole of Z_th. With one resistor the delay stays open.
        mismatch: Difference between the logarithm of each known resistor and its value from the
            other calibrations, and the standard error of this difference. None for one
            calibration, or if not known.
    """

    r_load: Float[Array, " record"]
    delay_samples: Float[Array, " record"]
    delay_std_samples: Float[Array, ""]
    mismatch: Float[Array, "2 record"] | None = None


class Driver(AbstractFeed):
    """An identified driver: the fields and methods that all kinds of drivers have.

    The kinds are `DiscreteDriver`, `ContinuousDriver` and `HarmonicDriver`. Only ratios to Z_th are
    observable. The tolerance of the calibration resistor therefore passes 1:1 into every resistance
    identified with this driver.

    Attributes:
        b: Numerator α₀ … of the discrete Z_th by Steiglitz-McBride (paper, eq. 4) [Ω].
        a: Denominator 1, β₁ … of the discrete Z_th.
        sample_rate: Rate of the calibrations and of the discrete filter [Hz].
        rrse: Largest root relative squared error over the calibrations (paper, eq. 3).
        chi2: Σ residual² / expected variance, per degree of freedom; 1 if the model is right.
        result: Verdict.
        steps: Iterations of the solver.
        method: Name of the estimator.
        remarks: Remarks on the calibrations, `etid.recordings.remarks.Remark` as an integer.
    """

    recorded: ClassVar[str] = "v_th"
    _: dataclasses.KW_ONLY
    b: Float[Array, " b"]
    a: Float[Array, " a"]
    sample_rate: float | Float[Array, ""]
    rrse: Float[Array, ""]
    chi2: Float[Array, ""]
    result: RESULTS
    steps: Int[Array, ""]
    method: str = eqx.field(static=True)
    remarks: Int[Array | np.ndarray, ""] = eqx.field(default_factory=lambda: np.zeros((), int))

    @property
    def order(self) -> int:
        """Number of poles."""
        return self.a.shape[0] - 1

    @program
    def gain(
        self, load: Complex[Array, "*lane frequency"], frequency: Float[Array, " frequency"]
    ) -> Complex[Array, "*lane frequency"]:
        """H = Z_L / (Z_L + Z_th)."""
        return load * reciprocal(load + self.response(frequency))

    def sensitivity(
        self, load: Complex[Array, "*lane frequency"], frequency: Float[Array, " frequency"]
    ) -> Complex[Array, "*lane frequency"]:
        """∂ ln H / ∂ ln Z_L = Z_th / (Z_L + Z_th)."""
        z_th = self.response(frequency)
        return z_th * reciprocal(load + z_th)

    @abc.abstractmethod
    def response(self, frequency: Float[Array | np.ndarray, "..."]) -> Complex[Array, "..."]:
        """Source impedance Z_th(j 2π f) [Ω], in continuous time if the method gives it.

        Args:
            frequency: Real frequencies [Hz].
        """

    @abc.abstractmethod
    def log_response_stderr(
        self, frequency: Float[Array | np.ndarray, " frequency"]
    ) -> Float[Array, "2 frequency"]:
        """Standard errors of ln |Z_th| and of the phase [rad]; NaN if there is no covariance."""

    @program
    def response_stderr(
        self, frequency: Float[Array | np.ndarray, " frequency"]
    ) -> Float[Array, " frequency"]:
        """Standard error of |Z_th|, from the derivatives of |Z_th| by its parameters.

        Args:
            frequency: Real frequencies [Hz].

        Returns:
            Standard errors [Ω]; NaN if the method gives no covariance.
        """
        return jnp.abs(self.response(frequency)) * self.log_response_stderr(frequency)[0]

    def _overview(self) -> Overview:
        at, verdict = jax.device_put(np.array([1e3])), self.verdict
        z = complex(np.asarray(self.response(at))[0])
        of_size, of_phase = np.asarray(self.log_response_stderr(at))[:, 0].tolist()
        rows = [
            ("|Z_th| at 1 kHz", plus_minus(abs(z) / 1e3, of_size * abs(z) / 1e3), "kΩ"),
            ("its phase", plus_minus(*np.degrees((np.angle(z), of_phase)).tolist()), "°"),
        ]
        notes = [*self._findings(), *([message(verdict)] if verdict != "successful" else [])]
        return Overview(
            f"Driver of order {self.order}: {verdict} in {several(int(self.steps), 'step')} "
            f"({self.method}), RRSE {100 * float(self.rrse):.3g} %, chi2 {float(self.chi2):.3g}",
            rows,
            notes=[*notes, *texts(int(self.remarks))],
        )

    def _findings(self) -> list[str]:
        """Lines on the orders tried, and on known resistors and their values from the others."""
        return []


class DiscreteDriver(Driver):
    """A driver from Steiglitz-McBride: Z_th is the discrete filter `b`, `a` (paper, eq. 4)."""

    @program
    def response(self, frequency: Float[Array | np.ndarray, "..."]) -> Complex[Array, "..."]:
        """Source impedance Z_th [Ω] of the discrete filter at real frequencies [Hz]."""
        z = delay_variable(jnp.asarray(frequency), self.sample_rate)
        return Rational(self.b, self.a)(z)

    @program
    def log_response_stderr(
        self, frequency: Float[Array | np.ndarray, " frequency"]
    ) -> Float[Array, "2 frequency"]:
        """NaN: Steiglitz-McBride gives no covariance."""
        return jnp.full((2, frequency.size), jnp.nan)


class ContinuousDriver(Driver):
    """A driver with Z_th in continuous time and its covariance.

    Attributes:
        source: Continuous Z_th, valid at any sample rate.
        cov: Covariance of the parameters of `source`, flattened in field order.
        calibration: Results of the calibrations that skins need.
        drift: Relative standard deviation of the change of each parameter of `source` between the
            calibration and the recording of a skin; None if there is no change. `cov` does not
            contain it.
        instrument: Tolerances of the instrument; None if it has none. `cov` does not contain them.
        tried: Orders that `order="auto"` tried; none if the user chose the order.
    """

    _: dataclasses.KW_ONLY
    source: SourceImpedance
    cov: Float[Array, "parameter parameter"]
    calibration: Calibration
    drift: Float[Array | np.ndarray, ""] | None = None
    instrument: Instrument | None = None
    tried: OrderEvidence = eqx.field(default_factory=OrderEvidence.none)

    def drift_std(self) -> Float[Array, " parameter"]:
        """Standard deviations of the parameters of `source` that come from `drift` alone."""
        # Frequencies, dampings and R are stored as logarithms, so their changes are relative.
        relative = jax.tree.map(jnp.ones_like, self.source)
        gains = (self.source.gain, self.source.slope, self.source.gain_real)
        relative = eqx.tree_at(lambda s: (s.gain, s.slope, s.gain_real), relative, gains)
        return jnp.abs(ravel_pytree(relative)[0]) * (0.0 if self.drift is None else self.drift)

    def later_cov(self) -> Float[Array, "parameter parameter"]:
        """Covariance of the parameters of `source` at the time when a skin is recorded."""
        return self.cov if self.drift is None else self.cov + jnp.diag(self.drift_std() ** 2)

    @property
    def r_known(self) -> Float[Array, ""]:
        """Resistor of the first calibration [Ω]."""
        return self.calibration.r_load[0]

    def late_std(self, sample_rate: Float[Array, ""]) -> Float[Array, ""]:
        """Standard deviation of the delay of the calibrations [samples at this rate, in Hz]."""
        return self.calibration.delay_std_samples * (sample_rate / self.sample_rate)

    @program
    def response(self, frequency: Float[Array | np.ndarray, "..."]) -> Complex[Array, "..."]:
        """Source impedance Z_th [Ω] in continuous time at real frequencies [Hz]."""
        return self.source.response(frequency)

    @program
    def log_response_stderr(
        self, frequency: Float[Array | np.ndarray, " frequency"]
    ) -> Float[Array, "2 frequency"]:
        """Standard errors of ln |Z_th| and of its phase [rad] at real frequencies [Hz].

        var = J cov Jᵀ,    J = ∂(ln |Z_th|, arg Z_th) / ∂parameters
        """
        relative = (
            self.source.slopes(jnp.asarray(frequency))
            * reciprocal(self.response(frequency))[None, :]
        )
        parts = jnp.stack([relative.real, relative.imag])
        return jnp.sqrt(jnp.einsum("cif,ij,cjf->cf", parts, self.cov, parts))

    def _findings(self) -> list[str]:
        known, tried = self.calibration, [str(self.tried)] if self.tried.orders else []
        if known.mismatch is None:
            return tried
        return tried + [
            f"r_load {float(r) / 1e3:.6g} kΩ is {100 * float(np.expm1(off)):+.3g}"
            f" ± {100 * float(error):.2g} % off what the others say"
            for r, off, error in zip(known.r_load, *known.mismatch, strict=True)
        ]


class HarmonicDriver(ContinuousDriver):
    """A driver that was identified from the harmonics of its calibrations and keeps them.

    Attributes:
        spectra: Harmonics of the calibrations, stacked along a leading axis.
        unloaded: Checksums of the unloaded records of the calibrations; None if not known. A load
            with another checksum shares no unloaded record with them. Its fit then skips the
            search for what they share, which doubles the cost.
        missing_pole: Largest score statistic of one more section
            (`etid.estimators.score_tests.of_calibrations`).
    """

    _: dataclasses.KW_ONLY
    spectra: Spectrum
    missing_pole: Float[Array, ""]
    unloaded: Int[np.ndarray, " record"] | None = None
