"""The gain of a load behind a driver whose Z_th is uncertain, and its derivatives.

All parameters act on a frequency through three numbers: Z_L, the phase factor of the delay, and W.
The code computes the derivatives with respect to these three and applies the chain rule.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from etid.circuits.circuit import AbstractCircuit
from etid.circuits.impedance import AbstractImpedance
from etid.estimators.element_prior import ElementPrior
from etid.estimators.maximum_likelihood.given_driver import AbstractGiven, combined
from etid.estimators.maximum_likelihood.terms import apart
from etid.estimators.unknowns import LoadUnknowns
from etid.signals.transfer import (
    as_complex,
    delayed,
    frequency_variable,
)


class Slopes(eqx.Module):
    """Derivatives of the gain at each frequency.

    Attributes:
        gain: The gain.
        by_load: Derivative with respect to Z_L.
        by_unknown: Derivatives with respect to the parameters.
    """

    gain: Complex[Array, " frequency"]
    by_load: Complex[Array, " frequency"]
    by_unknown: Complex[Array, "q frequency"]


class Gain(eqx.Module):
    """The gain of a load, as a function of the parameters of a fit.

    The parameters `q` of the solver are those of `LoadUnknowns`, followed by z unless z = z₀.

    Attributes:
        driver: Distribution of Z_th at the frequencies, or the measured current.
        circuit: Structure of the load.
        frequency: The frequencies [Hz]. They may differ from those of the driver by a small common
            factor.
        sample_rate: Sampling rate [Hz].
        prior: Prior of the elements; None without one.
    """

    driver: AbstractGiven
    circuit: AbstractCircuit
    frequency: Float[Array, " frequency"]
    sample_rate: Float[Array, ""]
    prior: ElementPrior | None = None

    @property
    def owned(self) -> int:
        """Number of own parameters."""
        return len(self.circuit.names()) + 1

    def split(self, q: Float[Array, "*row q"]) -> tuple[LoadUnknowns, Float[Array, "*row z"]]:
        """The unknowns of the load, and z; or other numbers in the same order."""
        own, mean = LoadUnknowns.of(q[..., : self.owned]), self.driver.mean
        return own, q[..., self.owned :] if q.shape[-1] == self.owned + mean.size else mean

    def centre(self, q: Float[Array, " q"]) -> Float[Array, " q"]:
        """Prior means of the parameters."""
        own = jnp.zeros(self.owned)
        if self.prior is not None:
            own = LoadUnknowns(self.prior.centre, jnp.zeros(())).vector()
        return jnp.concatenate([own, self.driver.mean])[: q.size]

    def widths(self, q: Float[Array, " q"]) -> Float[Array, " q"]:
        """Prior standard deviations of the parameters."""
        width = jnp.full(self.owned - 1, jnp.inf) if self.prior is None else self.prior.width
        own = LoadUnknowns(width, self.driver.delay_width).vector()
        return jnp.concatenate([own, jnp.ones(q.size - self.owned)])

    def impedance(self, q: Float[Array, " q"]) -> AbstractImpedance:
        """The impedance of the load."""
        return self.circuit.with_log_values(self.split(q)[0].log_elements).impedance()

    def w(self, z: Float[Array, " z"]) -> Complex[Array, " frequency"]:
        """W − W₀."""
        off = jnp.log(self.frequency[0] / self.driver.frequency[0])
        return as_complex(off) * self.driver.w_slope + combined(z, self.driver.slope)

    def undelayed(self, q: Float[Array, " q"]) -> Complex[Array, " frequency"]:
        """V_out per input, without the trigger delay."""
        load = self.impedance(q)(frequency_variable(self.frequency))
        return self.driver.gain(load, self.w(self.split(q)[1]))

    def __call__(self, q: Float[Array, " q"]) -> Complex[Array, " frequency"]:
        """The gain."""
        return self.turned(q, self.undelayed(q))

    def turned(
        self, q: Float[Array, " q"], values: Complex[Array, " frequency"]
    ) -> Complex[Array, " frequency"]:
        """`values` · e^(−jωτ)."""
        return delayed(values, self.frequency, self.split(q)[0].delay_samples, self.sample_rate)

    def slopes(self, q: Float[Array, " q"]) -> Slopes:
        """The gain and its derivatives."""
        own, _ = self.split(q)
        s = frequency_variable(self.frequency)

        def load(logs: Float[Array, " element"]) -> Complex[Array, " frequency"]:
            return self.circuit.with_log_values(logs).impedance()(s)

        def of_load(
            _,
        ) -> tuple[
            Complex[Array, " frequency"],
            Complex[Array, "element frequency"],
            Complex[Array, " frequency"],
        ]:
            logs = own.log_elements
            by_element = jax.vmap(lambda way: jax.jvp(load, (logs,), (way,))[1])
            return load(logs), by_element(jnp.eye(logs.size)), self.turned(q, jnp.ones_like(s))

        z_load, by_element, turned = apart(of_load, q)
        gain, by_load, by_w = apart(lambda q: self.by_acting(q, z_load, turned), q)
        by_delay = self._by_delay(gain)
        rows = [by_element * by_load[None, :], by_delay[None, :]]
        if q.size > self.owned:
            rows.append(self.driver.slope * by_w[None, :])
        return Slopes(gain, by_load, jnp.concatenate(rows))

    def by_acting(
        self,
        q: Float[Array, " q"],
        z_load: Complex[Array, " frequency"],
        turned: Complex[Array, " frequency"],
    ) -> tuple[Complex[Array, " frequency"], ...]:
        """The gain, and its derivatives with respect to Z_L and W, from Z_L and e^(−jωτ)."""
        w, gain, one = self.w(self.split(q)[1]), self.driver.gain, jnp.ones_like(z_load)
        value, by_load = jax.jvp(lambda at: gain(at, w), (z_load,), (one,))
        by_w = jax.jvp(lambda at: gain(z_load, at), (w,), (one,))[1]
        return value * turned, by_load * turned, by_w * turned

    def pulled(
        self,
        q: Float[Array, " q"],
        by_gain: Complex[Array, " frequency"],
        acting: tuple[Complex[Array, " frequency"], ...],
    ) -> Float[Array, " q"]:
        """Gradient of a real number with respect to the parameters.

        Args:
            q: The parameters.
            by_gain: Its derivative D with respect to the gain: its change is Σ Re (D ΔG).
            acting: `by_acting` at these parameters.
        """
        gain, by_load, by_w = acting
        own, s = self.split(q)[0], frequency_variable(self.frequency)

        def load(logs: Float[Array, " element"]) -> Complex[Array, " frequency"]:
            return self.circuit.with_log_values(logs).impedance()(s)

        (by_element,) = jax.vjp(load, own.log_elements)[1](by_gain * by_load)
        by_delay = jnp.sum((by_gain * self._by_delay(gain)).real)
        rows = [by_element, by_delay[None]]
        if q.size > self.owned:
            towards, slope = by_gain * by_w, self.driver.slope
            rows.append(slope.real @ towards.real - slope.imag @ towards.imag)
        return jnp.concatenate(rows)

    def _by_delay(self, gain: Complex[Array, " frequency"]) -> Complex[Array, " frequency"]:
        """Derivative of the gain with respect to the delay [samples]."""
        return -frequency_variable(self.frequency) * as_complex(1 / self.sample_rate) * gain
