"""A second opinion on standard errors: the distribution of the elements, and their profiles."""

import dataclasses
import statistics
from typing import Generic

import numpy as np
from jaxtyping import Float

from etid.circuits.circuit import Circuit
from etid.printing import Overview, Overviewed, between, quantity, several
from etid.solvers.importance_sampling import effective


def tails(level: float) -> tuple[float, float]:
    """Probabilities below both ends of an interval.

    Raises:
        ValueError: The level is not between 0 and 1.
    """
    if not 0 < level < 1:
        raise ValueError(f"level is {level}; it must be between 0 and 1, as in 0.95")
    return (1 - level) / 2, (1 + level) / 2


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Posterior(Overviewed, Generic[Circuit]):
    """Weighted draws of the elements, given a recording and its driver.

    Attributes:
        circuit: Fitted elements [SI].
        cov: Their covariance.
        draws: Elements [SI], arrays (draw,).
        weights: Probabilities of the draws; their sum is 1.
    """

    circuit: Circuit
    cov: Float[np.ndarray, "parameter parameter"]
    draws: Circuit
    weights: Float[np.ndarray, " draw"]

    @property
    def effective(self) -> float:
        """Number of draws of equal weight that would be as good, 1 / Σ w²."""
        return effective(self.weights)

    def intervals(self, level: float = 0.95) -> dict[str, tuple[float, float]]:
        """Both ends [SI] of the interval of each element, by name; both tails are equal.

        Args:
            level: Probability of an interval.

        Raises:
            ValueError: The level is not between 0 and 1.
        """
        low, high = tails(level)
        return {
            name: (self.quantile(name, low), self.quantile(name, high))
            for name in self.draws.names()
        }

    def quantile(self, name: str, probability: float) -> float:
        """The value [SI] of an element below which the draws have this probability."""
        values = np.asarray(getattr(self.draws, name))
        order = np.argsort(values)
        middles = np.cumsum(self.weights[order]) - 0.5 * self.weights[order]
        return float(np.interp(probability, middles, values[order]))

    def _overview(self) -> Overview:
        rows = []
        ends = self.intervals()
        errors = np.sqrt(np.diag(self.cov))
        for (name, unit), error in zip(self.circuit.units().items(), errors, strict=True):
            middle = quantity(self.quantile(name, 0.5), unit)
            fitted = quantity(float(getattr(self.circuit, name)), unit, float(error))
            rows.append((name, middle, between(*ends[name], unit), fitted))
        notes = []
        if self.effective < 100:  # then the ends of an interval are not worth two digits
            notes.append(
                "The draws represent the distribution badly; draw more, as in draws=10_000."
            )
        title = f"Posterior of {type(self.draws).__name__}: {several(self.weights.size, 'draw')}, "
        title += f"worth {self.effective:.0f}"
        return Overview(title, rows, ("", "median", "95 % interval", "fit"), notes)


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Profile(Overviewed):
    """How much worse a recording is explained if one element has another value.

    Attributes:
        name: The element.
        unit: Its SI unit.
        value: Fitted value [SI].
        stderr: Its standard error [SI].
        values: Values that were tried [SI], increasing.
        deviance: −2 log L at the best other parameters, minus its minimum. All parameters keep to
            the bounds of the fit.
        bounds: Bounds of the element [SI]; infinite without one.
    """

    name: str
    unit: str
    value: float
    stderr: float
    values: Float[np.ndarray, " point"]
    deviance: Float[np.ndarray, " point"]
    bounds: tuple[float, float] = (-np.inf, np.inf)

    def interval(self, level: float = 0.95) -> tuple[float, float]:
        """Both ends [SI]: where the deviance reaches the quantile of χ² with one degree of freedom.

        Args:
            level: Probability of the interval.

        Returns:
            The ends; a bound, or infinite, where no value that was tried is bad enough.

        Raises:
            ValueError: The level is not between 0 and 1.
        """
        z = statistics.NormalDist().inv_cdf(tails(level)[1])
        # The signed root of the deviance is nearly a straight line.
        best = self.values[np.argmin(self.deviance)]
        root = np.sign(self.values - best) * np.sqrt(np.maximum(self.deviance, 0.0))
        order = np.argsort(root, kind="stable")
        left, right = self.bounds
        low, high = np.interp([-z, z], root[order], self.values[order], left=left, right=right)
        return float(low), float(high)

    def _overview(self) -> Overview:
        rows = [
            ("95 % interval", between(*self.interval(), self.unit)),
            ("fit", quantity(self.value, self.unit, self.stderr)),
        ]
        return Overview(f"Profile of {self.name}: {several(self.values.size, 'value')}", rows)
