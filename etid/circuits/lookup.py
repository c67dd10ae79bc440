"""Circuits by name: what a file of fits says, and what a command is asked for.

The name is `module:Class`, and `etid:Class` for the circuits that come with etid. A name that was
read in a file imports nothing: it is looked up among the classes that exist.
"""

import importlib
import re
import reprlib
from collections.abc import Iterator

from etid.circuits import circuit as circuits
from etid.circuits.circuit import AbstractCircuit

_NAME = re.compile(r"([A-Za-z_]\w*(?:\.\w+)*):(?:[\w<>]+\.)*(\w+)", flags=re.ASCII)


def qualified(kind: type[AbstractCircuit]) -> str:
    """The name by which a file of fits remembers a circuit."""
    module = "etid" if kind.__module__ == circuits.__name__ else kind.__module__
    return f"{module}:{kind.__qualname__}"


def built_in() -> dict[str, type[AbstractCircuit]]:
    """The circuits that come with etid, by the names of their classes."""
    return {kind.__name__: kind for kind in _defined() if kind.__module__ == circuits.__name__}


def remembered(stored: str, given: type[AbstractCircuit] | None = None) -> type[AbstractCircuit]:
    """The circuit of a file of fits.

    Args:
        stored: Its qualified name, as the file has it.
        given: The class that the caller takes it for; if not given, it is looked up.

    Raises:
        LookupError: It is not known, or another one; the message says what to do.
    """
    found = _NAME.fullmatch(stored)
    if found is None:
        raise LookupError("No circuit has such a name: fit the recordings again")
    module, name = found.groups()
    if given is not None:
        if given.__name__ != name:
            raise LookupError(f"The circuit that was passed is {given.__name__}: pass {name}")
        return given
    for kind in _defined():
        if qualified(kind) == stored:
            return kind
    if module == "etid":
        raise LookupError("etid has no such circuit: read it with the version that wrote it")
    if module == "__main__":
        raise LookupError(
            f"{name} was defined in a script or a notebook: define it before you read, or pass the "
            f"class as circuit; for a command, put it into a module and say --circuit MODULE:{name}"
        )
    raise LookupError(
        f"{module} is not imported, and a file imports nothing: import it before you read, or pass "
        f"the class as circuit; for a command, say --circuit {module}:{name}"
    )


def imported(name: str) -> type[AbstractCircuit]:
    """The circuit that a user asks for, whose module is imported.

    Args:
        name: `Class` for a circuit of etid, else `module:Class`.

    Raises:
        ValueError: There is no such module or no such circuit in it.
    """
    module, _, attribute = name.rpartition(":")
    if not module:
        known = built_in()
        if name not in known:
            raise ValueError(
                f"there is no circuit {name!r} in etid; use one of {', '.join(sorted(known))}, or "
                "module:Class for a circuit of your own"
            )
        return known[name]
    try:
        found = getattr(importlib.import_module(module), attribute, None)
    except Exception as error:  # whatever a module of someone else may raise
        raise ValueError(f"cannot import {module}: {type(error).__name__}: {error}") from error
    if not (isinstance(found, type) and issubclass(found, AbstractCircuit)):
        raise ValueError(
            f"{attribute} of {module} is {reprlib.repr(found)}, no subclass of etid.AbstractCircuit"
        )
    return found


def _defined(of: type[AbstractCircuit] = AbstractCircuit) -> Iterator[type[AbstractCircuit]]:
    """All circuits that exist, the latest definition first."""
    for kind in reversed(of.__subclasses__()):
        yield kind
        yield from _defined(kind)
