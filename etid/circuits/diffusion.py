"""Elements of diffusion: semi-infinite, through layers, with a reaction, and in pores.

Formulas and parameters are those of impedance.py 1.7, so that fits of both agree.
"""

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float

from etid.circuits.elements import (
    FASTEST,
    Capacitance,
    ConstantPhase,
    Ohm,
    Second,
    beside,
    capacitor,
    ladder,
    resistor,
)
from etid.circuits.impedance import (
    AbstractElement,
    AbstractImpedance,
    AbstractIrrational,
    Netlist,
    Quantity,
    Series,
    Slopes,
    in_series,
    parallel,
    series,
)
from etid.precision import namespace
from etid.signals.filtering import StateSpace
from etid.signals.transfer import AnyArray, reciprocal

# Relaxations of a layer for each √(ωτ); the resistor of the others then misses 5e-5 of |Z|.
NEGLECTED = 5.2
EXACT, GROUP = 12, 0.7  # slow relaxations of a layer that are exact; of ln x for the others


class Warburg(AbstractIrrational):
    """Semi-infinite diffusion, Z = A (1 − j) / √ω = A √2 / √s, with A [Ω/√s].

    Source: E. Warburg, Ueber das Verhalten sogenannter unpolarisirbarer Elektroden gegen
    Wechselstrom, 1899. It is a constant-phase element of α = ½ and Q = 1 / (A √2).
    """

    symbol: ClassVar[str] = "W"
    a: Quantity

    def __call__(self, s: Complex[AnyArray, "..."]) -> Complex[AnyArray, "..."]:
        """Impedance [Ω]."""
        return beside(s, self.a) * beside(s, np.sqrt(2.0)) * reciprocal(_root(s))

    def slopes(self, s: Complex[AnyArray, "..."]) -> Slopes:
        """Impedance and its slope."""
        z = self(s)
        return z, [z]

    def exponents(self) -> tuple[Quantity, ...]:
        """Empty: its exponent is known."""
        return ()

    def state_space(self, rate: float | Float[AnyArray, ""], samples: int) -> StateSpace:
        """The ladder of the constant-phase element."""
        return self._constant_phase().state_space(rate, samples)

    def connect(self, netlist: Netlist, plus: str, minus: str) -> None:
        """Write the ladder of the constant-phase element."""
        self._constant_phase().connect(netlist, plus, minus)

    def _constant_phase(self) -> ConstantPhase:
        return ConstantPhase(1 / (np.sqrt(2.0) * self.a), 0.5)


class AbstractLayer(AbstractIrrational):
    """Diffusion through a layer, with relaxations from the Mittag-Leffler expansion.

    Attributes:
        sign: Z = R (1 − g) / ((1 + g) √(sτ)) with g = sign · e^(−2 √(sτ)).
        first: x_k = (first + k)² π², k = 0, 1, …, are the frequencies of the relaxations, times τ.
        total: Sum of their resistances 2 R / x_k, relative to R.
        least: s τ that stands for 0.
        r: R [Ω].
        tau: τ [s].
    """

    sign: ClassVar[float]
    first: ClassVar[float]
    total: ClassVar[float]
    least: ClassVar[float]
    r: Ohm
    tau: Second

    def __call__(self, s: Complex[AnyArray, "..."]) -> Complex[AnyArray, "..."]:
        """Impedance [Ω]."""
        root, gone = self._terms(s)
        one = beside(s, 1.0)
        return beside(s, self.r) * (one - gone) * reciprocal(root * (one + gone))

    def slopes(self, s: Complex[AnyArray, "..."]) -> Slopes:
        """Impedance, and its slopes Z and 2 R g / (1 + g)² − Z / 2."""
        root, gone = self._terms(s)
        one, r = beside(s, 1.0), beside(s, self.r)
        near = reciprocal(one + gone)
        z = r * (one - gone) * near * reciprocal(root)
        return z, [z, beside(s, 2.0) * r * gone * near * near - beside(s, 0.5) * z]

    def _terms(
        self, s: Complex[AnyArray, "..."]
    ) -> tuple[Complex[AnyArray, "..."], Complex[AnyArray, "..."]]:
        """√(sτ) and g; the real part of the root is positive."""
        xp, tau = namespace(s, self.tau), beside(s, self.tau)
        x = s * tau
        root = _root(xp.where(x == 0, xp.full_like(tau, self.least), x))
        return root, beside(s, self.sign) * xp.exp(beside(s, -2.0) * root)

    def exponents(self) -> tuple[Quantity, ...]:
        """Empty: no exponent of it can exceed that of a passive element."""
        return ()

    def state_space(self, rate: float | Float[AnyArray, ""], samples: int) -> StateSpace:
        """Its relaxations, for every τ up to the length of the record.

        Their states are scaled as in `ConstantPhase`. The slow ones are exact. Of the others, two
        stand for each `GROUP` of ln x.
        """
        x, weight = _relaxations(FASTEST * samples, self.first)
        xp = namespace(self.r, self.tau, rate)
        r, tau = xp.asarray(self.r), xp.asarray(self.tau)
        unit = r / (rate * xp.sqrt(rate * tau))  # |Z| at the sample rate, divided by it [Ω s]
        rises = r * (weight * x) / tau
        return StateSpace(
            xp.diag(-x / tau),
            xp.sqrt(rises / unit)[:, None],
            xp.sqrt(rises * unit),
            xp.asarray(r * (self.total - weight.sum()))[None],
        )

    def connect(self, netlist: Netlist, plus: str, minus: str) -> None:
        """Write its relaxations up to those that are far above the band, and the rest's sum."""
        high = netlist.band[1]
        netlist.remarks.add(f"diffusion as RC pairs, error below 0.01 % up to {high:g} Hz")
        self._ladder(2 * np.pi * high).connect(netlist, plus, minus)

    def _ladder(self, high: float) -> Series:
        """The network of the relaxations up to far above `high` [rad/s]."""
        r, tau = float(self.r), float(self.tau)
        x, share = _relaxations(high * tau, self.first)
        pairs = [parallel(resistor(r * part), capacitor(tau / (r * part * one)))
                 for one, part in zip(x, share, strict=True)]  # fmt: skip
        return series(resistor(r * (self.total - float(share.sum()))), *pairs)


class Diffusion(AbstractLayer):
    """Diffusion through a layer (finite-length Warburg), Z = R tanh √(sτ) / √(sτ).

    Its relaxations are, with the poles of the hyperbolic tangent (Mittag-Leffler),

        Z = Σ R_k / (1 + s τ / x_k),   R_k = 2 R / x_k,   x_k = (k − ½)² π²,   k = 1, 2, …
    """

    symbol: ClassVar[str] = "Ws"
    sign: ClassVar[float] = 1.0
    first: ClassVar[float] = 0.5
    total: ClassVar[float] = 1.0
    least: ClassVar[float] = 1e-10  # the limit is R


class FiniteSpace(AbstractLayer):
    """Diffusion into a layer with a closed end (finite space), Z = R coth √(sτ) / √(sτ).

    At low frequency it is a capacitor of C = τ/R in series with R/3. Its relaxations are

        Z = R / (s τ) + Σ R_k / (1 + s τ / x_k),   R_k = 2 R / x_k,   x_k = k² π²,   k = 1, 2, …
    """

    symbol: ClassVar[str] = "Wo"
    sign: ClassVar[float] = -1.0
    first: ClassVar[float] = 1.0
    total: ClassVar[float] = 1 / 3
    least: ClassVar[float] = 0.0

    def state_space(self, rate: float | Float[AnyArray, ""], samples: int) -> StateSpace:
        """Its relaxations and the capacitor."""
        slow = capacitor(self.tau / self.r).state_space(rate, samples)
        return in_series(super().state_space(rate, samples), slow)

    def _ladder(self, high: float) -> Series:
        """The network of the relaxations and the capacitor."""
        return series(*super()._ladder(high).parts, capacitor(self.tau / self.r))


class Gerischer(AbstractIrrational):
    """Diffusion with a reaction, Z = R / √(1 + sτ).

    Source: H. Gerischer, Wechselstrompolarisation von Elektroden mit einem potentialbestimmenden
    Schritt beim Gleichgewichtspotential, 1951; as written by Lu, Kreller and Adler, 2009, doi
    10.1149/1.3079337.
    """

    symbol: ClassVar[str] = "G"
    r: Ohm
    tau: Second

    def __call__(self, s: Complex[AnyArray, "..."]) -> Complex[AnyArray, "..."]:
        """Impedance [Ω]."""
        return beside(s, self.r) * reciprocal(_root(beside(s, 1.0) + s * beside(s, self.tau)))

    def slopes(self, s: Complex[AnyArray, "..."]) -> Slopes:
        """Impedance, and its slopes Z and −Z sτ / (2 (1 + sτ))."""
        x, z = s * beside(s, self.tau), self(s)
        return z, [z, beside(s, -0.5) * z * x * reciprocal(beside(s, 1.0) + x)]

    def exponents(self) -> tuple[Quantity, ...]:
        """Empty: its exponent is known."""
        return ()

    def connect(self, netlist: Netlist, plus: str, minus: str) -> None:
        """Write the ladder of R/√(sτ), each capacitor with a resistor that makes s + 1/τ of s."""
        r, tau, (low, high) = float(self.r), float(self.tau), netlist.band
        netlist.remarks.add(
            f"diffusion and reaction as RC pairs, error below 0.01 % from {low:g} Hz to {high:g} Hz"
        )

        def leaking(part: AbstractElement) -> AbstractImpedance:
            leaks = isinstance(part, Capacitance)
            return parallel(part, resistor(tau / part.c)) if leaks else part

        # s + 1/τ must be in the band of the ladder.
        steps = ladder(np.sqrt(tau) / r, 0.5, (low, max(high, 1 / (2 * np.pi * tau))))
        jax.tree.map(
            leaking, steps, is_leaf=lambda part: isinstance(part, AbstractElement)
        ).connect(netlist, plus, minus)


class PorousElectrode(AbstractIrrational):
    """A porous electrode, Z = A coth β / β + B / (β sinh β) with β = √(a + s b).

    Source: G. Paasch, K. Micka and P. Gersdorf, Theory of the electrochemical impedance of
    macrohomogeneous porous electrodes, 1993, doi 10.1016/0013-4686(93)85083-B. For a layer of the
    thickness d, with resistivities ρ₁ and ρ₂ of its phases, K the rate of charge diffusion and k
    that of the reaction,

        A = d (ρ₁² + ρ₂²) / (ρ₁ + ρ₂),   B = 2 d ρ₁ ρ₂ / (ρ₁ + ρ₂),   a = k d² / K,   b = d² / K.

    Attributes:
        r_a: A [Ω]. impedance.py has Ω m², that of an impedance times an area.
        r_b: B [Ω].
        reaction: a.
        tau: b [s].
    """

    symbol: ClassVar[str] = "T"
    r_a: Ohm
    r_b: Ohm
    reaction: Quantity
    tau: Second

    def __call__(self, s: Complex[AnyArray, "..."]) -> Complex[AnyArray, "..."]:
        """Impedance [Ω]."""
        return self.slopes(s)[0]

    def slopes(self, s: Complex[AnyArray, "..."]) -> Slopes:
        """Impedance and its slopes; those by a and b follow from ∂Z/∂β."""
        xp, (one, two) = namespace(s, self.reaction, self.tau), (beside(s, 1.0), beside(s, 2.0))
        a, sb = beside(s, self.reaction), s * beside(s, self.tau)
        root = _root(a + sb)
        gone = xp.exp(-root)
        sinh = two * gone * reciprocal(one - gone * gone)  # 1 / sinh β, which does not overflow
        coth = (one + gone * gone) * reciprocal(one - gone * gone)
        wide, narrow = beside(s, self.r_a), beside(s, self.r_b)
        first, second = wide * coth * reciprocal(root), narrow * sinh * reciprocal(root)
        z = first + second
        steep = z + wide * sinh * sinh + narrow * coth * sinh  # −β ∂Z/∂β
        part = -steep * reciprocal(two * (a + sb))
        return z, [first, second, a * part, sb * part]

    def exponents(self) -> tuple[Quantity, ...]:
        """Empty: no exponent of it can exceed that of a passive element."""
        return ()


def _root(x: Complex[AnyArray, "..."]) -> Complex[AnyArray, "..."]:
    """The root whose real part is positive."""
    return jnp.exp(0.5 * jnp.log(x)) if namespace(x) is jnp else np.sqrt(x)


def _relaxations(
    highest: float, first: float
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Frequencies x and shares of R of relaxations that replace a layer up to this ωτ."""
    count = max(EXACT + 1, int(np.ceil(NEGLECTED * np.sqrt(1 + highest))))
    x = (np.arange(count) + first) ** 2 * np.pi**2
    share = 2 / x
    found = [(x[:EXACT], share[:EXACT])]
    edges = np.exp(np.arange(np.log(x[EXACT]), np.log(x[-1]) + GROUP, GROUP))
    for low, high in zip(edges, np.append(edges[1:], np.inf), strict=True):
        part = (x >= low) & (x < high)
        if not part.any():
            continue
        # Gauss' rule with two nodes, for the sum over these relaxations as a function of ln x.
        w, u = share[part], np.log(x[part])
        whole, mean = w.sum(), np.average(u, weights=w)
        spread = np.average((u - mean) ** 2, weights=w)
        if spread == 0:
            found.append((x[part][:1], w[:1]))
            continue
        skew = np.average((u - mean) ** 3, weights=w) / spread
        root = np.sqrt(skew**2 + 4 * spread)
        nodes = np.array([skew - root, skew + root]) / 2
        found.append((np.exp(mean + nodes), whole * np.array([nodes[1], -nodes[0]]) / root))
    places, shares = zip(*found, strict=True)
    return np.concatenate(places), np.concatenate(shares)


def diffusion(r: Ohm, tau: Second) -> Diffusion:
    """Diffusion through a layer, Z = R tanh √(sτ) / √(sτ); impedance.py calls it `Ws`.

    Args:
        r: R [Ω], the impedance at low frequency.
        tau: τ [s]; far above 1/(2πτ) the phase is −45°.
    """
    return Diffusion(r, tau)
