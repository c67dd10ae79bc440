"""The profile of one element: the smallest F at each of its values, over all other parameters.

F is that of `etid.identify.posterior`. Its deviance is drawn over the stretched element, as the
draws are there. Bounds are walls: no element leaves them.
"""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float

from etid.circuits.circuit import AbstractCircuit
from etid.estimators.element_prior import FIXED, require_element
from etid.identify.posterior import Known, Minimum, costs, minimum_of
from etid.identify.spectrum import Spectrum
from etid.likelihood.linear import LevenbergMarquardt, NormalEquations
from etid.likelihood.load import Anew
from etid.precision import array_function, in_float64, one_thread
from etid.recordings.recording import Recording
from etid.results.driver import Driver
from etid.results.fit import Fit
from etid.results.posterior import Profile

POINTS = 29  # of a profile
FARTHEST = 3.5  # [standard errors]
WALL = 1e3  # slope of the terms outside of bounds [1/standard error]
ENOUGH = 1e-4  # of F, below which a step ends a search; the interval of 95 % is at 1.92


@dataclasses.dataclass(frozen=True)
class _Inside:
    """The likelihood of rows, with bounds as walls: steep terms outside.

    Attributes:
        terms: The likelihood.
        free: Parameters that are not held.
        low: Lower bounds of all parameters; −∞ without one.
        high: Upper bounds; ∞ without one.
        slope: Slopes of the walls.
    """

    terms: Anew | Spectrum
    free: Bool[np.ndarray, "row q"]
    low: Float[np.ndarray, " q"]
    high: Float[np.ndarray, " q"]
    slope: Float[np.ndarray, " q"]

    def equations(self, q: Float[np.ndarray, "row q"]) -> NormalEquations:
        """The normal equations."""
        found, free = self.terms.equations(q), self.free
        outside = self.slope * (q - np.clip(q, self.low, self.high))
        # At a wall, a step that leads out meets it.
        leads = (q <= self.low) & (found.gradient > 0) | (q >= self.high) & (found.gradient < 0)
        steep = np.where(leads | (outside != 0), self.slope, 0.0)
        matrix = found.matrix * (free[:, :, None] & free[:, None, :])
        own = np.where(free, steep**2, 1.0)[:, :, None] * np.eye(q.shape[-1])
        return found._replace(
            objective=found.objective + 0.5 * (outside**2).sum(-1),
            gradient=(found.gradient + steep * outside) * free,
            matrix=matrix + own,
        )

    def of(self, rows: np.ndarray) -> "_Inside":
        """Some of the rows."""
        return dataclasses.replace(self, terms=self.terms.of(rows), free=self.free[rows])


@array_function
def _profile(
    least: Minimum,
    known: Known,
    circuit: AbstractCircuit,
    number: int,
    stretched: Float[np.ndarray, " element"],
) -> tuple[Float[np.ndarray, " point"], Float[np.ndarray, " point"]]:
    """Logarithms of an element, and the deviance there.

    Args:
        least: The minimum without bounds.
        known: What is known besides the recording.
        circuit: The fitted circuit.
        number: Number of the element.
        stretched: Standard errors of the logarithms of the elements, from the fit.
    """
    load, q, cov = least
    names, errors = circuit.names(), np.sqrt(np.diagonal(cov))
    low, high = np.full(q.size, -np.inf), np.full(q.size, np.inf)  # [standard errors] from q
    for name, *ends in known.bounds:
        place = names.index(name)
        low[place], high[place] = (np.log(ends) - q[place]) / stretched[place]
    middle = np.clip(0.0, low[number], high[number])
    first, last = np.clip([middle - FARTHEST, middle + FARTHEST], low[number], high[number])
    steps = np.linspace(first, last, POINTS)
    # Each value of the element is a row that holds it; in the last row it is free.
    starts = q + np.append(steps, middle)[:, None] * cov[number] / errors[number]
    free = np.ones(starts.shape, bool)
    free[:-1, number] = False
    rows = load.of(np.zeros(len(starts), int))
    is_spectrum = isinstance(rows, Spectrum)
    terms = rows if is_spectrum else Anew(rows, rows.gains.at(rows.knots.index))
    problem = _Inside(
        terms,
        free,
        q + low * errors,
        q + high * errors,
        WALL / errors,
    )
    search = LevenbergMarquardt(damping=1e-2, steps=200)
    found = search(problem, starts, problem.equations(starts), ENOUGH).q
    deviance = 2 * costs(load, found)
    return q[number] + stretched[number] * steps, deviance[:-1] - deviance[-1]


@in_float64
@one_thread()
def profile(fit: Fit, recording: Recording | None, driver: Driver | None, name: str) -> Profile:
    """`Fit.profile`."""
    names = fit.circuit.names()
    require_element(name, fit.circuit)
    least, known, cov = minimum_of(fit, recording, driver, "fit.profile")
    number = names.index(name)
    if known.elements is not None and known.elements.width[number] <= FIXED:
        raise ValueError(f"{name} is fixed, so it has no profile; take another element")
    of = known, fit.circuit, number, np.sqrt(np.diagonal(cov))
    logs, deviance = _profile(least, *of)
    ends = {one: (low, high) for one, low, high in known.bounds}
    return Profile(
        name=name,
        unit=fit.circuit.units()[name],
        value=float(getattr(fit.circuit, name)),
        stderr=float(getattr(fit.stderr, name)),
        values=np.exp(logs),
        deviance=deviance,
        bounds=ends.get(name, (-np.inf, np.inf)),
    )
