"""The settings of JAX for all that etid computes and keeps, whatever the process has set.

Precision is float64. NaN and infinity are results here: elements of a fit that failed have no
number, and its verdict says why. So `jax_debug_nans` and `jax_debug_infs` do not look into etid.

Formulas compute in the namespace of their arrays, NumPy or JAX. OpenBLAS shares a product of a few
thousand multiplications among threads. Those then wait for the next product in a busy loop, which
takes three quarters of the CPU time of a driver. So fits by NumPy run in `one_thread`.
"""

import contextlib
import functools
import threading
from collections.abc import Callable, Iterator, Sequence
from types import ModuleType
from typing import Any, NamedTuple, ParamSpec, TypeVar

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from threadpoolctl import ThreadpoolController

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")
Tree = TypeVar("Tree")

_NUMPY = (np.ndarray, np.generic, float, int, complex)
_INSIDE = threading.local()  # whether a thread runs an array function
_lock, _inside = threading.Lock(), 0  # number of callers that have set BLAS to one thread
_limits: list[Any] = []


def namespace(*values: Any) -> ModuleType:
    """NumPy for arrays of NumPy and numbers, so that nothing is traced; JAX if one is another."""
    for one in values:
        if not isinstance(one, _NUMPY):
            return jnp
    return np


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """BLAS has one thread within, and after the last of several callers as many as before."""
    global _inside
    with _lock:
        if _inside == 0:
            _limits.append(_blas().limit(limits=1))
        _inside += 1
    try:
        yield
    finally:
        with _lock:
            _inside -= 1
            if _inside == 0:
                _limits.pop().__exit__(None, None, None)


@functools.cache
def _blas() -> ThreadpoolController:
    return ThreadpoolController().select(user_api="blas")


def array_function(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """A function of rows, whoever calls it.

    NumPy says nothing about a row whose numbers are not finite: its verdict does. JAX multiplies
    real by complex numbers, and arrays of different ranks, as NumPy does, even where its user has
    forbidden this for own code.
    """

    @functools.wraps(function)
    def call(*args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
        if getattr(_INSIDE, "another", False):  # which has set all this
            return function(*args, **kwargs)
        of_jax = jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow")
        _INSIDE.another = True
        try:
            with np.errstate(all="ignore"), of_jax[0], of_jax[1]:
                return function(*args, **kwargs)
        finally:
            _INSIDE.another = False

    return call


def held(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """The function of arrays without a derivative; JAX traces it once for each shape."""
    traced = jax.jit(function)

    @functools.wraps(function)
    def call(*args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
        if namespace(*jax.tree.leaves((args, kwargs))) is np:
            return function(*args, **kwargs)
        args, kwargs = jax.lax.stop_gradient((args, kwargs))
        return traced(*args, **kwargs)

    return call


def in_turn(step: Callable[..., Any], state: Any, arguments: Sequence[Any]) -> Any:
    """Steps with each of the arguments: a loop of Python for NumPy, one of JAX for JAX."""
    if namespace(*jax.tree.leaves((state, arguments))) is np:
        for of in zip(*arguments, strict=True):
            state = step(state, *of)
        return state
    return jax.lax.scan(lambda state, of: (step(state, *of), None), state, tuple(arguments))[0]


def in_float64(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """The function, run in float64, with NaN as a result. The process keeps its own settings.

    Raises:
        RuntimeError: JAX traces the function in float32, for a derivative or for `jax.jit`. The
            filters would lose 4 to 9 digits without a warning.
    """

    @functools.wraps(function)
    def call(*args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
        config: Any = jax.config  # its attributes are made at run time
        looks = config.jax_debug_nans or config.jax_debug_infs
        if is_float64() and not looks:
            return function(*args, **kwargs)
        if not is_float64() and is_traced((args, kwargs)):
            raise RuntimeError(
                "etid needs float64, and JAX traces this call in float32. Before making JAX arrays,"
                ' call\n    jax.config.update("jax_enable_x64", True)\n'
                "or set the environment variable JAX_ENABLE_X64=1."
            )
        with jax.enable_x64(True), jax.debug_nans(False), jax.debug_infs(False):
            return function(*args, **kwargs)

    return call


def is_traced(of: Any) -> bool:
    """Whether JAX traces what happens here, or one of these arrays."""
    # `jnp.asarray` would compile a program of its own.
    leaves = [jax.device_put(0.0), *jax.tree.leaves(of)]
    return any(isinstance(leaf, jax.core.Tracer) for leaf in leaves)


def untraced(of: Tree) -> Tree:
    """The same with arrays of NumPy, unless JAX traces one of its arrays."""
    leaves, structure = jax.tree.flatten(of)
    if any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):
        return of
    return structure.unflatten(map(np.asarray, leaves))


def unmasked(values: Any) -> npt.NDArray | jax.Array:
    """The values as a plain array, in which those under a mask are NaN.

    `numpy.asarray` would drop the mask and give what is under it.

    Args:
        values: An array, or nested sequences of numbers or arrays. Arrays of JAX remain.
    """
    if isinstance(values, jax.Array):
        return values
    if isinstance(values, list | tuple) and any(np.ma.isMaskedArray(one) for one in values):
        values = np.ma.stack([np.ma.asarray(one) for one in values])
    if not np.ma.is_masked(values):
        return np.asarray(values)
    found: np.ndarray = np.ma.getdata(values)
    hidden: np.ndarray = np.ma.getmaskarray(values)  # pyright: ignore  # checked above
    if found.dtype.kind in "biu":  # integers have no NaN
        found = found.astype(float)
    return np.where(hidden, np.array(np.nan, found.dtype), found)


def is_float64() -> bool:
    """Whether JAX computes in float64 here."""
    config: Any = jax.config  # its attributes are made at run time
    return config.jax_enable_x64


class Kept:
    """An object whose arrays keep type and bytes in copies and pickles.

    A process of float32 makes arrays of float32 of all arrays of JAX that it unpickles, also of
    those of float64. The arrays therefore travel as arrays of NumPy.
    """

    __slots__ = ()

    def __getstate__(self) -> tuple[dict[str, Any], dict[str, Any]]:
        state: Any = super().__getstate__() or {}  # with what is in slots, if there is any
        fields, slots = state if isinstance(state, tuple) else (state, {})
        return _each(_packed, fields, Kept), _each(_packed, slots, Kept)

    def __setstate__(self, state: tuple[dict[str, Any], dict[str, Any]]) -> None:
        fields, slots = (_each(_unpacked, of, Kept | _Packed) for of in state)
        self.__dict__.update(fields)
        for name, value in slots.items():
            object.__setattr__(self, name, value)


class Module(Kept, eqx.Module):
    """A module of equinox that is `Kept`.

    Its bound methods are no trees: looking for them at every attribute took a tenth of a fit.
    """

    __getattribute__ = object.__getattribute__


class _Packed(NamedTuple):
    """An array of JAX as one of NumPy."""

    array: np.ndarray


def _each(change: Callable[[Any], Any], fields: dict[str, Any], whole: Any) -> dict[str, Any]:
    """The fields with every leaf changed; objects of the classes `whole` are leaves."""

    def is_leaf(one: Any) -> bool:
        return isinstance(one, whole)

    return {name: jax.tree.map(change, of, is_leaf=is_leaf) for name, of in fields.items()}


def _packed(leaf: Any) -> Any:
    is_array = isinstance(leaf, jax.Array) and not isinstance(leaf, jax.core.Tracer)
    return _Packed(np.asarray(leaf)) if is_array else leaf


def _unpacked(leaf: Any) -> Any:
    if not isinstance(leaf, _Packed):
        return leaf
    with jax.enable_x64(True):
        return jax.device_put(leaf.array)
