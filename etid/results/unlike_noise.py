"""What a measured impedance shows of a residual that is not noise, and at which frequencies."""

import numpy as np
from jaxtyping import Complex, Float

from etid.printing import per_cent, rounded

# By chance 1 spectrum in 4 000 has such runs, 5 of 1 000 000 of 40 frequencies such tails.
RUNS, TAILS = 3.5, 2.5
NAMED = 4  # impedances that are named


def noise_in(e: Float[np.ndarray, " part"]) -> tuple[float, float]:
    """Mean squares of the noise of real parts, then imaginary parts, of an impedance's residual.

    They are what neighbours do not have in common, and that by the median of the sizes.
    """
    parts = e.reshape(2, -1)
    usual = np.median(np.abs(e)) / 0.6745  # the median of the size of a normal number
    return float(np.mean((parts[:, 1:] - parts[:, :-1]) ** 2) / 2), float(usual**2)


def why_not_noise(
    frequency: Float[np.ndarray, " frequency"], residual: Complex[np.ndarray, " frequency"]
) -> str:
    """A sentence on the sign that a relative residual is not noise, and on where it is largest."""
    e = np.concatenate([np.real(residual), np.imag(residual)])
    square, (of_steps, usual) = float(np.mean(e**2)), noise_in(e)
    size = np.abs(residual)
    order = np.argsort(-size)
    far = order[size[order] > 4 * np.sqrt(2 * usual)][:NAMED]
    named = [_place(float(frequency[at]), float(size[at])) for at in far]
    if square > TAILS**2 * usual and usual <= of_steps and far.size:
        return (
            f"The circuit misses by far the most at {' and '.join(named)}: leave such points "
            "out, or give stderr."
        )
    most = f"most at {_place(float(frequency[order[0]]), float(size[order[0]]))}"
    if 1 - of_steps / square > RUNS / e.size**0.5:
        return f"Neighbouring impedances miss alike, {most}."
    return f"Another passive circuit misses by less; this one misses {most}."


def _place(frequency: float, size: float) -> str:
    return f"{rounded(frequency, 3)} Hz ({per_cent(size)})"
