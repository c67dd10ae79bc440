"""What the functions of arrays share: how they run in NumPy and in JAX, and the axis of outputs."""

import functools
from collections.abc import Callable, Sequence
from typing import ParamSpec, TypeVar

import jax
import numpy as np
from jaxtyping import Inexact

from etid.precision import namespace
from etid.signals.transfer import AnyArray

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")


def array_function(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """A function of rows, whoever calls it.

    NumPy says nothing about a row whose numbers are not finite: its verdict does. JAX multiplies
    real by complex numbers, and arrays of different ranks, as NumPy does, even where its user has
    forbidden this for own code.
    """

    @functools.wraps(function)
    def call(*args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
        of_jax = jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow")
        with np.errstate(all="ignore"), of_jax[0], of_jax[1]:
            return function(*args, **kwargs)

    return call


def along_outputs(
    each: Sequence[Inexact[AnyArray, "*row bin"]],
) -> Inexact[AnyArray, "*row output bin"]:
    """Values of each output along an axis of outputs; without a copy if there is one output."""
    return each[0][..., None, :] if len(each) == 1 else namespace(each[0]).stack(each, -2)
