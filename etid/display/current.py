"""The current through an electrode at each pulse: charge per phase and peak, from the elements.

With the symbols of `etid.display.tracker`, the current at frequency f is

    I(f) = X(f) / (Z_L(f) + Z_th(f)),

for a pulse of the amplitude of the unloaded record. Every number that is linear in the current is
therefore a sum over frequencies. The charge per phase is ∫ i dt between the two times t₀ and t₁ at
which the unloaded voltage crosses zero around its maximum; the current at a time t is such a sum as
well. The admittance between the centres of two bands is interpolated linearly, so that the sums run
over bands.

**Errors.** The tracker knows the gain G of the pulses better than the elements and Z_th apart. With
G fixed, I = X (1 − G) / Z_th: an error δ log Z_th of the calibration makes an error −I δ log Z_th
of the current. A circuit that is not exact, and a gain g and a crosstalk κ of the instrument,
change the measured G by δ G + g G + κ, and so the current by I (δ G + g G + κ) / (1 − G); a
capacitance C across the skin takes −I s C Z_L of it. The noise of the pulses adds
∂I/∂ϑ = −X Y² ∂Z_L/∂ϑ, with Y = 1/(Z_L + Z_th).

The unloaded record has the bandwidth of its converter. A spike at an edge that is shorter than two
samples is higher than its peak here.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from etid.circuits.circuit import AbstractCircuit
from etid.display.pulse_fit import GainModel, first_largest
from etid.precision import Module
from etid.signals.transfer import as_complex, frequency_variable, power, reciprocal

EDGE = 24  # [samples] after each edge that are looked at in steps of half a sample


class Current(Module):
    """Charge and peak current of a pulse, and their errors, per unit of relative amplitude.

    Attributes:
        charge: Charge per phase [C].
        charge_stderr: Its standard error [C].
        peak: Largest current of either sign [A].
        peak_stderr: Its standard error [A].
    """

    charge: Float[Array, "*lane"]
    charge_stderr: Float[Array, "*lane"]
    peak: Float[Array, "*lane"]
    peak_stderr: Float[Array, "*lane"]


class CurrentModel(Module):
    """Sums over bands that turn an admittance into charge and current.

    Attributes:
        frequency: Centres of the bands [Hz].
        source: Z_th in each band [Ω].
        source_error: Errors of log Z_th by the calibrations, as in `GainModel`.
        faults: Errors of the instrument, as in `GainModel`.
        discrepancy: Functions of δ, as in `GainModel`.
        sums: Weights w of the admittance in Re Σ w Y: row 0 for the charge [C Ω], the others for
            the current at times that are dense at the edges [A Ω].
        phase: Duration of a phase, t₁ − t₀ [s].
        rest: Upper bound of the charge of a pulse after a pause, relative to `Current.charge`.
    """

    frequency: Float[Array, " band"]
    source: Complex[Array, " band"]
    source_error: Complex[Array, "z band"]
    faults: Float[Array, "z 3"] | None
    discrepancy: Float[Array, "function band"] | None
    sums: Complex[Array, "row band"]
    phase: float = eqx.field(static=True)
    rest: float = eqx.field(static=True)

    @classmethod
    def of(cls, pulses: GainModel) -> "CurrentModel":
        """The currents of the pulses whose gains a tracker fits."""
        bands = pulses.bands
        x, rate = np.asarray(bands.x), bands.sample_rate
        number = np.arange(1.0, x.size + 1)
        v = bands.waveform()
        polarity = np.sign(v[np.argmax(np.abs(v))])
        begin, end = _phase(polarity * v)
        edges = [np.arange(-2.0, EDGE, 0.5) + edge for edge in (begin, end)]
        times = np.concatenate([edges[0], np.arange(begin + EDGE, end - 2, 8.0), edges[1]])
        omega = 2 * np.pi * number / bands.samples  # per sample
        integral = (np.exp(1j * omega * end) - np.exp(1j * omega * begin)) / (1j * omega * rate)
        integral *= polarity
        rows = np.concatenate([integral[None, :], np.exp(1j * np.outer(times, omega))])
        rows = 2 / bands.samples * rows * x
        # Linear interpolation from the centres of bands to bins; constant at the ends.
        centres = np.asarray(bands.frequency) * bands.samples / rate
        weights = [np.interp(number, centres, one) for one in np.eye(centres.size)]
        return cls(
            frequency=bands.frequency,
            source=pulses.source,
            source_error=pulses.source_error,
            discrepancy=pulses.discrepancy,
            faults=pulses.faults,
            sums=jnp.asarray(rows @ np.stack(weights, axis=1)),
            phase=float((end - begin) / rate),
            rest=float(bands.samples / (bands.samples - (end - begin))),
        )

    def short_circuit(self) -> Float[Array, " time"]:
        """Current through a short circuit at these times, per unit of relative amplitude [A]."""
        return _real(self.sums[1:], reciprocal(self.source))

    def short_charge(self, quantile: Float[Array, ""]) -> Float[Array, ""]:
        """Upper bound of the charge of a pulse through a short circuit, per unit of amplitude [C].

        Args:
            quantile: Standard errors by the calibrations that are added.
        """
        row = self.sums[:1] * reciprocal(self.source)[None, :]
        shift = _real(row, self.source_error.T)[0]
        stderr = jnp.sqrt(shift @ shift)
        return self.rest * (row.real.sum() + quantile * stderr)

    def current(
        self,
        circuit: AbstractCircuit,
        logs: Float[Array, " element"],
        cov: Float[Array, "element element"],
    ) -> Current:
        """Charge and peak current for one electrode.

        Args:
            circuit: Structure of the load.
            logs: Logarithms of its elements [SI].
            cov: Covariance of `logs` from the noise of the pulses.
        """

        def load(logs: Float[Array, " element"]) -> Complex[Array, " band"]:
            return circuit.with_log_values(logs).response(self.frequency)

        z, pulled = jax.vjp(load, logs)
        admittance = reciprocal(z + self.source)
        at = first_largest(jnp.abs(_real(self.sums[1:], admittance)))
        rows = jnp.stack([self.sums[0], self.sums[1 + at]])
        # The rows times Y, not the derivatives: all electrodes have the same `source_error`.
        rows = rows * admittance[None, :]
        charge, peak = rows.real.sum(axis=1)
        shared, ratio = _real(rows, self.source_error.T), z * reciprocal(self.source)
        if self.faults is not None:
            direct = jnp.stack([ratio, 1 + ratio, -frequency_variable(self.frequency) * z])
            shared = shared - _real(rows, direct.T) @ self.faults.T
        # Re Σ row Y² ∂Z/∂ϑ
        (own,) = jax.vmap(pulled)(rows * admittance[None, :])
        variance = jnp.sum((own @ cov) * own, axis=1)
        variance = variance + jnp.sum(shared**2, axis=1)
        if self.discrepancy is not None:
            by_delta = (rows * ratio[None, :]) @ as_complex(self.discrepancy.T)
            variance = variance + jnp.sum(power(by_delta), axis=1)
        charge_stderr, peak_stderr = jnp.sqrt(variance)
        return Current(charge, charge_stderr, jnp.abs(peak), peak_stderr)


def _real(weights: Complex[Array, "row band"], values: Complex[Array, "..."]) -> Array:
    """Re(weights @ values), at half the cost of a complex product."""
    return weights.real @ values.real - weights.imag @ values.imag


def _phase(v: Float[np.ndarray, " sample"]) -> tuple[float, float]:
    """Zero crossings around the maximum [samples]."""
    top = int(np.argmax(v))
    below = np.flatnonzero(v <= 0)
    before, after = below[below < top].max(), below[below > top].min()
    begin = before + v[before] / (v[before] - v[before + 1])
    return begin, after - v[after] / (v[after] - v[after - 1])
