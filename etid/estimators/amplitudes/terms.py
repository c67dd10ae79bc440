"""The terms of one load that was recorded at several amplitudes, and their derivatives.

All records have the same elements and the same driver; each has its own trigger delay. The terms
are those of `etid.likelihood.profile`, but the load need not be linear:

    Y_k − V_k(X) e^(−jω_k τ),      V_k(X) = Z_L / (Z_L + Z_th) X_k for a linear load.

If the load has a resistor that depends on its current, harmonic balance gives V(X).

**The anti-alias filter** H of a converter shapes both records. A linear load does not notice: H is
in X and in Y. A load that depends on its current does. It acts on what the filter has not changed
yet, so that Y = H V(X/H). Without H, C_p is up to 1 % wrong at 200 kHz, and 15 standard errors at
60 dB. The filter is not known. So its logarithm is a sum of those of usual filters H_m, with
unknown weights that all records share,

    Y_k − H_k V_k(X/H) e^(−jω_k τ),      log H = Σ_m s tanh(ε_m/s) log H_m,      ε_m ~ N(0, 1).

ε = 0 is a converter that changes nothing below half its sample rate. The ε are further z, which
change no Z_th (`etid.likelihood.source`). No weight exceeds s: a misfit of another cause would
raise X/H beyond all bounds.

The weights are constant: a fit gets the variances of the terms from earlier estimates. If they
followed the parameters, elements with a large gain would explain any residual by the noise of X,
because a saturated V(X) hardly changes with them. The terms are treated as independent, which the
last step corrects (`etid.estimators.amplitudes.last_step`).
"""

import dataclasses
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float

from etid.circuits.circuit import AbstractCircuit
from etid.circuits.current_dependent import Norton, Port, Signals, current_dependent, port
from etid.circuits.impedance import AbstractImpedance
from etid.estimators.element_prior import ElementPrior
from etid.likelihood.gains import Gains
from etid.likelihood.source import Source
from etid.precision import array_function
from etid.results.driver import HarmonicDriver
from etid.results.feed import MeasuredCurrent
from etid.signals.harmonics import Spectrum, real_parts
from etid.signals.transfer import as_complex, delayed, frequency_variable, power, reciprocal
from etid.solvers.harmonic_balance import steady_state, to_time

BEYOND = 2  # harmonics of the balance, as a multiple of those of the records
STILL = 1e-6  # of the pulse rate; stands for 0 Hz, where a series capacitor has no impedance
# Corners of usual anti-alias filters, Butterworth's of fourth order, relative to the sample rate.
CORNERS = (0.4, 0.3)
STRONGEST = 1.2  # s, so that either filter alone is possible


class Amplitudes(eqx.Module):
    """Records of one load, stacked along a leading axis, with all data that their terms need.

    The unknowns of the solver are the logarithms of the elements, the delays, and z.

    Attributes:
        given: What is given of their feed at the harmonics (`etid.likelihood.source`).
        feed: Their feed, for other frequencies.
        circuit: Structure of the load and its typical values.
        spectra: The records.
        sample_rate: Their sampling rate [Hz].
        prior: Prior of the elements; None without one.
        expected: Variances of the terms by the noise; None before the first estimate.
    """

    given: Source
    feed: HarmonicDriver | MeasuredCurrent
    circuit: AbstractCircuit
    spectra: Spectrum
    sample_rate: Float[Array, ""]
    prior: ElementPrior | None = None
    expected: Float[Array, "record harmonic"] | None = None

    def weighted(self, own: Float[Array, "record own"]) -> "Amplitudes":
        """The same with the variances at these unknowns, by the linear gain at small currents.

        That gain is right for most of a period: there is little current between the pulses.
        """

        def one(own: Float[Array, " own"], spectrum: Spectrum) -> Float[Array, " harmonic"]:
            return self.variance(own, spectrum)

        return dataclasses.replace(self, expected=jax.vmap(one)(own, self.spectra))

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
        own = jnp.asarray(self.circuit.log_values())
        own = own if self.prior is None else self.prior.placed(own)
        centre = jnp.concatenate([self.start(own), self.given.mean])
        return (q - centre[: q.size]) / self.widths(q)

    def widths(self, q: Float[Array, " q"]) -> Float[Array, " q"]:
        """Prior standard deviations of the unknowns."""
        # A linear load has an infinite I_0. A prior of a factor of 150 keeps it finite.
        own = jnp.where(currents(self.circuit), 5.0, jnp.inf)
        own = own if self.prior is None else jnp.minimum(own, self.prior.width)
        delays = jnp.broadcast_to(self.given.delay_width, (self.count,))
        rest = jnp.ones(q.size - self.elements - self.count)
        return jnp.concatenate([own, delays, rest])

    def own(self, q: Float[Array, " q"]) -> Float[Array, "record own"]:
        """The unknowns of each record, in the order of `Gains`."""
        log_elements, late, z = self.split(q)

        def one(late: Float[Array, ""]) -> Float[Array, " own"]:
            return jnp.concatenate([log_elements, late[None], z])

        return jax.vmap(one)(late)

    def gain(self, spectrum: Spectrum) -> Gains:
        """Linear gain of a record at small currents."""
        return Gains(self.given, self.circuit, spectrum.frequency, self.sample_rate)

    @array_function
    def variance(self, own: Float[Array, " own"], spectrum: Spectrum) -> Float[Array, " harmonic"]:
        """Variances of the terms of a record, by the linear gain."""
        gain = self.gain(spectrum)(own)[0]
        return spectrum.variance_y + power(gain) * spectrum.variance_x

    def source(
        self, own: Float[Array, " own"], spectrum: Spectrum, frequency: Float[Array, " wide"]
    ) -> Norton:
        """The source of a record, at all frequencies of the balance."""
        known, room = spectrum.frequency.size, frequency.size - spectrum.frequency.size - 1
        # Harmonics that are not fitted are a part of the stimulus too.
        x = jnp.pad(spectrum.x, (1, room))
        if isinstance(self.feed, MeasuredCurrent):
            return Norton(x, jnp.zeros_like(x))
        gain = self.gain(spectrum)
        near = self.given.z_loaded(gain.w(gain.split(own)[2])) - as_complex(self.given.resistance)
        admittance = reciprocal(
            jnp.asarray(self.feed.response(frequency)).at[1 : known + 1].set(near)
        )
        return Norton(x * admittance, admittance)

    def port(self, own: Float[Array, " own"], spectrum: Spectrum) -> tuple[Port, Float[Array, ""]]:
        """The source of the resistor that depends on its current, and its largest current [A].

        The current is that of the resistance at small currents.
        """
        known = spectrum.frequency.size
        number = jnp.arange(BEYOND * known + 1.0).at[0].set(STILL)
        frequency = spectrum.frequency[0] * number
        source = self.source(own, spectrum, frequency)
        impedance = self.load(own)
        at = port(impedance, source, frequency_variable(frequency))
        r = as_complex(jnp.asarray(at.element.r))
        small = at.source.current * reciprocal(1 + at.source.admittance * r)
        return at, jnp.max(jnp.abs(to_time(small, 2 * BEYOND * known)))

    def load(self, own: Float[Array, " own"]) -> AbstractImpedance:
        """The impedance of the load."""
        return self.circuit.with_log_values(own[: self.elements]).impedance()

    @array_function
    def loaded(self, own: Float[Array, " own"], spectrum: Spectrum) -> Complex[Array, " harmonic"]:
        """Fourier coefficients of V_out [V], without delay."""
        if current_dependent(self.load(own)) is None:
            return self.gain(spectrum).undelayed(own)[0] * spectrum.x
        at, size = self.port(own, spectrum)
        slope = at.element.typical_slope(2 * size)
        signals = Signals(*steady_state(at.element.current, slope, *at.source))
        return at.outwards(signals).voltage[1 : spectrum.frequency.size + 1]

    def turned(
        self,
        own: Float[Array, " own"],
        values: Complex[Array, " harmonic"],
        spectrum: Spectrum,
    ) -> Complex[Array, " harmonic"]:
        """`values` with the delay of a record."""
        return delayed(values, spectrum.frequency, own[self.elements], self.sample_rate)

    def predicted(
        self, own: Float[Array, " own"], spectrum: Spectrum
    ) -> Complex[Array, " harmonic"]:
        """Fourier coefficients of V_out [V] of a record."""
        _, _, z = self.gain(spectrum).split(own)
        logs = _log_filters(spectrum.frequency / self.sample_rate)
        strength = STRONGEST * jnp.tanh(z[-logs.shape[0] :] / STRONGEST)
        passed = jnp.exp(as_complex(strength) @ logs)
        before = dataclasses.replace(spectrum, x=spectrum.x * reciprocal(passed))
        return self.turned(own, passed * self.loaded(own, before), spectrum)

    @property
    def weight(self) -> Float[Array, "record harmonic"]:
        """1/σ of both parts of each term; 0 where a harmonic is not used."""
        assert self.expected is not None
        return jnp.where(self.spectra.selected, jnp.sqrt(2 / self.expected), 0.0)

    def terms(self, q: Float[Array, " q"]) -> Float[Array, "record part"]:
        """Terms of all records."""
        return self.scaled(jax.lax.map(lambda of: self.predicted(*of), (self.own(q), self.spectra)))

    def scaled(self, predicted: Complex[Array, "record harmonic"]) -> Float[Array, "record part"]:
        """The same, from predictions that are known already."""
        return real_parts((self.spectra.y - predicted) * as_complex(self.weight))

    def __call__(self, q: Float[Array, " q"]) -> Float[Array, " term"]:
        """All terms."""
        return jnp.concatenate([self.terms(q).ravel(), self.priors(q)])

    def slopes(
        self, q: Float[Array, " q"]
    ) -> tuple[Complex[Array, "record harmonic"], Complex[Array, "record q harmonic"]]:
        """Predictions, and their derivatives with respect to all unknowns."""
        first, last = self.elements, self.elements + self.count
        others = jnp.delete(q, slice(first, last))  # all but the delays

        def one(of: tuple[Array, Spectrum]) -> tuple[Array, Array]:
            number, spectrum = of

            def along(others: Float[Array, " other"]) -> tuple[Array, Array]:
                there = jnp.concatenate([others[:first], q[first:last], others[first:]])
                value = self.predicted(self.own(there)[number], spectrum)
                return value, value

            by_other, value = jax.jacfwd(along, has_aux=True)(others)
            s = frequency_variable(spectrum.frequency)
            by_delay = -value * s * as_complex(1 / self.sample_rate)
            rows = jnp.zeros((self.count, by_delay.size), by_delay.dtype).at[number].set(by_delay)
            return value, jnp.concatenate([by_other.T[:first], rows, by_other.T[first:]])

        return jax.lax.map(one, (jnp.arange(self.count), self.spectra))


def with_filter(given: Source) -> Source:
    """The same with the weights ε of the anti-alias filters as the last z."""
    of, more = given.tolerances, len(CORNERS)
    if of is not None:
        of = of._replace(
            faults_by_z=jnp.pad(of.faults_by_z, ((0, more), (0, 0))),
            bending_by_z=jnp.pad(of.bending_by_z, (0, more)),
        )
    return given._replace(
        by_z=jnp.pad(given.by_z, ((0, more), (0, 0))),
        mean=jnp.pad(given.mean, (0, more)),
        cov=jax.scipy.linalg.block_diag(given.cov, jnp.eye(more)),
        tolerances=of,
        errors=None,
    )


def _log_filters(position: Float[Array, " harmonic"]) -> Complex[Array, "corner harmonic"]:
    """Logarithms of the filters H at frequencies relative to the sample rate."""
    u = position[None, :] / jnp.asarray(CORNERS)[:, None]
    pairs = [
        jnp.log(jax.lax.complex(1 - u * u, 2 * math.sin(math.pi * odd / 8) * u)) for odd in (1, 3)
    ]
    return -pairs[0] - pairs[1]


def currents(circuit: AbstractCircuit) -> Bool[np.ndarray, " element"]:
    """Which elements of a circuit are currents."""
    return np.array([unit == "ampere" for unit in circuit.units().values()])
