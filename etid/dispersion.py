"""Is a load the circuit that is fitted? A score test against constant phases.

Skin that is not one RC has a relaxation that is spread over time constants. The most common
description is Cole's (1940), which puts (jω)^α in the place of jω, and α = 1 is the circuit itself.
There the impedance changes with α by

    ∂Z/∂α = s ln s dZ/ds,

and Rao's score test asks whether the residual r goes with it: with d the derivative of r by α less
what the other parameters can do, z = d·r / σ(d·r) is normal if the circuit is right. It sees what
χ² over all harmonics does not: at 40 dB and α = 0.9, which costs R_s a quarter of its value, χ² is
1.1 and z above 10. A second relaxation shows in it nearly as well.

**A circuit with an α of its own** can do this itself, and the test would have nothing to say. It is
asked instead whether the spread is the same on both sides, as Cole's is and that of Davidson and
Cole (1951) is not: ln s goes on to ln s + ε ln² (s/s₀) around the middle s₀ of the band, and

    ∂Z/∂ε = s ln² (s/s₀) dZ/ds.

Two layers that are fitted as one Cole relaxation show in it at 40 dB, where R_s is off by a third,
with z = 9.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Complex, Float

from etid.elements import AbstractImpedance, exponents
from etid.transfer import as_complex, frequency_variable

SEEN = 4.0  # standard deviations, by which one fit in 16 000 is off by chance
# By which α, or ε, must be off as well, which costs R_s a few per cent. A driver of too low an
# order can imitate 0.002: at 60 dB, behind damp skin, four standard deviations.
SPREAD = 0.01


def slope(
    impedance: AbstractImpedance, frequency: Float[Array, " harmonic"]
) -> tuple[Complex[Array, " harmonic"], Complex[Array, " harmonic"]]:
    """Z and ∂Z/∂α [Ω], or ∂Z/∂ε if it has constant phases, at real frequencies [Hz]."""
    s = frequency_variable(frequency)
    log_s = jax.lax.complex(jnp.log(s.imag), jnp.full_like(frequency, jnp.pi / 2))
    if not exponents(impedance):
        return jax.jvp(impedance, (s,), (s * log_s,))
    log_s = log_s - as_complex((log_s.real[0] + log_s.real[-1]) / 2)
    return jax.jvp(impedance, (s,), (s * log_s * log_s,))


def is_seen(
    row: Float[Array, " term"],
    jacobian: Float[Array, "q term"],
    residual: Float[Array, " term"],
    rest: Float[Array, " q"],
    spread: Float[Array, "q q"],
    covariance: Float[Array, "q q"],
    share: Float[Array, " term"],
    noise: Float[Array, " term"],
) -> Bool[Array, ""]:
    """Whether α differs from 1, or ε from 0.

    Args:
        row: Derivative of the residual by α or ε.
        jacobian: The same by the parameters.
        residual: In standard deviations.
        rest: Gradient of the priors.
        spread: Covariance of that.
        covariance: Inverse of the information.
        share: Weights of the terms in the information.
        noise: Variance of each residual.
    """
    others = covariance @ (jacobian @ (share * row))
    direction = row - others @ jacobian
    score = row @ residual - others @ (jacobian @ residual + rest)
    variance = jnp.sum(noise * direction**2) + others @ spread @ others
    curvature = (share * row) @ direction
    return (score**2 > SEEN**2 * variance) & (jnp.abs(score) > SPREAD * curvature)
