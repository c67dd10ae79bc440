"""Session-wide settings: float64, no silent promotion, seeded keys, reference data or a skip."""

import functools
import inspect
import os
import pathlib
import signal

import jax
import jaxtyping
import pytest
from hypothesis import settings

from benchmarks.machine import make_room

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")

# Compilation makes first examples slow, and a failure must be the same one tomorrow.
settings.register_profile("etid", deadline=None, derandomize=True, max_examples=40)
settings.load_profile("etid")

# XLA compiles the programs of these tests in half the time: code of fusions without MLIR, and fewer
# passes of LLVM. Parts that are compiled one beside the other cost more on one core.
COMPILE_FAST = "--xla_backend_optimization_level=1 --xla_cpu_parallel_codegen_split_count=1"
if jax.__version_info__ < (0, 12):  # later ones do not know it
    COMPILE_FAST = f"--xla_cpu_use_fusion_emitters=false {COMPILE_FAST}"

REFERENCE_DATA = pathlib.Path(__file__).parents[2] / "shared" / "data"


CHECKED = set()  # functions whose annotations the present test has checked
_checks_each_call = jaxtyping._decorator.jaxtyped


def _checks_first_call(of, *, typechecker):
    """The decorator of functions, and of those in classes; to check each call costs much more.

    A function in a function is another one at each call, whose check would be compiled anew.
    """
    if not inspect.isfunction(of):  # its functions come here, too
        return _checks_each_call(of, typechecker=typechecker)
    if "<locals>" in of.__qualname__:
        return of
    checked = functools.cache(lambda: _checks_each_call(of, typechecker=typechecker))

    @functools.wraps(of)
    def call(*args, **kwargs):
        __tracebackhide__ = True
        if call in CHECKED:
            return of(*args, **kwargs)
        CHECKED.add(call)
        return checked()(*args, **kwargs)

    return call


jaxtyping._decorator.jaxtyped = _checks_first_call


def _jaxtyped(of=None, **checker):
    """A module that is checked asks for a decorator: `@jaxtyped(typechecker=…)`."""
    context = of == "context"
    return _checks_each_call(of) if context else functools.partial(_checks_first_call, **checker)


jaxtyping.jaxtyped = _jaxtyped


def pytest_runtest_setup():
    """Check annotations anew."""
    CHECKED.clear()


def pytest_configure(config):
    """Share what is compiled between the workers, and give each a core of its own.

    Compilation is most of the time of the tests. On one core XLA's threads do not slow each other
    down sixfold. Slow tests and notebooks are compiled as users' programs are.
    """
    flags = os.environ.get("XLA_FLAGS", "")  # JAX has not read them yet
    if _is_ordinary(config) and COMPILE_FAST not in flags:
        os.environ["XLA_FLAGS"] = f"{COMPILE_FAST} {flags}"
    os.environ["JAX_COMPILATION_CACHE_DIR"] = str(config.cache.mkdir("xla"))  # for notebooks
    jax.config.update("jax_compilation_cache_dir", os.environ["JAX_COMPILATION_CACHE_DIR"])
    # To read a program of one operation takes a third of the time of its compilation.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    worker = os.environ.get("PYTEST_XDIST_WORKER")
    if worker is not None and hasattr(os, "sched_setaffinity"):
        cores = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {cores[int(worker.removeprefix("gw")) % len(cores)]})


def _is_ordinary(config):
    """Whether neither slow tests nor notebooks run."""
    return "not slow" in config.option.markexpr


def pytest_collection_modifyitems(items):
    """Mark the tests that compare with stored numbers; `make test-portable` runs them."""
    for item in items:
        names = item.function.__code__.co_names if isinstance(item, pytest.Function) else ()
        if {"kept_numbers", "printed"} & set(names):
            item.add_marker("stored")


def pytest_xdist_auto_num_workers():
    """One worker for each core that these tests may use, which may be fewer than there are."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else None


@pytest.fixture(autouse=True, scope="module")
def _room_for_executables():
    yield
    make_room()


@pytest.fixture
def in_the_foreground():
    """What a shell starts in the background ignores SIGINT."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture
def getkey():
    """A fresh seeded key at every call."""
    keys = iter(jax.random.split(jax.random.key(20260101), 1000))
    return lambda: next(keys)


@pytest.fixture(scope="session")
def reference_data():
    """Path of a folder of the reference data; where it is absent the test is skipped, visibly."""

    def folder(name):
        path = REFERENCE_DATA / name
        if not path.exists():
            pytest.skip(f"reference data {name!r} not found at {path}")
        return path

    return folder
