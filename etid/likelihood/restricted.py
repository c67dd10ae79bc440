"""How large δ is, and whether a change that has a name explains what a circuit leaves.

Near a minimum the terms of a fit are linear in its parameters q and in δ at the nodes,

    t = y + J q + U δ + noise,      δ ~ N(0, κ).

The size, the length and the power of δ are seen by the restricted likelihood, in which the
parameters are integrated over (Patterson and Thompson 1971, Biometrika 58),

    −2 ln p = ln |C| + ln |Jᵀ C⁻¹ J + P| + yᵀ (C⁻¹ − C⁻¹ J (Jᵀ C⁻¹ J + P)⁻¹ Jᵀ C⁻¹) y,

    C = 1 + U κ Uᵀ.

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
ROUNDS = 2  # in a fit, the size of δ is chosen again where its first choice has led
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
    precision: Float[np.ndarray, "row q"],
    pull: Float[np.ndarray, "row q"],
    left: Float[np.ndarray, " row"],
    harmonics: int,
    parts: int = 2,
) -> Restricted:
    """What the restricted likelihood says of δ.

    Args:
        rows: J, then y, then further changes.
        nodes: U: real parts of δ, output by output, then imaginary parts.
        precision: Of the prior of each parameter.
        pull: The same times its distance from the mean of the prior.
        left: What the circuit leaves, relative to the signal.
        harmonics: Number of harmonics.
        parts: Number of real and imaginary parts of δ.
    """
    count = precision.shape[-1]
    whole = rows @ rows.swapaxes(-1, -2)
    own = np.arange(count)
    whole[:, own, own] += precision
    whole[:, own, count] += pull
    whole[:, count, own] += pull
    inner, cross = nodes @ nodes.swapaxes(-1, -2), nodes @ rows.swapaxes(-1, -2)
    every, root = kernels(harmonics), np.kron(np.eye(parts), roots(harmonics))
    eigen, turn = np.linalg.eigh(root.swapaxes(-1, -2) @ inner[:, None] @ root)
    eigen = np.maximum(eigen, 0.0)
    told = turn.swapaxes(-1, -2) @ (root.swapaxes(-1, -2) @ cross[:, None])
    size = (left[:, None] * LEVELS) ** 2
    own = count + 1  # the parameters and the terms
    square = size[:, None, :, None]
    value, _, squares = _marginal(
        whole[:, None, None, :own, :own],
        told[:, :, None, :, :own],
        square,
        eigen[:, :, None],
        count,
    )
    best = value.min((1, 2))
    penalty = value - best[:, None, None]
    weight = np.exp(-0.5 * penalty)
    weight = weight / weight.sum((1, 2), keepdims=True)
    covariance = np.nan_to_num(np.einsum("rkl,rl,kij->rij", weight, size, every))
    # Of each size the likeliest length and power, and no δ at all.
    row, place = np.arange(len(value))[:, None], value.argmin(1)
    size, place = np.pad(size, ((0, 0), (1, 0))), np.pad(place, ((0, 0), (1, 0)))
    of = told[row, place], size[..., None], eigen[row, place]
    value, scores, left_over = _marginal(whole[:, None], *of, count)
    ratio = (scores - (value - best[:, None])[..., None]).max(1)
    explained = left_over[:, 0] - squares.reshape(len(best), -1).min(1)
    return Restricted(covariance, value[:, 0] - best, ratio, scores[:, 0] / explained[:, None])


def _marginal(
    whole: Float[np.ndarray, "*#row n n"],
    told: Float[np.ndarray, "*#row function n"],
    square: Float[np.ndarray, "*#row 1"],
    eigen: Float[np.ndarray, "*#row function"],
    count: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """−2 ln p, z² of each change, and the squares of the terms that are left.

    The first `count` rows of the products are those of the parameters, the next that of the terms.
    """
    weight = square / (1 + square * eigen)
    reduced = whole - (told * weight[..., None]).swapaxes(-1, -2) @ told
    sizes = diagonal(reduced)
    sound = np.isfinite(sizes).all(-1) & (sizes[..., : count + 1] > 0).all(-1)
    reduced = np.where(sound[..., None, None], reduced, np.eye(reduced.shape[-1]))
    scale = np.sqrt(np.maximum(diagonal(reduced), 0.0))
    scale = np.where(scale > 0, scale, 1.0)
    scaled = reduced / scale[..., :, None] / scale[..., None, :]
    own = scaled[..., :count, :count] + SMALLEST * np.eye(count)
    beside = scaled[..., :count, count:]
    rest = np.linalg.solve(own, beside)
    size = scale[..., count, None]
    left = scaled[..., count, count:] - (beside[..., :1] * rest).sum(-2)
    information = 1.0 - (beside[..., 1:] * rest[..., 1:]).sum(-2)
    squares = left[..., 0] * size[..., 0] ** 2
    sign, logdet = np.linalg.slogdet(own)
    logdet = logdet + np.log1p(square * eigen).sum(-1) + 2 * np.log(scale[..., :count]).sum(-1)
    logdet = np.where(sound & (sign > 0) & (squares > 0), logdet, np.inf)
    seen = information > NOTHING
    z = np.where(seen, (left[..., 1:] * size) ** 2 / np.where(seen, information, 1.0), 0.0)
    return logdet + squares, z, squares
