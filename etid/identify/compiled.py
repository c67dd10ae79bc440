"""Traced functions on disk: a process need not trace what another process has traced.

The persistent compilation cache of JAX stores the programs that XLA compiles. Its key is the traced
and lowered program, so every process must trace its first fit again. This takes seconds. If that
cache has a folder, this module stores the lowered program (`jax.export`) there too. The name of the
file has the key of `etid.identify.program_key`, a digest of all that determines the program.

`etid.identify.program_files` reads and writes the files. Trust a folder as you trust the
compilation cache itself, whose executables run unchecked.
"""

import contextlib
import dataclasses
import functools
import gc
import pathlib
import threading
from collections.abc import Callable, Iterator
from typing import Any, ParamSpec, TypeVar

import equinox as eqx
import jax
import jax.core
import jax.export

from etid.identify import program_files
from etid.identify.program_files import Slot, filled
from etid.identify.program_key import Unknown, is_weak, key_of
from etid.identify.waiting import announced_later

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")

FOLDER = "etid"  # inside the folder of the compilation cache
# XLA compiles for a processor in two thirds of the time without the emitters of fusions and with
# fewer passes of LLVM, and in 85 % of that time if each sum is one kernel, not a tree of three. The
# programs are as fast.
QUICKLY = {
    "xla_cpu_use_fusion_emitters": False,
    "xla_backend_optimization_level": 1,
    "xla_disable_hlo_passes": "tree_reduction_rewriter",
}
# With vectors of two numbers XLA takes 91 % of that time. A batch takes 102 to 108 % of its time
# then, and single fits as long as before.
SHORT_VECTORS = {"xla_cpu_prefer_vector_width": 128}
# Without any passes it takes less than half of that time, and the programs take two to three times
# their time.
AT_ONCE = {**QUICKLY, **SHORT_VECTORS, "xla_backend_optimization_level": 0}


def stored_jit(
    function: Callable[Parameters, Result], *, rare: bool = False, batch: bool = False
) -> Callable[Parameters, Result]:
    """`equinox.filter_jit` that stores the traced function in the compilation cache of JAX.

    In these cases it is plain `equinox.filter_jit`:

    - The cache has no folder (`JAX_COMPILATION_CACHE_DIR`).
    - A transformation (`jax.grad`, `jax.vmap`, `jax.jit`) needs the function itself.
    - `jax.export` cannot hold the function.
    - A setting of JAX runs the parts of a function one by one (`jax_disable_jit`,
      `jax_debug_nans`).
    - An argument belongs to a class from outside etid, such as your own circuit: its code is not
      in the key.

    Args:
        function: Function of arrays and of anything else that can be hashed.
        rare: Whether it runs so rarely, or for so short a time, that its compilation matters more
            than its run time.
        batch: Whether it runs for so many recordings that its run time matters more.
    """
    compiling = threading.local()  # what ends when this thread has compiled

    @functools.wraps(function)
    def traced(*args: Any, **kwargs: Any) -> Any:  # runs once for each trace
        compiling.ends.enter_context(_compiling())
        return function(*args, **kwargs)

    @functools.wraps(function)
    def stored(*args: Any, **kwargs: Any) -> Any:  # runs once for each trace
        compiling.ends.enter_context(_compiling())
        found = _trace(function, args, kwargs)
        if found is None:
            return function(*args, **kwargs)
        exported, shell = found
        return filled(shell, exported.call(*_arrays((args, kwargs))))

    inner = eqx.filter_jit(function)  # part of another function, which decides how it is compiled

    @functools.cache
    def outer(stores: bool) -> Callable[..., Any]:
        options: dict[str, Any] | None = None
        if jax.default_backend() == "cpu":
            options = AT_ONCE if rare else QUICKLY if batch else {**QUICKLY, **SHORT_VECTORS}
        jit: Any = eqx.filter_jit  # its overloads lack the options of `jax.jit`
        return jit(stored if stores else traced, compiler_options=options)

    @functools.wraps(function)
    def call(*args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
        arrays = _arrays((args, kwargs))
        if any(isinstance(array, jax.core.Tracer) for array in arrays):
            return inner(*args, **kwargs)
        with contextlib.ExitStack() as compiling.ends, _at_once():
            return outer(_folder() is not None and _on_device(arrays))(*args, **kwargs)

    return call


@contextlib.contextmanager
def _compiling() -> Iterator[None]:
    """While a function is traced and compiled: a line for a person who waits, and no garbage.

    A trace makes a million objects that live on. To search them for garbage again and again takes a
    sixth of its time.
    """
    timer, collects = announced_later(), gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        timer.cancel()
        if collects:
            gc.enable()


def _at_once() -> contextlib.AbstractContextManager[None]:
    """Within someone's trace, a context that computes what is constant there at once.

    Elsewhere it does nothing: in this context, each constant of a program to trace would be
    compiled as a program of its own. A driver and a skin have three hundred, which take 14 s.
    """
    # `jnp.asarray` would compile a program of its own.
    tracing = isinstance(jax.device_put(0.0), jax.core.Tracer)
    return jax.ensure_compile_time_eval() if tracing else contextlib.nullcontext()


def _folder() -> pathlib.Path | None:
    """Folder of the traces; None if they are not stored."""
    config: Any = jax.config  # its attributes are made at run time
    folder = config.jax_compilation_cache_dir
    takes_apart = config.jax_disable_jit or config.jax_debug_nans or config.jax_debug_infs
    # An exported program is for the default device.
    elsewhere = config.jax_default_device is not None
    if not folder or "://" in folder or takes_apart or elsewhere:
        return None
    return pathlib.Path(folder, FOLDER) if config.jax_enable_compilation_cache else None


def _arrays(tree: Any) -> list[Any]:
    return [leaf for leaf in jax.tree.leaves(tree) if eqx.is_array(leaf)]


def _on_device(arrays: list[Any]) -> bool:
    """Whether all arrays hold numbers and each is on one device of the default kind."""
    platform = jax.default_backend()
    for array in arrays:
        if isinstance(array, jax.Array):
            devices = array.sharding.device_set
            if len(devices) > 1 or next(iter(devices)).platform != platform:
                return False
    return True


def _trace(function: Callable, args: tuple, kwargs: dict) -> tuple[jax.export.Exported, Any] | None:
    """The exported function and the shell of its result; None if there is no export."""
    folder = _folder()
    try:
        key = key_of(function, args, kwargs)
    except Unknown:
        return None
    if folder is None or key is None:
        return None
    path = folder / f"{function.__name__}-{key}"
    found = program_files.read(path)
    if found is not None:
        return found
    try:
        found = _export(function, args, kwargs)
        program_files.write(path, *found)
    # Errors of any kind: a callback or a custom call that a file cannot hold, a result without a
    # name. The function is then traced in the ordinary way. Its own errors are raised there.
    except Exception:
        return None
    return found


def _export(function: Callable, args: tuple, kwargs: dict) -> tuple[jax.export.Exported, Any]:
    leaves, tree = jax.tree.flatten((args, kwargs))
    places = [i for i, leaf in enumerate(leaves) if eqx.is_array(leaf)]
    shells = []

    def flat(*arrays: jax.Array) -> list[jax.Array]:
        filled = list(leaves)
        for place, array in zip(places, arrays, strict=True):
            filled[place] = array
        args, kwargs = tree.unflatten(filled)
        found, structure = jax.tree.flatten(function(*args, **kwargs))
        dynamic = [i for i, leaf in enumerate(found) if eqx.is_array(leaf)]
        slots = {i: Slot(index) for index, i in enumerate(dynamic)}
        shells.append(structure.unflatten([slots.get(i, leaf) for i, leaf in enumerate(found)]))
        return [found[i] for i in dynamic]

    flat.__name__ = flat.__qualname__ = function.__name__
    shapes = [
        jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, weak_type=is_weak(leaf))
        for leaf in map(leaves.__getitem__, places)
    ]
    exported = jax.export.export(jax.jit(flat))(*shapes)
    # The derivative is a Python function, and a stored program is not differentiated.
    return dataclasses.replace(exported, _get_vjp=None), shells[0]
