"""Circuit classes by name, for files of fits and for the option `--circuit`.

The name is `module:Class`, and `etid:Class` for the circuits of etid. A name from a file never
causes an import: etid searches for it only among the classes that are already defined. A circuit
may also be named by a string in the notation of impedance.py, such as `R0-p(R1,C1)`:

    circuit = part {"-" part}                    series
    part    = element | "p(" circuit {"," circuit} ")"     parallel
    element = ("R" | "C" | "L" | "CPE" | "W" | "Wo" | "Ws" | "G" | "La" | "K" | "T") ["_"] number

The parameters are `r_0`, `c_1`, `l_3`, `w_4`, and `q_2` and `alpha_2` of `CPE2`. Those of other
elements have its name, such as `r_wo1` and `tau_wo1` of `Wo1`.
"""

import difflib
import functools
import importlib
import re
import reprlib
from collections.abc import Callable, Iterable, Iterator
from typing import Any, ClassVar, NoReturn

from etid.circuits import circuit as circuits
from etid.circuits.circuit import AbstractCircuit, parameter
from etid.circuits.current_dependent import SkinCurrent
from etid.circuits.diffusion import Diffusion, FiniteSpace, Gerischer, PorousElectrode, Warburg
from etid.circuits.elements import (
    ModifiedInductance,
    Relaxation,
    capacitor,
    constant_phase,
    inductor,
    resistor,
)
from etid.circuits.impedance import AbstractImpedance, parallel, series

STRINGS = "circuit strings"  # module of their classes, whose compiled programs are not stored
# Elements by symbol: unit and typical value of each parameter, whose name ends in a number. The
# values of R, C and K are those of `SkinRC`. Diffusion has its |Z|, and is ten times as slow.
_ELEMENTS: dict[str, tuple[Callable[..., AbstractImpedance], dict[str, tuple[str, float]]]] = {
    "R": (resistor, {"r_": ("ohm", 20e3)}),
    "C": (capacitor, {"c_": ("farad", 0.3e-9)}),
    "L": (inductor, {"l_": ("henry", 1e-3)}),
    "CPE": (constant_phase, {"q_": ("siemens second^alpha", 2e-9), "alpha_": ("1", 0.8)}),
    "W": (Warburg, {"w_": ("ohm second^-1/2", 10e6)}),
    "Wo": (FiniteSpace, {"r_wo": ("ohm", 100e3), "tau_wo": ("second", 300e-6)}),
    "Ws": (Diffusion, {"r_ws": ("ohm", 100e3), "tau_ws": ("second", 300e-6)}),
    "G": (Gerischer, {"r_g": ("ohm", 100e3), "tau_g": ("second", 300e-6)}),
    "La": (
        ModifiedInductance,
        {"l_la": ("second ohm^(1/alpha)", 1e-3), "alpha_la": ("1", 0.8)},
    ),
    "K": (Relaxation, {"r_k": ("ohm", 100e3), "tau_k": ("second", 30e-6)}),
    "T": (
        PorousElectrode,
        {
            "r_a_t": ("ohm", 100e3),
            "r_b_t": ("ohm", 50e3),
            "reaction_t": ("1", 1.0),
            "tau_t": ("second", 300e-6),
        },
    ),
}
NESTED = 100  # a string of a file must not exceed Python's stack
_SYMBOL = "|".join(sorted(_ELEMENTS, reverse=True))  # "Wo" before "W"
_TOKEN = re.compile(rf"(p)\(|({_SYMBOL})(\d+)", re.ASCII)
_SLOW = ("farad", "siemens second^alpha", "second")  # proportional to a time constant
_STRING = re.compile(rf"[p(),-]*(?:(?:{_SYMBOL})_?\d+[p(),-]*)+", re.ASCII)
# An element of a string, from its kind, its number, and whether it is in a parallel connection.
_Element = Callable[[str, str, bool], AbstractImpedance]


def class_path(kind: type[AbstractCircuit]) -> str:
    """Name of a circuit in a file of fits, such as `etid:SkinRC`."""
    own = kind.__module__ in (circuits.__name__, STRINGS)
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
    """
    string = stored.removeprefix("etid:")
    if given is None and is_circuit_string(string):
        try:
            return class_of(string)
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
    """
    if is_circuit_string(name) or re.search(r"[-(,]", name):  # no name has these characters
        return class_of(name)
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


# --- Circuit strings ------------------------------------------------------------------------------


def circuit(string: str) -> AbstractCircuit:
    """A circuit from a string in the notation of impedance.py, such as `R0-p(R1,C1)`.

    Args:
        string: Elements with a number, such as `R0`, `C_1` or `CPE2`, joined by `-` in series and
            by `p(…,…)` in parallel: R, C, L, CPE, W, Wo, Ws, G, La, K and T of impedance.py.

    Returns:
        The circuit with typical values. Its parameters are `r_0`, `c_1`, `l_3`, `w_4`, `q_2` and
        `alpha_2` of `CPE2`, `r_wo1` and `tau_wo1` of `Wo1`, as of `Ws`, `G` and `K`, `l_la1` and
        `alpha_la1` of `La1`, and `r_a_t1`, `r_b_t1`, `reaction_t1` and `tau_t1` of `T1`, which are
        its A, B, a and b. Equal strings give circuits of one class.

    Raises:
        ValueError: The string is not a circuit, or an element occurs twice.
    """
    for kind in _defined():
        if kind.__name__.lower() == string.strip().lower() and kind.__module__ != STRINGS:
            name = f"{'etid.' if kind.__module__.startswith('etid.') else ''}{kind.__name__}"
            raise ValueError(f"{string!r} is a class of circuits; pass a circuit, as in {name}()")
    return class_of(string)()


def is_circuit_string(name: str) -> bool:
    """Whether a text can only be a circuit string."""
    return _STRING.fullmatch(name) is not None


def class_of(string: str) -> type[AbstractCircuit]:
    """The class of the circuits of a string; ValueError as `circuit`."""
    spaceless = "".join(string.split())
    return _class_of(re.sub(rf"({_SYMBOL})_(?=\d)", r"\1", spaceless, flags=re.ASCII))


@functools.cache
def _class_of(string: str) -> type[AbstractCircuit]:
    fields: dict[str, Any] = {}

    def declared(kind: str, number: str, within: bool) -> AbstractImpedance:
        """Add the parameters of an element, with their typical values."""
        make, parameters = _ELEMENTS[kind]
        if f"{next(iter(parameters))}{number}" in fields:
            raise ValueError(
                f"{string!r} has {kind}{number} twice; give each element its own number"
            )
        # Later elements are slower, as in `SkinLayers`, and resistors within larger.
        larger = 10.0 ** sum(field.metadata["unit"] in _SLOW for field in fields.values())
        values = []
        for name, (unit, typical) in parameters.items():
            factor = larger if unit in _SLOW else 5.0 if kind == "R" and within else 1.0
            fields[f"{name}{number}"] = parameter(unit, typical=typical * factor)
            values.append(typical * factor)
        return make(*values)

    if string.count("(") > NESTED:
        raise ValueError(f"a circuit of more than {NESTED} parallel connections cannot be read")
    _, end = _series(string, 0, declared)
    if end != len(string):
        _refuse(string, end)

    def impedance(self: AbstractCircuit) -> AbstractImpedance:
        """Impedance of the string."""

        def element(kind: str, number: str, _: bool) -> AbstractImpedance:
            make, parameters = _ELEMENTS[kind]
            return make(*(getattr(self, f"{name}{number}") for name in parameters))

        return _series(string, 0, element)[0]

    def restored(self: AbstractCircuit) -> tuple:
        return _blank, (string,), self.__getstate__()

    body = {
        "__module__": STRINGS,
        "__doc__": f"The circuit {string}.",
        "__annotations__": {"formula": ClassVar[str]} | dict.fromkeys(fields, Any),
        "formula": string,
        "impedance": impedance,
        "__reduce__": restored,
        **fields,
    }
    kind: Any = type(AbstractCircuit)
    return kind(string, (AbstractCircuit,), body)


def _blank(string: str) -> AbstractCircuit:
    """A circuit that has no values yet; a pickle of it restores them."""
    return object.__new__(class_of(string))


def _refuse(string: str, at: int) -> NoReturn:
    kind = re.compile(_SYMBOL).match(string, at)
    rest = string[at:] if kind is None else string[kind.end() :]
    cause = f"cannot read {rest!r}" if rest else "it ends too early"
    if kind is not None:
        cause += f", where the number of {kind[0]} must be"
    *known, last = _ELEMENTS
    raise ValueError(
        f"{string!r} is no circuit: {cause}; write {', '.join(known)} or {last} with a number, '-' "
        "for series and 'p(…,…)' for parallel, as in 'R0-p(R1,C1)'"
    )


def _series(
    string: str, at: int, element: _Element, *, within: bool = False
) -> tuple[AbstractImpedance, int]:
    """Impedance of the parts from this place on, and the place after them."""
    parts = []
    while True:
        token = _TOKEN.match(string, at)
        if token is None:
            _refuse(string, at)
        if token[1]:
            part, at = _branches(string, token.end(), element)
        else:
            part, at = element(token[2], token[3], within), token.end()
        parts.append(part)
        if string[at : at + 1] != "-":
            return series(*parts) if len(parts) > 1 else part, at
        at += 1


def _branches(string: str, at: int, element: _Element) -> tuple[AbstractImpedance, int]:
    branches = []
    while True:
        branch, at = _series(string, at, element, within=True)
        branches.append(branch)
        if string[at : at + 1] == ")" and len(branches) > 1:
            return parallel(*branches), at + 1
        if string[at : at + 1] != ",":
            _refuse(string, at)
        at += 1
