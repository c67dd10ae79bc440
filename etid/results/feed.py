"""What feeds a load: the recorded input, and the gain from it to V_out.

A load is identified from an input and from V_out = H · input. There are two kinds of input. A
driver is a Thévenin source: its input is V_th, with H = Z_L / (Z_L + Z_th). A measured current is
the input itself, with H = Z_L. Estimators ask the feed for H and need not know its kind.

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

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int

from etid.circuits.impedance import Quantity, divider, realise
from etid.precision import Module, in_float64, namespace, untraced
from etid.printing import Overview
from etid.results.verdicts import RESULTS, Judged, verdict
from etid.signals import modal
from etid.signals.departure import Departure
from etid.signals.filtering import StateSpace
from etid.signals.transfer import AnyArray, Rational

Load = Complex[Array, "..."] | Complex[np.ndarray, "..."]
"""Type of the impedance of a load [Ω]."""


class AbstractFeed(Judged):
    """What feeds a load.

    Attributes:
        recorded: Name of the record that is its input.
    """

    recorded: ClassVar[str]

    @abc.abstractmethod
    def gain(self, load: Load, frequency: Quantity) -> Complex[Array, "..."]:
        """H: V_out per input.

        Args:
            load: Z_L [Ω] at these frequencies.
            frequency: Real frequencies [Hz].
        """

    @abc.abstractmethod
    def sensitivity(self, load: Load, frequency: Quantity) -> Complex[AnyArray, "..."]:
        """∂ ln H / ∂ ln Z_L.

        Args:
            load: Z_L [Ω] at these frequencies.
            frequency: Real frequencies [Hz].
        """


class SourceImpedance(Module):
    """Order-n rational Z_th(s) in modal form.

    Z_th = R + Σ_k (g_k + h_k s/ω_k) / (1 + 2 ζ_k s/ω_k + (s/ω_k)²) + Σ_j g_j / (1 + s/ω_j)

    g, h [Ω] may have either sign. R [Ω], ω [rad/s] and ζ are positive and stored as logarithms:
    with R < 0 the driver could not be loaded with a capacitor. ζ > 1 is a pair of real poles. Order
    n has ⌊(n−1)/2⌋ sections, because a transformer always has one slow real pole: its magnetising
    inductance.

    Where no order explains the calibrations, Z_th is this times e^δ: `departure`, a smooth function
    of frequency whose coefficients are further parameters. In time it has no effect.
    """

    log_resistance: Float[AnyArray, "*row"]
    log_omega: Float[AnyArray, "*row section"]
    log_zeta: Float[AnyArray, "*row section"]
    gain: Float[AnyArray, "*row section"]
    slope: Float[AnyArray, "*row section"]
    log_omega_real: Float[AnyArray, "*row real"]
    gain_real: Float[AnyArray, "*row real"]
    departure: Departure | None = dataclasses.field(default=None, kw_only=True)

    @property
    def order(self) -> int:
        """Number of poles."""
        return 2 * self.log_omega.shape[0] + self.log_omega_real.shape[0]

    def vector(self) -> Float[AnyArray, "*row parameter"]:
        """All parameters in field order, of one source or of several that are stacked."""
        names = [one.name for one in dataclasses.fields(self) if one.name != "departure"]
        first, *rest = untraced([getattr(self, name) for name in names])
        rest += [] if self.departure is None else [untraced(self.departure.coefficients)]
        return namespace(first, *rest).concatenate([first[..., None], *rest], -1)

    @property
    def modes(self) -> int:
        """Number of parameters of the modal form, which come first."""
        return 1 + modal.SECTION * self.log_omega.shape[-1] + 2 * self.log_omega_real.shape[-1]

    def of_vector(self, vector: Float[AnyArray, " parameter"]) -> "SourceImpedance":
        """A source of the same order with these parameters."""
        pairs, reals, delta = self.log_omega.shape[0], self.log_omega_real.shape[0], self.departure
        ends = np.cumsum([1, *[pairs] * modal.SECTION, reals, reals])
        first, *rest = (vector[a:b] for a, b in zip([0, *ends[:-1]], ends, strict=True))
        if delta is not None:
            delta = dataclasses.replace(delta, coefficients=vector[self.modes :])
        return SourceImpedance(first[0], *rest, departure=delta)

    @in_float64
    def response(self, frequency: Quantity) -> Complex[AnyArray, "..."]:
        """Impedance [Ω] at real frequencies [Hz], an array of NumPy unless JAX traces it."""
        of, at = self.vector(), untraced(frequency)
        at = namespace(of, at).asarray(at, float)
        return self.impedance(of, at.reshape(-1)).reshape(at.shape)

    def impedance(
        self, parameters: Float[AnyArray, "*row parameter"], frequency: Float[AnyArray, "*bin"]
    ) -> Complex[AnyArray, "..."]:
        """Impedance [Ω] with other parameters (*row *bin)."""
        wide = _wide(parameters[..., : self.modes], frequency)
        found = modal.impedance(wide, self.log_omega.shape[-1], frequency)
        if self.departure is None:
            return found
        return found * self.departure.factor(parameters[..., self.modes :], frequency)

    def with_slopes(
        self, frequency: Float[AnyArray, " frequency"]
    ) -> tuple[Complex[AnyArray, " frequency"], Complex[AnyArray, "parameter frequency"]]:
        """`response`, and its derivatives with respect to the parameters, in field order."""
        return self.slopes(self.vector(), untraced(frequency))

    def slopes(
        self, parameters: Float[AnyArray, "*row parameter"], frequency: Float[AnyArray, "*bin"]
    ) -> tuple[Complex[AnyArray, "..."], Complex[AnyArray, "..."]]:
        """`impedance`, and its derivatives with respect to the parameters (*row parameter *bin)."""
        wide, axis = _wide(parameters[..., : self.modes], frequency), -1 - frequency.ndim
        z, by_mode = modal.with_slopes(wide, self.log_omega.shape[-1], frequency)
        xp = namespace(z)
        by_mode = xp.moveaxis(by_mode, -2, axis)
        if self.departure is None:
            return z, by_mode
        by = self.departure.factor(parameters[..., self.modes :], frequency)
        z, by_mode = z * by, by_mode * xp.expand_dims(by, axis)
        of_delta = xp.expand_dims(z, axis) * self.departure.by_coefficient(frequency)
        return z, xp.concatenate([by_mode, of_delta], axis)

    @property
    def log_omegas(self) -> Int[np.ndarray, " pole"]:
        """Places of all ln ω among the parameters; Z_th depends on f/ω only."""
        pairs, reals = self.log_omega.shape[0], self.log_omega_real.shape[0]
        return np.r_[1 : 1 + pairs, 1 + 4 * pairs : 1 + 4 * pairs + reals]

    @property
    def gains(self) -> Int[np.ndarray, " gain"]:
        """Places of all impedances among the parameters; the others are logarithms."""
        pairs, reals = self.log_omega.shape[0], self.log_omega_real.shape[0]
        ends = 1 + modal.SECTION * pairs + reals
        return np.r_[1 + 2 * pairs : 1 + modal.SECTION * pairs, ends : ends + reals]

    def state_space(self) -> StateSpace:
        """Realisation from current [A] to voltage drop [V], one balanced 2x2 block per section."""
        xp = namespace(self.log_resistance, self.log_omega, self.gain)
        order, pairs = self.order, self.log_omega.shape[0]
        omega, zeta = xp.exp(self.log_omega), xp.exp(self.log_zeta)
        rate, zero = xp.exp(self.log_omega_real), xp.zeros(1, omega.dtype)
        # The elements of A, and where they are: several changes of a matrix of zeros are slower.
        values = xp.concatenate([zero, omega, -omega, -2 * zeta * omega, -rate])
        place, i, j = np.zeros((order, order), int), np.arange(pairs), np.arange(2 * pairs, order)
        place[2 * i, 2 * i + 1], place[2 * i + 1, 2 * i] = 1 + i, 1 + pairs + i
        place[2 * i + 1, 2 * i + 1], place[j, j] = 1 + 2 * pairs + i, 1 + pairs + j
        A = xp.take(values, place, mode="clip")
        none = xp.zeros_like(omega)
        B = xp.concatenate([xp.stack([none, omega], axis=1).reshape(-1), rate])
        C = xp.concatenate([xp.stack([self.gain, self.slope], axis=1).reshape(-1), self.gain_real])
        return StateSpace(A, B[:, None], C, xp.exp(self.log_resistance)[None])

    def connected(self, load: StateSpace) -> StateSpace:
        """The system V_th → V_out with a load, from current [A] to voltage [V], at the terminal."""
        return divider(self.state_space(), load)


def _wide(
    parameters: Float[AnyArray, "*row parameter"], frequency: Float[AnyArray, "*bin"]
) -> Float[AnyArray, "..."]:
    """Parameters with axes for all but the last axis of the frequencies."""
    return parameters[(..., *[None] * (frequency.ndim - 1), slice(None))]


class CurrentSource(Module):
    """The source of a measured current in continuous time: nothing but the load follows it.

    Attributes:
        parameters: Its parameters, none; they give a vector of parameters its precision.
    """

    parameters: Float[Array | np.ndarray, "0"] = dataclasses.field(
        default_factory=lambda: np.zeros(0)
    )

    def connected(self, load: StateSpace) -> StateSpace:
        """The system current → V_out: the impedance of the load."""
        return load


def loaded(
    source: SourceImpedance | CurrentSource,
    load: Rational | StateSpace,
    rate: float | Float[AnyArray, ""],
) -> StateSpace:
    """The system input → V_out with `load` at the terminal, in continuous time."""
    return source.connected(load if isinstance(load, StateSpace) else realise(load, rate))


class MeasuredCurrent(AbstractFeed):
    """The feed of recordings that measure the current through the load, H = Z_L.

    It has no unknowns and needs no calibration. An error of the scale of the current causes the
    same relative error in every impedance.
    """

    recorded: ClassVar[str] = "current"
    source: CurrentSource = dataclasses.field(default_factory=CurrentSource)
    result: RESULTS = dataclasses.field(default_factory=lambda: verdict("successful"))

    def gain(self, load: Load, frequency: Quantity) -> Complex[Array, "..."]:
        """H = Z_L [Ω]."""
        del frequency
        return jnp.asarray(load)

    def sensitivity(self, load: Load, frequency: Quantity) -> Complex[AnyArray, "..."]:
        """1: the voltage is proportional to the impedance."""
        del frequency
        return namespace(load).ones_like(load)

    @property
    def r_known(self) -> Float[AnyArray, ""]:
        """Resistor of the calibration [Ω]; there is none."""
        return jnp.array(jnp.nan)

    def later_cov(self) -> Float[Array, "0 0"]:
        """Covariance of the parameters of the source, of which there are none."""
        return jnp.zeros((0, 0))

    def _overview(self) -> Overview:
        return Overview("Measured current", [])


MEASURED_CURRENT = MeasuredCurrent()
