"""Whether a driver has changed: its unloaded voltage differs from that of the calibration.

A change of Z_th affects Y/X like a change of the load. If a resistor in the driver grows by 5 %,
R_p of dry skin is wrong by 63 standard errors at 60 dB, and χ² is 1. But the parts of Z_th also
shape V_th, without any skin. The harmonics of two unloaded records of an unchanged driver differ
only by an amplitude a and a delay τ,

    X_k = a e^(−jω_k τ) X⁰_k (1 + δ_k),      δ = 0.

If a part has changed, δ is smooth in frequency. Another pulse, for example a longer one, has other
zeros, and its δ is not smooth. It tells nothing about the driver and is no fault.
"""

from typing import Any

import numpy as np
from jaxtyping import Bool

from etid.likelihood.noise import excess
from etid.likelihood.profile import Records
from etid.precision import array_function, namespace
from etid.signals.transfer import AnyArray, as_complex, power, turns

SEEN = 37.37  # χ² that all directions exceed by chance once in 10 000
SIZE = 1.5e-4  # smallest difference relative to V_th; pulses repeat no better than this
OTHER = 0.1  # difference relative to V_th of another pulse; doubling a part has less effect
SMOOTH = 1 / 3  # part of the difference that must be smooth
# Relative difference of pulse rates. Records of other lengths are cut to other whole samples. This
# moves the zeros of a pulse at its thousandth harmonic as much as a part that has changed.
SAME_FREQUENCY = 1e-6


@array_function
def differs(shape: Any, records: Records) -> Bool[AnyArray, "*row"]:
    """Whether the unloaded voltages of recordings show that the driver has changed.

    `shape` is the unloaded voltage of a calibration, an `UnloadedShape`.
    """
    xp = namespace(records.x)
    known = xp.where(records.used[..., 0, :], shape.x, 0)
    here = known != 0
    count = known.shape[-1]
    number = np.arange(1.0, count + 1)
    squares = power(known)
    total = squares.sum(-1)
    found = xp.where(here, records.x, 0)
    product = found * xp.conj(known)
    angle = xp.angle((product[..., 1:] * xp.conj(product[..., :-1])).sum(-1))
    aligned = found * turns(-angle / (2 * np.pi), count)  # to a tenth of a sample
    late = (number * (aligned * xp.conj(known)).imag).sum(-1)
    angle = angle + late / (number**2 * squares).sum(-1)
    aligned = found * turns(-angle / (2 * np.pi), count)
    amplitude = (aligned * xp.conj(known)).real.sum(-1) / total
    variance = records.variance_x + amplitude[..., None] ** 2 * shape.variance
    scale = xp.sqrt(2 / xp.where(here, variance, 0.0).max(-1))
    rest = (aligned - as_complex(amplitude)[..., None] * known) * as_complex(scale)[..., None]
    part = xp.concatenate([rest.real, rest.imag], -1)
    along = part @ shape.directions.T + (amplitude * scale)[..., None] * shape.bias
    smooth, whole = (along**2).sum(-1), (part**2).sum(-1)
    size = xp.sqrt(smooth) / (scale * xp.abs(amplitude) * xp.sqrt(total))
    same = xp.abs(records.frequency[..., 0] / shape.frequency[0] - 1) < SAME_FREQUENCY
    of_chance = 2.0 * here.sum(-1)
    large = (size > SIZE) & (size < OTHER) & (smooth > SMOOTH * (whole - of_chance))
    beyond = xp.maximum(1 - shape.drift / size, 0.0)  # part that no stated drift explains
    another = whole > of_chance / 2  # otherwise both are the same record
    seen = same & large & another & (beyond**2 * smooth > SEEN)
    if xp is np and not seen.any():
        return seen
    left = part - along @ shape.directions  # in its own noise, which is at least 1
    of_each = 0.5 * (left[..., :count] ** 2 + left[..., count:] ** 2)
    noise = excess(of_each, here)
    noise = xp.concatenate([noise, noise], -1)
    sure = ((beyond[..., None] * along) ** 2 / (noise @ (shape.directions**2).T)).sum(-1)
    return seen & (sure > SEEN)
