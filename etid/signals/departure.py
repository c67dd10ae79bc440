"""A smooth relative error of an impedance: Z e^δ, δ = u + j v.

u and v are cubic splines in ln f between nodes at equal distances. Each is a sum of functions,
whose values at the nodes are given, with coefficients whose prior is N(0, 1). Beyond the first and
the last node δ is constant.
"""

import functools

import numpy as np
from jaxtyping import Complex, Float

from etid.precision import Module, namespace
from etid.signals.transfer import AnyArray, as_complex, from_parts


@functools.lru_cache(maxsize=16)
def _pieces(nodes: int) -> Float[np.ndarray, "power interval node"]:
    """Coefficients of the spline that is 1 at each node and 0 at the others; its last is t⁰."""
    import scipy.interpolate  # a fifth of a second, which exact drivers do not need

    return scipy.interpolate.CubicSpline(np.arange(nodes), np.eye(nodes)).c


class Departure(Module):
    """δ.

    Attributes:
        ends: ln of the frequencies [Hz] of the first and of the last node.
        functions: Values of the functions at the nodes.
        coefficients: Coefficients of u, then of v.
    """

    ends: Float[AnyArray, "2"]
    functions: Float[AnyArray, "node function"]
    coefficients: Float[AnyArray, " c"]

    def at(self, frequency: Float[AnyArray, "*bin"]) -> Float[AnyArray, "function *bin"]:
        """The functions at frequencies [Hz]."""
        xp, last = namespace(frequency, self.functions), self.functions.shape[0] - 1
        place = xp.log(frequency.reshape(-1)) - self.ends[0]
        place = xp.clip(place * last / (self.ends[1] - self.ends[0]), 0.0, 1.0 * last)
        first = xp.clip(xp.floor(place), 0.0, last - 1.0)
        t = place - first
        powers = xp.stack([t**3, t**2, t, xp.ones_like(t)])
        pieces = _pieces(last + 1) @ self.functions
        pieces = xp.take(pieces, first.astype(int), axis=1, mode="clip")
        found = (powers[..., None] * pieces).sum(0)
        return found.T.reshape(-1, *frequency.shape)

    def factor(
        self, coefficients: Float[AnyArray, "*row c"], frequency: Float[AnyArray, "*bin"]
    ) -> Complex[AnyArray, "..."]:
        """e^δ with other coefficients (*row *bin)."""
        xp, at = namespace(coefficients, frequency), self.at(frequency)
        count = self.functions.shape[1]
        u = xp.tensordot(coefficients[..., :count], at, 1)
        v = xp.tensordot(coefficients[..., count:], at, 1)
        size = xp.exp(u)
        return from_parts(size * xp.cos(v), size * xp.sin(v))

    def by_coefficient(self, frequency: Float[AnyArray, "*bin"]) -> Complex[AnyArray, "c *bin"]:
        """Derivatives of δ."""
        at = as_complex(self.at(frequency))
        return namespace(at).concatenate([at, 1j * at])
