"""Files of traced programs: the lowered module, and its signature and result as JSON.

A file holds no pickle. To read it imports classes of `KNOWN` packages by name and calls nothing of
them. The program itself runs unchecked, like the executables of the compilation cache.

Files are written completely or not at all. A damaged file counts as absent.
"""

import contextlib
import dataclasses
import hashlib
import importlib
import json
import operator
import pathlib
import zlib
from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.export
import numpy as np

from etid.recordings.errors import RecordingError
from etid.recordings.replacing import replacing

# Packages whose code the key of a file knows: etid by its source files, all others by versions.
KNOWN = {"etid", "builtins", "equinox", "jax", "jaxlib", "lineax", "numpy", "optimistix", "scipy"}
# Parts of an exported program that are made anew.
_REBUILT = {"in_tree", "out_tree", "mlir_module_serialized", "_get_vjp"}


@dataclasses.dataclass(frozen=True)
class Slot:
    """Place of an array in the result of an exported function."""

    index: int


def filled(shell: Any, arrays: Any) -> Any:
    """The result of an exported function, from its `shell` and its arrays."""
    leaves, tree = jax.tree.flatten(shell)
    return tree.unflatten(
        [arrays[leaf.index] if isinstance(leaf, Slot) else leaf for leaf in leaves]
    )


def write(path: pathlib.Path, exported: jax.export.Exported, shell: Any) -> None:
    """Write an exported function and the shell of its result.

    Several processes may write the same file. A folder that cannot be written is left as it is.

    Raises:
        TypeError: JSON cannot describe a part of the result.
    """
    fields = {of.name for of in dataclasses.fields(exported)} - _REBUILT
    signature = {name: _encoded(getattr(exported, name)) for name in sorted(fields)}
    header = json.dumps([signature, _encoded(shell)]).encode()
    module = bytes(exported.mlir_module_serialized)
    packed = zlib.compress(header + b"\n" + module, 1)
    with contextlib.suppress(OSError, RecordingError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as partial:
            partial.write_bytes(_checksum(path, packed) + packed)


def read(path: pathlib.Path) -> tuple[jax.export.Exported, Any] | None:
    """Content of a file; None if the file is missing or damaged."""
    try:
        content = path.read_bytes()
        checksum, packed = content[:32], content[32:]
        if _checksum(path, packed) != checksum:
            return None
        header, _, module = zlib.decompress(packed).partition(b"\n")
        signature, shell = json.loads(header)
        of = {name: _decoded(value) for name, value in signature.items()}
        exported = jax.export.Exported(
            **of,
            in_tree=jax.tree.structure((tuple(range(len(of["in_avals"]))), {})),
            out_tree=jax.tree.structure([0] * len(of["out_avals"])),
            mlir_module_serialized=module,
            _get_vjp=None,
        )
        return exported, _decoded(shell)
    # A file of another version with the same key has other fields; it is damaged too.
    except (OSError, ValueError, KeyError, TypeError, AttributeError, ImportError, zlib.error):
        return None


def _checksum(path: pathlib.Path, packed: bytes) -> bytes:
    return hashlib.sha256(path.name.encode() + packed).digest()


def _encoded(node: Any) -> Any:
    """A value as JSON: a simple value as it is, all others as an object with one name.

    Raises:
        TypeError: The value is of another kind.
    """
    kind = type(node)
    if node is None or kind in (bool, int, float, str):
        return node
    if kind is Slot:
        return {"slot": node.index}
    if isinstance(node, jax.core.ShapedArray):
        return {"array": [list(node.shape), str(node.dtype), node.weak_type]}
    if kind in (list, tuple):
        return {kind.__name__: [_encoded(item) for item in node]}
    if kind is dict:
        return {"dict": [[_encoded(name), _encoded(item)] for name, item in node.items()]}
    if isinstance(node, type):
        return {"class": _name(node)}
    if isinstance(node, tuple) and hasattr(kind, "_fields"):
        return {"named": [_name(kind), [_encoded(item) for item in node]]}
    if dataclasses.is_dataclass(node):
        present = [of.name for of in dataclasses.fields(node) if hasattr(node, of.name)]
        return {"object": [_name(kind), {of: _encoded(getattr(node, of)) for of in present}]}
    raise TypeError(f"a file of a program cannot hold a {kind.__name__}")


def _decoded(node: Any) -> Any:
    """The value that `_encoded` described."""
    if not isinstance(node, dict):
        return node
    [(kind, content)] = node.items()
    if kind == "slot":
        return Slot(content)
    if kind == "array":
        shape, dtype, weak = content
        return jax.core.ShapedArray(tuple(shape), np.dtype(dtype), weak_type=weak)
    if kind in ("list", "tuple"):
        items = [_decoded(item) for item in content]
        return items if kind == "list" else tuple(items)
    if kind == "dict":
        return {_decoded(name): _decoded(item) for name, item in content}
    if kind == "class":
        return _class(content)
    name, parts = content
    if kind == "named":
        return _class(name)(*(_decoded(item) for item in parts))
    made = object.__new__(_class(name))
    for field, value in parts.items():
        object.__setattr__(made, field, _decoded(value))
    return made


def _name(kind: type) -> str:
    name = f"{kind.__module__}:{kind.__qualname__}"
    if _class(name) is not kind:
        raise TypeError(f"{name} has no name of its own")
    return name


def _class(name: str) -> type:
    module, _, path = name.partition(":")
    if module.partition(".")[0] not in KNOWN:
        raise TypeError(f"{name} belongs to another package")
    found = operator.attrgetter(path)(importlib.import_module(module))
    if isinstance(found, type) and (
        dataclasses.is_dataclass(found) or issubclass(found, eqx.Enumeration | tuple)
    ):
        return found
    raise TypeError(f"{name} is no class of data")
