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

from etid.circuits.display import per_cent, quantity, several
from etid.circuits.overview import Overview, Overviewed
from etid.recordings.fields import LABELS, check_names
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
        rows = [
            # A search for the minimum at 0 ends near it.
            (
                f"between {name}{'' if name == REST else 's'}",
                *(_per_cent(of) if of > 1e-3 * max(part) else "0 %" for of in part),
            )
            for name, part in self.between.items()
        ]
        rows.append(("error of a fit", _per_cent(self.error), "", ""))
        of = f"each {self.driver}" if self.driver else "all"
        rows.append((f"error of the driver of {of}", _per_cent(self.driver_error), "", ""))
        title = f"{self.element} of {several(self.fits, 'fit')}: "
        title += quantity(self.mean, self.unit, self.stderr)
        heads = "variation", "standard deviation", "95 % from", "to"
        names = ", ".join(self.unused)
        notes = [f"no groups of several fits by {names}"] if names else []
        return Overview(title, rows, heads, notes=notes)


def _per_cent(part: float) -> str:
    return f"{100 * part:.0f} %" if part >= 1 else per_cent(part)


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
    values = np.asarray(getattr(good.circuit, element))
    place = list(units).index(element)
    shared = np.asarray(good.fit.shared_cov)[:, place, place]
    own = np.asarray(good.cov)[:, place, place] - shared
    y = np.log(values)
    s, a = (np.sqrt(np.maximum(of, 0.0)) / values for of in (own, shared))
    levels = _levels([good.labels[name].astype(str) for name in by], by, len(values))
    if len(values) < 2 or not levels:
        raise ValueError(f"no variation by {', '.join(by)} in {several(len(values), 'usable fit')}")
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


class _Inverse(NamedTuple):
    """V⁻¹ at some standard deviations; see `_Model`.

    Attributes:
        w: Diagonal of W.
        gram: ŪᵀWŪ.
        kernel: K̄.
        along: v; V⁻¹1 = W Ū v.
        total: 1ᵀV⁻¹1.
        logs: ln |V|.
    """

    w: np.ndarray
    gram: np.ndarray
    kernel: np.ndarray
    along: np.ndarray
    total: float
    logs: float


@dataclasses.dataclass(frozen=True)
class _Model:
    """The restricted likelihood of logarithms.

    Their covariance is V = W⁻¹ + U S² Uᵀ. W is diagonal and has the errors of the fits and the last
    level, U the other effects, S their standard deviations. With K = S (1 + S UᵀWU S)⁻¹ S
    (Woodbury), v = (−K UᵀW1, 1) and Ū = (U, 1),

        V⁻¹ = W − W U K UᵀW,    P = V⁻¹ − V⁻¹1 1ᵀV⁻¹ / 1ᵀV⁻¹1 = W − W Ū K̄ ŪᵀW,
        K̄ = (K, 0; 0, 0) + v vᵀ / 1ᵀV⁻¹1.

    Attributes:
        y: Logarithms.
        noise: Their squared errors.
        effects: Ū: groups of all levels but the last, errors of the drivers, 1.
        level: (effect, level but the last), 1 where the effect is of this level.
        spread: Standard deviation of the logarithms.
    """

    y: np.ndarray
    noise: np.ndarray
    effects: np.ndarray
    level: np.ndarray
    spread: float

    @classmethod
    def of(
        cls, y: np.ndarray, s: np.ndarray, levels: Sequence[np.ndarray], drivers: np.ndarray
    ) -> "_Model":
        """The model.

        Args:
            y: Logarithms.
            s: Their errors.
            levels: Group of each logarithm, by level, numbered from 0; in the last level each has a
                group of its own.
            drivers: Errors of the drivers, (logarithm, driver).
        """
        spread = float(np.std(y)) or 1.0
        groups = [np.eye(of.max() + 1)[of] for of in levels[:-1]]
        effects = np.hstack([*groups, drivers, np.ones((y.size, 1))])
        owner = np.repeat(np.arange(len(groups)), [of.shape[1] for of in groups])
        level = np.eye(effects.shape[1], owner.size) @ np.eye(len(groups))[owner]
        return cls(y, s**2 + (FINE * spread) ** 2, effects, level, spread)

    def deviance(self, std: np.ndarray) -> float:
        """−2 ln of the restricted likelihood."""
        of = self._inverse(std)
        return of.logs + float(np.log(of.total) + self.y @ self._projected(of))

    def _inverse(self, std: np.ndarray) -> _Inverse:
        w = 1 / (self.noise + std[-1] ** 2)
        gram = self._gram(w)
        scale = np.where(self.level.any(1), self.level @ std[:-1], 1.0)[:-1]
        inner = np.eye(scale.size) + scale[:, None] * gram[:-1, :-1] * scale
        k = scale[:, None] * np.linalg.solve(inner, np.diag(scale))
        along = np.append(-k @ gram[:-1, -1], 1.0)
        total = float(along @ gram[:, -1])
        logs = float(np.linalg.slogdet(inner)[1] - np.sum(np.log(w)))
        kernel = np.pad(k, (0, 1)) + np.outer(along, along) / total
        return _Inverse(w, gram, kernel, along, total, logs)

    def _gram(self, weight: np.ndarray) -> np.ndarray:
        """Ūᵀ diag(weight) Ū."""
        return self.effects.T @ (weight[:, None] * self.effects)

    def _projected(self, of: _Inverse) -> np.ndarray:
        """P y."""
        weighted = of.w * (self.y - np.mean(self.y))  # P 1 = 0, but for the digits that it costs
        return weighted - of.w * (self.effects @ (of.kernel @ (self.effects.T @ weighted)))

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
        for _ in range(60):
            slope, matrix = self._derivatives(std)
            slope, matrix = slope[free], matrix[np.ix_(free, free)]
            step = np.linalg.solve(matrix + 1e-6 * np.eye(slope.size), -slope)  # for std 0
            std[free] = np.maximum(std[free] * np.exp(np.clip(step, -2, 2)), FINE * self.spread)
            if np.abs(step @ slope) < 1e-5:  # of the deviance
                break
        return std, self.deviance(std)

    def _derivatives(self, std: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Slope of the deviance by the ln σ_r, and the expected matrix of its second derivatives.

        By σ_r² they are tr(P M_r) − yᵀP M_r P y and tr(P M_r P M_s), M_r = Z_r Z_rᵀ: sums over the
        effects of a level, and over the logarithms for the last one.
        """
        of = self._inverse(std)
        squared, cubed = self._gram(of.w**2), self._gram(of.w**3)
        rest = np.eye(of.along.size) - of.kernel @ of.gram
        p, pp = of.gram @ rest, rest.T @ squared @ rest  # ŪᵀPŪ and ŪᵀPPŪ
        residual, lost = self._projected(of), of.kernel @ squared
        own = np.diag(p) - (self.effects.T @ residual) ** 2
        last = np.sum(of.w) - np.trace(lost) - residual @ residual
        edge = np.diag(pp) @ self.level
        corner = np.sum(of.w**2) - 2 * np.sum(of.kernel * cubed) + np.sum(lost * lost.T)
        matrix = np.block([[self.level.T @ p**2 @ self.level, edge[:, None]], [edge, corner]])
        scale = 2 * std**2
        slope = scale * np.append(own @ self.level, last)
        return slope, scale[:, None] * matrix * scale

    def fitted(self) -> tuple[Float[np.ndarray, " level"], float, float]:
        """The standard deviations, the mean and its standard error."""
        best, _ = self.smallest(np.full(self.level.shape[1] + 1, 0.3 * self.spread))
        of = self._inverse(best)
        mean = float((of.w * self.y) @ (self.effects @ of.along)) / of.total
        return best, mean, float(1 / np.sqrt(of.total))

    def interval(self, row: int, best: np.ndarray) -> tuple[float, float]:
        """The ends of the 95 % interval of one standard deviation."""
        least = self.deviance(best)

        def beyond(std: float) -> float:
            start = best.copy()
            start[row] = std
            return self.smallest(start, row)[1] - least - 3.84  # χ², 95 %

        at, low = float(best[row]), 0.0
        if beyond(0.0) > 0:
            low = scipy.optimize.root_scalar(beyond, bracket=(0.0, at), rtol=END).root
        high = max(at, 1e3 * FINE * self.spread)
        while beyond(high) < 0:
            high *= 2
        return low, scipy.optimize.root_scalar(beyond, bracket=(at, high), rtol=END).root
