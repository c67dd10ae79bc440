"""Inverses and roots of symmetric matrices, each scaled to a unit diagonal.

The parameters of a fit have different units, or very different accuracies. Inverses and roots
therefore scale their matrix M before it is factorised: D⁻¹ M D⁻¹, where D² is the diagonal of M.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from etid.precision import namespace
from etid.signals.transfer import AnyArray

SMALLEST = 1e-12  # eigenvalue of a scaled matrix; double precision resolves no smaller one


def inverse(matrix: Float[AnyArray, "n n"], *, drop: bool = False) -> Float[AnyArray, "n n"]:
    """Inverse of a symmetric matrix.

    Directions without information get an enormous variance. With `drop` they get none: nuisance
    parameters that the data do not determine do not affect the other parameters.
    """
    xp, (scaled, scale) = namespace(matrix), _unit_diagonal(matrix)
    if xp is np and not np.isfinite(scaled).all():
        return np.full_like(scaled, np.nan)  # as JAX does
    values, vectors = xp.linalg.eigh(scaled)
    weight = 1 / xp.maximum(values, SMALLEST)
    weight = xp.where(values > SMALLEST, weight, 0.0 if drop else weight)
    return (vectors * weight[None, :]) @ vectors.T / scale[:, None] / scale[None, :]


def inverse_of_few(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Inverse of a positive definite matrix of a few rows, for all lanes at once.

    It uses Gauss-Jordan elimination: a call of LAPACK for each lane costs twenty times as much.
    """
    scaled, scale = _unit_diagonal(matrix)
    size = matrix.shape[0]
    work = jnp.concatenate([scaled, jnp.eye(size)], axis=1)
    for i in range(size):
        row = work[i] / work[i, i]
        work = (work - work[:, i][:, None] * row[None, :]).at[i].set(row)
    return work[:, size:] / scale[:, None] / scale[None, :]


def root_of_few(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Cholesky's factor L of a positive definite matrix of a few rows, for all lanes at once."""
    scaled, scale = _unit_diagonal(matrix)
    columns, left = [], np.arange(matrix.shape[0])
    for i in left:
        column = jnp.where(left >= i, scaled[:, i], 0.0) / jnp.sqrt(scaled[i, i])
        columns.append(column)
        scaled = scaled - column[:, None] * column[None, :]
    return jnp.stack(columns, axis=1) * scale[:, None]


def root(matrix: Float[AnyArray, "n n"]) -> Float[AnyArray, "n n"]:
    """A matrix L with L Lᵀ = M, for a positive semidefinite M."""
    factor, scale = _factor(matrix)
    return scale[:, None] * factor


def inverse_root(matrix: Float[AnyArray, "n n"]) -> Float[AnyArray, "n n"]:
    """A matrix L with L Lᵀ = M⁻¹, for a positive semidefinite M."""
    factor, scale = _factor(matrix)
    if isinstance(factor, np.ndarray):
        return (np.linalg.inv(factor) / scale[None, :]).T
    return jax.scipy.linalg.solve_triangular(factor, jnp.diag(1 / scale), lower=True).T


def is_definite(cov: Float[np.ndarray, "n n"]) -> bool:
    """Whether each combination of parameters has a variance, whatever their units are.

    The variance of a fixed element is 10⁻¹⁸: only correlations have a common scale.
    """
    scale = np.sqrt(np.maximum(np.diagonal(cov), 0.0))
    if not (np.isfinite(cov).all() and (scale > 0).all()):
        return False
    return bool(np.linalg.eigvalsh(cov / np.outer(scale, scale))[0] > SMALLEST)


def diagonal(matrix: Float[AnyArray, "n n"]) -> Float[AnyArray, " n"]:
    """The diagonal of a matrix; `jnp.diagonal` is traced as twenty operations."""
    return namespace(matrix).where(np.eye(matrix.shape[0], dtype=bool), matrix, 0.0).sum(1)


def _unit_diagonal(
    matrix: Float[AnyArray, "n n"],
) -> tuple[Float[AnyArray, "n n"], Float[AnyArray, " n"]]:
    """D⁻¹ M D⁻¹ and the diagonal of D, which is 1 where the diagonal of M is not positive."""
    xp = namespace(matrix)
    scale = xp.sqrt(xp.maximum(diagonal(matrix), 0.0))
    scale = xp.where(scale > 0, scale, 1.0)
    return matrix / scale[:, None] / scale[None, :], scale


def _factor(matrix: Float[AnyArray, "n n"]) -> tuple[Float[AnyArray, "n n"], Float[AnyArray, " n"]]:
    """Cholesky factor of D⁻¹ M D⁻¹ with a ridge for directions without information, and D."""
    scaled, scale = _unit_diagonal(matrix)
    scaled = scaled + SMALLEST * np.eye(scale.size)
    if not isinstance(scaled, np.ndarray):
        return jax.scipy.linalg.cholesky(scaled, lower=True), scale
    try:
        return np.linalg.cholesky(scaled), scale
    except np.linalg.LinAlgError:
        return np.full_like(scaled, np.nan), scale  # as JAX does
