"""Key of a stored program: a digest of all that determines it.

It holds the source files and module constants of etid, the versions of the packages that it uses,
the settings of JAX, the platform, and the arguments: their structure, their static parts, and the
shapes and types of their arrays.
"""

import dataclasses
import functools
import hashlib
import operator
import os
import pathlib
import sys
import time
import types
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jaxlib
import lineax
import numpy as np
import optimistix as optx
import scipy

from etid.identify import program_files

LOADED = time.time()
# Settings of JAX that do not change a program.
UNRELATED = ("jax_compilation_cache", "jax_persistent_cache", "jax_log", "jax_dump", "jax_explain")


class Unknown(Exception):
    """A value or a function that the key does not describe."""


def key_of(function: Callable, args: tuple, kwargs: dict) -> str | None:
    """Key of a function with these arguments; None if its sources may have changed.

    Raises:
        Unknown: A part of it is from elsewhere, such as your own circuit: its code has no key.
    """
    sources = _sources()
    if sources is None:
        return None
    parts = (
        sources,
        _platform(),
        _settings(),
        _described(function),
        _constants(function.__module__),
        _described((args, kwargs)),
    )
    return hashlib.sha256(repr(parts).encode()).hexdigest()


def is_weak(array: Any) -> bool:
    """Whether the type of an array gives way to that of another one."""
    return getattr(array, "weak_type", False)


@functools.cache
def _sources() -> str | None:
    """Digest of all files of the package; None if they may have changed since they were loaded."""
    digest = hashlib.sha256()
    # The whole package, because a program may be traced through any of its files.
    package = pathlib.Path(str(sys.modules[__name__.partition(".")[0]].__file__)).parent
    paths = sorted(package.rglob("*.py"))
    try:
        if not paths or max(path.stat().st_mtime for path in paths) > LOADED:
            return None
        for path in paths:
            name = path.relative_to(package).as_posix()
            digest.update(name.encode() + b"\0" + path.read_bytes() + b"\0")
    except OSError:
        return None
    return digest.hexdigest()


@functools.cache
def _platform() -> tuple[str, ...]:
    packages = (jax, jaxlib, eqx, optx, lineax, np, scipy)
    device = jax.devices()[0]
    return (
        sys.version,
        *(package.__version__ for package in packages),
        f"{jax.device_count()} {device.platform} {device.device_kind}",
    )


def _settings() -> list[str]:
    """Settings of JAX and equinox that may change a program."""
    values = jax.config.values
    return [os.environ.get("EQX_ON_ERROR", "")] + [
        f"{name}={getattr(jax.config, name, values[name])}"  # includes context managers
        for name in sorted(values)
        if not name.startswith(UNRELATED)
    ]


class _Names(NamedTuple):
    """The names of a module, as they were when it was last looked at.

    Attributes:
        values: Their values.
        described: Descriptions of functions, classes, and constants that nobody can change.
        changeable: Names of all other constants.
        homes: Modules of etid that the module uses.
    """

    values: tuple[Any, ...]
    described: tuple[tuple[str, Any], ...]
    changeable: tuple[str, ...]
    homes: tuple[str, ...]


_looked_at: dict[str, _Names] = {}


def _constants(first: str) -> list[tuple[str, Any]]:
    """Constants of a module and of the modules of etid that it uses: a user may have changed them.

    Raises:
        Unknown: A function was replaced by a function of another package.
    """
    found, seen, waiting = [], {first, __name__}, [first]
    while waiting:
        module = waiting.pop()
        of = vars(sys.modules[module])
        names = _looked_at.get(module)
        values = tuple(of.values())
        if (
            names is None
            or len(values) != len(names.values)
            or not all(map(operator.is_, values, names.values))
        ):
            names = _looked_at[module] = _names(module, of)
        found.extend(names.described)
        found.extend(_stated(module, name, of[name]) for name in names.changeable)
        new = [home for home in names.homes if home not in seen and home in sys.modules]
        seen.update(new)
        waiting.extend(new)
    return found


def _names(module: str, of: dict[str, Any]) -> _Names:
    described, changeable, homes = [], [], {}
    for name, value in sorted(of.items()):
        if name.startswith("__"):
            continue
        if isinstance(value, types.ModuleType):
            homes[value.__name__] = None
        elif isinstance(value, type | types.FunctionType):
            home = str(value.__module__)
            homes[home] = None
            described.append((f"{module}.{name}", f"{home}.{value.__qualname__}"))
            origin = home.partition(".")[0]
            known = origin in program_files.KNOWN or origin in sys.stdlib_module_names
            if isinstance(value, types.FunctionType) and not known:
                raise Unknown(name)
        elif value is None or isinstance(value, bool | int | float | complex | str | bytes):
            described.append(_stated(module, name, value))
        else:
            changeable.append(name)
    own = tuple(home for home in homes if home.startswith("etid."))
    return _Names(tuple(of.values()), tuple(described), tuple(changeable), own)


def _stated(module: str, name: str, value: Any) -> tuple[str, Any]:
    """Name and description of a constant; None for loggers, type variables and similar values."""
    try:
        return f"{module}.{name}", _described(value, by_value=True)
    except Unknown:
        return f"{module}.{name}", None


def _described(node: Any, by_value: bool = False) -> Any:
    """Description of a value that is the same in every process.

    Args:
        node: Arguments of a function, or a constant.
        by_value: Whether the numbers in an array matter, or only its shape and type.

    Raises:
        Unknown: The value contains a class or a function of another package.
    """
    kind = type(node)
    inner = functools.partial(_described, by_value=by_value)
    if node is None or kind in (bool, int, float, complex, str, bytes):
        return kind.__name__, repr(node)
    if eqx.is_array(node):
        content = hashlib.sha256(np.asarray(node).tobytes()).hexdigest() if by_value else ""
        return "array", node.shape, str(node.dtype), is_weak(node), content
    if isinstance(node, type | types.FunctionType):
        if (
            str(node.__module__).partition(".")[0] not in program_files.KNOWN
            or "<lambda>" in node.__qualname__
        ):
            raise Unknown(node)
        return f"{node.__module__}.{node.__qualname__}"
    if isinstance(node, tuple | list):
        return inner(kind), [inner(item) for item in node]
    if isinstance(node, dict):
        return inner(kind), [(inner(name), inner(item)) for name, item in node.items()]
    if dataclasses.is_dataclass(node):
        fields = [(f.name, getattr(node, f.name, None)) for f in dataclasses.fields(node)]
        return inner(kind), [(name, inner(item)) for name, item in fields]
    raise Unknown(node)
