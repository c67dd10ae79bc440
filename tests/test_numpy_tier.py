"""NumPy runs a jaxpr with the results of XLA: each primitive alone, and programs of several."""

import functools
import tracemalloc
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from etid.numpy_tier import UntranslatableError, translated
from etid.numpy_tier.primitives import RULES
from etid.numpy_tier.translator import written

EPSILON = {"f": 8, "c": 16}  # roundings of both results; complex products add two of them
REAL = (np.float64, np.float32)
NUMBERS = (*REAL, np.int64, np.int32)
FINITE = (0.0, -0.0, 0.5, -0.5, 1.0, -1.0, 1.5, -2.5, 3.0, 1e-3, 7e4, -13.7)
SPECIAL = (*FINITE, np.nan, np.inf, -np.inf)


def every(dtype, finite=False):
    """Numbers of a type that are easily wrong, with NaN and infinities unless they must be finite.

    On a cut of the complex plane XLA does not always regard the sign of 0: no complex part is -0.
    """
    kind = np.dtype(dtype).kind
    if kind == "b":
        return np.array([False, True])
    if kind == "i":
        return np.arange(-9, 10, dtype=dtype)
    if kind == "c":
        parts = np.add.outer(np.array(FINITE), 1j * np.array(FINITE)).ravel()
        return (parts + 0).astype(dtype)
    return np.array(FINITE if finite else SPECIAL, dtype)


def pairs(dtype):
    """Each of these numbers with each."""
    numbers = every(dtype)
    return np.repeat(numbers, numbers.size), np.tile(numbers, numbers.size)


jitted = functools.cache(jax.jit)


def check(function, *operands, rounding=1.0):
    """The results of both, of which the types and shapes must be equal too."""
    program = translated(jax.make_jaxpr(function)(*operands))
    found = program(jax.tree.leaves(operands))
    expected = jax.tree_util.tree_leaves_with_path(jitted(function)(*operands))
    for one, (path, other) in zip(found, expected, strict=True):
        name, other = jax.tree_util.keystr(path), np.asarray(other)
        assert (np.asarray(one).dtype, np.shape(one)) == (other.dtype, other.shape), name
        if other.dtype.kind in "fc":
            tolerance = rounding * EPSILON[other.dtype.kind] * np.finfo(other.dtype).eps
            finite = np.abs(other[np.isfinite(other)])
            atol = tolerance * min(finite.max() if finite.size else 0.0, 1)
            np.testing.assert_allclose(one, other, rtol=tolerance, atol=atol, err_msg=name)
        else:
            np.testing.assert_array_equal(one, other, name)


def each(functions):
    """One program of these functions, by name: it is compiled faster than one for each."""
    return lambda *of: {name: function(*of) for name, function in functions.items()}


def of_type(table, dtype):
    """The functions of a table that take this type."""
    found = [of for dtypes, functions in table.items() if dtype in dtypes for of in functions]
    return each({of.__name__: of for of in found})


COMPLEX = (np.complex128,)
ONE = {
    REAL: (
        *(lax.acos, lax.acosh, lax.asin, lax.asinh, lax.atan, lax.atanh, lax.cbrt, lax.ceil),
        *(lax.erf, lax.erfc, lax.expm1, lax.floor, lax.is_finite, lax.log1p, lax.logistic),
        lax.round,
    ),
    REAL + COMPLEX: (lax.cos, lax.exp, lax.log, lax.sin, lax.sqrt),
    NUMBERS: (lax.sign,),
    NUMBERS + COMPLEX: (lax.abs, lax.neg, lax.square),
    COMPLEX: (lax.conj, lax.imag, lax.real),
    (np.bool_, np.int32): (lax.bitwise_not,),
}
TWO = {
    REAL: (lax.atan2, lax.complex),
    NUMBERS: (lax.div, lax.ge, lax.gt, lax.le, lax.lt, lax.max, lax.min, lax.rem),
    NUMBERS + COMPLEX: (lax.add, lax.mul, lax.sub),
    (*NUMBERS, np.bool_, np.complex128): (lax.eq, lax.ne),
    (np.bool_, np.int32): (lax.bitwise_and, lax.bitwise_or, lax.bitwise_xor),
}
# Functions that both compute from polynomials of their own, to some units in the last place.
APPROXIMATE = {REAL: (lax.exp2, lax.sinh, lax.cosh, lax.tan, lax.tanh)}
TYPES = (*NUMBERS, np.complex128, np.bool_)


@pytest.mark.parametrize("dtype", TYPES)
def test_functions_of_one_number_and_of_two(dtype):
    a, b = pairs(dtype)
    check(of_type(ONE, dtype), every(dtype), rounding=4)
    check(of_type(TWO, dtype), a, b, rounding=4)
    if dtype in REAL:
        check(of_type(APPROXIMATE, dtype), every(dtype), rounding=40)
        check(lax.pow, a, b, rounding=100)
    if dtype in COMPLEX:
        check(lax.div, a, b + (b == 0), rounding=4)


X = np.random.default_rng(0).normal(size=(3, 4, 5))
KEYS = (*(X[:2] * 2).round(), X[2])
OTHER = {  # functions, and their operands
    "of no number": (lambda x: lax.sin(x) + x, np.zeros((2, 0))),
    "of one number": (lambda x: lax.convert_element_type(lax.sin(x), np.int32), np.array(0.5)),
    "clamped": (lax.clamp, *(np.roll(pairs(np.float64)[0], n) for n in (40, 0, 90))),
    "rounded": (lambda x: lax.round(x, lax.RoundingMethod.TO_NEAREST_EVEN), every(np.float64)),
    "chosen": (lax.select, X > 0, X, X[::-1]),
    "chosen at once": (lax.select, np.bool_(True), X, X[::-1]),
    "one of three": (lax.select_n, (abs(X) % 3).astype(np.int32), X, -X, X[::-1]),
    "slope of what is made complex": (
        lambda x: jax.linear_transpose(lambda y: y.astype(complex), x.real)(x)[0],
        X + 1j * X[::-1],
    ),
    "gaps": (lambda x: jnp.sum(x, axis=0), np.where(X > 1, np.nan, X)),
    "sum of nothing": (lambda x: (x.sum(1), x.sum(0), jnp.cumsum(x, 1)), np.zeros((2, 0))),
    "least of nothing": (
        lambda x: lax.reduce_min_p.bind(x, axes=(1,), out_sharding=None),
        np.zeros((2, 0)),
    ),
    "sorted by one": (lambda *of: lax.sort(of, dimension=1, num_keys=1), *KEYS),
    "sorted by two": (lambda *of: lax.sort(of, dimension=0, num_keys=2), *KEYS),
    "nothing is looked up": (lambda x, at: (x[at], x.at[at].set(1.0)), X, np.zeros((0, 2), int)),
    "no step": (lambda x: lax.fori_loop(3, 3, lambda i, y: y + i, x), X),
    "algebra of nothing": (
        lambda a: (jnp.linalg.cholesky(a), lax.linalg.triangular_solve(a, a, lower=True)),
        np.zeros((0, 0)),
    ),
}


def test_other_functions():
    operands = {name: of for name, (_, *of) in OTHER.items()}
    check(lambda of: {name: OTHER[name][0](*of[name]) for name in OTHER}, operands, rounding=8)


@pytest.mark.parametrize("dtype", [*REAL, np.complex128])
def test_whole_powers(dtype):
    x, powers = every(dtype), (-3, 0, 1, 2, 7)
    by = each({power: functools.partial(lax.integer_pow, y=power) for power in powers})
    check(by, x if dtype in REAL else x + (x == 0), rounding=8)
    if dtype in REAL:
        full = {power: np.full(x.size, power, np.int32) for power in powers}
        check(lambda x, of: jax.tree.map(lambda y: lax.pow(x, y), of), x, full, rounding=100)


PLAIN = (*REAL, np.int64, np.int32, np.bool_)
CONVERTED: dict[Any, Any] = {of: PLAIN for of in (*REAL, np.int64, np.bool_)}
CONVERTED |= {np.float64: PLAIN + COMPLEX, np.complex128: (np.complex64,)}


@pytest.mark.parametrize("old", CONVERTED)
def test_numbers_of_another_type(old):
    check(lambda x: [lax.convert_element_type(x, new) for new in CONVERTED[old]], every(old))


ALONG = {
    (*REAL, np.int32, np.complex128): (jnp.sum,),
    (*REAL, np.int32): (jnp.prod, jnp.max, jnp.min, jnp.argmax, jnp.cumsum),
    (np.bool_,): (jnp.any, jnp.all),
    REAL: (jnp.argmin, functools.partial(lax.cumsum, reverse=True)),
    (*NUMBERS, np.bool_): (jnp.sort,),
    NUMBERS: (jnp.argsort,),
}


@pytest.mark.parametrize("dtype", TYPES)
def test_functions_along_an_axis(dtype):
    functions = [of for dtypes, these in ALONG.items() if dtype in dtypes for of in these]
    x = np.random.default_rng(2).choice(every(dtype, finite=True), (4, 3, 5))  # some are equal
    check(lambda x: [[of(x, axis=axis) for axis in range(3)] for of in functions], x, rounding=8)


SHAPED = {
    "broadcast": lambda x: jnp.broadcast_to(x[:, None, :, :1], (3, 2, 4, 5)) + 1.0,
    "broadcast scalar": lambda x: jnp.full((2, 3), x[0, 0, 0]).reshape(3, 2).T @ jnp.ones((3, 4)),
    "concatenate": lambda x: jnp.concatenate([x, x[:, :0], x[:, :1]], axis=1),
    "expand and squeeze": lambda x: jnp.expand_dims(x, (0, 3)).squeeze(0),
    "flip": lambda x: jnp.flip(x, (0, 2)),
    "iota": lambda x: lax.broadcasted_iota(jnp.float64, (3, 4, 5), 1) * x,
    "pad": lambda x: lax.pad(x, 1.5, ((1, 2, 0), (0, 0, 2), (3, 0, 1))),
    "pad with less": lambda x: lax.pad(x, 1.5, ((-1, 0, 0), (-2, -3, 2), (2, -4, 1))),
    "reshape": lambda x: x.reshape(2, 30).reshape(5, 12),
    "slice": lambda x: x[1:, ::2, 1:4],
    "split": lambda x: jnp.split(x, [1, 3], axis=1),
    "stack": lambda x: jnp.stack([x, -x], axis=2),
    "tile": lambda x: jnp.tile(x, (2, 1, 3)),
    "transpose": lambda x: x.transpose(2, 0, 1),
    "unstack": lambda x: list(x),
    "dynamic slice": lambda x: lax.dynamic_slice(x, (jnp.argmax(x[:, 0, 0]), 3, 9), (2, 2, 2)),
    "dynamic index": lambda x: x[jnp.argmax(x[:, 0, 0])],
    "dynamic update": lambda x: lax.dynamic_update_slice(x, x[:2, :2, :2], (2, 1, -1)),
    "window sum": lambda x: lax.reduce_window(x, 0.0, lax.add, (1, 3, 2), (1, 2, 1), "SAME"),
}


def test_arrays_of_another_shape():
    check(each(SHAPED), np.where(X > 1, np.nan, X))


AT = np.array([[0, 2], [5, -1], [1, -7]])
LOOKED_UP = {
    "rows": lambda x, at: x[at],
    "elements": lambda x, at: x[at[:, 0], at[:, 1]],
    "elements, clipped": lambda x, at: x.at[at[:, 0], :, at[:, 1]].get(mode="clip"),
    "elements, filled": lambda x, at: x.at[at[:, 0], :, at[:, 1]].get(mode="fill"),
    "whole numbers, filled": lambda x, at: jnp.round(x).astype(int).at[at].get(mode="fill"),
    "elements, 7 elsewhere": lambda x, at: x.at[at].get(mode="fill", fill_value=7.0),
    "along an axis": lambda x, at: jnp.take_along_axis(x, at[:, :, None] % 4, axis=1),
    "windows": lambda x, at: jax.vmap(lambda i: lax.dynamic_slice(x, (i, 1, i), (2, 2, 3)))(
        at[:, 0]
    ),
    "each its own": lambda x, at: jax.vmap(lambda x, i: x[i])(x, at[:, 1]),
    "each its own window": lambda x, at: jax.vmap(
        lambda x, i: lax.dynamic_slice(x, (i, 0), (2, 3))
    )(x, at[:, 1]),
    "a diagonal": lambda x, at: jnp.diagonal(x, axis1=0, axis2=2),
    "set": lambda x, at: x.at[at[:, 0], :, at[:, 1]].set(0.5),
    "added": lambda x, at: x.at[at].add(x[:1] * 2),
    "set, clipped": lambda x, at: x.at[at[:1, 1]].set(-1.0, mode="clip"),
    "set in windows": lambda x, at: x.at[:, 1:3, 2].set(jnp.arange(2.0)),
    "each set": lambda x, at: jax.vmap(lambda x, i: x.at[i].set(0.0))(x, at[:, 1]),
}


def test_elements_are_looked_up():
    look_up = each(LOOKED_UP)
    check(look_up, X, AT)
    check(lambda x: look_up(x, AT), X)  # at places that are known
    check(lambda at: look_up(jnp.asarray(X), at), AT)


EINSUMS = "i,i-> ij,j->i ji,kj->ik ij,kl->ijkl bij,bjk->bik ijb,kbj->bk bi,bi->b".split()


@pytest.mark.parametrize("dtype", [*REAL, np.complex128])
def test_products(dtype):
    rng = np.random.default_rng(3)

    def drawn(part, sizes):
        shape = [sizes.get(axis, 2 + "ijklb".index(axis)) for axis in part]
        return (rng.normal(size=shape) + (1j if dtype is np.complex128 else 0)).astype(dtype)

    for sizes in ({}, {"j": 0}, {"i": 1}):
        operands = {
            text: [drawn(part, sizes) for part in text.partition("->")[0].split(",")]
            for text in EINSUMS
        }
        check(lambda of: [jnp.einsum(text, *of[text]) for text in EINSUMS], operands, rounding=40)


# Condition numbers stay below 100, and each of some ten operations rounds.
ALGEBRA = {
    "cholesky": jnp.linalg.cholesky,
    "lu": lambda a: lax.linalg.lu(a),
    "solve": lambda a: jnp.linalg.solve(a, a[..., :1]),
    "inverse": jnp.linalg.inv,
    "eigenvalues": lambda a: jnp.linalg.eigh(a)[0],
    "projections": lambda a: jnp.linalg.eigh(a)[1] ** 2,
    "roots": lambda a: jnp.sort(jnp.linalg.eigvals(a).real),
    "qr": lambda a: abs(jnp.linalg.qr(a)[1]),
    "singular values": lambda a: jnp.linalg.svd(a, compute_uv=False),
    "singular vectors": lambda a: [abs(of) for of in jnp.linalg.svd(a[..., :3])],
    "pseudo-inverse": jnp.linalg.pinv,
    "lower": lambda a: lax.linalg.triangular_solve(a, a, left_side=True, lower=True),
    "right": lambda a: lax.linalg.triangular_solve(a, a, lower=False),
    "transposed": lambda a: lax.linalg.triangular_solve(
        a, a, left_side=True, lower=True, transpose_a=True
    ),
    "unit": lambda a: lax.linalg.triangular_solve(
        a, a, left_side=True, lower=True, unit_diagonal=True
    ),
}


@pytest.mark.parametrize("batch", [(), (2,), (2, 3)])
def test_linear_algebra(batch):
    root = np.random.default_rng(4).normal(size=(*batch, 4, 4))
    check(each(ALGEBRA), root @ root.swapaxes(-1, -2) + 2 * np.eye(4), rounding=1e4)


def test_matrices_without_a_result():
    """They give the NaN and the infinities of XLA, never a number and never an error."""
    names = "cholesky", "inverse", "lower", "eigenvalues", "roots", "singular values"
    of = each({name: ALGEBRA[name] for name in names})
    for matrix in (np.zeros((3, 3)), np.full((3, 3), np.nan), np.diag([1.0, 0.0, 2.0])):
        check(of, matrix)
    check(ALGEBRA["cholesky"], np.diag([1.0, -1.0, 2.0]))
    good = np.diag([1.0, 2.0, 3.0, 4.0]) + 0.1  # beside one, a matrix has its own result
    both = np.stack([np.full((4, 4), np.nan), good])
    program, alone = (translated(jax.make_jaxpr(each(ALGEBRA))(of)) for of in (both, good[None]))
    for one, other in zip(program([both]), alone([good[None]]), strict=True):
        np.testing.assert_array_equal(one[1], other[0])


def test_fourier_transforms():
    real, sizes = (jnp.fft.rfft, jnp.fft.fft, jnp.fft.ifft), (8, 9, 5)
    check(lambda x: [of(x, n=size) for of in real for size in sizes], X, rounding=20)
    check(lambda x: [jnp.fft.irfft(x, n=n) for n in sizes], X + 1j * X[::-1], rounding=20)
    check(lambda x: [jnp.fft.rfft2(x, s=(n, 4)) for n in sizes], X, rounding=20)


def root(x):
    """Square roots by Newton's method, with a loop of unknown length."""

    def wrong(state):
        return (state[1] > 1e-12) & (state[2] < 30)

    def step(state):
        y, _, count = state
        new = 0.5 * (y + x / y)
        return new, jnp.abs(new - y).max(), count + 1

    return lax.while_loop(wrong, step, (x, jnp.inf, 0))


def recursion(x):
    def step(carry, row):
        scale = jnp.exp(-x[0, 0])  # does not change in the loop
        carry = jnp.where(row > 0, carry * scale + row, carry)
        return carry, (carry.sum(), row * scale)

    return lax.scan(step, jnp.zeros(x.shape[1:]), x)


def backwards(x):
    return lax.scan(
        lambda total, row: (total + row, total), jnp.zeros(x.shape[1:]), x, reverse=True
    )


def either(x):
    return lax.cond(x[0, 0] > 0, lambda x: (jnp.sin(x), x), lambda x: (x, x * 2), x)


def nested(x):
    def step(i, y):
        return lax.cond(i % 2 == 0, lambda y: y + recursion(x)[0], lambda y: y * 0.5, y)

    return lax.fori_loop(0, 5, step, x[0])


PROGRAMS = {
    "while": lambda x: root(jnp.abs(x) + 0.1),
    "no step": lambda x: lax.while_loop(lambda y: y[0, 0] > 1e9, lambda y: y * 0, x),
    "scan": recursion,
    "one step": lambda x: recursion(x[:1])[1],
    "backwards": backwards,
    "cond": either,
    "nested": nested,
    "lanes": jax.vmap(lambda x: root(jnp.abs(x) + 0.1)),
    "lanes of scalars": jax.vmap(jax.vmap(lambda x: root(jnp.abs(x) + 0.1)[2])),
    "gradient": jax.grad(lambda x: recursion(x)[0].sum()),
    "jacobian": jax.jacfwd(lambda x: jnp.linalg.solve(jnp.eye(3) + x @ x.T, x)[0]),
    "map": lambda x: lax.map(lambda row: jnp.sort(row) - row.mean(), x),
    "cases": lambda x: lax.switch(jnp.argmax(x[0]), [jnp.sin, jnp.cos, jnp.tan], x),
    "switch": lambda x: lax.switch(1, [jnp.sin, jnp.cos, jnp.tan], x),
    "own derivative": lambda x: jax.nn.relu(x) + jax.nn.softplus(x),
    "complex": lambda x: jnp.exp(lax.complex(x, -x)).real * jnp.conj(lax.complex(x, x)).imag,
    "constants": lambda x: jnp.arange(12.0).reshape(3, 4) * 2 + jnp.ones((3, 4)),
    "placed": lambda x: jax.device_put(2 * x) + jax.device_put(np.float64(1.0)),
    "nothing but its operand": lambda x: (x, x),
}


def test_programs():
    x = np.random.default_rng(1).normal(size=(3, 4))
    check(each(PROGRAMS), x, rounding=400)
    for name in ("constants", "nothing but its operand"):
        check(PROGRAMS[name], x)
    special = {name: PROGRAMS[name] for name in ("while", "scan", "cond", "own derivative", "map")}
    check(each(special), np.array([[np.nan, 1.0], [np.inf, -np.inf]]), rounding=40)


def test_what_has_no_rule_is_refused():
    refused = (
        jax.scipy.special.erfinv,
        lambda x: jax.random.normal(jax.random.key(0), x.shape),
        lambda x: lax.conv(x, x[:, :, :1], (1,), "SAME"),
        lambda x: lax.reduce_window(
            x, 0.0, lax.add, (1, 2, 1), (1, 1, 1), "VALID", window_dilation=(1, 2, 1)
        ),
        lambda x: jnp.linalg.eig(x[:, :3, :3]),
        lambda x: jnp.linalg.svd(x[:, :0]),
    )
    for function in refused:
        with pytest.raises(UntranslatableError):
            translated(jax.make_jaxpr(function)(X))
    assert callable(RULES["rev"]({"dimensions": (0,)}, [], []))
    with pytest.raises(UntranslatableError):
        RULES["rev"]({"dimensions": (0,), "of_a_later_version": 1}, [], [])


def test_a_program_does_not_change_its_operands():
    x = X.copy()
    translated(jax.make_jaxpr(lambda x: x.at[0].set(0.0).at[:, 1].add(1.0))(x))([x])
    np.testing.assert_array_equal(x, X)


def test_what_does_not_change_is_computed_before_the_loop():
    text, _ = written(jax.make_jaxpr(recursion)(X[0]))
    inside = [line for line in text.splitlines() if line.startswith("  ")]  # of the step
    assert "=exp" in text
    assert inside
    assert not any("=exp" in line for line in inside)


def test_memory_does_not_grow_with_the_length_of_a_program():
    def chain(x):
        for _ in range(30):
            x = jnp.sin(x)
        return x

    x = np.ones(100_000)
    run = translated(jax.make_jaxpr(chain)(x))
    tracemalloc.start()
    run([x])
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 4 * x.nbytes
