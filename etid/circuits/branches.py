"""Branches of a circuit that can be exchanged, and the one order in which they are named.

If both relaxations of R_s + R_1 ‖ C_1 + R_2 ‖ C_2 are exchanged, the impedance stays the same. No
data can tell which of them is which: a fit finds either, and names would swap between two fits of
one thing. The branches are therefore ordered by their time constants, as the typical values of the
class are: of `SkinLayers` the first layer is the faster one.
"""

import functools
import itertools
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from etid.circuits.circuit import AbstractCircuit, dimensions, impedance_at
from etid.circuits.impedance import AbstractConnection, AbstractImpedance
from etid.precision import namespace

# Places of the elements of a branch. In two branches that can be exchanged, those with the same
# number correspond.
Branch = tuple[int, ...]
EQUAL = 1e-9  # relative difference of impedances that are rounded differently


def in_order(
    circuit: AbstractCircuit,
    logs: Float[Array | np.ndarray, "*row element"],
    *told: Float[Array | np.ndarray, " element"],
) -> Int[Array | np.ndarray, "*row element"]:
    """Places of the elements, such that branches which can be exchanged are in their order.

    Args:
        circuit: The circuit.
        logs: Logarithms of its elements.
        *told: What is known of the elements, such as priors and bounds. Branches of which different
            things are known cannot be exchanged.

    Returns:
        The places: `logs[..., places]` is in order.
    """
    xp: Any = namespace(logs, *told)
    places: Any = np.arange(logs.shape[-1]) + xp.zeros(logs.shape, int)
    for branches in exchangeable(type(circuit)):
        for one, other in itertools.combinations(branches, 2):
            swap = np.arange(logs.shape[-1])
            swap[[*one, *other]] = [*other, *one]
            now = xp.take_along_axis(logs, places, -1)
            wrong = _log_time(circuit, now, one) > _log_time(circuit, now, other)
            for of in told:
                wrong = wrong & (of[np.array(one)] == of[np.array(other)]).all()
            places = xp.where(wrong[..., None], places[..., swap], places)
    return places


@functools.cache
def exchangeable(kind: type[AbstractCircuit]) -> tuple[tuple[Branch, ...], ...]:
    """Sets of branches that can be exchanged, inner ones first, the typically fastest branch first.

    Two branches can be exchanged if they are parts of one connection, and if the impedance stays
    the same when each element of one takes the value of an element of the other.
    """
    # Inside of a trace, too, these are numbers.
    with jax.ensure_compile_time_eval(), jax.enable_x64(True):
        typical = kind()
        logs = np.log(typical.values())
        found = []
        for parts in _connections(kind, logs):
            sets: list[list[Branch]] = []
            for part in parts:
                for branches in sets:
                    other = _counterpart(kind, logs, branches[0], part)
                    if other is not None:
                        branches.append(other)
                        break
                else:
                    sets.append([part])
            for branches in sets:
                times = [float(_log_time(typical, logs, of)) for of in branches]
                order = np.argsort(np.round(times, 9), kind="stable")
                found.append(tuple(branches[place] for place in order))
    return tuple(branches for branches in found if len(branches) > 1)


def _log_time(circuit: AbstractCircuit, logs: Any, branch: Branch) -> Any:
    """Logarithm of the time constant of a branch, the mean of several.

    It is the shortest combination Σ k ln(element) of the dimension of a time. A branch that has no
    time constant, such as one resistor, has the sum of its logarithms.
    """
    units = [list(circuit.units().values())[place] for place in branch]
    values = [logs[..., place] for place in branch]
    if "second" in units:
        return values[units.index("second")]
    exponents = [value for value, unit in zip(values, units, strict=True) if unit == "1"]
    xp: Any = np if isinstance(logs, np.ndarray) else jnp
    alpha = xp.exp(exponents[0]) if exponents else 0.8  # as `AbstractCircuit.scaling` has it
    # A current has no time; it would leave a determinant of 0 with a resistance.
    powers = {unit: of for unit, of in dimensions(alpha).items() if unit not in ("ampere", "1")}
    known = [(*powers[unit], value) for value, unit in zip(values, units, strict=True)
             if unit in powers]  # fmt: skip
    levels, times = ([one[row] for one in known] for row in (0, 1))
    # k = u · level + v · time has no dimension of an impedance, and that of a time.
    ll, lt, tt = (
        sum(a * b for a, b in zip(*of, strict=True))
        for of in ((levels, levels), (levels, times), (times, times))
    )
    kinds = {unit for unit in units if unit in powers}
    if len(kinds) < 2:
        return sum(value for value, unit in zip(values, units, strict=True) if unit != "1")
    determinant = ll * tt - lt * lt
    return sum((ll * t - lt * z) / determinant * value for z, t, value in known)


def _connections(kind: type[AbstractCircuit], logs: np.ndarray) -> Iterator[list[Branch]]:
    """The branches of each connection, as the elements that occur in one part only."""
    trees = [_tree(kind, logs + step) for step in (0.0, *0.1 * np.eye(logs.size))]

    def walk(
        parts: Sequence[AbstractImpedance], *moved: Sequence[AbstractImpedance]
    ) -> Iterator[list[Branch]]:
        """The connections below these parts; `moved` are the same with one element changed."""
        inner = [_parts(part) for part in parts]
        for row, below in enumerate(inner):
            if below:
                yield from walk(below, *(_parts(of[row]) for of in moved))
        changes = np.array(
            [[_differ(a, b) for a, b in zip(parts, of, strict=True)] for of in moved]
        ).reshape(len(moved), len(parts))
        own = changes & (changes.sum(1, keepdims=True) == 1)
        yield [tuple(np.flatnonzero(column).tolist()) for column in own.T]

    yield from walk(*(_parts(tree) or [tree] for tree in trees))


def _tree(kind: type[AbstractCircuit], logs: np.ndarray) -> AbstractImpedance:
    return kind().with_log_values(logs).impedance()


def _parts(of: AbstractImpedance) -> list[AbstractImpedance]:
    """The parts of a connection, and of connections of its kind in it; empty for an element."""
    if not isinstance(of, AbstractConnection):
        return []
    nested = ([part] if type(part) is not type(of) else _parts(part) for part in of.parts)
    return list(itertools.chain.from_iterable(nested))


def _differ(one: AbstractImpedance, other: AbstractImpedance) -> bool:
    pairs = zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    return any(np.any(np.asarray(a) != np.asarray(b)) for a, b in pairs)


def _counterpart(
    kind: type[AbstractCircuit], logs: np.ndarray, one: Branch, other: Branch
) -> Branch | None:
    """The other branch in the order that corresponds to one, if they can be exchanged."""
    units = list(kind.units().values())
    if not one or sorted(units[of] for of in one) != sorted(units[of] for of in other):
        return None
    for order in itertools.permutations(other):
        same = all(units[a] == units[b] for a, b in zip(one, order, strict=True))
        if same and _is_same(kind, logs, lambda of, order=order: _swapped(of, one, order)):
            return order
    return None


def _swapped(logs: np.ndarray, one: Branch, other: Branch) -> np.ndarray:
    swapped = logs.copy()
    swapped[[*one, *other]] = logs[[*other, *one]]
    return swapped


def _is_same(
    kind: type[AbstractCircuit], logs: np.ndarray, change: Callable[[np.ndarray], np.ndarray]
) -> bool:
    """Whether a change of the elements leaves the impedance as it is, whatever they are."""
    frequency, random = np.geomspace(1.0, 1e7, 15), np.random.default_rng(0)
    for _ in range(2):
        drawn = logs + 0.3 * random.standard_normal(logs.size)
        z, changed = (impedance_at(kind(), of, frequency) for of in (drawn, change(drawn)))
        if not np.allclose(z, changed, rtol=EQUAL, atol=0.0):
            return False
    return True
