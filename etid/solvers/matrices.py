"""Inverses of symmetric matrices, each in its own scaling.

The parameters of a fit have different units, or are known with very different accuracy. A matrix of
their curvatures is therefore scaled to a unit diagonal, D⁻¹ M D⁻¹ with D² the diagonal of M, before
it is factorised. All functions here do so.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

SMALLEST = 1e-12  # of a scaled matrix; below it double precision sees nothing


def inverse(matrix: Float[Array, "n n"], *, drop: bool = False) -> Float[Array, "n n"]:
    """Inverse of a symmetric matrix.

    Directions without information keep an enormous variance, or with `drop` none: nuisances that
    the data do not determine have no effect either.
    """
    scaled, scale = _unit_diagonal(matrix)
    values, vectors = jnp.linalg.eigh(scaled)
    weight = 1 / jnp.maximum(values, SMALLEST)
    weight = jnp.where(values > SMALLEST, weight, 0.0 if drop else weight)
    return (vectors * weight[None, :]) @ vectors.T / scale[:, None] / scale[None, :]


def inverse_of_few(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Inverse of a positive definite matrix of a few rows, all lanes at once.

    By Gauss and Jordan: a call of LAPACK for each lane costs twenty times as much.
    """
    scaled, scale = _unit_diagonal(matrix)
    size = matrix.shape[0]
    work = jnp.concatenate([scaled, jnp.eye(size)], axis=1)
    for i in range(size):
        row = work[i] / work[i, i]
        work = (work - work[:, i][:, None] * row[None, :]).at[i].set(row)
    return work[:, size:] / scale[:, None] / scale[None, :]


def root(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """A matrix L with L Lᵀ = M, for a positive semidefinite M."""
    factor, scale = _factor(matrix)
    return scale[:, None] * factor


def inverse_root(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """A matrix L with L Lᵀ = M⁻¹, for a positive semidefinite M."""
    factor, scale = _factor(matrix)
    return jax.scipy.linalg.solve_triangular(factor, jnp.diag(1 / scale), lower=True).T


def _unit_diagonal(
    matrix: Float[Array, "n n"],
) -> tuple[Float[Array, "n n"], Float[Array, " n"]]:
    """D⁻¹ M D⁻¹ and the diagonal of D; 1 where M has no positive diagonal."""
    scale = jnp.sqrt(jnp.maximum(jnp.diagonal(matrix), 0.0))
    scale = jnp.where(scale > 0, scale, 1.0)
    return matrix / scale[:, None] / scale[None, :], scale


def _factor(matrix: Float[Array, "n n"]) -> tuple[Float[Array, "n n"], Float[Array, " n"]]:
    """Cholesky factor of D⁻¹ M D⁻¹, with a ridge for directions of which nothing is known."""
    scaled, scale = _unit_diagonal(matrix)
    return jax.scipy.linalg.cholesky(scaled + SMALLEST * jnp.eye(scale.size), lower=True), scale
