"""Circuits from strings in the notation of impedance.py, such as `R0-p(R1,C1)`.

    circuit = part {"-" part}                    series
    part    = element | "p(" circuit {"," circuit} ")"     parallel
    element = "R" number | "C" number | "L" number | "CPE" number

The parameters are `r_0`, `c_1`, `l_3`, and `q_2` and `alpha_2` of `CPE2`.
"""

import functools
import re
from typing import Any, ClassVar, NoReturn

from etid.circuits.circuit import AbstractCircuit, parameter
from etid.circuits.elements import capacitor, constant_phase, inductor, resistor
from etid.circuits.impedance import AbstractImpedance, parallel, series

MODULE = "circuit strings"  # of the classes: compiled programs of such a class are not stored

_Tree = tuple[str, Any]  # kind of a part, and its parts or the number of an element


def circuit(string: str) -> AbstractCircuit:
    """A circuit from a string in the notation of impedance.py, such as `R0-p(R1,C1)`.

    Args:
        string: Elements `R0`, `C1`, `L3` and `CPE2`, joined by `-` in series and by `p(…,…)` in
            parallel.

    Returns:
        The circuit with typical values. Its parameters are `r_0`, `c_1`, `l_3`, and `q_2` and
        `alpha_2` of `CPE2`. Equal strings give circuits of one class.

    Raises:
        ValueError: The string is not a circuit, or an element occurs twice.
    """
    return class_of(string)()


def is_circuit_string(name: str) -> bool:
    """Whether a text can only be a circuit string."""
    return bool(re.fullmatch(r"[RCLPEp(),-]*\d[RCLPEp(),\d-]*", name))


def class_of(string: str) -> type[AbstractCircuit]:
    """The class of the circuits of a string.

    Raises:
        ValueError: The string is not a circuit, or an element occurs twice.
    """
    return _kind("".join(string.split()))


@functools.cache
def _kind(string: str) -> type[AbstractCircuit]:
    tree, end = _series(string, 0)
    if end != len(string):
        _refuse(string, end)
    fields: dict[str, Any] = {}
    _declare(string, tree, fields, within=False)

    def impedance(self: AbstractCircuit) -> AbstractImpedance:
        """Impedance of the string."""
        return _built(self, tree)

    def restored(self: AbstractCircuit) -> tuple:
        return _restored, (string, {name: getattr(self, name) for name in fields})

    body = {
        "__module__": MODULE,
        "__doc__": f"The circuit {string}.",
        "__annotations__": {"formula": ClassVar[str]} | dict.fromkeys(fields, Any),
        "formula": string,
        "impedance": impedance,
        "__reduce__": restored,
        **fields,
    }
    kind: Any = type(AbstractCircuit)
    return kind(string, (AbstractCircuit,), body)


def _restored(string: str, values: dict[str, Any]) -> AbstractCircuit:
    return class_of(string)(**values)


def _refuse(string: str, at: int) -> NoReturn:
    raise ValueError(
        f"{string!r} is no circuit: cannot read {string[at:] or 'its end'!r}; write R, C, L or "
        "CPE with a number, '-' for series and 'p(…,…)' for parallel, as in 'R0-p(R1,C1)'"
    )


def _series(string: str, at: int) -> tuple[_Tree, int]:
    parts = []
    while True:
        token = re.compile(r"(p)\(|(CPE|R|C|L)(\d+)").match(string, at)
        if token is None:
            _refuse(string, at)
        if token[1]:
            branches, at = _branches(string, token.end())
            parts.append(("p", branches))
        else:
            parts.append((token[2], token[3]))
            at = token.end()
        if string[at : at + 1] != "-":
            return ("-", parts), at
        at += 1


def _branches(string: str, at: int) -> tuple[list[_Tree], int]:
    branches = []
    while True:
        branch, at = _series(string, at)
        branches.append(branch)
        if string[at : at + 1] == ")" and len(branches) > 1:
            return branches, at + 1
        if string[at : at + 1] != ",":
            _refuse(string, at)
        at += 1


def _declare(string: str, tree: _Tree, fields: dict[str, Any], *, within: bool) -> None:
    """Add the parameters of all elements to `fields`.

    Their typical values are those of skin, as in `SkinRC`. Later capacitances are larger, as in
    `SkinLayers`.
    """
    kind, rest = tree
    if kind in ("-", "p"):
        for part in rest:
            _declare(string, part, fields, within=within or kind == "p")
        return
    larger = 10.0 ** sum(name[0] in "cq" for name in fields)
    own: dict[str, Any]
    if kind == "R":
        own = {f"r_{rest}": parameter("ohm", typical=100e3 if within else 20e3)}
    elif kind == "C":
        own = {f"c_{rest}": parameter("farad", typical=0.3e-9 * larger)}
    elif kind == "L":
        own = {f"l_{rest}": parameter("henry", typical=1e-3)}
    else:
        own = {
            f"q_{rest}": parameter("siemens second^alpha", typical=2e-9 * larger),
            f"alpha_{rest}": parameter("1", typical=0.8),
        }
    if own.keys() & fields.keys():
        raise ValueError(f"{string!r} has {kind}{rest} twice; give each element its own number")
    fields |= own


def _built(circuit: AbstractCircuit, tree: _Tree) -> AbstractImpedance:
    kind, rest = tree
    if kind in ("-", "p"):
        parts = [_built(circuit, part) for part in rest]
        if len(parts) == 1:
            return parts[0]
        return series(*parts) if kind == "-" else parallel(*parts)
    if kind == "R":
        return resistor(getattr(circuit, f"r_{rest}"))
    if kind == "C":
        return capacitor(getattr(circuit, f"c_{rest}"))
    if kind == "L":
        return inductor(getattr(circuit, f"l_{rest}"))
    return constant_phase(getattr(circuit, f"q_{rest}"), getattr(circuit, f"alpha_{rest}"))
