"""Circuit classes by name, for files of fits and for the option `--circuit`.

The name is `module:Class`, and `etid:Class` for the circuits of etid. A name from a file never
causes an import: etid searches for it only among the classes that are already defined.
"""

import difflib
import importlib
import re
import reprlib
from collections.abc import Iterable, Iterator

from etid.circuits import circuit as circuits
from etid.circuits import circuit_string
from etid.circuits.circuit import AbstractCircuit
from etid.circuits.current_dependent import SkinCurrent


def class_path(kind: type[AbstractCircuit]) -> str:
    """Name of a circuit in a file of fits, such as `etid:SkinRC`."""
    own = kind.__module__ in (circuits.__name__, circuit_string.MODULE)
    module = "etid" if own else kind.__module__
    return f"{module}:{kind.__qualname__}"


def built_in() -> dict[str, type[AbstractCircuit]]:
    """Circuits of etid by class name."""
    return {kind.__name__: kind for kind in _defined() if kind.__module__ == circuits.__name__}


def circuit_class(stored: str, given: type[AbstractCircuit] | None = None) -> type[AbstractCircuit]:
    """Circuit class of a file of fits.

    Args:
        stored: Qualified name of the circuit in the file.
        given: Class that the caller expects. If it is None, the class is searched by name.

    Raises:
        LookupError: No class has this name, or `given` has a different name. The message says what
            to do.
    """
    string = stored.removeprefix("etid:")
    if given is None and circuit_string.is_circuit_string(string):
        try:
            return circuit_string.class_of(string)
        except ValueError as error:
            raise LookupError(str(error)) from None
    if given is not None and class_path(given) == stored:
        return given
    names = re.fullmatch(r"([A-Za-z_]\w*(?:\.\w+)*):(?:[\w<>]+\.)*(\w+)", stored, re.ASCII)
    if names is None:
        raise LookupError("This is not a name of a circuit: fit the recordings again")
    module, name = names.groups()
    if given is not None:
        if given.__name__ != name:
            raise LookupError(f"The circuit that was passed is {given.__name__}: pass {name}")
        return given
    for kind in _defined():
        if class_path(kind) == stored:
            return kind
    if module == "etid":
        raise LookupError(
            "etid has no such circuit: read the file with the version of etid that wrote it"
        )
    if module == "__main__":
        raise LookupError(
            f"{name} was defined in a script or a notebook: define it before you read the file, or "
            f"pass the class as circuit; for a command, put the class into a module and add "
            f"--circuit MODULE:{name}"
        )
    raise LookupError(
        f"{module} is not imported, and etid imports no module because a file names it: import it "
        f"before you read the file, or pass the class as circuit; for a command, add --circuit "
        f"{module}:{name}"
    )


def imported(name: str) -> type[AbstractCircuit]:
    """Circuit class that the user names; its module is imported.

    Args:
        name: `Class` for a circuit of etid, a circuit string, or `module:Class`.

    Raises:
        ValueError: The module cannot be imported or has no such circuit, or the string is none.
    """
    if circuit_string.is_circuit_string(name):
        return circuit_string.class_of(name)
    module, _, attribute = name.rpartition(":")
    if not module:
        known = built_in()
        if name not in known:
            raise ValueError(_unknown(name, known))
        return known[name]
    try:
        found = getattr(importlib.import_module(module), attribute, None)
    except Exception as error:  # a user's module may raise anything
        raise ValueError(f"cannot import {module}: {type(error).__name__}: {error}") from error
    if not (isinstance(found, type) and issubclass(found, AbstractCircuit)):
        raise ValueError(
            f"{attribute} of {module} is {reprlib.repr(found)}, not a subclass of "
            "etid.AbstractCircuit"
        )
    return found


def _unknown(name: str, known: Iterable[str]) -> str:
    """Why a command has no circuit of this name, and what to do."""
    if name == SkinCurrent.__name__:
        return (
            f"{name} depends on its current, and no command fits such a circuit; call "
            "etid.identify_amplitudes(recordings), which fits it to several amplitudes"
        )
    simple = {other.lower(): other for other in known}
    near = difflib.get_close_matches(name.lower(), simple, n=1)
    hint = f"; did you mean {simple[near[0]]}? Or" if near else ";"
    return (
        f"there is no circuit {name!r} in etid{hint} use one of {', '.join(sorted(known))}, "
        "a string as R0-p(R1,C1), or module:Class for a circuit of your own"
    )


def _defined(of: type[AbstractCircuit] = AbstractCircuit) -> Iterator[type[AbstractCircuit]]:
    """All subclasses of `of` that are defined, the latest definition first."""
    for kind in reversed(of.__subclasses__()):
        yield kind
        yield from _defined(kind)
