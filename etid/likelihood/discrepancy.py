"""What no circuit explains: a smooth unknown relative error δ of each output.

No circuit of a few elements is exact to the noise of a good converter, and no two channels are
equal to it. Then each output has an unknown factor,

    G e^δ,      δ = u + j v,      u, v ~ GP(0, κ) in x = ln f,

with a Gaussian process that is smooth over a length ℓ, and larger at one end of the band by the
power γ of the frequency (Kennedy and O'Hagan 2001, J. R. Stat. Soc. B 63; Rasmussen and Williams,
Gaussian Processes for Machine Learning, 2006, ch. 4),

    κ(x, x') = s² (f f')^γ exp(−½ (x − x')² / ℓ²).

Between the nodes of a grid in ln f δ is a spline. So it is a few parameters of a fit with a prior,
and weights, covariance, score tests and evidence contain it like any other parameter.
"""

import functools
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from etid.precision import array_function, namespace
from etid.signals.transfer import AnyArray

SPACING = 0.35  # of the nodes; a spline through them is good to 1 % of δ of the shortest length
LENGTHS = 0.5 * 1.3 ** np.arange(8)  # the nearest is 14 % off
POWERS = np.array([-0.4, 0.0, 0.4, 0.8])  # a low-pass errs by a power of 1 to 2
NOTHING = 1e-5  # of the variance of a δ, which the functions of its length may leave out
FUNCTIONS = 20  # δ of the shortest length leaves 1e-4 of its variance to others


@functools.lru_cache(maxsize=16)
def nodes(harmonics: int) -> Float[np.ndarray, " node"]:
    """Ln of the number of a harmonic at the nodes."""
    last = np.log(harmonics)
    return np.linspace(0.0, last, int(np.ceil(last / SPACING)) + 1)


@functools.lru_cache(maxsize=16)
def splines(harmonics: int) -> Float[np.ndarray, "node bin"]:
    """The function of each node, which is 1 there and 0 at the others, at all harmonics."""
    import scipy.interpolate  # a fifth of a second, which exact circuits do not need

    every = nodes(harmonics)
    unit = scipy.interpolate.CubicSpline(every, np.eye(every.size))
    return np.ascontiguousarray(unit(np.log(np.arange(1, harmonics + 1))).T)


@functools.lru_cache(maxsize=16)
def kernels(harmonics: int) -> Float[np.ndarray, "kernel node node"]:
    """κ of each length and power between the nodes; its mean variance is 1."""
    x, found = nodes(harmonics), []
    for length in LENGTHS:
        shape = np.exp(-0.5 * ((x[:, None] - x) / length) ** 2)
        for by_power in POWERS:
            size = np.exp(by_power * (x - x.mean()))
            size = size / np.sqrt((size**2).mean())
            found.append(size[:, None] * shape * size)
    return np.stack(found)


@functools.lru_cache(maxsize=16)
def roots(harmonics: int) -> tuple[Float[np.ndarray, "kernel node function"], ...]:
    """The functions of the kernels of each length, of which longer ones have fewer."""
    found = []
    for of in np.split(root_of(kernels(harmonics)), LENGTHS.size):
        variance = (of**2).sum(-2).max(0)  # the smallest are the first
        found.append(of[..., np.cumsum(variance) > NOTHING * variance.sum()])
    return tuple(found)


def root_of(covariance: Float[np.ndarray, "*row node node"]) -> AnyArray:
    """Functions at the nodes whose sum with coefficients N(0, 1) has this covariance."""
    sizes, functions = np.linalg.eigh(covariance)
    sizes, functions = sizes[..., -FUNCTIONS:], functions[..., -FUNCTIONS:]
    return functions * np.sqrt(np.maximum(sizes, 0.0))[..., None, :]


def nearest(
    root: Float[np.ndarray, "*row node function"], nodes: Float[np.ndarray, "*row 2 output node"]
) -> Float[np.ndarray, "*row c"]:
    """Coefficients of the δ that is nearest to these values: the functions are orthogonal."""
    size = (root**2).sum(-2)[..., None, None, :]
    c = nodes @ root[..., None, :, :] / np.where(size > 0, size, 1.0)
    return c.reshape(*c.shape[:-3], -1)


class Discrepancy(NamedTuple):
    """δ of the outputs of loads as a function of its coefficients, whose prior is N(0, 1).

    Attributes:
        splines: The functions of the nodes at the frequencies.
        root: Values of the functions of each coefficient at the nodes.
    """

    splines: Float[AnyArray, "node bin"]
    root: Float[AnyArray, "*row node function"]

    @classmethod
    def of_covariance(
        cls, harmonics: int, covariance: Float[np.ndarray, "*row node node"]
    ) -> "Discrepancy":
        """δ with this covariance between the nodes."""
        return cls(splines(harmonics), root_of(covariance))

    def count(self, outputs: int) -> int:
        """Number of coefficients: the real parts of each output, then the imaginary parts."""
        return 2 * outputs * self.root.shape[-1]

    def at_nodes(self, c: Float[AnyArray, "*row c"]) -> Float[AnyArray, "*row 2 output node"]:
        """Real and imaginary parts of δ at the nodes."""
        parts = c.reshape(*c.shape[:-1], 2, -1, self.root.shape[-1])
        return parts @ self.root.swapaxes(-1, -2)[..., None, :, :]

    def nearest(self, nodes: Float[np.ndarray, "*row 2 output node"]) -> np.ndarray:
        """The coefficients of the nearest δ."""
        return nearest(self.root, nodes)

    def rows(self, rows: np.ndarray) -> "Discrepancy":
        """Those of some of the loads."""
        return self._replace(root=self.root[rows])

    def at(self, index: np.ndarray) -> "Discrepancy":
        """The same at some of the frequencies."""
        return self._replace(splines=self.splines[:, index])

    @array_function
    def __call__(self, c: Float[AnyArray, "*row c"]) -> Complex[AnyArray, "*row output bin"]:
        """δ."""
        found = self.at_nodes(c) @ self.splines
        return found[..., 0, :, :] + 1j * found[..., 1, :, :]

    @array_function
    def by_coefficient(self, outputs: int) -> Complex[AnyArray, "*row c output bin"]:
        """Derivatives of δ."""
        xp = namespace(self.root)
        each = (self.root.swapaxes(-1, -2) @ self.splines)[..., None, :, None, :]
        real = each * np.eye(outputs)[:, None, :, None]
        real = real.reshape(*real.shape[:-4], -1, *real.shape[-2:])
        return xp.concatenate([real + 0j, 1j * real], -3)
