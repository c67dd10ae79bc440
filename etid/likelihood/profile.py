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

**A record that is not of whole periods** ends with other states than it begins with. At the bins of
its own transform it obeys (ibid., sections on arbitrary excitation)

    Y_m = G_m (X − V_m) + T_m + noise,

where V and T are linear in a few real numbers p and as smooth as the gains
(`etid.likelihood.transient`). p is at its minimum everywhere: the innovations are those of the rest
of the outputs, and the terms at the knots are also those of T_m, with p projected out,

    C (G − G₀, T − T₀) − t,    C_bᴴ C_b = Σ_k φ_b(k) [d̄ 1]ᵀ P₀ [d 1],    d = X̂ − V,    P₀ = 2 Σ⁻¹.
"""

import functools
import operator
from collections.abc import Sequence
from typing import Any, NamedTuple, cast

import numpy as np
from jaxtyping import Bool, Complex, Float, Inexact

from etid.likelihood.linear import inverse
from etid.precision import array_function, namespace
from etid.signals.harmonics import real_parts
from etid.signals.knots import Knots
from etid.signals.transfer import AnyArray, as_complex, power

NOTHING = 1e-12  # of an information; rounding leaves less where another output tells all of it


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


class States(NamedTuple):
    """What the states at the ends of records make of their outputs, for each unknown number p.

    Attributes:
        inputs: −V; zero for numbers beyond its axis.
        outputs: G · inputs + T.
        width: Prior standard deviation of each number.
    """

    inputs: Complex[AnyArray, "*row few output bin"]
    outputs: Complex[AnyArray, "*row term output bin"]
    width: Float[AnyArray, "*row term"]


class Profile(NamedTuple):
    """The likelihood of records at some gains.

    Attributes:
        gains: The gains.
        towards: Derivatives of the estimate of X with respect to the innovations.
        expected: Variances of the innovations.
        weight: 2/σ² of each innovation; 0 where a harmonic is not used.
        innovations: The innovations of Y − G x, or of Y − G (x − V) − T.
        x: X̂.
        states: p; None for whole periods.
        inputs: −V; None for whole periods.
        made: What the states make of the outputs, T − G V; None for whole periods.
        rest: ½ Σ (p/width)²; None for whole periods.
    """

    gains: Complex[AnyArray, "*row output bin"]
    towards: Complex[AnyArray, "*row output bin"]
    expected: Float[AnyArray, "*row output bin"]
    weight: Float[AnyArray, "*row output bin"]
    innovations: Complex[AnyArray, "*row output bin"]
    x: Complex[AnyArray, "*row bin"]
    states: Float[AnyArray, "*row term"] | None = None
    inputs: Complex[AnyArray, "*row output bin"] | None = None
    made: Complex[AnyArray, "*row output bin"] | None = None
    rest: Float[AnyArray, "*row"] | None = None

    @classmethod
    def of(
        cls,
        records: Records,
        gains: Complex[AnyArray, "*row output bin"],
        states: States | None = None,
    ) -> "Profile":
        """The records at these gains, with states at their ends if they are not whole periods."""
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
        found = cls(gains, towards, expected, weight, innovations, x)
        return found if states is None else found._without(states)

    def _without(self, states: States) -> "Profile":
        """The same with the states at their minimum."""
        xp, used = namespace(self.x), self.weight > 0
        scale = xp.where(used, xp.sqrt(xp.where(used, self.weight, 1.0)), 0.0)
        scale = as_complex(scale)
        made = self.whitened(states.outputs)
        rows = _flat(made * scale[..., None, :, :])
        left, told = self.innovations, 1 / states.width**2
        p = 0.0 * told
        inverted = inverse(rows @ rows.swapaxes(-1, -2) + told[..., None] * np.eye(told.shape[-1]))
        for _ in range(2):  # the second time for what rounding has left
            terms = _flat((left * scale)[..., None, :, :])
            pull = (terms @ rows.swapaxes(-1, -2))[..., 0, :] - told * p
            step = (pull[..., None, :] @ inverted)[..., 0, :]
            p, left = p + step, left - weighted_sum(step, made)
        x = self.x + (self.towards * (left - self.innovations)).sum(-2)
        inputs, made = (weighted_sum(p, of) for of in (states.inputs, states.outputs))
        rest = 0.5 * (told * p * p).sum(-1)
        of = {"inputs": inputs, "made": made, "rest": rest}
        return self._replace(innovations=left, x=x, states=p, **of)

    @property
    def driving(self) -> Complex[AnyArray, "*row output bin"]:
        """X̂ − V, which each gain multiplies."""
        x = self.x[..., None, :]
        return x if self.inputs is None else x + self.inputs

    @property
    def squares(self) -> Float[AnyArray, "*row output bin"]:
        """|innovation|² over its variance."""
        return power(self.innovations) / self.expected

    @property
    def objective(self) -> Float[AnyArray, "*row"]:
        """½ D."""
        found = 0.5 * (self.weight * power(self.innovations)).sum((-2, -1))
        return found if self.rest is None else found + self.rest

    @property
    def size(self) -> Float[AnyArray, "*row output bin"]:
        """Information about each gain, given the innovations before it."""
        return self.weight * power(self.driving)

    def whitened(self, change: Complex[AnyArray, "... output bin"]) -> AnyArray:
        """Innovations, not scaled, of a change of the outputs, or of several changes of a row."""
        found, x = [change[..., 0, :]], None
        for m in range(1, change.shape[-2]):
            towards, gain = self.towards[..., m - 1, :], self.gains[..., m, :]
            if change.ndim > self.gains.ndim:
                towards, gain = towards[..., None, :], gain[..., None, :]
            moved = towards * found[-1]
            x = moved if x is None else x + moved
            found.append(change[..., m, :] - gain * x)
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
        """P₀ = 2 Σ⁻¹: the lower triangle, row by row; its diagonal is real."""
        xp, count = namespace(self.x), self.gains.shape[-2]
        if count == 1:
            return [[self.weight[..., 0, :]]]
        columns = []
        for m in range(count):
            unit = np.eye(count)[m][:, None] + xp.zeros_like(self.gains)
            columns.append(self.weighted(self.whitened(unit)))
        return [[columns[j][..., i, :] for j in range(i)] + [columns[i][..., i, :].real]
                for i in range(count)]  # fmt: skip


def rrse(records: Records, profile: Profile) -> Float[AnyArray, "*row"]:
    """RRSE of the output that is predicted worst."""
    xp, predicted = namespace(profile.x), profile.gains * records.x[..., None, :]
    predicted = predicted if profile.made is None else predicted + profile.made
    missed = xp.where(records.used, power(predicted - records.y), 0.0)
    whole = xp.where(records.used, power(records.y), 0.0)
    return xp.sqrt(missed.sum(-1) / whole.sum(-1)).max(-1)


class Condensed(NamedTuple):
    """A likelihood as a function of the gains at the knots.

    Attributes:
        gains: G₀.
        root: C: the lower triangle, row by row.
        target: t.
        states: Rows of all real terms by the states; None for whole periods.
        information: Inverse of the information about the states; None in the same case.
        priors: Terms of the priors of the states, which follow the other real terms.
    """

    gains: Complex[AnyArray, "*row output knot"]
    root: list[list[AnyArray]]
    target: Complex[AnyArray, "*row output knot"]
    states: Float[AnyArray, "*row term part"] | None = None
    information: Float[AnyArray, "*row term term"] | None = None
    priors: Float[AnyArray, "*row term"] | None = None

    @classmethod
    def of(
        cls,
        profiles: Sequence[Profile],
        knots: Knots,
        states: States | None = None,
    ) -> "Condensed":
        """The likelihood near the gains of `profiles`, one for each input."""
        with_states, xp = states is not None, namespace(profiles[0].x)
        each = [_curvature(of, with_states) for of in profiles]
        lower = [[added([of[0][i][j] for of in each]) for j in range(i + 1)]
                 for i in range(len(each[0][0]))]  # fmt: skip
        score = [added([of[1][i] for of in each]) for i in range(len(lower))]
        real = [lower[i][i] for i in range(len(lower))]
        mixed = [lower[i][j] for i in range(len(lower)) for j in range(i)] + score
        parts = real + [one.real for one in mixed] + [one.imag for one in mixed]
        sums = knots.summed(xp.stack(parts, -2))
        of = [sums[..., n, :] for n in range(len(parts))]
        size, many = len(lower), len(mixed)
        mixed = [a + 1j * b for a, b in zip(of[size : size + many], of[size + many :],
                                            strict=True)]  # fmt: skip
        score = mixed[many - size :]
        p = [[mixed[i * (i - 1) // 2 + j] for j in range(i)] + [of[i]] for i in range(size)]
        root, target = _factored(p, score)
        found = cls(profiles[0].gains[..., knots.index], root, along_outputs(target))
        if states is None:
            return found
        told = (1 / states.width)[..., None] * np.eye(states.width.shape[-1])
        rows = xp.concatenate([found._rows(None, states.outputs[..., knots.index]), told], -1)
        priors = added([of.states for of in profiles]) / states.width
        return found._replace(
            states=rows, information=inverse(rows @ rows.swapaxes(-1, -2)), priors=priors
        )

    @array_function
    def rows(
        self,
        changes: Complex[AnyArray, "*row change output knot"],
        states: Complex[AnyArray, "*row change output knot"] | None = None,
    ) -> AnyArray:
        """Changes of the real terms by changes of the gains (*row change part).

        `states` are changes of what the states make of the outputs at the same time.
        """
        return self._beside_states(self._rows(changes, states))

    def _rows(
        self,
        changes: Complex[AnyArray, "*row change output knot"] | None,
        states: Complex[AnyArray, "*row change output knot"] | None,
    ) -> Float[AnyArray, "*row change term"]:
        count, found = self.gains.shape[-2], []
        for of in self.root:
            parts = [] if changes is None else _products(of[:count], changes)
            parts += [] if states is None else _products(of[count:], states)
            shape = changes if states is None else states
            found.append(added(parts) if parts else 0 * cast(Any, shape)[..., 0, :])
        whole = found[0] if len(found) == 1 else namespace(*found).concatenate(found, -1)
        return -real_parts(whole)

    def _beside_states(self, rows: Float[AnyArray, "*row change term"]) -> AnyArray:
        """The rows without what the states can do of them (*row change part)."""
        if self.states is None:
            return rows
        of, size = self.states, rows.shape[-1]
        made = rows @ of[..., :size].swapaxes(-1, -2) @ self.information @ of
        return namespace(rows).concatenate([rows - made[..., :size], -made[..., size:]], -1)

    def terms(
        self,
        gains: Complex[AnyArray, "*row output knot"],
        states: Complex[AnyArray, "*row output knot"] | None = None,
    ) -> Float[AnyArray, "*row part"]:
        """The real terms at gains near G₀, and where states make so much more of the outputs."""
        states = None if states is None else states[..., None, :, :]
        return self.rows((gains - self.gains)[..., None, :, :], states)[..., 0, :] + self.part

    @property
    def part(self) -> Float[AnyArray, "*row part"]:
        """The real terms at G₀."""
        terms = real_parts(self.target.reshape(*self.target.shape[:-2], -1))
        # The states are at their minimum, so that they can do nothing of these terms.
        return (
            terms if self.priors is None else namespace(terms).concatenate([terms, self.priors], -1)
        )

    def means(
        self,
        profiles: Sequence[Profile],
        knots: Knots,
        values: Float[AnyArray, "*row value output bin"],
    ) -> Float[AnyArray, "*row value part"]:
        """Means of values of the innovations for each real term, weighted by information."""
        xp, size = namespace(values), added([of.size for of in profiles])[..., None, :, :]
        if self.states is not None:
            of_states = added([of.weight for of in profiles])[..., None, :, :]
            size = xp.concatenate([size, of_states], -2)
            values = xp.concatenate([values, values], -2)
        sums = knots.summed(xp.concatenate([size, values * size], -3))
        whole, sums = sums[..., :1, :, :], sums[..., 1:, :, :]
        found = sums / xp.where(whole > 0, whole, 1.0)
        found = found.reshape(*found.shape[:-2], -1)
        rest = [] if self.priors is None else [xp.ones((*found.shape[:-1], self.priors.shape[-1]))]
        return xp.concatenate([found, found, *rest], -1)


def _curvature(of: Profile, with_states: bool) -> tuple[list[list[AnyArray]], list[AnyArray]]:
    """Information about the gains, and about what states make; its lower triangle; the score."""
    pull, of_outputs = of.pull, of.information()
    count, xp = len(of_outputs), namespace(of.x)
    d = [of.driving[..., min(m, of.driving.shape[-2] - 1), :] for m in range(count)]
    score = [xp.conj(d[m]) * pull[..., m, :] for m in range(count)]
    lower = [[xp.conj(d[i]) * of_outputs[i][j] * d[j] for j in range(i)]
             + [power(d[i]) * of_outputs[i][i]] for i in range(count)]  # fmt: skip
    if not with_states:
        return lower, score
    for i, row in enumerate(of_outputs):
        every = [*row, *(xp.conj(of_outputs[j][i]) for j in range(i + 1, count))]
        lower.append([one * d[j] for j, one in enumerate(every)] + row)
    return lower, score + [pull[..., m, :] for m in range(count)]


def _factored(
    p: list[list[AnyArray]], score: list[AnyArray]
) -> tuple[list[list[AnyArray]], list[AnyArray]]:
    """C and t: Cholesky's factors, the last output first."""
    xp, root, target = namespace(p[0][0]), [], []
    whole = [p[i][i] for i in range(len(p))]
    for i in reversed(range(len(p))):
        left = p[i][i]
        tells = left > NOTHING * whole[i]
        scale = xp.where(tells, 1 / xp.sqrt(xp.where(tells, left, 1.0)), 0.0)
        root.append([one * scale for one in p[i]])
        target.append(score[i] * scale)
        for a in range(i):
            p[a] = [one - xp.conj(root[-1][a]) * root[-1][b] for b, one in enumerate(p[a])]
            p[a][a] = p[a][a].real
            score[a] = score[a] - xp.conj(root[-1][a]) * target[-1]
    return root[::-1], target[::-1]


def _flat(
    changes: Complex[AnyArray, "*row change output bin"],
) -> Float[AnyArray, "*row change part"]:
    """Real and imaginary parts in any order, for sums of products."""
    *first, outputs, bins = changes.shape
    flat = changes.reshape(*first, outputs * bins)
    if isinstance(flat, np.ndarray):  # those of long records take as long to copy as to multiply
        return np.ascontiguousarray(flat, complex).view(float)
    return real_parts(flat)


def weighted_sum(
    sizes: Float[AnyArray, "*row change"], changes: Complex[AnyArray, "... output bin"]
) -> Complex[AnyArray, "*row output bin"]:
    """Σ of changes of the outputs of these sizes, the first of which they are."""
    few, (outputs, bins) = sizes[..., None, : changes.shape[-3]], changes.shape[-2:]
    if isinstance(changes, np.ndarray):
        found = (few @ _flat(changes)).view(complex)
    else:
        flat = changes.reshape(*changes.shape[:-2], outputs * bins)
        found = few @ flat.real + 1j * (few @ flat.imag)
    return found.reshape(*found.shape[:-2], outputs, bins)


def _products(
    factors: Sequence[AnyArray], changes: Complex[AnyArray, "*row change output knot"]
) -> list[AnyArray]:
    """Products of one row of C with changes of outputs."""
    return [one[..., None, :] * changes[..., m, :] for m, one in enumerate(factors)]


def added(values: Sequence[AnyArray]) -> AnyArray:
    """The sum of arrays, such as those of each input."""
    return functools.reduce(operator.add, values)


def along_outputs(
    each: Sequence[Inexact[AnyArray, "*row bin"]],
) -> Inexact[AnyArray, "*row output bin"]:
    """Values of each output along an axis of outputs; without a copy if there is one output."""
    return each[0][..., None, :] if len(each) == 1 else namespace(each[0]).stack(each, -2)
