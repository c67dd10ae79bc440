"""What is known of elements before a fit: priors, of which a fixed element is the limit.

A value m ± s of an element becomes a normal prior of its logarithm, ln m ± s/m, one more residual
of the fit. Standard errors contain it like any measurement. A fixed element has s = 0.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from etid.circuits.circuit import AbstractCircuit
from etid.likelihood.own_prior import OwnPrior
from etid.precision import Module, namespace
from etid.signals.transfer import AnyArray

FIXED = 1e-9  # standard deviation of the logarithm of a fixed element, below all errors of a fit

Known = tuple[tuple[str, float, float], ...]
"""Elements that are known: name, value and standard deviation [SI]; 0 for a fixed element."""


class ElementPrior(Module):
    """Prior of the logarithms of the elements.

    Attributes:
        told: Values of the elements [SI], whose logarithms are the means; 1 without a prior.
        width: Standard deviations of the logarithms; infinite for elements without a prior.
        own: A function of the circuit, as of `etid.likelihood.own_prior`, besides.
    """

    told: Float[AnyArray, " element"]
    width: Float[AnyArray, " element"]
    own: OwnPrior | None = eqx.field(static=True, default=None)

    @classmethod
    def of(cls, known: Known, circuit: AbstractCircuit) -> "ElementPrior | None":
        """The prior of the elements of a circuit, None if none is known; raises as `checked`."""
        if not known:
            return None
        checked(known, circuit)
        names = circuit.names()
        told, width = np.ones(len(names)), np.full(len(names), np.inf)
        for name, mean, deviation in known:
            row = names.index(name)
            told[row], width[row] = mean, max(deviation / mean, FIXED)
        return cls(told, width)

    @classmethod
    def by(cls, own: OwnPrior, circuit: AbstractCircuit) -> "ElementPrior":
        """A prior that is a function of the circuit."""
        count = len(circuit.names())
        return cls(np.ones(count), np.full(count, np.inf), own)

    @property
    def centre(self) -> Float[AnyArray, " element"]:
        """Means of the logarithms; 0 for elements without a prior."""
        return namespace(self.told).log(self.told)

    @property
    def precision(self) -> Float[AnyArray, " element"]:
        """1/width²."""
        return 1 / self.width**2

    def placed(self, logs: Float[AnyArray, "*start element"]) -> Float[AnyArray, "*start element"]:
        """Starts with the known elements at their means."""
        xp = namespace(logs, self.width)
        return xp.where(xp.isfinite(self.width), self.centre, logs)


def require_element(name: str, circuit: AbstractCircuit) -> None:
    """Raise ValueError unless the circuit has an element of this name."""
    if name not in circuit.names():
        raise ValueError(
            f"{name!r} is no element of {type(circuit).__name__}; its elements are "
            f"{', '.join(circuit.names())}"
        )


def checked(known: Sequence[Sequence], circuit: AbstractCircuit) -> None:
    """Raise ValueError unless these are elements of the circuit with sensible values."""
    usual, names = type(circuit)(), circuit.names()
    for one in known:
        name, mean, deviation = one
        require_element(name, circuit)
        if not (0 < mean < float("inf") and 0 <= deviation < float("inf")):
            raise ValueError(
                f"the known value of {name} is {mean:g} ± {deviation:g}; it must be positive, and "
                "its standard deviation must not be negative"
            )
        with jax.ensure_compile_time_eval():
            told = usual.of_fit([mean if of == name else getattr(usual, of) for of in names])
            steep = any(float(alpha) > 1 for alpha in told.exponents())
        if steep:
            raise ValueError(f"the known value of {name} is {mean:g}; an exponent is at most 1")


def stated(known: Known) -> str:
    """A sentence for a methods section; empty if no element is known."""
    if not known:
        return ""
    each = [
        f"{name} = {mean:g} {f'± {error:g}' if error else '(fixed)'}" for name, mean, error in known
    ]
    return f" Known before the fit [SI]: {'; '.join(each)}."
