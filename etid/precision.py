"""float64 for all that etid computes, whatever precision the process has set for JAX."""

import functools
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import jax
import jax.core

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")


def in_float64(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """The function, run in float64. The rest of the process keeps its precision.

    Raises:
        RuntimeError: JAX traces the function in float32, for a derivative or for `jax.jit`. The
            filters would lose 4 to 9 digits without a warning.
    """

    @functools.wraps(function)
    def call(*args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
        if is_float64():
            return function(*args, **kwargs)
        if is_traced((args, kwargs)):
            raise RuntimeError(
                "etid needs float64, and JAX traces this call in float32. Before making JAX arrays,"
                ' call\n    jax.config.update("jax_enable_x64", True)\n'
                "or set the environment variable JAX_ENABLE_X64=1."
            )
        with jax.enable_x64(True):
            return function(*args, **kwargs)

    return call


def is_traced(of: Any) -> bool:
    """Whether JAX traces what happens here, or one of these arrays."""
    # `jnp.asarray` would compile a program of its own.
    leaves = [jax.device_put(0.0), *jax.tree.leaves(of)]
    return any(isinstance(leaf, jax.core.Tracer) for leaf in leaves)


def is_float64() -> bool:
    """Whether JAX computes in float64 here."""
    config: Any = jax.config  # its attributes are made at run time
    return config.jax_enable_x64
