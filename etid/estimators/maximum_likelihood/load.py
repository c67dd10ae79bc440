"""One load, given the calibrations of its driver: terms and derivatives.

The likelihood is that of `etid.estimators.maximum_likelihood.terms`, with the z of
`etid.estimators.maximum_likelihood.given_driver` as parameters of Z_th.

The objective and its gradient are sums over all harmonics. Curvature, covariance and score tests
need products of a record and derivatives of the gain. The derivatives are smooth in frequency, so
these products are summed at the knots of `etid.signals.knots`. With the noise of X removed,

    x̂ = X + conj(G) σ_x² (Y − G X) / σ²,      σ² = σ_y² + |G|² σ_x²,

the gradient of ½ Σ r² is −Re Σ_k conj(∂G_k) ρ_k with ρ = 2 conj(x̂) (Y − G X) / σ², and the
information is Re Σ_k conj(∂G_k) ∂G_k P_k with P = 2 |x̂|² / σ².
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from etid.circuits.circuit import AbstractCircuit
from etid.estimators.element_prior import ElementPrior
from etid.estimators.maximum_likelihood.gain import Gain, Slopes
from etid.estimators.maximum_likelihood.given_driver import AbstractGiven, UnloadedSlopes, combined
from etid.estimators.maximum_likelihood.terms import (
    apart,
    residual,
    variance,
)
from etid.estimators.score_tests import falling_resistance, other_circuit
from etid.signals.harmonics import Spectrum, real_parts
from etid.signals.knots import Knots, knots
from etid.signals.transfer import as_complex, frequency_variable, power, reciprocal, turns
from etid.solvers.levenberg_marquardt import NormalEquations


class Load(eqx.Module):
    """One recording, with all data that its terms need.

    Attributes:
        gain: The gain at all harmonics.
        spectrum: The recording.
        unloaded: How X depends on z; None if it does not.
    """

    gain: Gain
    spectrum: Spectrum
    unloaded: UnloadedSlopes | None

    @classmethod
    def behind(
        cls,
        driver: AbstractGiven,
        circuit: AbstractCircuit,
        spectrum: Spectrum,
        sample_rate: Float[Array, ""],
        prior: ElementPrior | None = None,
    ) -> "Load":
        """A recording that was made with `driver`, and a prior of the elements if there is one."""
        known, unloaded = driver.informed(spectrum)
        gain = Gain(driver, circuit, spectrum.frequency, sample_rate, prior)
        return cls(gain, known, unloaded)

    @property
    def knots(self) -> Knots:
        """Knots of the harmonics."""
        return knots(self.spectrum.frequency.size)

    def centre(self, q: Float[Array, " q"]) -> Float[Array, " q"]:
        """Prior means of the parameters."""
        return self.gain.centre(q)

    def widths(self, q: Float[Array, " q"]) -> Float[Array, " q"]:
        """Prior standard deviations of the parameters."""
        return self.gain.widths(q)

    def predicted(self, q: Float[Array, " q"]) -> tuple[Complex[Array, " harmonic"], Spectrum]:
        """Gain, and the recording with the X that the calibrations estimate."""
        z_load, turned, known = self._acting(q)
        return self.gain.driver.gain(z_load, self.gain.w(self.gain.split(q)[1])) * turned, known

    def _acting(
        self, q: Float[Array, " q"]
    ) -> tuple[Complex[Array, " harmonic"], Complex[Array, " harmonic"], Spectrum]:
        """Z_L, e^(−jωτ), and the recording with the X that the calibrations estimate."""
        own, z = self.gain.split(q)
        f = self.spectrum.frequency
        z_load = self.gain.impedance(q)(frequency_variable(f))
        turned = turns(-f[0] * own.delay_samples / self.gain.sample_rate, f.size)
        if self.unloaded is None:
            return z_load, turned, self.spectrum
        x = self.spectrum.x + combined(z, self.unloaded.x)
        variance = self.spectrum.variance_x * jnp.exp(z @ self.unloaded.log_variance)
        known = eqx.tree_at(lambda s: (s.x, s.variance_x), self.spectrum, (x, variance))
        return z_load, turned, known

    def __call__(self, q: Float[Array, " q"]) -> Float[Array, " term"]:
        """Terms of the recording, and the priors of its delay and of z."""
        prior = 1 / self.gain.widths(q)
        return jnp.concatenate([self.residual(q), prior * (q - self.gain.centre(q))])

    def residual(self, q: Float[Array, " q"]) -> Float[Array, " part"]:
        """Terms of the recording alone."""
        g, spectrum = apart(self.predicted, q)
        return residual(spectrum, g)

    def equations(self, q: Float[Array, " q"]) -> NormalEquations:
        """Normal equations of the recording alone; the matrix is its information."""
        return self.evaluated(q)[0]

    def evaluated(self, q: Float[Array, " q"]) -> "tuple[NormalEquations, Around]":
        """Normal equations of the recording alone, and the terms from which they are computed."""
        of = self.gain
        z_load, turned, known = apart(self._acting, q)
        acting = apart(lambda q: of.by_acting(q, z_load, turned), q)
        around = Around.of(self, q, (acting[0], known))
        gradient = of.pulled(q, -jnp.conj(around.score), acting)
        if self.unloaded is not None:
            by_x = self.by_unloaded((acting[0], known)).sum(-1)
            gradient = gradient + jnp.pad(by_x, (of.owned, 0))[: q.size]
        jacobian = around.jacobian
        return NormalEquations(around.objective, gradient, jacobian @ jacobian.T), around

    def at_knots(self, every: Knots) -> Gain:
        """The gain at knots."""
        of, frequency = self.gain, every.at(self.gain.frequency)
        return Gain(of.driver.at_knots(every), of.circuit, frequency, of.sample_rate, of.prior)

    def known(self, q: Float[Array, " q"]) -> Spectrum:
        """The recording with the X that the calibrations estimate."""
        return self.spectrum if self.unloaded is None else self._acting(q)[2]

    def by_unloaded(
        self, at: tuple[Complex[Array, " harmonic"], Spectrum]
    ) -> Float[Array, "z harmonic"]:
        """Derivatives of ½ r² at each harmonic with respect to the z that X depends on."""
        (g, known), slopes = at, self.unloaded
        if slopes is None:
            return jnp.zeros((self.gain.driver.mean.size, g.size))
        weight = jnp.where(known.selected, 1 / variance(known, g), 0.0)
        error = known.y - g * known.x
        by_x = as_complex(2 * weight) * jnp.conj(error) * g
        by_log = weight**2 * power(error) * power(g) * known.variance_x
        return -(by_x[None, :] * slopes.x).real - by_log[None, :] * slopes.log_variance


class Sums(eqx.Module):
    """What the fit of a recording needs around q₀, summed at the knots.

    Attributes:
        gain: The gain at q₀.
        score: ρ.
        power: P.
        by_z: Relative derivatives of X with respect to z; None if X does not depend on z.
        shift: Relative difference of X between z = 0 and q₀.
    """

    gain: Complex[Array, "*load knot"]
    score: Complex[Array, "*load knot"]
    power: Float[Array, "*load knot"]
    by_z: Complex[Array, "*load z knot"] | None
    shift: Complex[Array, "*load knot"] | None


class AtKnots(eqx.Module):
    """The terms of a recording near q₀; they are as good as those of `Load` for small steps.

    Attributes:
        gain: The gain at the knots.
        sums: The recording at the knots.
    """

    gain: Gain
    sums: Sums

    def rows(self, slopes: Complex[Array, "row knot"]) -> Float[Array, "row part"]:
        """Derivatives of the terms, from those of the gain."""
        rows = slopes * as_complex(jnp.sqrt(self.sums.power))[None, :]
        return -real_parts(rows)

    def by_unknown(self, slopes: Slopes) -> Complex[Array, "q knot"]:
        """Derivatives of G X/x̂ with respect to the parameters."""
        own, by_z = self.gain.owned, self.sums.by_z
        if by_z is None or slopes.by_unknown.shape[0] == own:
            return slopes.by_unknown
        of_x = jnp.pad(slopes.gain[None, :] * by_z, ((own, 0), (0, 0)))
        return slopes.by_unknown + of_x

    def residual(self, q: Float[Array, " q"]) -> Float[Array, " part"]:
        """Terms at `q`."""
        return self.rows(self._change(q, self.gain(q))[None, :])[0]

    def _change(
        self, q: Float[Array, " q"], gain: Complex[Array, " knot"]
    ) -> Complex[Array, " knot"]:
        """Change of G X/x̂ from the gain that would leave no residual."""
        of, z = self.sums, self.gain.split(q)[1]
        change = gain - of.gain
        if of.by_z is not None and of.shift is not None:
            change = change + gain * (of.shift + (combined(z, of.by_z) if z.size else 0.0))
        return change - of.score * as_complex(1 / jnp.where(of.power > 0, of.power, 1.0))

    def __call__(self, q: Float[Array, " q"]) -> Float[Array, " term"]:
        """Terms at `q` and the priors."""
        prior = 1 / self.gain.widths(q)
        return jnp.concatenate([self.residual(q), prior * (q - self.gain.centre(q))])

    def equations(self, q: Float[Array, " q"]) -> NormalEquations:
        """Normal equations of the recording alone."""
        slopes = apart(self.gain.slopes, q)
        change = self._change(q, slopes.gain)
        # One matrix product gives all sums.
        rows = self.rows(jnp.concatenate([self.by_unknown(slopes), change[None, :]]))
        products = rows @ rows.T
        return NormalEquations(0.5 * products[-1, -1], products[:-1, -1], products[:-1, :-1])


class Around(eqx.Module):
    """The terms at one point q, linear in the parameters, without the noise of X.

    Attributes:
        at: The terms at the knots.
        q: q.
        slopes: The gain and its derivatives at the knots.
        gain: The gain at all harmonics.
        x: x̂ at all harmonics.
        power: P at all harmonics.
        score: ρ at all harmonics.
        objective: ½ Σ r².
    """

    at: AtKnots
    q: Float[Array, " q"]
    slopes: Slopes
    gain: Complex[Array, " harmonic"]
    x: Complex[Array, " harmonic"]
    power: Float[Array, " harmonic"]
    score: Complex[Array, " harmonic"]
    objective: Float[Array, ""]

    @classmethod
    def of(
        cls,
        load: Load,
        q: Float[Array, " q"],
        at: tuple[Complex[Array, " harmonic"], Spectrum] | None = None,
        every: Knots | None = None,
    ) -> "Around":
        """The terms of `load` around `q`.

        Args:
            load: The recording.
            q: The point.
            at: `load.predicted(q)` if it is known already.
            every: The knots if they are not those of `load`.
        """
        g, known = apart(load.predicted, q) if at is None else at
        every = every or load.knots

        def of_harmonics(_) -> tuple[Array, Array, Array, Array]:
            weight = jnp.where(known.selected, 2 / variance(known, g), 0.0)
            error = known.y - g * known.x
            share = as_complex(0.5 * weight * known.variance_x)
            x = known.x + jnp.conj(g) * share * error
            score = as_complex(weight) * jnp.conj(x) * error
            return x, score, weight * power(x), 0.5 * jnp.dot(weight, power(error))

        x, score, size, objective = apart(of_harmonics, q)
        real, imaginary, total = every.summed(jnp.stack([score.real, score.imag, size]))
        gain = load.at_knots(every)
        by_z = shift = None
        if load.unloaded is not None:
            by_z = every.summed((as_complex(size) * reciprocal(x))[None, :] * load.unloaded.x)
            by_z = by_z * as_complex(1 / jnp.where(total > 0, total, 1.0))[None, :]
            shift = -combined(gain.split(q)[1], by_z)
        slopes = apart(gain.slopes, q)
        sums = Sums(slopes.gain, jax.lax.complex(real, imaginary), total, by_z, shift)
        return cls(AtKnots(gain, sums), q, slopes, g, x, size, score, objective)

    @property
    def jacobian(self) -> Float[Array, "q part"]:
        """Transposed Jacobian."""
        return self.at.rows(self.at.by_unknown(self.slopes))

    @property
    def part(self) -> Float[Array, " part"]:
        """The terms."""
        return self.at.residual(self.q)

    def mean(self, values: Float[Array, "row harmonic"]) -> Float[Array, "row part"]:
        """Means of `values` around the knots, weighted with P."""
        total = self.at.sums.power
        sums = knots(values.shape[1]).summed(values * self.power[None, :])
        return jnp.tile(sums / jnp.where(total > 0, total, 1.0)[None, :], (1, 2))

    def by_falling(self) -> Complex[Array, " harmonic"]:
        """What a resistance that falls with its current adds to V_out [V²]."""
        every, of = knots(self.x.size), self.at.gain
        z = of.impedance(self.q)(frequency_variable(of.frequency))
        sensitivity = self.slopes.by_load * z * reciprocal(self.slopes.gain)
        v_out = every.between(self.slopes.gain) * self.x
        return falling_resistance.added_voltage(v_out, z, sensitivity, every)

    def by_changes(self) -> Complex[Array, "change knot"]:
        """Derivatives of the gain with respect to changes of the circuit and, last, to a gain.

        The changes are those of `etid.estimators.score_tests.other_circuit`. The gain is that of
        V_out alone. If it is 1 % too large, R_p of dry skin is wrong by a quarter, and χ² shows
        this only at 60 dB.
        """
        of = self.at.gain
        _, changes = other_circuit.changes(of.impedance(self.q), of.frequency)
        return jnp.concatenate([changes * self.slopes.by_load[None, :], self.slopes.gain[None, :]])
