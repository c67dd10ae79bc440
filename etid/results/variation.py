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

from etid.printing import Overview, Overviewed, per_cent, quantity, several
from etid.recordings.fields import LABELS
from etid.recordings.labels import check_names
from etid.results.fits import Fits

REST = "recordings"  # the last level: recordings with equal labels
END = 1e-4  # relative error of the ends of an interval
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
        fits: Number of usable fits.
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
        parts = {
            f"between {name}{'' if name == REST else 's'}": part
            for name, part in self.between.items()
        }
        # A search for the minimum at 0 ends near it.
        rows = [
            (name, *(per_cent(of) if of > 1e-3 * max(part) else "0 %" for of in part))
            for name, part in parts.items()
        ]
        of = f"each {self.driver}" if self.driver else "all"
        rows.append(("error of a fit", per_cent(self.error), "", ""))
        rows.append((f"error of the driver of {of}", per_cent(self.driver_error), "", ""))
        mean = quantity(self.mean, self.unit, self.stderr)
        title = f"{self.element} of {several(self.fits, 'fit')}: {mean}"
        names = ", ".join(self.unused)
        notes = [f"no groups of several fits by {names}"] if names else []
        return Overview(title, rows, ("variation", "standard deviation", "95 % from", "to"), notes)


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
        fits: Fits of one condition; unusable ones are left out.
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
    good = fits.usable()
    values, place = np.asarray(getattr(good.circuit, element)), list(units).index(element)
    total, shared = (np.asarray(of)[:, place, place] for of in (good.cov, good.fit.shared_cov))
    s, a = (np.sqrt(np.maximum(of, 0.0)) / values for of in (total - shared, shared))
    levels = _levels([good.labels[name].astype(str) for name in by], by, len(values))
    if len(values) < 2 or not levels:
        raise ValueError(f"no variation by {', '.join(by)} in {several(len(values), 'usable fit')}")
    names = good.labels[driver].astype(str) if driver else np.zeros(values.size)
    member = (names[:, None] == np.unique(names)).astype(float)
    # One error for a driver: that of each fit grows with its element, and would explain it.
    drivers = member * np.sqrt(a**2 @ member / member.sum(0))
    model = _Model(np.log(values), s, list(levels.values()), drivers)
    best = model.best()
    between = {
        name: Part(float(best[i]), *model.interval(i, best)) for i, name in enumerate(levels)
    }
    _, _, mean, stderr = model.at(best)
    return Variation(
        element=element,
        unit=units[element],
        fits=len(values),
        mean=float(np.exp(mean)),
        stderr=float(np.exp(mean) * stderr),
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
    found, groups = {}, 1
    for depth, name in enumerate(names, start=1):
        keys = np.array(["\0".join(parts) for parts in zip(*columns[:depth], strict=True)])
        place = np.unique(keys, return_inverse=True)[1]
        if groups < place.max(initial=0) + 1 < count:
            found[name] = place
            groups = place.max() + 1
    return found | ({REST: np.arange(count)} if count > groups else {})


class _Model:
    """The restricted likelihood of logarithms y with errors s, by the equations of mixed models.

    With weights W (errors of the fits and the last level), standard deviations S of the others and
    a flat prior of μ, the effects u solve C u = RᵀW y with R = (Z S, A, 1), C = E + RᵀW R and
    E = diag(1, …, 1, 0) (Henderson, Biometrics 31, 1975, 423-447). The deviance is

        −2 ln L = ln |C| − Σ ln w + Σ w (y − R u)² + uᵀE u.
    """

    def __init__(
        self, y: np.ndarray, s: np.ndarray, levels: Sequence[np.ndarray], drivers: np.ndarray
    ) -> None:
        """`levels`: group of each y, by level; in the last one each has its own."""
        self.middle, self.spread = float(np.mean(y)), float(np.std(y)) or 1.0
        self.y, self.noise = y - self.middle, s**2 + (FINE * self.spread) ** 2
        groups = [np.eye(of.max() + 1)[of] for of in levels[:-1]]
        self.effects = np.hstack([*groups, drivers, np.ones((y.size, 1))])
        owner = np.repeat(np.arange(len(groups)), [of.shape[1] for of in groups])
        # (effect, level but the last), 1 where the effect is of this level.
        self.level = np.eye(self.effects.shape[1], owner.size) @ np.eye(len(groups))[owner]

    def at(self, std: np.ndarray) -> tuple[float, np.ndarray, float, float]:
        """The deviance, its slope by the logarithms of `std`, μ, and the standard error of μ.

        The slope by σ_r² is tr(P Z_r Z_rᵀ) − |Z_rᵀP y|², with P y = W (y − R u).
        """
        w = 1 / (self.noise + std[-1] ** 2)
        r = self.effects * np.where(self.level.any(1), self.level @ std[:-1], 1.0)
        prior = np.append(np.ones(r.shape[1] - 1), 0.0)
        matrix = np.diag(prior) + r.T @ (w[:, None] * r)
        inverse = np.linalg.inv(matrix)
        u = inverse @ (r.T @ (w * self.y))
        left = w * (self.y - r @ u)
        logs = np.linalg.slogdet(matrix)[1] - np.sum(np.log(w))
        last = np.sum(w) - np.sum((r @ inverse) * r * w[:, None] ** 2) - left @ left
        own = 2 * (1 - np.diag(inverse) - u**2) @ self.level
        deviance, mean = float(logs + left @ (left / w) + prior @ u**2), self.middle + float(u[-1])
        return deviance, np.append(own, 2 * std[-1] ** 2 * last), mean, inverse[-1, -1] ** 0.5

    def best(self, start: np.ndarray | None = None, fixed: int | None = None) -> np.ndarray:
        """Standard deviations with the smallest deviance; the one of level `fixed` stays."""
        std = np.full(self.level.shape[1] + 1, 0.3 * self.spread) if start is None else start.copy()
        free = np.arange(std.size) != fixed

        def objective(logs: np.ndarray) -> tuple[float, np.ndarray]:
            std[free] = np.exp(logs)
            deviance, slope, *_ = self.at(std)
            return deviance, slope[free]

        if free.any():
            begin = np.log(np.maximum(std[free], 0.05 * self.spread))
            limits, ends = [(np.log(FINE * self.spread), None)], {"ftol": 1e-12, "gtol": 1e-8}
            found = scipy.optimize.minimize(
                objective, begin, jac=True, bounds=limits * begin.size, options=ends
            )
            std[free] = np.exp(found.x)
        return std

    def interval(self, row: int, best: np.ndarray) -> tuple[float, float]:
        """The ends of the 95 % interval of one standard deviation."""
        limit = self.at(best)[0] + 3.84  # χ², 95 %

        def beyond(std: float) -> float:
            start = best.copy()
            start[row] = std
            return self.at(self.best(start, row))[0] - limit

        at, low = float(best[row]), 0.0
        if beyond(0.0) > 0:
            low = scipy.optimize.root_scalar(beyond, bracket=(0.0, at), rtol=END).root
        high = max(at, 1e3 * FINE * self.spread)
        while beyond(high) < 0:
            high *= 2
        return low, scipy.optimize.root_scalar(beyond, bracket=(at, high), rtol=END).root
