"""Who runs the traced functions of etid: NumPy where that is sooner, else XLA.

XLA compiles a first driver and skin for 7 s, for fits that run in 50 and 10 ms. NumPy runs the same
traced programs (`etid.numpy_tier`) in a fifth of a second and in 10 ms, and nothing is compiled.
"""

import contextlib
import functools
import logging
import weakref
from collections.abc import Callable, Iterator
from typing import Any, ParamSpec, TypeVar

import equinox as eqx
import jax
import jax.core

from etid.garbage import unsearched
from etid.numpy_tier.text import translated
from etid.numpy_tier.translator import UntranslatableError
from etid.numpy_tier.waiting import announced_later

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")

# XLA compiles for a processor in two thirds of the time without the emitters of fusions and with
# fewer passes of LLVM, and in 85 % of that time if each sum is one kernel, not a tree of three. The
# programs are as fast.
QUICKLY = {
    "xla_cpu_use_fusion_emitters": False,
    "xla_backend_optimization_level": 1,
    "xla_disable_hlo_passes": "tree_reduction_rewriter",
}
# With vectors of two numbers XLA takes 91 % of that time. Without any passes it takes less than
# half of that, and the programs take two to three times their time.
AT_ONCE = {
    **QUICKLY,
    "xla_cpu_prefer_vector_width": 128,
    "xla_backend_optimization_level": 0,
}

# XLA compiles a batch for some 5 s. NumPy takes 5 to 10 ms longer for each skin of 1728 harmonics,
# and longer in proportion for samples: from about 400 such skins on, XLA is sooner.
WORTH_COMPILING = 400 * 1728

_log = logging.getLogger(__name__)


@jax.tree_util.register_static
class _Static:
    """What a function takes or returns beside arrays; part of a structure, not a leaf."""

    def __init__(self, of: Any) -> None:
        leaves, structure = jax.tree.flatten(of)
        self.of = of
        self.key = structure, tuple((type(leaf), leaf) for leaf in leaves)

    def __hash__(self) -> int:
        return hash(self.key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Static) and self.key == other.key


def program(
    function: Callable[Parameters, Result], *, batch: bool = False
) -> Callable[Parameters, Result]:
    """A function that NumPy or XLA runs as a whole.

    NumPy runs it on a processor. XLA compiles it in these cases:

    - It is part of a transformation (`jax.grad`, `jax.vmap`, `jax.jit`).
    - A setting of JAX looks into it (`jax_disable_jit`, `jax_debug_nans`, `jax_debug_infs`).
    - The default device is no processor.
    - It is a batch.
    - It has a primitive that NumPy cannot run, as your own circuit may have.

    Args:
        function: Function of arrays and of anything else that can be hashed.
        batch: Whether it runs for so many recordings that its run time matters more than its
            compilation.
    """
    inner = eqx.filter_jit(function)  # part of another function, which decides how it is compiled

    @functools.cache
    def outer(processor: bool) -> Any:
        def flat(static: _Static, arrays: Any) -> tuple[Any, _Static]:
            args, kwargs = eqx.combine(arrays, static.of)
            of: Any = function
            found, others = eqx.partition(of(*args, **kwargs), eqx.is_array)
            return found, _Static(others)

        flat.__name__ = flat.__qualname__ = function.__name__
        options = None if not processor else QUICKLY if batch else AT_ONCE
        return jax.jit(flat, static_argnums=0, compiler_options=options)

    @functools.wraps(function)
    def call(*args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
        arrays, others = eqx.partition((args, kwargs), eqx.is_array)
        leaves = jax.tree.leaves(arrays)
        if any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):
            return inner(*args, **kwargs)
        static, processor = _Static(others), jax.default_backend() == "cpu"
        run = outer(processor)
        with _at_once():
            if not batch and _by_numpy():
                traced = _traced(run, static, arrays)
                small = _in_numpy(traced, function.__name__)
                if small is not None:
                    found = jax.tree.unflatten(
                        jax.tree.structure(traced.out_info), jax.device_put(small(leaves))
                    )
                    return eqx.combine(found[0], found[1].of)
            with _announced():
                found, others = run(static, arrays)
        return eqx.combine(found, others.of)

    return call


def worth_compiling(numbers: int) -> bool:
    """Whether fits of arrays with so many numbers in all are sooner done if they are compiled."""
    return numbers >= WORTH_COMPILING or not _by_numpy()


def _by_numpy() -> bool:
    """Whether NumPy may run programs: on a processor, and no setting of JAX looks into them."""
    config: Any = jax.config  # its attributes are made at run time
    looks = config.jax_disable_jit or config.jax_debug_nans or config.jax_debug_infs
    return jax.default_backend() == "cpu" and not looks


def _traced(run: Any, static: _Static, arrays: Any) -> Any:
    with unsearched():
        return run.trace(static, arrays)


_programs: weakref.WeakKeyDictionary[Any, Any] = weakref.WeakKeyDictionary()


def _in_numpy(traced: Any, name: str) -> Any:
    """The program of a trace in NumPy; None if it has a primitive that NumPy cannot run."""
    jaxpr = traced.jaxpr.jaxpr  # the same object each time, because JAX keeps its traces
    if jaxpr not in _programs:
        try:
            with unsearched():
                _programs[jaxpr] = translated(traced.jaxpr)
        except UntranslatableError as error:
            _log.info("XLA compiles %s: NumPy cannot run %s", name, error)
            _programs[jaxpr] = None
    return _programs[jaxpr]


@contextlib.contextmanager
def _announced() -> Iterator[None]:
    """While a function is compiled: a line tells a person who waits."""
    timer = announced_later()
    try:
        with unsearched():
            yield
    finally:
        timer.cancel()


def _at_once() -> contextlib.AbstractContextManager[None]:
    """Within someone's trace, a context that computes what is constant there at once.

    Elsewhere it does nothing: in this context, each constant of a program to trace would be
    compiled as a program of its own. A driver and a skin have three hundred, which take 14 s.
    """
    # `jnp.asarray` would compile a program of its own.
    tracing = isinstance(jax.device_put(0.0), jax.core.Tracer)
    return jax.ensure_compile_time_eval() if tracing else contextlib.nullcontext()
