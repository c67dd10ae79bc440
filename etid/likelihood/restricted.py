"""How large δ is, and whether a change that has a name explains what a circuit leaves.

Near a minimum the terms of a fit are linear in its parameters q and in δ at the nodes,

    t = y + J q + U δ + noise,      δ ~ N(0, κ).

The size, the length and the power of δ are seen by the restricted likelihood, in which the
parameters are integrated over (Patterson and Thompson 1971, Biometrika 58),

    −2 ln p = ln |1 + κ Uᵀ M U| + yᵀ (M − M U (κ⁻¹ + Uᵀ M U)⁻¹ Uᵀ M) y,

    M = 1 − J (Jᵀ J + P)⁻¹ Jᵀ,

with the precision P of their priors.

The covariance of δ is the mean over sizes, lengths and powers, weighted by it. The largest alone
would be too small, because a smooth function tells of its own size by a few numbers only.

**Changes with a name.** A gain, a capacitance or another circuit is no smooth random function: what
it does lies nearly in the span of the elements, and δ would not contain it. A change d explains the
residual if its amplitude in place of δ makes the data likelier, by the likelihood ratio

    max over κ of z²(κ) − (−2 ln p(κ) + 2 ln p(best)),

where z(κ) is the score of d with δ in the covariance: if d is the cause, a smaller δ is enough.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from etid.likelihood.discrepancy import kernels, roots
from etid.likelihood.linear import diagonal

LEVELS = np.geomspace(0.1, 10.0, 15)  # sizes of δ, relative to what the circuit leaves
SMALLEST = 1e-9  # of a matrix that is scaled to a unit diagonal
NOTHING = 1e-6  # of the information about a change; the parameters leave less of what they can make


class Restricted(NamedTuple):
    """What the restricted likelihood says.

    Attributes:
        covariance: Mean covariance of δ between the nodes.
        shown: Likelihood ratio of δ.
        ratio: Likelihood ratio of each change.
        explained: Part of the squares that δ explains, which each change explains without δ.
    """

    covariance: Float[np.ndarray, "row node node"]
    shown: Float[np.ndarray, " row"]
    ratio: Float[np.ndarray, "row change"]
    explained: Float[np.ndarray, "row change"]


def restricted(
    rows: Float[np.ndarray, "row term part"],
    nodes: Float[np.ndarray, "row node part"],
    precision: Float[np.ndarray, "row q q"],
    pull: Float[np.ndarray, "row q"],
    left: Float[np.ndarray, " row"],
    harmonics: int,
    parts: int = 2,
) -> Restricted:
    """What the restricted likelihood says of δ.

    Args:
        rows: J, then y, then further changes.
        nodes: U: real parts of δ, output by output, then imaginary parts.
        precision: Of the priors of the parameters.
        pull: Gradient of the priors.
        left: What the circuit leaves, relative to the signal.
        harmonics: Number of harmonics.
        parts: Number of real and imaginary parts of δ.
    """
    count, known = precision.shape[-1], rows.shape[1]
    products = np.concatenate([rows, nodes], 1)
    products = products @ products.swapaxes(-1, -2)
    products[:, :count, :count] += precision
    products[:, :count, count] += pull
    products[:, count, :count] += pull
    whole = diagonal(products)[:, None, count + 1 : known]
    products, known = without(products, count), known - count  # the terms and the changes
    eigen, told = _independent(products[:, None, known:], known, harmonics, parts)
    eigen = eigen[:, :, None]
    size = (left[:, None] * LEVELS) ** 2
    share = size[:, None, :, None] / (1 + size[:, None, :, None] * eigen)
    squares = products[:, :1, :1] - (share * told[:, :, None, :, 0] ** 2).sum(-1)
    value = np.log1p(size[:, None, :, None] * eigen).sum(-1) + squares
    value = np.where(np.isfinite(value) & (squares > 0), value, np.inf)
    best = value.min((1, 2))
    weight = np.exp(-0.5 * (value - best[:, None, None]))
    weight = weight / weight.sum((1, 2), keepdims=True)
    covariance = np.nan_to_num(np.einsum("rkl,rl,kij->rij", weight, size, kernels(harmonics)))
    # Of each size the likeliest length and power, and no δ at all.
    row, place, level = np.arange(len(value))[:, None], value.argmin(1), np.arange(LEVELS.size)
    share, told = share[row, place, level], told[row, place]
    changed = products[:, None, 0, 1:known] - np.einsum(
        "rlf,rlfc->rlc", share * told[..., 0], told[..., 1:]
    )
    information = diagonal(products)[:, None, 1:known] - np.einsum(
        "rlf,rlfc->rlc", share, told[..., 1:] ** 2
    )
    none = products[:, None, 0, 1:known], diagonal(products)[:, None, 1:known]
    changed, information = (
        np.concatenate(of, 1) for of in zip(none, (changed, information), strict=True)
    )
    seen = information > NOTHING * whole
    scores = np.where(seen, changed**2 / np.where(seen, information, 1.0), 0.0)
    value = np.concatenate([products[:, :1, 0], value.min(1)], 1)
    ratio = (scores - (value - best[:, None])[..., None]).max(1)
    explained = products[:, 0, 0] - squares.reshape(len(best), -1).min(1)
    return Restricted(covariance, value[:, 0] - best, ratio, scores[:, 0] / explained[:, None])


def _independent(
    products: Float[np.ndarray, "row 1 node every"], known: int, harmonics: int, parts: int
) -> tuple[
    Float[np.ndarray, "row kernel function"], Float[np.ndarray, "row kernel function known"]
]:
    """Information on the functions of each kernel, turned to be independent; products with them.

    Kernels of long lengths have fewer functions than others; the rest are zeros.
    """
    every = [np.kron(np.eye(parts), of) for of in roots(harmonics)]
    most, found = max(of.shape[-1] for of in every), []
    for root in every:
        back = root.swapaxes(-1, -2)
        eigen, turn = np.linalg.eigh(back @ products[..., known:] @ root)
        told = turn.swapaxes(-1, -2) @ (back @ products[..., :known])
        more = (0, most - eigen.shape[-1])
        eigen = np.pad(np.maximum(eigen, 0.0), [(0, 0), (0, 0), more])
        found.append((eigen, np.pad(told, [(0, 0), (0, 0), more, (0, 0)])))
    eigens, tolds = zip(*found, strict=True)
    return np.concatenate(eigens, 1), np.concatenate(tolds, 1)


def without(
    products: Float[np.ndarray, "row n n"], count: int
) -> Float[np.ndarray, "row rest rest"]:
    """Products of what the first `count` of so many terms leave of the others."""
    scale = np.sqrt(diagonal(products)[:, :count])
    scale = np.where(scale > 0, scale, 1.0)
    own = products[:, :count, :count] / scale[:, :, None] / scale[:, None, :]
    beside = products[:, :count, count:] / scale[:, :, None]
    rest = np.linalg.solve(own + SMALLEST * np.eye(count), beside)
    return products[:, count:, count:] - beside.swapaxes(-1, -2) @ rest
