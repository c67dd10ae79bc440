"""Is a load the circuit that is fitted? Score tests against other relaxations.

Let Z be the impedance that is fitted, and r the residual in standard deviations. Rao's score test
asks whether r goes with a change of Z that the circuit cannot make: with d the derivative of r by
the size ε of the change, less what the other parameters can do, z = d·r / σ(d·r) is normal if the
circuit is right. It sees what χ² over all harmonics does not. There are two kinds of change.

**A relaxation that is spread over time constants.** The most common description of skin that is not
one RC is Cole's (1940), which puts (jω)^α in the place of jω, and α = 1 is the circuit itself:

    ∂Z/∂α = s ln s dZ/ds.

At 40 dB and α = 0.9, which costs R_s a quarter of its value, χ² is 1.1 and z above 10. A circuit
with an α of its own can do this itself. It is asked instead whether the spread is the same on both
sides, as Cole's is and that of Davidson and Cole (1951) is not: ln s goes on to
ln s + ε ln² (s/s₀) around the middle s₀ of the band, and

    ∂Z/∂ε = s ln² (s/s₀) dZ/ds.

**One more relaxation**, ΔZ = ε |Z(j/τ)| / (1 + sτ), for each τ of a grid that covers the band and
exceeds it. This has power where dZ/ds = 0: a resistor has no phase to be spread. What the circuit
can do itself, such as this relaxation where it has one with this τ, is no evidence: d vanishes.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Complex, Float

from etid.circuits.impedance import AbstractImpedance
from etid.estimators.sandwich import Linear
from etid.signals.transfer import as_complex, frequency_variable

# Standard deviations. By chance the spread exceeds its own in one fit of 16 000. Of the relaxations
# the fast ones have 1.2 to 1.3 where 1 is expected (60 dB, order 5 for six poles), so that 5 is 4.
SEEN_SPREAD, SEEN_RELAXATION = 4.0, 5.0
# Standard deviations of a wrong gain. Among 1200 undisturbed fits one reaches 3.5. A gain that is
# 1 % wrong is five standard deviations at 40 dB and makes R_p of dry skin a quarter too large.
SEEN_GAIN = 3.5
# By which α, or ε, must be off as well, which costs R_s a few per cent. A driver of too low an
# order can imitate 0.002: at 60 dB, behind damp skin, four standard deviations.
SPREAD = 0.01
MOVED = 0.02  # of an element, which the relaxation must have cost as well, for the same reason
GRID = 7  # time constants, two in a decade: a relaxation is wider than that
BEYOND = 2.0  # by which they exceed the band
NOTHING = 1e-9  # of a change's power: less is what rounding leaves of one that the circuit can make


def changes(
    impedance: AbstractImpedance, frequency: Float[Array, " harmonic"]
) -> tuple[Complex[Array, " harmonic"], Complex[Array, "change harmonic"]]:
    """Z and ∂Z/∂ε [Ω] of all changes at real frequencies [Hz]; the first is the spread."""
    s = frequency_variable(frequency)
    log_s = jax.lax.complex(jnp.log(s.imag), jnp.full_like(frequency, jnp.pi / 2))
    if impedance.exponents():
        log_s = log_s - as_complex((log_s.real[0] + log_s.real[-1]) / 2)
        log_s = log_s * log_s
    z, spread = jax.jvp(impedance, (s,), (s * log_s,))
    corner, level = relaxations(impedance, frequency[0], frequency[-1])
    x = s.imag[None, :] * (1 / corner)[:, None]
    real = level[:, None] / (1 + x**2)
    return z, jnp.concatenate([spread[None, :], jax.lax.complex(real, -x * real)])


def relaxations(
    impedance: AbstractImpedance, lowest: Float[Array, ""], highest: Float[Array, ""]
) -> tuple[Float[Array, " relaxation"], Float[Array, " relaxation"]]:
    """1/τ [rad/s] and |Z(j/τ)| [Ω] of the relaxations for a band [Hz]."""
    corner = 2 * jnp.pi * jnp.geomspace(lowest / BEYOND, highest * BEYOND, GRID)
    return corner, jnp.abs(impedance(jax.lax.complex(jnp.zeros_like(corner), corner)))


class Scores(NamedTuple):
    """What a residual says of each change; the first is the spread.

    Attributes:
        z: Standard deviations; not a number if the circuit can make the change itself.
        size: Estimate of ε.
        moved: By how much ε has moved the elements at most (of logarithms).
    """

    z: Float[Array, " change"]
    size: Float[Array, " change"]
    moved: Float[Array, " change"]

    def seen(self) -> Bool[Array, ""]:
        """Whether the load is another circuit."""
        spread = (jnp.abs(self.z[0]) > SEEN_SPREAD) & (jnp.abs(self.size[0]) > SPREAD)
        return spread | Scores(self.z[1:], self.size[1:], self.moved[1:]).relaxes()

    def has_other_gain(self) -> Bool[Array, ""]:
        """Whether V_out has another gain than V_th, if the last change is a gain."""
        return (jnp.abs(self.z[-1]) > SEEN_GAIN) & (self.moved[-1] > MOVED)

    def relaxes(self) -> Bool[Array, ""]:
        """The same of relaxations alone."""
        return jnp.any((jnp.abs(self.z) > SEEN_RELAXATION) & (self.moved > MOVED))


def scores(
    rows: Float[Array, "change term"],
    linear: Linear,
    residual: Float[Array, " term"],
    rest: Float[Array, " q"],
    spread: Float[Array, "q q"],
    covariance: Float[Array, "q q"],
    elements: slice,
) -> Scores:
    """Score of each change.

    The parameters need not be at a minimum: what they could still explain of the residual is taken
    out of it (Neyman's C(α)).

    Args:
        rows: Derivatives of the residual by ε.
        linear: The terms by the parameters.
        residual: In standard deviations.
        rest: Gradient of the priors.
        spread: Covariance of that.
        covariance: Inverse of the information, that of other terms included.
        elements: Which parameters are the logarithms of the elements.
    """
    others = linear.told(rows) @ covariance
    directions = rows - others @ linear.jacobian
    score = directions @ residual - others @ rest
    # Products of matrices, which take a fifth of the time of sums.
    of_priors = jnp.sum((others @ spread) * others, axis=1)
    variance, curvature = (
        directions**2 @ jnp.stack([linear.noise, linear.share], axis=1)
    ).T + of_priors[None]
    can = curvature <= NOTHING * (rows**2 @ linear.share)
    size = score / curvature
    moved = jnp.max(jnp.abs(others[:, elements]), axis=1)
    return Scores(jnp.where(can, jnp.nan, score / jnp.sqrt(variance)), size, jnp.abs(size) * moved)
