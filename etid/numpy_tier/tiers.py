"""Who runs the traced functions of etid: NumPy where that is sooner, else XLA.

XLA compiles a first driver and skin for some ten seconds, for fits that it runs in 50 and 10 ms.
NumPy runs the same traced programs in 0.3 s and in 20 ms, and nothing is compiled.
"""

import contextlib
import functools
import logging
import sys
import threading
import weakref
from collections.abc import Callable, Iterator
from typing import Any, ParamSpec, TypeVar

import equinox as eqx
import jax
import jax.core
from tqdm import tqdm

from etid.garbage import unsearched
from etid.numpy_tier.source import UntranslatableError
from etid.numpy_tier.translator import translated
from etid.precision import in_float64, is_traced

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")

# For a batch: XLA compiles for a processor in 55 % of the time with other code for fusions, fewer
# passes of LLVM, and one kernel for each sum, not a tree of three. The programs are as fast.
QUICKLY = {
    "xla_cpu_use_fusion_emitters": False,
    "xla_backend_optimization_level": 1,
    "xla_disable_hlo_passes": "tree_reduction_rewriter",
}
# For what runs once: in less than half of that without passes, and with vectors of two numbers. The
# programs take two to three times their time.
AT_ONCE = {
    **QUICKLY,
    "xla_backend_optimization_level": 0,
    "xla_cpu_prefer_vector_width": 128,
}

# Fits in time. XLA compiles a batch for 3 to 8 s, the longer the records are; NumPy takes ten times
# as long for each fit.
WORTH_COMPILING = 40

PATIENCE = 1.0  # [s] waiting time without a word
COMPILING = "etid: JAX compiles the fit, once in each process."

_log = logging.getLogger(__name__)
_told = threading.Event()  # that JAX compiles
_programs: weakref.WeakKeyDictionary[Any, Any] = weakref.WeakKeyDictionary()


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
    - `jax_disable_jit` is set.
    - The default device is no processor.
    - It is a batch.
    - It has a primitive that NumPy cannot run, as your own circuit may have.

    Args:
        function: Function of arrays and of anything else that can be hashed.
        batch: Whether it runs for so many recordings that its run time matters more than its
            compilation.
    """

    def flat(static: _Static, arrays: Any) -> tuple[Any, _Static]:
        args, kwargs = eqx.combine(arrays, static.of)
        of: Any = function
        found, others = eqx.partition(of(*args, **kwargs), eqx.is_array)
        return found, _Static(others)

    flat.__name__ = flat.__qualname__ = function.__name__
    # To run by NumPy, or as part of another function, which decides who runs it.
    part = jax.jit(flat, static_argnums=0)

    @functools.cache
    def compiled(processor: bool) -> Any:
        options = {} if not processor else _known(QUICKLY if batch else AT_ONCE)
        return jax.jit(flat, static_argnums=0, compiler_options=options)

    @functools.wraps(function)
    @in_float64
    def call(*args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
        arrays, others = eqx.partition((args, kwargs), eqx.is_array)
        static = _Static(others)
        if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(arrays)):
            found, others = part(static, arrays)
            return eqx.combine(found, others.of)
        with _at_once():
            small = None if batch or not _by_numpy() else _in_numpy(part, static, arrays)
            if small:
                found, others = small(arrays)
            else:
                run = compiled(jax.default_backend() == "cpu")
                found, others = _by_xla(run, static, arrays)
        return eqx.combine(found, others.of)

    return call


def _known(options: dict[str, Any]) -> dict[str, Any]:
    """Those of the options that this version of XLA has; others would end the compilation."""
    return {name: value for name, value in options.items() if _is_known(name, value)}


@functools.cache  # it compiles
def _is_known(name: str, value: bool | int | str) -> bool:
    try:
        jax.jit(lambda: 0, compiler_options={name: value}).lower().compile()
    except jax.errors.JaxRuntimeError:
        return False
    return True


def worth_compiling(fits: int) -> bool:
    """Whether so many fits in time are sooner done if they are compiled."""
    return fits >= WORTH_COMPILING or not _by_numpy()


def _by_numpy() -> bool:
    """Whether NumPy may run programs: on a processor, unless JAX runs each operation alone."""
    config: Any = jax.config  # its attributes are made at run time
    return jax.default_backend() == "cpu" and not config.jax_disable_jit


def _by_xla(run: Any, static: _Static, arrays: Any) -> Any:
    """What XLA computes, once it has compiled the function."""
    with _announced(), unsearched():
        return run(static, arrays)


def _in_numpy(part: Any, static: _Static, arrays: Any) -> Any:
    """The function as one of NumPy; None if it has a primitive that NumPy cannot run."""
    with unsearched():
        traced = part.trace(static, arrays)
        jaxpr = traced.jaxpr.jaxpr  # the same object each time, because JAX keeps its traces
        if jaxpr not in _programs:
            try:
                _programs[jaxpr] = translated(traced.jaxpr)
            except UntranslatableError as error:
                _log.info("XLA compiles %s: NumPy cannot run %s", traced.fun_name, error)
                _programs[jaxpr] = None
    small, structure = _programs[jaxpr], jax.tree.structure(traced.out_info)
    if small is None:
        return None
    return lambda of: jax.tree.unflatten(structure, jax.device_put(small(jax.tree.leaves(of))))


def _at_once() -> contextlib.AbstractContextManager[None]:
    """Within someone's trace, a context that computes what is constant there at once.

    Elsewhere it does nothing: in this context, each constant of a program to trace would be
    compiled as a program of its own. A driver and a skin have three hundred, which take 14 s.
    """
    return jax.ensure_compile_time_eval() if is_traced(()) else contextlib.nullcontext()


@contextlib.contextmanager
def _announced() -> Iterator[None]:
    """Tell a person on a terminal or in a notebook who waits: one line, once in each process."""
    timer = threading.Timer(PATIENCE, _tell)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def _tell() -> None:
    person = sys.stderr is not None and (sys.stderr.isatty() or "ipykernel" in sys.modules)
    if person and not _told.is_set():
        _told.set()
        tqdm.write(COMPILING, file=sys.stderr)  # not into a progress bar
