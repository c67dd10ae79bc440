"""How much an element varies between subjects, sessions and recordings, beyond its errors.

The logarithms of an element are a sum of random effects, nested in each other, and of the errors of
the fits, whose standard deviations s are known:

    y = μ + Σ_r Z_r u_r + e,    u_r ~ N(0, σ_r²),    e ~ N(0, diag(s²)).

σ_r are those of the largest restricted likelihood (Patterson and Thompson, Biometrika 58, 1971,
545-554), their intervals those of its profile. It needs no balanced design.
"""

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import scipy.optimize
from jaxtyping import Float

from etid.circuits.display import quantity
from etid.circuits.overview import Overview, Overviewed
from etid.recordings.fields import LABELS, check_names
from etid.results.fits import Fits

REST = "recordings"  # the last level: recordings with equal labels
INTERVAL = 3.84  # increase of −2 ln L at the ends of a 95 % interval
END = 0.01  # relative error of the ends of an interval
FINE = 1e-6  # of the spread of the logarithms; smaller deviations are 0


class Part(NamedTuple):
    """A relative standard deviation, and its 95 % interval."""

    std: float
    low: float
    high: float


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Variation(Overviewed):
    """Variation of an element.

    Attributes:
        element: Name of the element.
        unit: Its SI unit.
        fits: Number of successful fits.
        mean: Geometric mean [SI].
        stderr: Its standard error [SI]: how far it is from that of all subjects.
        between: The variation between the groups of each level, such as `subject`, and between
            the `recordings` of the last level; relative to the mean.
        error: Median of the relative standard errors of the fits, without that of the driver.
    """

    element: str
    unit: str
    fits: int
    mean: float
    stderr: float
    between: Mapping[str, Part]
    error: float

    def _overview(self) -> Overview:
        rows = [
            (f"between {name}{'' if name == REST else 's'}", *(f"{100 * x:.2g} %" for x in part))
            for name, part in self.between.items()
        ]
        rows.append(("error of a fit", f"{100 * self.error:.2g} %", "", ""))
        title = f"{self.element} of {self.fits} fits: {quantity(self.mean, self.unit, self.stderr)}"
        return Overview(title, rows, ("variation", "standard deviation", "95 % from", "to"))


def variation(
    fits: Fits, element: str, by: Sequence[str] = ("subject", "session", "site")
) -> Variation:
    """Variation of an element between subjects, their sessions, and so on, beyond its errors.

    The error of a driver is common to all of its recordings, so it is no variation between them.
    Where sessions have calibrations of their own, it is part of the variation between sessions.

    Args:
        fits: Fits of one condition; those without success are left out.
        element: Name of the element.
        by: Labels, each nested in those before it. A label that does not divide the groups of
            those before it further, or that leaves one recording in each group, is no level.

    Returns:
        The geometric mean, and the standard deviation of each level with its interval.

    Raises:
        ValueError: There is no such element, or no level has two groups.
        RecordingError: There is no such label.
    """
    units = fits.circuit.units()
    if element not in units:
        raise ValueError(f"the element is {element!r}, must be one of {', '.join(units)}")
    check_names(dict.fromkeys(by), LABELS, "label")
    good = fits.successful()
    values = np.asarray(getattr(good.circuit, element))
    place = list(units).index(element)
    own = np.asarray(good.cov - good.fit.shared_cov)[:, place, place]
    y, s = np.log(values), np.sqrt(np.maximum(own, 0.0)) / values
    levels = _levels([good.labels[name].astype(str) for name in by], by, len(values))
    if len(values) < 2 or not levels:
        raise ValueError(f"{len(values)} successful fits show no variation by {', '.join(by)}")
    model = _Model.of(y, s, list(levels.values()))
    best, mean, stderr = model.fitted()
    between = {}
    for row, name in enumerate(levels):
        ends = model.interval(row, best)
        between[name] = Part(float(best[row]), *ends)
    middle = float(np.exp(mean))
    return Variation(
        element, units[element], len(values), middle, middle * stderr, between, float(np.median(s))
    )


def _levels(
    columns: Sequence[np.ndarray], names: Sequence[str], count: int
) -> dict[str, np.ndarray]:
    """Number of the group of each fit, by level; the last level are the fits themselves."""
    found: dict[str, np.ndarray] = {}
    groups = 1
    for depth, name in enumerate(names, start=1):
        keys = np.array(["\0".join(parts) for parts in zip(*columns[:depth], strict=True)])
        place = np.unique(keys, return_inverse=True)[1]
        if groups < place.max(initial=0) + 1 < count:
            found[name] = place
            groups = place.max() + 1
    return found | ({REST: np.arange(count)} if count > groups else {})


@dataclasses.dataclass(frozen=True)
class _Model:
    """The restricted likelihood. Groups of the first level are independent blocks.

    Attributes:
        blocks: Logarithms, squared errors, and whether two fits share a group, for each level.
        spread: Standard deviation of the logarithms.
        levels: Number of levels.
    """

    blocks: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]]
    spread: float
    levels: int

    @classmethod
    def of(cls, y: np.ndarray, s: np.ndarray, levels: Sequence[np.ndarray]) -> "_Model":
        blocks = []
        for group in np.unique(levels[0]):
            rows = levels[0] == group
            same = np.stack([of[rows][:, None] == of[rows] for of in levels])
            blocks.append((y[rows], s[rows] ** 2, same.astype(float)))
        return cls(blocks, float(np.std(y)) or 1.0, len(levels))

    def sums(self, std: np.ndarray) -> tuple[float, float, float, float]:
        """ln |V|, and 1ᵀV⁻¹1, 1ᵀV⁻¹y and yᵀV⁻¹y."""
        total = np.zeros(4)
        for y, noise, same in self.blocks:
            v = np.einsum("r,rij->ij", std**2, same) + np.diag(noise + (FINE * self.spread) ** 2)
            factor = np.linalg.cholesky(v)
            ones, own = np.linalg.solve(factor, np.column_stack([np.ones(y.size), y])).T
            total += 2 * np.log(np.diagonal(factor)).sum(), ones @ ones, ones @ own, own @ own
        return tuple(total)

    def deviance(self, std: np.ndarray) -> float:
        """−2 ln of the restricted likelihood."""
        logs, ones, cross, squares = self.sums(std)
        return logs + float(np.log(ones)) + squares - cross**2 / ones

    def smallest(self, start: np.ndarray, fixed: Mapping[int, float]) -> tuple[np.ndarray, float]:
        """Standard deviations with the smallest deviance, some of them fixed."""
        free = [row for row in range(self.levels) if row not in fixed]

        def full(x: np.ndarray) -> np.ndarray:
            std = np.array(start)
            std[free] = self.spread * x
            for row, value in fixed.items():
                std[row] = value
            return std

        if not free:
            return full(np.zeros(0)), self.deviance(full(np.zeros(0)))
        found = scipy.optimize.minimize(
            lambda x: self.deviance(full(x)),
            start[free] / self.spread,
            bounds=[(0.0, None)] * len(free),
            options={"ftol": 1e-6},
        )
        return full(found.x), float(found.fun)

    def fitted(self) -> tuple[Float[np.ndarray, " level"], float, float]:
        """The standard deviations, the mean and its standard error."""
        best, _ = self.smallest(np.full(self.levels, 0.3 * self.spread), {})
        _, ones, cross, _ = self.sums(best)
        return best, float(cross / ones), float(1 / np.sqrt(ones))

    def interval(self, row: int, best: np.ndarray) -> tuple[float, float]:
        """The ends of the 95 % interval of one standard deviation."""
        least = self.deviance(best)

        def beyond(std: float) -> float:
            return self.smallest(best, {row: std})[1] - least - INTERVAL

        at = float(best[row])
        low = (
            scipy.optimize.brentq(beyond, 0.0, at, xtol=FINE, rtol=END) if beyond(0.0) > 0 else 0.0
        )
        outside = (
            end
            for end in (max(at, FINE * self.spread) * 2.0**n for n in itertools.count(1))
            if beyond(end) > 0
        )
        high = scipy.optimize.brentq(beyond, at, next(outside), xtol=FINE, rtol=END)
        return float(low), float(high)
