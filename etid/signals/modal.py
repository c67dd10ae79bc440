"""Rational impedances in modal form: a constant, resonant sections, and real poles.

    Z(s) = R + Σ_k (g_k + h_k x) / (1 + 2 ζ_k x + x²) + Σ_j g_j / (1 + s/ω_j),      x = s/ω_k

The parameters are log R, then log ω, log ζ, g and h of all sections, then log ω and g of all real
poles. They can have leading axes, and broadcast with those of the frequencies.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from etid.precision import array_function, namespace
from etid.signals.transfer import AnyArray, as_complex, from_parts, reciprocal

SECTION = 4  # parameters of a section; a real pole has two, the constant one


class _Modes(NamedTuple):
    """The parameters, each with an axis of modes and one for the frequencies."""

    log_resistance: Float[AnyArray, "*row 1 1"]
    log_omega: Float[AnyArray, "*row section 1"]
    log_zeta: Float[AnyArray, "*row section 1"]
    gain: Float[AnyArray, "*row section 1"]
    slope: Float[AnyArray, "*row section 1"]
    log_omega_real: Float[AnyArray, "*row real 1"]
    gain_real: Float[AnyArray, "*row real 1"]

    @classmethod
    def of(cls, parameters: Float[AnyArray, "*row parameter"], sections: int) -> "_Modes":
        reals = (parameters.shape[-1] - 1 - SECTION * sections) // 2
        ends = np.cumsum([1, *[sections] * SECTION, reals, reals])
        starts = [0, *ends[:-1]]
        return cls(*(parameters[..., a:b, None] for a, b in zip(starts, ends, strict=True)))


@array_function
def impedance(
    parameters: Float[AnyArray, "*#row parameter"],
    sections: int,
    frequency: Float[AnyArray, "*#row bin"],
) -> Complex[AnyArray, "*row bin"]:
    """Z at frequencies [Hz]."""
    xp, of = namespace(parameters, frequency), _Modes.of(parameters, sections)
    omega = 2 * np.pi * frequency[..., None, :]
    turn = omega * xp.exp(-of.log_omega)
    # In real arithmetic, which takes half the time to compile and to run.
    below, damped = 1 - turn * turn, 2 * xp.exp(of.log_zeta) * turn
    scale = 1 / (below * below + damped * damped)
    gain, slope = of.gain * scale, of.slope * turn * scale
    turn_real = omega * xp.exp(-of.log_omega_real)
    gain_real = of.gain_real / (1 + turn_real * turn_real)
    real = (gain * below + slope * damped).sum(-2) + gain_real.sum(-2)
    imaginary = (slope * below - gain * damped).sum(-2) - (gain_real * turn_real).sum(-2)
    return from_parts(xp.exp(of.log_resistance)[..., 0, :] + real, imaginary)


@array_function
def with_slopes(
    parameters: Float[AnyArray, "*#row parameter"],
    sections: int,
    frequency: Float[AnyArray, "*#row bin"],
) -> tuple[Complex[AnyArray, "*row bin"], Complex[AnyArray, "*row parameter bin"]]:
    """Z at frequencies [Hz], and its derivatives with respect to the parameters."""
    xp, of = namespace(parameters, frequency), _Modes.of(parameters, sections)
    omega = 2 * np.pi * frequency[..., None, :]
    turn, damping = omega * xp.exp(-of.log_omega), 2 * xp.exp(of.log_zeta)
    shape = reciprocal(from_parts(1 - turn * turn, damping * turn))
    x = 1j * turn
    by_slope = x * shape
    section = of.gain * shape + of.slope * by_slope
    turn = omega * xp.exp(-of.log_omega_real)
    scale = 1 / (1 + turn * turn)
    shape_real = from_parts(scale, -turn * scale)
    single = of.gain_real * shape_real
    constant = xp.exp(of.log_resistance) + 0j * omega
    slopes = [
        constant,
        (section * (damping + 2 * x) - of.slope) * by_slope,
        -damping * section * by_slope,
        shape,
        by_slope,
        1j * turn * single * shape_real,
        shape_real,
    ]
    whole = constant[..., 0, :] + section.sum(-2) + single.sum(-2)
    return whole, xp.concatenate(slopes, -2)


@array_function
def decays(
    parameters: Float[AnyArray, "*#row parameter"],
    sections: int,
    frequency: Float[AnyArray, "*#row bin"],
) -> Complex[AnyArray, "*row decay bin"]:
    """Transforms [s] of decays that begin with 1, one for each state, at frequencies [Hz].

    They are 1/ω / (1 + 2ζx + x²) and x/ω / (1 + 2ζx + x²) of each section, and 1 / (ω + s) of each
    real pole: Z with other gains and without its constant part.
    """
    xp, slopes = namespace(parameters, frequency), with_slopes(parameters, sections, frequency)[1]
    of = _Modes.of(parameters, sections)
    first, reals = 1 + 2 * sections, of.log_omega_real.shape[-2]
    omega = [of.log_omega, of.log_omega, of.log_omega_real]
    shapes = [slopes[..., first : first + 2 * sections, :], slopes[..., -reals:, :]]
    return xp.concatenate(shapes, -2) * as_complex(xp.exp(-xp.concatenate(omega, -2)))


@array_function
def decays_by_parameters(
    parameters: Float[AnyArray, "*row parameter"],
    sections: int,
    sizes: Float[AnyArray, "*row record decay"],
    frequency: Float[AnyArray, " bin"],
) -> Complex[AnyArray, "*row record parameter bin"]:
    """Derivatives of sums of `decays` of these sizes with respect to the parameters."""
    xp, of = namespace(parameters, sizes), _Modes.of(parameters, sections)
    omega = xp.exp(xp.concatenate([of.log_omega, of.log_omega, of.log_omega_real], -2))[..., 0]
    gains, reals = sizes / omega[..., None, :], of.log_omega_real.shape[-2]
    wide = xp.broadcast_to(parameters[..., None, :], (*sizes.shape[:-1], parameters.shape[-1]))
    first = 1 + 2 * sections
    shapes = wide[..., 1:first], gains[..., : 2 * sections], wide[..., -2 * reals : -reals]
    alike = xp.concatenate([wide[..., :1], *shapes, gains[..., 2 * sections :]], -1)
    _, slopes = with_slopes(alike, sections, frequency)
    of_gains = slopes[..., first : first + 2 * sections, :] * as_complex(
        gains[..., : 2 * sections, None]
    )
    both = of_gains[..., :sections, :] + of_gains[..., sections:, :]
    of_reals = slopes[..., -reals:, :] * as_complex(gains[..., 2 * sections :, None])
    none = xp.zeros_like(slopes)
    return xp.concatenate(
        [
            none[..., :1, :],
            slopes[..., 1 : 1 + sections, :] - both,
            slopes[..., 1 + sections : first, :],
            none[..., : 2 * sections, :],
            slopes[..., -2 * reals : -reals, :] - of_reals,
            none[..., :reals, :],
        ],
        -2,
    )
