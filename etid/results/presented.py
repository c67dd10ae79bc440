"""A fit as MATLAB's `present` shows it, and under the names that lmfit gives its parts."""

import itertools
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from etid.precision import Module
from etid.printing import Overview, between, number, several
from etid.recordings.fields import LABELS
from etid.results.method_options import fixed

if TYPE_CHECKING:
    from etid.results.fit import Fit


class Parameter(NamedTuple):
    """An element of a fit, or of a batch of fits.

    Attributes:
        value: Its value [SI].
        stderr: Its standard error [SI].
        unit: The SI unit.
    """

    value: Any
    stderr: Any
    unit: str


class Presented(Module):
    """The parts of a `Fit` under the names of lmfit."""

    @property
    def success(self: Any) -> Any:
        """Whether the fit can be used, as `usable`; an array for a batch."""
        return self.usable

    @property
    def params(self: Any) -> dict[str, Parameter]:
        """Value, standard error and unit of each element [SI], as in `fit.params["r_s"].stderr`.

        `table` has the same numbers as columns, with changes, quality and verdict.
        """
        columns = self.table()
        return {
            name: Parameter(columns[name], columns[f"{name}_stderr"], unit)
            for name, unit in self.circuit.units().items()
        }

    @property
    def aic(self: Any) -> Any:
        """−2 log L + 2 p for p free elements (Akaike 1974), as `bic`."""
        return self._criterion(2.0)

    @property
    def bic(self: Any) -> Any:
        """−2 log L + p ln n for p free elements and n real numbers in the data (Schwarz 1978).

        L has a constant that depends on the data, so that only fits to the same data compare. A
        choice of the circuit divides −2 log L by noise that exceeds its estimate; this number does
        not. NaN without a likelihood; an array for a batch.
        """
        terms = np.nan if self.support is None else np.asarray(self.support.terms, float)
        return self._criterion(np.log(terms))

    def _criterion(self: Any, of_each: Any) -> Any:
        lost = np.nan if self.support is None else np.asarray(self.support.deviance, float)
        found = np.zeros(np.shape(self.rrse)) + lost + of_each * self.free
        return found if found.ndim else float(found)

    @property
    def free(self: Any) -> int:
        """Number of elements that are not fixed."""
        return len(self.circuit.names()) - len(fixed(self.method))


def report(fit: "Fit") -> str:
    """`Fit.report`."""
    fit.refuse_batch()
    shown = fit._overview()
    ends, correlation = fit.intervals(), np.asarray(fit.correlation)
    units = fit.circuit.units()
    rows = [
        (*row, between(*ends[name], units[name]), *(number(r, "+.2f") for r in correlation[place]))
        for place, (name, row) in enumerate(zip(units, shown.rows, strict=True))
    ]
    heads = "", "± standard error", "", "95 % interval", *(f"with {name}" for name in units)
    table = Overview(shown.title, rows, heads, shown.notes)
    parts = [_model(fit), table.text(), _data(fit), _recording(fit)]
    return "\n".join(filter(None, parts))


def _model(fit: "Fit") -> str:
    kind, formula = type(fit.circuit).__name__, fit.circuit.formula
    return f"Model: {kind}" + (f", Z = {formula}" if formula and formula != kind else "")


def _data(fit: "Fit") -> str:
    """Numbers of data and parameters, and the criteria."""
    count = several(fit.free, "free element" if fit.free < len(fit.circuit.names()) else "element")
    if fit.support is None or np.isnan(fit.support.terms):
        return f"Data: {count}; no likelihood, so no AIC and no BIC"
    data = several(int(fit.support.terms), "real number")
    return f"Data: {data}, {count}; AIC {fit.aic:.1f}, BIC {fit.bic:.1f}"


def _recording(fit: "Fit") -> str:
    """Path and labels of the recording, as far as known."""
    told = fit.described
    labels = [f"{name} {told[name]}" for name in LABELS if name != "path" and told.get(name)]
    named = [repr(str(told["path"]))] if told.get("path") else []
    return f"Recording: {', '.join(itertools.chain(named, labels))}" if named or labels else ""
