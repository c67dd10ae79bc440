"""The terms of one load that was recorded at several amplitudes, and their derivatives.

All records have the same elements and the same driver; each has its own trigger delay. The terms
are those of `etid.estimators.maximum_likelihood.terms`, but the load need not be linear:

    Y_k − V_k(X) e^(−jω_k τ),      V_k(X) = Z_L / (Z_L + Z_th) X_k for a linear load.

If the load has a resistor that depends on its current, harmonic balance gives V(X). The noise of X
is small, so that the linear gain at small currents weights it.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from etid.circuits.circuit import AbstractCircuit
from etid.circuits.current_dependent import Norton, Signals, current_dependent, port
from etid.estimators.maximum_likelihood.given_driver import AbstractGiven, GivenDriver, combined
from etid.estimators.maximum_likelihood.terms import variance
from etid.results.driver import HarmonicDriver
from etid.results.feed import MeasuredCurrent
from etid.signals.harmonics import Spectrum
from etid.signals.transfer import as_complex, frequency_variable, reciprocal, turns
from etid.solvers.harmonic_balance import steady_state, to_time

BEYOND = 2  # harmonics of the balance, as a multiple of those of the records
STILL = 1e-6  # of the pulse rate; stands for 0 Hz, where a series capacitor has no impedance
# A linear load would have an infinite I_0. The prior of its logarithm keeps it finite; its standard
# deviation is a factor of 150.
CURRENT_WIDTH = 5.0


class Amplitudes(eqx.Module):
    """Records of one load, stacked along a leading axis, with all data that their terms need.

    The unknowns of the solver are the logarithms of the elements, the delays, and z.

    Attributes:
        given: What is given of their feed at the harmonics.
        feed: Their feed, for other frequencies.
        circuit: Structure of the load and its typical values.
        spectra: The records.
        sample_rate: Their sampling rate [Hz].
    """

    given: AbstractGiven
    feed: HarmonicDriver | MeasuredCurrent
    circuit: AbstractCircuit
    spectra: Spectrum
    sample_rate: Float[Array, ""]

    @property
    def count(self) -> int:
        """Number of records."""
        return self.spectra.x.shape[0]

    @property
    def elements(self) -> int:
        """Number of elements."""
        return len(self.circuit.names())

    def split(
        self, q: Float[Array, " q"]
    ) -> tuple[Float[Array, " element"], Float[Array, " record"], Float[Array, " z"]]:
        """Logarithms of the elements, delays and z; z is its mean if `q` lacks it."""
        log_elements, late, z = jnp.split(q, (self.elements, self.elements + self.count))
        return log_elements, late, z if z.size else self.given.mean

    def start(self, log_elements: Float[Array, " element"]) -> Float[Array, " q"]:
        """Unknowns without delays and without z."""
        return jnp.concatenate([log_elements, jnp.zeros(self.count)])

    def priors(self, q: Float[Array, " q"]) -> Float[Array, " q"]:
        """Terms of the priors."""
        centre = jnp.concatenate([self.start(self.circuit.log_values()), self.given.mean])
        return (q - centre[: q.size]) / self.widths(q)

    def widths(self, q: Float[Array, " q"]) -> Float[Array, " q"]:
        """Prior standard deviations of the unknowns."""
        units = self.circuit.units().values()
        own = [CURRENT_WIDTH if unit == "ampere" else jnp.inf for unit in units]
        delays = jnp.broadcast_to(self.given.delay_width, (self.count,))
        rest = jnp.ones(q.size - self.elements - self.count)
        return jnp.concatenate([jnp.array(own), delays, rest])

    def w(
        self, z: Float[Array, " z"], frequency: Float[Array, " harmonic"]
    ) -> Complex[Array, " harmonic"]:
        """W − W₀ at the harmonics of a record."""
        off = jnp.log(frequency[0] / self.given.frequency[0])
        return as_complex(off) * self.given.w_slope + combined(z, self.given.slope)

    def gain(
        self, log_elements: Float[Array, " element"], z: Float[Array, " z"], spectrum: Spectrum
    ) -> Complex[Array, " harmonic"]:
        """Linear gain at small currents."""
        load = self.circuit.with_log_values(log_elements).response(spectrum.frequency)
        return self.given.gain(load, self.w(z, spectrum.frequency))

    def source(
        self, z: Float[Array, " z"], spectrum: Spectrum, frequency: Float[Array, " wide"]
    ) -> Norton:
        """The source of a record, at all frequencies of the balance."""
        known, room = spectrum.frequency.size, frequency.size - spectrum.frequency.size - 1
        x = jnp.pad(jnp.where(spectrum.selected, spectrum.x, 0.0), (1, room))
        if not isinstance(self.given, GivenDriver) or isinstance(self.feed, MeasuredCurrent):
            return Norton(x, jnp.zeros_like(x))
        near = self.given.z_th(self.w(z, spectrum.frequency))
        admittance = reciprocal(self.feed.response(frequency).at[1 : known + 1].set(near))
        return Norton(x * admittance, admittance)

    def loaded(
        self, log_elements: Float[Array, " element"], z: Float[Array, " z"], spectrum: Spectrum
    ) -> Complex[Array, " harmonic"]:
        """Fourier coefficients of V_out [V], without delay."""
        impedance = self.circuit.with_log_values(log_elements).impedance()
        if current_dependent(impedance) is None:
            return self.gain(log_elements, z, spectrum) * spectrum.x
        known = spectrum.frequency.size
        number = jnp.arange(BEYOND * known + 1.0).at[0].set(STILL)
        frequency = spectrum.frequency[0] * number
        source = self.source(z, spectrum, frequency)
        at = port(impedance, source, frequency_variable(frequency))
        r = as_complex(jnp.asarray(at.element.r))
        small = at.source.current * reciprocal(1 + at.source.admittance * r)
        size = jnp.max(jnp.abs(to_time(small, 2 * BEYOND * known)))
        slope = at.element.typical_slope(2 * size)
        signals = Signals(*steady_state(at.element.current, slope, *at.source))
        return at.outwards(signals).voltage[1 : known + 1]

    def predicted(
        self, q: Float[Array, " q"], late: Float[Array, ""], spectrum: Spectrum
    ) -> Complex[Array, " harmonic"]:
        """Fourier coefficients of V_out [V] of a record with this delay [samples]."""
        log_elements, _, z = self.split(q)
        f = spectrum.frequency
        delay = turns(-f[0] * late / self.sample_rate, f.size)
        return self.loaded(log_elements, z, spectrum) * delay

    def weight(self, q: Float[Array, " q"], spectrum: Spectrum) -> Complex[Array, " harmonic"]:
        """1/σ of both parts of a term; 0 where a harmonic is not used."""
        log_elements, _, z = self.split(q)
        expected = variance(spectrum, self.gain(log_elements, z, spectrum))
        return as_complex(jnp.where(spectrum.selected, jnp.sqrt(2 / expected), 0.0))

    def residual(
        self, q: Float[Array, " q"], late: Float[Array, ""], spectrum: Spectrum
    ) -> Complex[Array, " harmonic"]:
        """Terms of one record."""
        return (spectrum.y - self.predicted(q, late, spectrum)) * self.weight(q, spectrum)

    def terms(self, q: Float[Array, " q"]) -> Float[Array, "record part"]:
        """Terms of all records."""
        late = self.split(q)[1]
        return jax.lax.map(lambda of: _parts(self.residual(q, *of)), (late, self.spectra))

    def __call__(self, q: Float[Array, " q"]) -> Float[Array, " term"]:
        """All terms."""
        return jnp.concatenate([self.terms(q).ravel(), self.priors(q)])

    def slopes(
        self, q: Float[Array, " q"]
    ) -> tuple[Float[Array, "record part"], Float[Array, "record q part"]]:
        """Terms of each record, and their derivatives with respect to all unknowns."""
        first, last = self.elements, self.elements + self.count

        def one(of: tuple[Array, Array, Spectrum]) -> tuple[Array, Array]:
            number, late, spectrum = of

            def along(rest: Float[Array, " rest"]) -> tuple[Array, Array]:
                there = jnp.concatenate([rest[:first], q[first:last], rest[first:]])
                part = self.residual(there, late, spectrum)
                return part, part

            by_rest, part = jax.jacfwd(along, has_aux=True)(jnp.delete(q, slice(first, last)))
            turned = self.predicted(q, late, spectrum) * self.weight(q, spectrum)
            by_delay = turned * as_complex(2 * jnp.pi * spectrum.frequency / self.sample_rate) * 1j
            rows = jnp.zeros((self.count, by_delay.size), by_delay.dtype).at[number].set(by_delay)
            whole = jnp.concatenate([by_rest.T[:first], rows, by_rest.T[first:]])
            return _parts(part), _parts(whole)

        late = self.split(q)[1]
        return jax.lax.map(one, (jnp.arange(self.count), late, self.spectra))


def _parts(value: Complex[Array, "*row harmonic"]) -> Float[Array, "*row part"]:
    """Real and imaginary parts along the last axis."""
    return jnp.concatenate([value.real, value.imag], axis=-1)
