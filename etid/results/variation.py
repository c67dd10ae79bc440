"""How much an element varies between subjects, sessions and recordings, beyond its errors.

The logarithms of an element are a sum of random effects, nested in each other, and of the errors of
the fits and of their drivers, whose standard deviations s and a are known:

    y = μ + Σ_r Z_r u_r + e + A d,    u_r ~ N(0, σ_r²),    e ~ N(0, diag(s²)),    d ~ N(0, 1).

A has a column for each driver, with a, the root mean square of its fits: they share one error. σ_r
are those of the largest restricted likelihood (Patterson and Thompson, Biometrika 58, 1971,
545-554), their intervals those of its profile. It needs no balanced design.
"""

import dataclasses
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
STEPS, SETTLED = 60, 1e-5  # of the search; the change of −2 ln L where it ends
RIDGE = 1e-6  # added to the matrix, for deviations that are 0
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
        stderr: Its standard error [SI], with that of the drivers: how far it is from that of all
            subjects.
        between: The variation between the groups of each level, such as `subject`, and between
            the `recordings` of the last level; relative to the mean.
        error: Median of the relative standard errors of the fits, without that of the driver.
        driver_error: Median of the relative errors that come from the driver.
        driver: Label whose groups have a driver of their own; empty if all fits share one.
        unused: Labels that divide nothing, and so are no levels.
    """

    element: str
    unit: str
    fits: int
    mean: float
    stderr: float
    between: Mapping[str, Part]
    error: float
    driver_error: float
    driver: str
    unused: Sequence[str]

    def _overview(self) -> Overview:
        rows = [
            (f"between {name}{'' if name == REST else 's'}", *map(_per_cent, part))
            for name, part in self.between.items()
        ]
        rows.append(("error of a fit", _per_cent(self.error), "", ""))
        of = f"each {self.driver}" if self.driver else "all"
        rows.append((f"error of the driver of {of}", _per_cent(self.driver_error), "", ""))
        title = f"{self.element} of {self.fits} fits: {quantity(self.mean, self.unit, self.stderr)}"
        heads = "variation", "standard deviation", "95 % from", "to"
        names = ", ".join(self.unused)
        notes = [f"no groups of several fits by {names}"] if names else []
        return Overview(title, rows, heads, notes=notes)


def _per_cent(part: float) -> str:
    return f"{100 * part:.0f} %" if part >= 1 else f"{100 * part:.2g} %"


def variation(
    fits: Fits,
    element: str,
    by: Sequence[str] = ("subject", "session", "site"),
    *,
    driver: str = "",
) -> Variation:
    """Variation of an element between subjects, their sessions, and so on, beyond its errors.

    The error of a driver is common to all of its recordings, so it is no variation between them,
    but an error of their mean. Where sessions have calibrations of their own, say so by
    `driver="session"`: else the errors of their drivers count as variation between sessions.

    Args:
        fits: Fits of one condition; those without success are left out.
        element: Name of the element.
        by: Labels, each nested in those before it. A label that does not divide the groups of
            those before it further, or that leaves one recording in each group, is no level.
        driver: Label whose groups have calibrations of their own, such as `session`.

    Returns:
        The geometric mean, and the standard deviation of each level with its interval.

    Raises:
        ValueError: There is no such element, or no level has two groups.
        RecordingError: There is no such label.
    """
    units = fits.circuit.units()
    if element not in units:
        raise ValueError(f"the element is {element!r}, must be one of {', '.join(units)}")
    check_names(dict.fromkeys((*by, *([driver] if driver else []))), LABELS, "label")
    good = fits.successful()
    values = np.asarray(getattr(good.circuit, element))
    place = list(units).index(element)
    shared = np.asarray(good.fit.shared_cov)[:, place, place]
    own = np.asarray(good.cov)[:, place, place] - shared
    y = np.log(values)
    s, a = (np.sqrt(np.maximum(of, 0.0)) / values for of in (own, shared))
    levels = _levels([good.labels[name].astype(str) for name in by], by, len(values))
    if len(values) < 2 or not levels:
        raise ValueError(f"{len(values)} successful fits show no variation by {', '.join(by)}")
    names = good.labels[driver].astype(str) if driver else np.zeros(y.size)
    member = (names[:, None] == np.unique(names)).astype(float)
    # One error for a driver: that of each fit grows with its element, and would explain it.
    drivers = member * np.sqrt(a**2 @ member / member.sum(0))
    model = _Model.of(y, s, list(levels.values()), drivers)
    best, mean, stderr = model.fitted()
    between = {}
    for row, name in enumerate(levels):
        ends = model.interval(row, best)
        between[name] = Part(float(best[row]), *ends)
    middle = float(np.exp(mean))
    return Variation(
        element=element,
        unit=units[element],
        fits=len(values),
        mean=middle,
        stderr=middle * stderr,
        between=between,
        error=float(np.median(s)),
        driver_error=float(np.median(a)),
        driver=driver,
        unused=[name for name in by if name not in levels],
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
    """The restricted likelihood of logarithms.

    Attributes:
        y: Logarithms.
        noise: Their squared errors.
        levels: Group of each logarithm, by level, numbered from 0.
        drivers: Errors of the drivers, (logarithm, driver).
        spread: Standard deviation of the logarithms.
    """

    y: np.ndarray
    noise: np.ndarray
    levels: Sequence[np.ndarray]
    drivers: np.ndarray
    spread: float

    @classmethod
    def of(
        cls, y: np.ndarray, s: np.ndarray, levels: Sequence[np.ndarray], drivers: np.ndarray
    ) -> "_Model":
        spread = float(np.std(y)) or 1.0
        return cls(y, s**2 + (FINE * spread) ** 2, levels, drivers, spread)

    def deviance(self, std: np.ndarray) -> float:
        """−2 ln of the restricted likelihood."""
        return self._parts(std)[0]

    def _parts(self, std: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        """The deviance, P = V⁻¹ − V⁻¹1 1ᵀV⁻¹ / 1ᵀV⁻¹1, and V⁻¹1."""
        inverse, logs = np.zeros((self.y.size, self.y.size)), 0.0
        for group in range(self.levels[0].max() + 1):  # independent but for the drivers
            rows = np.flatnonzero(self.levels[0] == group)
            v = np.diag(self.noise[rows])
            for one, of in zip(std, self.levels, strict=True):
                v += one**2 * (of[rows][:, None] == of[rows])
            logs += float(np.linalg.slogdet(v)[1])
            inverse[np.ix_(rows, rows)] = np.linalg.inv(v)
        # (V + A Aᵀ)⁻¹ = V⁻¹ − V⁻¹A (1 + AᵀV⁻¹A)⁻¹ AᵀV⁻¹
        of = inverse @ self.drivers
        inner = np.eye(of.shape[1]) + self.drivers.T @ of
        logs += float(np.linalg.slogdet(inner)[1])
        inverse -= of @ np.linalg.solve(inner, of.T)
        ones = inverse.sum(0)
        p = inverse - np.outer(ones, ones) / ones.sum()
        return logs + float(np.log(ones.sum()) + self.y @ p @ self.y), p, ones

    def smallest(self, start: np.ndarray, fixed: int | None = None) -> tuple[np.ndarray, float]:
        """Standard deviations with the smallest deviance, by Fisher's scoring of their logarithms.

        Args:
            start: Where to begin.
            fixed: Level whose standard deviation stays as it is.
        """
        std = np.maximum(start, 0.05 * self.spread)
        free = np.arange(std.size) != fixed
        if fixed is not None:
            std[fixed] = start[fixed]
        for _ in range(STEPS):
            slope, matrix = self._derivatives(std)
            slope, matrix = slope[free], matrix[np.ix_(free, free)]
            step = np.linalg.solve(matrix + RIDGE * np.eye(slope.size), -slope)
            std[free] = np.maximum(std[free] * np.exp(np.clip(step, -2, 2)), FINE * self.spread)
            if np.abs(step @ slope) < SETTLED:
                break
        return std, self.deviance(std)

    def _derivatives(self, std: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Slope of the deviance by the ln σ_r, and the expected matrix of its second derivatives.

        By σ_r² they are tr(P M_r) − yᵀP M_r P y and tr(P M_r P M_s), M_r = Z_r Z_rᵀ.
        """
        _, p, _ = self._parts(std)
        columns, along = [_summed(p, of) for of in self.levels], self.y @ p
        slope = [
            np.trace(_summed(part.T, of)) - np.sum(np.bincount(of, along) ** 2)
            for part, of in zip(columns, self.levels, strict=True)
        ]
        matrix = [[np.sum(_summed(part.T, of) ** 2) for of in self.levels] for part in columns]
        scale = 2 * std**2
        return scale * np.array(slope), scale[:, None] * np.array(matrix) * scale

    def fitted(self) -> tuple[Float[np.ndarray, " level"], float, float]:
        """The standard deviations, the mean and its standard error."""
        best, _ = self.smallest(np.full(len(self.levels), 0.3 * self.spread))
        _, _, ones = self._parts(best)
        return best, float(ones @ self.y / ones.sum()), float(1 / np.sqrt(ones.sum()))

    def interval(self, row: int, best: np.ndarray) -> tuple[float, float]:
        """The ends of the 95 % interval of one standard deviation."""
        least = self.deviance(best)

        def beyond(std: float) -> float:
            start = best.copy()
            start[row] = std
            return self.smallest(start, row)[1] - least - INTERVAL

        at, low = float(best[row]), 0.0
        if beyond(0.0) > 0:
            low = scipy.optimize.root_scalar(beyond, bracket=(0.0, at), rtol=END).root
        high = max(at, 1e3 * FINE * self.spread)
        while beyond(high) < 0:
            high *= 2
        return low, scipy.optimize.root_scalar(beyond, bracket=(at, high), rtol=END).root


def _summed(matrix: np.ndarray, groups: np.ndarray) -> np.ndarray:
    """Sums of the columns of each group."""
    order = np.argsort(groups, kind="stable")
    starts = np.flatnonzero(np.diff(groups[order], prepend=-1))
    return np.add.reduceat(matrix[:, order], starts, axis=1)
