"""The likelihood of records of one unknown input at given gains, and condensed to a few knots.

At every harmonic each output Y_m is a gain times the input X, and all records have noise,

    Y_m = G_m X + noise,      x = X + noise.

With X at its maximum-likelihood estimate X̂, −2 ln likelihood is a quadratic form of e = Y − G x
(Pintelon and Schoukens, System Identification, 2012, ch. 9),

    D = 2 eᴴ Σ⁻¹ e,      Σ = diag(σ_y²) + σ_x² G Gᴴ,      X̂ = x + σ_x² Gᴴ Σ⁻¹ e,

    ρ_m = 2 conj(X̂) (Σ⁻¹ e)_m,      P = 2 |X̂|² Σ⁻¹.

ρ is −½ ∂D/∂ conj(G) times 2, and P is the information about the gains. The *innovations* of e are
independent: each is what an output shows beyond x and the outputs before it.

Gains are smooth in frequency, records are not. Near gains G₀ the likelihood is therefore known from
sums at the knots (`etid.signals.knots`),

    ½ D ≈ ½ Σ_b |C_b (G(f_b) − G₀(f_b)) − t_b|² + constant,

    C_bᴴ C_b = Σ_k φ_b(k) P_k,      C_bᴴ t_b = Σ_k φ_b(k) ρ_k.

C is lower triangular, like the innovations. The terms are a residual for any solver, at a few per
cent of the cost of all harmonics.
"""

import functools
import operator
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float, Inexact

from etid.precision import array_function, namespace
from etid.signals.harmonics import real_parts
from etid.signals.knots import Knots
from etid.signals.transfer import AnyArray, as_complex, power


class Records(NamedTuple):
    """An input and its outputs at the harmonics.

    Attributes:
        frequency: The harmonics [Hz].
        x: Coefficients of the input.
        variance_x: E|noise|² of each of them.
        y: Coefficients of the outputs.
        variance_y: E|noise|² of each of them.
        used: Harmonics of each output that are used.
    """

    frequency: Float[AnyArray, "*row bin"]
    x: Complex[AnyArray, "*row bin"]
    variance_x: Float[AnyArray, "*row bin"]
    y: Complex[AnyArray, "*row output bin"]
    variance_y: Float[AnyArray, "*row output bin"]
    used: Bool[AnyArray, "*row output bin"]

    def of(self, rows: np.ndarray) -> "Records":
        """The records of some of the rows."""
        return Records(*(each[rows] for each in self))

    @property
    def terms(self) -> Float[AnyArray, "*row"]:
        """Number of real terms."""
        return 2.0 * self.used.sum((-2, -1))


class Profile(NamedTuple):
    """The likelihood of records at some gains.

    Attributes:
        gains: The gains.
        towards: Derivatives of the estimate of X with respect to the innovations.
        expected: Variances of the innovations.
        weight: 2/σ² of each innovation; 0 where a harmonic is not used.
        innovations: The innovations of Y − G x.
        x: X̂.
    """

    gains: Complex[AnyArray, "*row output bin"]
    towards: Complex[AnyArray, "*row output bin"]
    expected: Float[AnyArray, "*row output bin"]
    weight: Float[AnyArray, "*row output bin"]
    innovations: Complex[AnyArray, "*row output bin"]
    x: Complex[AnyArray, "*row bin"]

    @classmethod
    def of(cls, records: Records, gains: Complex[AnyArray, "*row output bin"]) -> "Profile":
        """The records at these gains."""
        xp = namespace(gains)
        left, x = records.variance_x, records.x
        towards, expected, innovations = [], [], []
        for m in range(gains.shape[-2]):
            g, of_y, used = gains[..., m, :], records.variance_y[..., m, :], records.used[..., m, :]
            total = of_y + power(g) * left
            share = xp.where(used, left / total, 0.0)
            expected.append(total)
            towards.append(xp.conj(g) * as_complex(share))
            innovations.append(records.y[..., m, :] - g * x)
            x = x + towards[-1] * innovations[-1]
            left = xp.where(used, share * of_y, left)
        towards, expected, innovations = map(along_outputs, (towards, expected, innovations))
        weight = xp.where(records.used, 2 / expected, 0.0)
        return cls(gains, towards, expected, weight, innovations, x)

    @property
    def squares(self) -> Float[AnyArray, "*row output bin"]:
        """|innovation|² over its variance."""
        return power(self.innovations) / self.expected

    @property
    def objective(self) -> Float[AnyArray, "*row"]:
        """½ D."""
        return 0.5 * (self.weight * power(self.innovations)).sum((-2, -1))

    @property
    def size(self) -> Float[AnyArray, "*row output bin"]:
        """Information about each gain, given the innovations before it."""
        return self.weight * power(self.x)[..., None, :]

    def whitened(
        self, change: Complex[AnyArray, "*row output bin"]
    ) -> Complex[AnyArray, "*row output bin"]:
        """Innovations, not scaled, of a change of the outputs."""
        found, x = [change[..., 0, :]], None
        for m in range(1, change.shape[-2]):
            moved = self.towards[..., m - 1, :] * found[-1]
            x = moved if x is None else x + moved
            found.append(change[..., m, :] - self.gains[..., m, :] * x)
        return along_outputs(found)

    def weighted(
        self, innovations: Complex[AnyArray, "*row output bin"]
    ) -> Complex[AnyArray, "*row output bin"]:
        """2 Σ⁻¹ times a change of the outputs, from its innovations."""
        xp, last = namespace(innovations), innovations.shape[-2] - 1
        scaled = innovations * as_complex(self.weight)
        found, back = [scaled[..., last, :]], None
        for m in reversed(range(last)):
            moved = xp.conj(self.gains[..., m + 1, :]) * found[-1]
            back = -moved if back is None else back - moved
            found.append(scaled[..., m, :] + xp.conj(self.towards[..., m, :]) * back)
        return along_outputs(found[::-1])

    @property
    def pull(self) -> Complex[AnyArray, "*row output bin"]:
        """2 Σ⁻¹ (Y − G x)."""
        return self.weighted(self.innovations)

    def information(self) -> list[list[Inexact[AnyArray, "*row bin"]]]:
        """P: the lower triangle, row by row; its diagonal is real."""
        xp, count = namespace(self.x), self.gains.shape[-2]
        squares = power(self.x)
        if count == 1:
            return [[self.weight[..., 0, :] * squares]]
        columns = []
        for m in range(count):
            unit = np.eye(count)[m][:, None] + xp.zeros_like(self.gains)
            columns.append(self.weighted(self.whitened(unit)) * squares[..., None, :])
        return [[columns[j][..., i, :] for j in range(i)] + [columns[i][..., i, :].real]
                for i in range(count)]  # fmt: skip


def rrse(records: Records, gains: Complex[AnyArray, "*row output bin"]) -> Float[AnyArray, "*row"]:
    """RRSE of the output that is predicted worst."""
    xp = namespace(gains)
    missed = xp.where(records.used, power(gains * records.x[..., None, :] - records.y), 0.0)
    whole = xp.where(records.used, power(records.y), 0.0)
    return xp.sqrt(missed.sum(-1) / whole.sum(-1)).max(-1)


class Condensed(NamedTuple):
    """A likelihood as a function of the gains at the knots.

    Attributes:
        gains: G₀.
        root: C: the lower triangle, row by row.
        target: t.
    """

    gains: Complex[AnyArray, "*row output knot"]
    root: list[list[AnyArray]]
    target: Complex[AnyArray, "*row output knot"]

    @classmethod
    def of(cls, profiles: Sequence[Profile], knots: Knots) -> "Condensed":
        """The likelihood near the gains of `profiles`, one for each input."""
        xp, count = namespace(profiles[0].x), profiles[0].gains.shape[-2]
        score = added([xp.conj(of.x)[..., None, :] * of.pull for of in profiles])
        each = [of.information() for of in profiles]
        lower = [[added([of[i][j] for of in each]) for j in range(i + 1)] for i in range(count)]
        real = [lower[i][i] for i in range(count)]
        mixed = [lower[i][j] for i in range(count) for j in range(i)]
        mixed += [score[..., m, :] for m in range(count)]
        parts = real + [one.real for one in mixed] + [one.imag for one in mixed]
        sums = knots.summed(xp.stack(parts, -2))
        of = [sums[..., n, :] for n in range(len(parts))]
        many = len(mixed)
        mixed = [a + 1j * b for a, b in zip(of[count : count + many], of[count + many :],
                                            strict=True)]  # fmt: skip
        score = mixed[many - count :]
        p = [[mixed[i * (i - 1) // 2 + j] for j in range(i)] + [of[i]] for i in range(count)]
        root, target = [], []
        for i in reversed(range(count)):  # Cholesky's factors, the last output first
            left = p[i][i]
            scale = xp.where(left > 0, 1 / xp.sqrt(xp.where(left > 0, left, 1.0)), 0.0)
            root.append([one * scale for one in p[i]])
            target.append(score[i] * scale)
            for a in range(i):
                p[a] = [one - xp.conj(root[-1][a]) * root[-1][b] for b, one in enumerate(p[a])]
                p[a][a] = p[a][a].real
                score[a] = score[a] - xp.conj(root[-1][a]) * target[-1]
        gains = profiles[0].gains[..., knots.index]
        return cls(gains, root[::-1], along_outputs(target[::-1]))

    @array_function
    def rows(self, changes: Complex[AnyArray, "*row change output knot"]) -> AnyArray:
        """Changes of the real terms by changes of the gains (*row change part)."""
        found = []
        for of in self.root:
            found.append(
                added([one[..., None, :] * changes[..., j, :] for j, one in enumerate(of)])
            )
        whole = found[0] if len(found) == 1 else namespace(changes).concatenate(found, -1)
        return -real_parts(whole)

    def terms(self, gains: Complex[AnyArray, "*row output knot"]) -> Float[AnyArray, "*row part"]:
        """The real terms at gains near G₀."""
        return self.rows((gains - self.gains)[..., None, :, :])[..., 0, :] + self.part

    @property
    def part(self) -> Float[AnyArray, "*row part"]:
        """The real terms at G₀."""
        return real_parts(self.target.reshape(*self.target.shape[:-2], -1))

    def means(
        self,
        profiles: Sequence[Profile],
        knots: Knots,
        values: Float[AnyArray, "*row value output bin"],
    ) -> Float[AnyArray, "*row value part"]:
        """Means of values of the innovations for each real term, weighted by information."""
        xp, size = namespace(values), added([of.size for of in profiles])[..., None, :, :]
        sums = knots.summed(xp.concatenate([size, values * size], -3))
        whole, sums = sums[..., :1, :, :], sums[..., 1:, :, :]
        found = sums / xp.where(whole > 0, whole, 1.0)
        found = found.reshape(*found.shape[:-2], -1)
        return xp.concatenate([found, found], -1)


def added(values: Sequence[AnyArray]) -> AnyArray:
    """The sum of arrays, such as those of each input."""
    return functools.reduce(operator.add, values)


def along_outputs(
    each: Sequence[Inexact[AnyArray, "*row bin"]],
) -> Inexact[AnyArray, "*row output bin"]:
    """Values of each output along an axis of outputs; without a copy if there is one output."""
    return each[0][..., None, :] if len(each) == 1 else namespace(each[0]).stack(each, -2)
