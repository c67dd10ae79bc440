"""What a converter adds that holds a command from each sample to the next.

Between the samples the voltage or current of such a converter is a staircase. Its spectrum is that
of the samples X, times the hold, at all frequencies: also at the images of a bin,
f + k fs. With s in units of the sample rate,

    H(s) = (1 − e^(−s)) / s,      Y(s) = X Σ_k G(s + 2πik) H(s + 2πik)

is the spectrum of samples of an output without a filter: the response of G discretised with a
zero-order hold (`scipy.signal.cont2discrete`). A lane has H X in place of X, so that its gains are
G and what the images k ≠ 0 add,

    Σ_k≠0 G(s + 2πik) s / (s + 2πik).

Beyond half the sample rate, G is known at a few nodes and is there

    G = c₀ + Σ_j c_j a_j / (s + a_j) + d_j (a_j / (s + a_j))²,

by least squares with fixed rates a_j, to 1e-5 for poles up to 0.3 of the sample rate and to 2e-3 at
0.45. Each of these terms is discretised in closed form, c₀ → c₀ and

    a / (s + a) → (1 − e^(−a)) z⁻¹ / (1 − e^(−a) z⁻¹),      z = e^s,

and the squares follow by (a / (s + a))² = (1 − a ∂/∂a) a / (s + a).

**No delay** of the output can be fitted: behind one relaxation a sample that is taken later shows
another series resistance and another gain, exactly.
"""

import functools

import numpy as np
from jaxtyping import Complex, Float

from etid.precision import namespace
from etid.signals.transfer import AnyArray, as_complex

RATES = 2 * np.pi * np.geomspace(0.1, 2.0, 5)  # a_j [sample rates]
NODES = np.geomspace(0.5, 20.0, 24)  # of the sample rate
DELAY = np.float64(1e-4)  # [samples] prior standard deviation of a delay behind a held command


def of_hold(place: Float[AnyArray, "*record bin"]) -> Complex[AnyArray, "*record bin"]:
    """H at frequencies in units of the sample rate."""
    xp = namespace(place)
    return xp.sinc(place) * xp.exp(-1j * np.pi * place)


def _terms(s: Complex[AnyArray, " bin"]) -> Complex[AnyArray, "term bin"]:
    once = RATES[:, None] / (s + RATES[:, None])
    return namespace(s).concatenate([1 + 0 * s[None], once, once**2])


@functools.cache
def _solution() -> Float[np.ndarray, "part term"]:
    """From real and imaginary parts at the nodes to the coefficients of the terms."""
    found = _terms(2j * np.pi * NODES)
    return np.linalg.pinv(np.concatenate([found.real, found.imag], -1)).copy()


def images(place: Float[AnyArray, " bin"]) -> Complex[AnyArray, "part bin"]:
    """What real and imaginary parts of a gain at `NODES` add to it, for the input H X.

    Args:
        place: The bins, in units of the sample rate.
    """
    s, hold = 2j * np.pi * place, of_hold(place)
    xp = namespace(s)
    back = xp.exp(-s)
    decay = np.exp(-RATES)[:, None] * back
    once = (1 - np.exp(-RATES))[:, None] * back / (1 - decay)
    # a ∂/∂a of the same
    by_rate = RATES[:, None] * decay * (1 - back) / (1 - decay) ** 2
    held = xp.concatenate([1 + 0 * s[None], once, once - by_rate])
    return as_complex(_solution()) @ (held / hold - _terms(s))


def added(
    nodes: Complex[AnyArray, "*row node"], of: Complex[AnyArray, "part bin"]
) -> Complex[AnyArray, "*row bin"]:
    """What the images add to gains with these values at `NODES`; `of` is from `images`."""
    return as_complex(namespace(nodes).concatenate([nodes.real, nodes.imag], -1)) @ of
