"""The gains of a load: each output per input, with its delay.

Another kind of data is another class of outputs, which may be anywhere: `Load.behind` takes it.

All parameters act on a frequency through Z_L, the phase factors of the delays, and W. The code
computes the derivatives with respect to these and applies the chain rule.

A gain g, a crosstalk κ and a capacitance C of the instrument change the outputs of a load,

    V_out / V_th = (1 + g) Z' / (Z' + Z_th) + κ,      Z' = Z_L ‖ C.
"""

import abc
from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from etid.circuits.circuit import AbstractCircuit, with_slopes
from etid.circuits.impedance import AbstractImpedance
from etid.estimators.element_prior import ElementPrior
from etid.estimators.maximum_likelihood.condensed import Slopes
from etid.estimators.maximum_likelihood.given_driver import GivenDriver
from etid.likelihood.source_prior import DELAY_WIDTH
from etid.signals.knots import Knots
from etid.signals.transfer import as_complex, delayed, frequency_variable, reciprocal

Current = Callable[[Complex[Array, " frequency"]], Complex[Array, " frequency"]]
"""Current per input of all that is connected to the source, from its impedance [Ω]."""


class AbstractOutputs(eqx.Module):
    """The outputs as functions of the impedance of the load.

    Attributes:
        count: Number of outputs. Each has a delay, and a gain that is tested. The first is V_out;
            the scales of the others are tested against the driver.
    """

    count: ClassVar[int]

    @abc.abstractmethod
    def __call__(
        self, z_load: Complex[Array, " frequency"], current: Current
    ) -> Complex[Array, "output frequency"]:
        """The outputs per input."""


class Voltage(AbstractOutputs):
    """V_out."""

    count: ClassVar[int] = 1

    def __call__(
        self, z_load: Complex[Array, " frequency"], current: Current
    ) -> Complex[Array, "1 frequency"]:
        """Z_L I."""
        return (z_load * current(z_load))[None, :]


class VoltageAndCurrent(AbstractOutputs):
    """V_out and the current through the load."""

    count: ClassVar[int] = 2

    def __call__(
        self, z_load: Complex[Array, " frequency"], current: Current
    ) -> Complex[Array, "2 frequency"]:
        """Z_L I and I."""
        i = current(z_load)
        return jnp.stack([z_load * i, i])


class Gains(eqx.Module):
    """The gains of a load, as functions of the parameters of a fit.

    The parameters `q` of the solver are the logarithms of the elements, the delay of each output
    [samples], and z unless z = z₀.

    Attributes:
        driver: Distribution of Z_th at the frequencies, or the measured current.
        circuit: Structure of the load.
        frequency: The frequencies [Hz]. They may differ from those of the driver by a small common
            factor.
        sample_rate: Sampling rate [Hz].
        prior: Prior of the elements; None without one.
        measured: The outputs.
    """

    driver: GivenDriver
    circuit: AbstractCircuit
    frequency: Float[Array, " frequency"]
    sample_rate: Float[Array, ""]
    prior: ElementPrior | None = None
    measured: AbstractOutputs = Voltage()

    @property
    def outputs(self) -> int:
        """Number of outputs."""
        return self.measured.count

    @property
    def elements(self) -> int:
        """Number of elements."""
        return len(self.circuit.names())

    @property
    def owned(self) -> int:
        """Number of own parameters: elements and delays."""
        return self.elements + self.outputs

    def split(
        self, q: Float[Array, "*row q"]
    ) -> tuple[Float[Array, "*row element"], Float[Array, "*row output"], Float[Array, "*row z"]]:
        """Logarithms of the elements, delays and z; or other numbers in the same order."""
        logs, delays, z = jnp.split(q, (self.elements, self.owned), axis=-1)
        return logs, delays, z if z.shape[-1] == self.driver.mean.size else self.driver.mean

    def centre(self, q: Float[Array, " q"]) -> Float[Array, " q"]:
        """Prior means of the parameters."""
        own = np.zeros(self.elements) if self.prior is None else self.prior.centre
        return jnp.concatenate([own, np.zeros(self.outputs), self.driver.mean])[: q.size]

    def widths(self, q: Float[Array, " q"]) -> Float[Array, " q"]:
        """Prior standard deviations of the parameters."""
        own = np.full(self.elements, np.inf) if self.prior is None else self.prior.width
        # How little the delays of V_out scatter tells nothing about those of the current.
        delays = self.driver.delay_width[None], np.full(self.outputs - 1, DELAY_WIDTH)
        return jnp.concatenate([own, *delays, np.ones(self.driver.mean.size)])[: q.size]

    def at(self, every: Knots) -> "Gains":
        """The same at the knots of the harmonics."""
        driver, frequency = self.driver.at_knots(every), every.at(self.frequency)
        return Gains(driver, self.circuit, frequency, self.sample_rate, self.prior, self.measured)

    def impedance(self, q: Float[Array, " q"]) -> AbstractImpedance:
        """The impedance of the load."""
        return self.circuit.with_log_values(self.split(q)[0]).impedance()

    def w(self, z: Float[Array, " z"]) -> Complex[Array, " frequency"]:
        """W − W₀."""
        off = jnp.log(self.frequency[0] / self.driver.frequency[0])
        return as_complex(off) * self.driver.w_slope + self.driver.w(z)[0]

    def undelayed(self, q: Float[Array, " q"]) -> Complex[Array, "output frequency"]:
        """The gains without their delays."""
        load = self.impedance(q)(frequency_variable(self.frequency))
        z = self.split(q)[2]
        return self._undelayed(load, self.w(z), self.faults(z))

    def faults(self, z: Float[Array, " z"]) -> Float[Array, "3"] | None:
        """Gain, crosstalk and capacitance; None if the instrument has no tolerances."""
        if self.driver.faults is None:
            return None
        fault, by_z = self.driver.faults
        return fault + z @ by_z

    def _undelayed(
        self,
        z_load: Complex[Array, " frequency"],
        w: Complex[Array, " frequency"],
        faults: Float[Array, "3"] | None,
    ) -> Complex[Array, "output frequency"]:
        def current(total: Complex[Array, " frequency"]) -> Complex[Array, " frequency"]:
            return self.driver.current(total, w)

        if faults is None:
            return self.measured(z_load, current)
        gain, crosstalk, capacitance = as_complex(faults)
        s = frequency_variable(self.frequency)
        outputs = self.measured(z_load * reciprocal(1 + s * capacitance * z_load), current)
        return outputs.at[0].set(outputs[0] * (1 + gain) + crosstalk)

    def __call__(self, q: Float[Array, " q"]) -> Complex[Array, "output frequency"]:
        """The gains."""
        return self.turned(q, self.undelayed(q), self.frequency)

    def turned(
        self,
        q: Float[Array, " q"],
        values: Complex[Array, "output _"],
        frequency: Float[Array, "_"],
    ) -> Complex[Array, "output _"]:
        """`values` · e^(−jωτ) of each output."""
        each = zip(values, self.split(q)[1], strict=True)
        return jnp.stack([delayed(of, frequency, late, self.sample_rate) for of, late in each])

    @jax.jit  # JAX remembers its trace
    def slopes(self, q: Float[Array, " q"]) -> Slopes:
        """The gains and their derivatives."""
        logs, _, z = self.split(q)
        s, w, faults = frequency_variable(self.frequency), self.w(z), self.faults(z)
        z_load, by_element = with_slopes(self.circuit, logs, self.frequency)
        one = jnp.ones_like(s)
        value, by_load = jax.jvp(lambda at: self._undelayed(at, w, faults), (z_load,), (one,))
        by_w = jax.jvp(lambda at: self._undelayed(z_load, at, faults), (w,), (one,))[1]
        value, by_load, by_w = (self.turned(q, of, self.frequency) for of in (value, by_load, by_w))
        alone = np.eye(self.outputs, dtype=complex)[:, :, None]
        rows = [
            by_element[:, None] * by_load[None],
            alone * ((-s * as_complex(1 / self.sample_rate))[None, :] * value)[None],
            self.driver.w(z)[1][:, None] * by_w[None],
        ]
        if faults is not None and self.driver.faults is not None:
            by_fault = jax.jacfwd(lambda at: self._undelayed(z_load, w, at))(faults)
            each = jnp.moveaxis(by_fault, -1, 0)
            by_fault = jnp.stack([self.turned(q, of, self.frequency) for of in each])
            rows[-1] = rows[-1] + jnp.tensordot(as_complex(self.driver.faults[1]), by_fault, 1)
        return Slopes(z_load, value, by_load, jnp.concatenate(rows))
