"""Ways in which a recording may depart from its model, each a change of size ε of the gains.

Rao's score test asks of each whether ε = 0 (`etid.likelihood.scores`).

**A relaxation that is spread over time constants.** The most common model of skin that is not one
RC is that of Cole (1940). It replaces jω by (jω)^α; α = 1 is the circuit itself:

    ∂Z/∂α = s ln s dZ/ds.

At 40 dB, α = 0.9 changes R_s by a quarter of its value; χ² is 1.1 and z above 10. A circuit with
its own α can make this change itself. For such a circuit the test checks whether the spread is
symmetric. Cole's spread is symmetric; that of Davidson and Cole (1951) is not. ln s becomes
ln s + ε ln² (s/s₀) around the middle s₀ of the band, and

    ∂Z/∂ε = s ln² (s/s₀) dZ/ds.

**One more relaxation**, ΔZ = ε |Z(j/τ)| / (1 + sτ), for each τ of a grid that exceeds the band. It
also has power if dZ/ds = 0, as for a resistor.

**A layer through which charge diffuses**, tanh √(sτ) / √(sτ), is a slow relaxation, a ninth of it
that is nine times as fast, a 25th of it that is 25 times as fast, and so on. With Z(0) as it is,

    ∂Z/∂ε = Σ (Z(s/n²) − Z(s)) / n² / (1 + Σ 1/n²),      n = 3, 5, 7, …

**Errors of the instrument**: another gain of each output, crosstalk of the unloaded voltage into
V_out, and a capacitance across the load. Most gains of 1 % are not seen at 40 dB, and would change
R_p of dry skin by 14 %.

**A resistance that falls with its current.** To first order in 1/I_0, a resistor R / (1 + |i|/I_0)
adds the voltage −|u| u / (R I_0) to its own voltage u. The rest of the circuit filters it like the
voltage of the relaxations, and the feed like a change of Z_L. This signal is no change of an
impedance: harmonics mix, so it is a change of the outputs at all harmonics.
"""

import numpy as np
from jaxtyping import Complex, Float

from etid.circuits.circuit import impedance_at
from etid.likelihood.gains import Gains
from etid.likelihood.search import Near
from etid.precision import namespace
from etid.signals.knots import Knots
from etid.signals.transfer import AnyArray, frequency_variable, reciprocal

RELAXATIONS = 7  # time constants, two per decade; a relaxation is wider than that
BEYOND = 2.0  # factor by which they exceed the band
# Faster relaxations of a layer of diffusion, by √(τ₁/τ). The rest adds 3 % of R_p to R_s.
FASTER = np.arange(3.0, 17.0, 2.0)
STEP = 1e-5  # of ln f, for dZ/ds
HARMONICS = 512  # that the pulse needs, up to 30 kHz; without the rest z is a few per cent smaller
FINE = 2  # points of the grid in time, relative to twice the number of these harmonics


def of_circuit(gains: Gains, near: Near) -> Complex[AnyArray, "*row change output knot"]:
    """Changes of the gains by a layer, a spread, and relaxations from slow to fast."""
    xp, f, z = namespace(near.q), gains.frequency, near.slopes.z
    logs = gains.split(near.q)[0]

    def impedance(frequency: Float[AnyArray, "*row _"]) -> Complex[AnyArray, "*row _"]:
        return impedance_at(gains.circuit, logs, frequency)

    shares = FASTER**-2 / (1 + (FASTER**-2).sum())
    each = zip(shares, FASTER, strict=True)
    layer = sum(share * (impedance(f * n**-2.0) - z) for share, n in each)
    log_s = xp.log(2 * np.pi * f) + 0.5j * np.pi
    if gains.circuit.exponents():
        log_s = (log_s - 0.5 * (log_s[..., :1].real + log_s[..., -1:].real)) ** 2
    slope = (impedance(f * (1 + STEP)) - impedance(f * (1 - STEP))) / (2 * STEP)
    spread = log_s * slope
    grid = np.linspace(0.0, 1.0, RELAXATIONS)
    lowest, highest = f[..., :1] / BEYOND, f[..., -1:] * BEYOND
    corner = lowest * (highest / lowest) ** grid
    level = xp.abs(impedance(corner))
    relaxed = level[..., None] / (1 + 1j * (f[..., None, :] / corner[..., None]))
    changes = xp.concatenate([xp.stack([layer, spread], -2), relaxed], -2)
    return changes[..., None, :] * near.slopes.by_z[..., None, :, :]


def of_instrument(gains: Gains, near: Near) -> Complex[AnyArray, "*row change output knot"]:
    """Changes of the gains by crosstalk, a capacitance, and a gain of each output."""
    xp, slopes = namespace(near.q), near.slopes
    delays = gains.split(near.q)[1]
    angle = -2 * np.pi * delays[..., None] * (gains.frequency[..., None, :] / gains.sample_rate)
    turn = xp.cos(angle) + 1j * xp.sin(angle)
    count = gains.outputs.count
    first = np.eye(count)[0][:, None]
    s, z = frequency_variable(gains.frequency), slopes.z
    capacitance = (-s * z * z)[..., None, :] * slopes.by_z
    scales = np.eye(count)[:, :, None] * slopes.gains[..., None, :, :]
    both = xp.stack([first * turn, capacitance], -3)
    return xp.concatenate([both, scales], -3)


def falling(near: Near, knots: Knots) -> Complex[AnyArray, "*row output bin"]:
    """What a resistance that falls with its current adds to the outputs, for 1/(R I_0) = 1/V.

    The current is that of the pulse, whose shape the first harmonics give.
    """
    xp, slopes = namespace(near.q), near.slopes
    relaxing = slopes.z - slopes.z[..., -1:].real  # without the series resistor
    v_out = knots.between(slopes.gains[..., 0, :]) * near.profile.x
    count = min(HARMONICS, v_out.shape[-1])
    u = (v_out * knots.between(relaxing * reciprocal(slopes.z)))[..., :count]
    # There is no direct voltage behind a transformer, or with charge-balanced pulses.
    whole = xp.concatenate([xp.zeros_like(u[..., :1]), u], -1)
    points = xp.fft.irfft(whole, 2 * FINE * count, norm="forward")
    added = xp.fft.rfft(-xp.abs(points) * points, norm="forward")[..., 1 : count + 1]
    rest = xp.zeros((*added.shape[:-1], v_out.shape[-1] - count), added.dtype)
    added = xp.concatenate([added, rest], -1)
    sensitivity = slopes.by_z * (slopes.z * reciprocal(slopes.gains[..., 0, :]))[..., None, :]
    return added[..., None, :] * knots.between(sensitivity * relaxing[..., None, :])
