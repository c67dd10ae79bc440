"""The likelihood of records of one unknown input, at given gains.

At every harmonic each output Y_m is a gain times the input X, and all records have noise,

    Y_m = G_m X + noise,      x = X + noise.

With X at its maximum-likelihood estimate X̂, −2 ln likelihood is a quadratic form of e = Y − G x
(Pintelon and Schoukens, System Identification, 2012, ch. 9),

    D = 2 eᴴ Σ⁻¹ e,      Σ = diag(σ_y²) + σ_x² G Gᴴ,      X̂ = x + σ_x² Gᴴ Σ⁻¹ e,

    ρ_m = 2 conj(X̂) (Σ⁻¹ e)_m,      P = 2 |X̂|² Σ⁻¹.

ρ is −½ ∂D/∂ conj(G) times 2, and P is the information about the gains. The *innovations* of e are
independent: each is what an output shows beyond x and the outputs before it. σ² are the variances
of one coefficient, at every harmonic.
"""

import functools
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float

from etid.likelihood.noise import HUM, LOW, SURE
from etid.results.fit import complex_rrse
from etid.signals.harmonics import Spectrum, local_sum, real_parts
from etid.signals.mains import lines
from etid.signals.transfer import as_complex, power


class Records(eqx.Module):
    """An input and its outputs at the harmonics.

    Attributes:
        frequency: The harmonics [Hz].
        x: Coefficients of the input.
        variance_x: E|noise|² of each of them.
        y: Coefficients of the outputs.
        variance_y: E|noise|² of each of them.
        selected: Harmonics of each output that are used.
    """

    frequency: Float[Array, " harmonic"]
    x: Complex[Array, " harmonic"]
    variance_x: Float[Array, " harmonic"]
    y: Complex[Array, "output harmonic"]
    variance_y: Float[Array, "output harmonic"]
    selected: Bool[Array, "output harmonic"]

    @classmethod
    def of(cls, spectrum: Spectrum, *others: tuple[Array, Array]) -> "Records":
        """V_th and V_out, and further outputs: their coefficients and variances."""
        each = [(spectrum.y, spectrum.variance_y), *others]
        y, variance_y = (jnp.stack(of) for of in zip(*each, strict=True))
        s, selected = spectrum, jnp.tile(spectrum.selected, (len(each), 1))
        return cls(s.frequency, s.x, s.variance_x, y, variance_y, selected)


class Profile(eqx.Module):
    """The likelihood of records at some gains.

    Attributes:
        gains: The gains.
        towards: Derivatives of the estimate of X with respect to the innovations.
        expected: Variances of the innovations.
        weight: 1/σ² of both parts of each innovation; 0 where a harmonic is not used.
        innovations: The innovations of Y − G x.
        x: X̂.
        variance_x: Variance of X̂.
    """

    gains: Complex[Array, "output harmonic"]
    towards: Complex[Array, "output harmonic"]
    expected: Float[Array, "output harmonic"]
    weight: Float[Array, "output harmonic"]
    innovations: Complex[Array, "output harmonic"]
    x: Complex[Array, " harmonic"]
    variance_x: Float[Array, " harmonic"]

    @classmethod
    def of(cls, records: Records, gains: Complex[Array, "output harmonic"]) -> "Profile":
        """The records at these gains."""
        left, x = records.variance_x, records.x
        towards, expected, innovations = [], [], []
        each = gains, records.y, records.variance_y, records.selected
        for g, y, of_y, selected in zip(*each, strict=True):
            total = of_y + power(g) * left
            share = jnp.where(selected, left / total, 0.0)
            expected.append(total)
            towards.append(jnp.conj(g) * as_complex(share))
            innovations.append(y - g * x)
            x = x + towards[-1] * innovations[-1]
            left = jnp.where(selected, share * of_y, left)
        weight = jnp.where(records.selected, 2 / jnp.stack(expected), 0.0)
        towards, innovations = jnp.stack(towards), jnp.stack(innovations)
        return cls(gains, towards, jnp.stack(expected), weight, innovations, x, left)

    @classmethod
    def of_output(cls, spectrum: Spectrum, gain: Complex[Array, " harmonic"]) -> "Profile":
        """One recording at the gain of its V_out."""
        return cls.of(Records.of(spectrum), gain[None])

    def whitened(
        self, change: Complex[Array, "output harmonic"]
    ) -> Complex[Array, "output harmonic"]:
        """Innovations, not scaled, of a change of the outputs."""
        x, found = jnp.zeros_like(self.x), []
        for of, g, towards in zip(change, self.gains, self.towards, strict=True):
            found.append(of - g * x)
            x = x + towards * found[-1]
        return jnp.stack(found)

    def weighted(
        self, innovations: Complex[Array, "output harmonic"]
    ) -> Complex[Array, "output harmonic"]:
        """2 Σ⁻¹ times a change of the outputs, from its innovations."""
        scaled = innovations * as_complex(self.weight)
        back, found = jnp.zeros_like(self.x), []
        each = list(zip(scaled, self.gains, self.towards, strict=True))
        for of, g, towards in reversed(each):
            found.append(of + jnp.conj(towards) * back)
            back = back - jnp.conj(g) * found[-1]
        return jnp.stack(found[::-1])

    @property
    def pull(self) -> Complex[Array, "output harmonic"]:
        """2 Σ⁻¹ (Y − G x)."""
        return self.weighted(self.innovations)

    @property
    def score(self) -> Complex[Array, "output harmonic"]:
        """ρ."""
        return jnp.conj(self.x)[None, :] * self.pull

    @property
    def information(self) -> Complex[Array, "output output harmonic"]:
        """P."""
        outputs, harmonics = self.gains.shape
        unit = np.eye(outputs, dtype=complex)[:, :, None]
        each = [jnp.broadcast_to(one, (outputs, harmonics)) for one in unit]
        columns = jnp.stack([self.weighted(self.whitened(one)) for one in each], axis=1)
        return columns * as_complex(power(self.x))[None, None, :]

    @property
    def size(self) -> Float[Array, "output harmonic"]:
        """Information of each innovation about its gain."""
        return self.weight * power(self.x)[None, :]

    @property
    def terms(self) -> Float[Array, "output part"]:
        """Innovations, scaled to unit variance; Σ of their squares is D."""
        # The root of the weight itself would have no derivative where a harmonic is not used.
        scale = jnp.where(self.weight > 0, jnp.sqrt(2 / self.expected), 0.0)
        return real_parts(self.innovations * as_complex(scale))

    @property
    def objective(self) -> Float[Array, ""]:
        """½ D."""
        return 0.5 * jnp.sum(self.weight * power(self.innovations))

    def by_x(
        self,
        records: Records,
        x: Complex[Array, "z harmonic"],
        log_variance: Float[Array, "z harmonic"],
    ) -> Float[Array, "z harmonic"]:
        """Derivatives of ½ D at each harmonic, from those of `x` and of ln `variance_x`."""
        towards = jnp.sum(jnp.conj(self.pull) * self.gains, axis=0)  # 2 conj(X̂ − x) / σ_x²
        moved = 0.25 * power(towards) * records.variance_x
        return -(towards[None, :] * x).real - moved[None, :] * log_variance

    def excess(self, records: Records) -> Float[Array, "output harmonic"]:
        """`excess` of the innovations of each output."""
        each = jax.vmap(excess)(self.terms, records.selected)
        return each[:, : self.x.size]

    def shows_hum(
        self, records: Records, without: Complex[Array, "output harmonic"] | None = None
    ) -> Bool[Array, ""]:
        """Whether the innovations of an output show mains hum, as `stands_out` has it.

        `without` is a part of the innovations that is no hum.
        """
        left = self.innovations if without is None else self.innovations - without
        squares = power(left) / self.expected
        each = zip(squares, records.selected, strict=True)
        return jnp.stack([stands_out(of, records.frequency, used) for of, used in each]).any()

    def rrse(self, records: Records, x: Complex[Array, " harmonic"]) -> Float[Array, ""]:
        """RRSE of the output that is predicted worst from this input."""
        each = zip(self.gains, records.y, records.selected, strict=True)
        return jnp.stack([complex_rrse(g * x, y, used) for g, y, used in each]).max()


def total(values: Sequence[Array]) -> Array:
    """Sum of arrays, such as those of the records of each input."""
    return functools.reduce(jnp.add, values)


def excess(
    part: Float[Array, " part"], selected: Bool[Array, " harmonic"]
) -> Float[Array, " part"]:
    """Variance of a residual around each harmonic, relative to the expected variance; at least 1.

    The weights assume white noise, but noise may be coloured, and no model is exact. The covariance
    (Jᵀ C J in place of Jᵀ J, White 1980) therefore uses the variance of the residual. It is the
    mean over `harmonics.WINDOW` harmonics where this surely exceeds the mean over all harmonics,
    and otherwise the mean over all.
    """
    count = selected.size
    power = part[:count] ** 2 + part[count:] ** 2
    of = jnp.where(selected, 2.0, 0.0)
    overall = jnp.maximum(jnp.sum(power) / jnp.maximum(jnp.sum(of), 1.0), 1.0)
    freedom = jnp.maximum(local_sum(of), 1.0)
    local = local_sum(power) / freedom
    sure = local > overall * (1 + SURE * jnp.sqrt(2 / freedom))
    return jnp.tile(jnp.where(sure, local, overall), 2)


def stands_out(
    squares: Float[Array, " harmonic"],
    frequency: Float[Array, " harmonic"],
    selected: Bool[Array, " harmonic"],
) -> Bool[Array, ""]:
    """Whether `squares` at the harmonics show mains hum; without hum their mean is 1."""
    squares, suspect = squares[:LOW], lines(frequency[:LOW])
    others = selected[:LOW] & ~suspect
    count = jnp.maximum(jnp.sum(others, dtype=squares.dtype), 1.0)
    around = jnp.sum(jnp.where(others, squares, 0.0)) / count
    return jnp.max(jnp.where(suspect, squares, 0.0)) > HUM * jnp.maximum(around, 1.0)
