"""Linear systems of rows that are known by their products only.

A search tries elements for which a system has no solution in floating point. Then the solution is
0, and its caller sees no progress.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Inexact

from etid.likelihood.linear import repeated
from etid.precision import namespace
from etid.signals.transfer import AnyArray

LEFT = 1e-4  # of the right side; the next step of a search, or its last one, corrects it
PRODUCTS = 100  # largest number of steps of a solution

Vector = Inexact[AnyArray, "*row term"]
Product = Callable[[Vector], Vector]


def solved(product: Product, b: Vector) -> Vector:
    """Solution of A x = b for A near 1; JAX differentiates it."""
    if namespace(b) is np:
        return stabilised(product, b)
    return jax.lax.custom_linear_solve(product, b, stabilised, stabilised)


class _Stabilised(NamedTuple):
    """Where BiCGStab is; the names are those of van der Vorst."""

    x: Vector
    r: Vector
    p: Vector
    rho: Float[AnyArray, "*row 1"]
    moves: Bool[AnyArray, "*row 1"]


def stabilised(product: Product, b: Vector) -> Vector:
    """BiCGStab (van der Vorst 1992, SIAM J. Sci. Stat. Comput. 13)."""
    xp, least = namespace(b), LEFT**2 * _dot(b, b)

    def step(of: _Stabilised) -> _Stabilised:
        v = product(of.p)
        alpha = of.rho / _dot(b, v)
        s = of.r - alpha * v
        t = product(s)
        squares = _dot(t, t)
        omega = _dot(t, s) / xp.where(squares > 0, squares, 1.0)
        x, r = of.x + alpha * of.p + omega * s, s - omega * t
        rho = _dot(b, r)
        p = r + rho / of.rho * alpha / xp.where(omega != 0, omega, 1.0) * (of.p - omega * v)
        sound = xp.isfinite(rho)
        moves = of.moves & sound & (_dot(r, r) > least)
        taken = of.moves & sound
        new, old = (x, r, p, rho), (of.x, of.r, of.p, of.rho)
        x, r, p, rho = (xp.where(taken, *each) for each in zip(new, old, strict=True))
        return _Stabilised(x, r, p, rho, moves)

    whole = _dot(b, b)
    last = repeated(step, _Stabilised(xp.zeros_like(b), b, b, whole, whole > 0), PRODUCTS)
    return last.x


class _Conjugate(NamedTuple):
    """Where conjugate gradients are."""

    x: Vector
    r: Vector
    p: Vector
    size: Float[AnyArray, "*row 1"]
    moves: Bool[AnyArray, "*row 1"]


def conjugate(product: Product, b: Vector, left: float, steps: int) -> Vector:
    """Solution for a symmetric positive A, to this part of b; complex terms are pairs."""
    xp, whole = namespace(b), _dot(b, b)

    def step(of: _Conjugate) -> _Conjugate:
        along = product(of.p)
        far = xp.where(of.moves, of.size / _dot(of.p, along), 0.0)
        x, r = of.x + far * of.p, of.r - far * along
        size = _dot(r, r)
        p = r + xp.where(of.moves, size / of.size, 0.0) * of.p
        return _Conjugate(x, r, p, size, of.moves & (size > left**2 * whole))

    return repeated(step, _Conjugate(xp.zeros_like(b), b, b, whole, whole > 0), steps).x


def _dot(a: Vector, b: Vector) -> Float[AnyArray, "*row 1"]:
    """Σ a b, of real and imaginary parts."""
    found = (a.real * b.real).sum(-1, keepdims=True)
    if not namespace(a).iscomplexobj(a):
        return found
    return found + (a.imag * b.imag).sum(-1, keepdims=True)
