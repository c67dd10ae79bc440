"""The fit of a circuit to a measured impedance, and its verdict.

It starts at several corner frequencies that span the data, each with several impedance levels, and
keeps the best minimum. From a single start, two layers sometimes ended as one.

Without standard errors the residual alone says whether the circuit is right; `_judged` does.
"""

import dataclasses
import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from etid.circuits.branches import in_order
from etid.circuits.circuit import AbstractCircuit, too_steep
from etid.estimators.element_limits import Limits, limited, of_circuit, within
from etid.estimators.element_prior import Known
from etid.identify.kramers_kronig import EXACT, FAIL, MISFIT_CHI2, KramersKronig
from etid.identify.spectrum import ROUNDING, PassiveFit, Spectrum
from etid.likelihood.linear import LevenbergMarquardt, NormalEquations, taken
from etid.precision import array_function
from etid.printing import several
from etid.recordings.remarks import Remark
from etid.results.data import MeasuredImpedance
from etid.results.fit import Fit, Support, complex_rrse
from etid.results.method_options import options_of
from etid.results.unlike_noise import RUNS, TAILS, noise_in
from etid.results.verdicts import RESULTS, first_verdict, verdict
from etid.solvers.matrices import inverse

METHOD = "impedance"
# Three steps in a row that reduce the sum of squares by less than this part end a fit, at a
# distance of less than 1e-4 standard errors from its minimum.
ENOUGH = 1e-8
FACTOR = np.log(3.0)  # of an element, which must cost
SURE = 8.0  # of ½ Σ r², four standard errors; or a quarter of what its own standard error says
ROUGHLY, LEADING = 10, 5  # steps from all starts; one of so many then goes on
FEW = 3  # elements, the valley of which is straight
SIMPLE = 5  # elements, up to which the minimum was always found from the ordinary starts


class Told(NamedTuple):
    """What is told of elements before a fit; as text it is the method of the fit.

    Attributes:
        known: Elements that are known.
        bounds: Elements with bounds.
    """

    known: Known = ()
    bounds: Limits = ()

    @classmethod
    def of(cls, method: str) -> "Told":
        """What the text of a method says."""
        options = options_of(method)[1]
        return cls(options.get("known_elements", ()), options.get("bounds", ()))

    def __str__(self) -> str:
        of = {"known_elements": self.known, "bounds": self.bounds}
        options = ", ".join(f"{name}={value!r}" for name, value in of.items() if value)
        return f"{METHOD}({options})" if options else METHOD


class Least(NamedTuple):
    """The minimum of a spectrum.

    Attributes:
        spectrum: Its terms, with the noise that they have.
        q: Logarithms of the elements.
        equations: The normal equations there, as one row.
        settled: Whether it is the minimum.
        steps: Number of steps of the best start.
        near: Logarithms of the elements of all minima that are nearly as good.
    """

    spectrum: Spectrum
    q: Float[np.ndarray, " element"]
    equations: NormalEquations
    settled: bool
    steps: int
    near: Float[np.ndarray, "minimum element"]

    @classmethod
    def of(cls, spectrum: Spectrum, starts: Float[np.ndarray, "start element"]) -> "Least":
        """The best minimum from several starts."""
        size = spectrum.noise if spectrum.sigma is None else spectrum.sigma / np.abs(spectrum.z)
        exact = spectrum.z.size * float(np.mean((ROUNDING / size) ** 2))
        first = LevenbergMarquardt(damping=1e-2, steps=ROUGHLY, patience=3, relative=ENOUGH)
        near = first(spectrum, starts, spectrum.equations(starts), exact)
        # Of starts that have found one minimum the first counts, whatever rounding says.
        order = np.argsort(np.float32(near.equations.objective), kind="stable")
        leading = order[: len(starts) // LEADING]
        found = dataclasses.replace(first, steps=500).further(spectrum, taken(near, leading))
        best = int(np.argmin(np.float32(found.equations.objective)))
        settled = np.isfinite(found.equations.objective[best]) & ~found.moves[best]
        q, steps = found.q[best], int(found.steps[best])
        equations = taken(found.equations, np.array([best]))
        alone = cls(spectrum, q, equations, bool(settled), steps, q[None])
        above = found.equations.objective - found.equations.objective[best]
        return alone._replace(near=found.q[above < SURE * max(alone.chi2, 1.0)])

    @property
    def terms(self) -> Float[np.ndarray, " part"]:
        """The terms of the impedances."""
        assert self.equations.terms is not None
        return self.equations.terms[0]

    @property
    def chi2(self) -> float:
        """Σ r² of the impedances per degree of freedom."""
        return float((self.terms**2).sum()) / (self.terms.size - int(self.spectrum.free.sum()))


class Solved(NamedTuple):
    """The minimum without bounds, judged.

    Attributes:
        least: The minimum.
        q: Logarithms of the elements, with branches that can be exchanged in their order.
        cov: Their covariance.
        misfit: Whether the circuit leaves more than is accepted.
        remark: What the residual shows.
    """

    least: Least
    q: Float[np.ndarray, " element"]
    cov: Float[np.ndarray, "element element"]
    misfit: bool
    remark: int


@array_function
def solved(
    measured: MeasuredImpedance,
    circuit: AbstractCircuit,
    chain: KramersKronig | None,
    told: Told,
) -> Solved:
    """The minimum of a measured impedance; without standard errors its `chain` judges it.

    Raises:
        ValueError: There are too few impedances for the elements.
    """
    spectrum = Spectrum.measured(measured, circuit, told.known)
    size, free = measured.z.size, spectrum.free
    if 2 * size <= free.sum():
        given, wanted = several(size, "impedance"), several(int(free.sum()), "element")
        raise ValueError(f"{given} cannot determine {wanted}")
    passive, starts = None, spectrum.starts()
    if spectrum.sigma is None:
        passive = PassiveFit.of(chain, measured.z, int(free.sum()))
        square = passive.square
        if not math.isfinite(square):  # priors weigh against what the circuit leaves alone
            alone = np.where(free, np.inf, spectrum.width)
            square = Least.of(dataclasses.replace(spectrum, width=alone), starts).chi2
        spectrum = dataclasses.replace(spectrum, noise=max(math.sqrt(square), ROUNDING))
    least = Least.of(spectrum, starts)
    if free.sum() > SIMPLE and least.chi2 > MISFIT_CHI2:
        other = Least.of(spectrum, spectrum.scattered())
        least = min(least, other, key=lambda one: float(one.equations.objective[0]))
    cov, misfit, remark = _judged(least, passive)
    q, cov = _ordered(least.q, cov, spectrum, of_circuit(told.bounds, circuit))
    return Solved(least, q, cov, misfit, remark)


@array_function
def fit_spectrum(
    measured: MeasuredImpedance,
    circuit: AbstractCircuit,
    chain: KramersKronig | None,
    told: Told,
) -> Fit:
    """The fit of one circuit, with its verdict; arguments and errors as those of `solved`."""
    least, q, of_logs, misfit, remark = solved(measured, circuit, chain, told)
    spectrum, own, limits = least.spectrum, of_circuit(told.bounds, circuit), None
    values = np.exp(q)
    cov = of_logs * np.outer(values, values)
    deviance, contradicted = 2 * spectrum.objective(q[None])[0], False
    if own:
        inside = within(circuit, values, cov, np.zeros_like(cov), own)
        values = inside.values if np.isfinite(inside.values).all() else values
        cov, limits = inside.cov, limited(circuit, own, inside.outside)
        deviance, contradicted = deviance + inside.deviance, bool(inside.contradicted)
        remark |= int(Remark.at_bound) if inside.outside.any() and not contradicted else 0
    free = spectrum.free
    exact = {name: value for name, value, _ in told.known}  # to the last digit
    values = np.where(free, values, [exact.get(name, np.nan) for name in circuit.names()])
    cov, fitted = np.where(free[:, None] & free, cov, 0.0), circuit.of_fit(values)
    relative = np.sqrt(np.diagonal(cov)) / values
    support = dataclasses.replace(  # no changes of the circuit are tested
        Support.unknown(values.size),
        deviance=np.asarray(deviance),
        terms=np.asarray(2.0 * measured.z.size),
    )
    return Fit(
        circuit=fitted,
        cov=cov,
        shared_cov=np.zeros_like(cov),
        rrse=np.asarray(complex_rrse(fitted.response(measured.frequency), measured.z)),
        chi2=np.asarray(np.nan if measured.stderr is None else least.chi2),
        result=first_verdict(
            (~np.isfinite(values).all(), RESULTS.nonphysical),
            (np.bool_(too_steep(circuit, q, of_logs)), RESULTS.nonphysical),
            (np.bool_(not least.settled), verdict("max_steps_reached")),
            (np.bool_(misfit), RESULTS.misfit),
            (np.bool_(contradicted), verdict("out_of_bounds")),
            (~(relative < 1).all() | _open(least, q, of_logs), RESULTS.insensitive),
        ),
        steps=np.asarray(least.steps),
        method=str(told),
        remarks=np.asarray(remark),
        limits=limits,
        support=support,
    )


@dataclasses.dataclass(frozen=True)
class _Held:
    """A spectrum with some elements held in each row."""

    spectrum: Spectrum
    free: Bool[np.ndarray, "row element"]

    def equations(self, q: Float[np.ndarray, "row element"]) -> NormalEquations:
        """The normal equations."""
        return self.spectrum.equations(q).along(self.free)

    def of(self, rows: np.ndarray) -> "_Held":
        """Some of the rows."""
        return _Held(self.spectrum, self.free[rows])


def _open(
    least: Least, q: Float[np.ndarray, " element"], cov: Float[np.ndarray, "element element"]
) -> np.bool_:
    """Whether an element could be `FACTOR` larger or smaller, although its standard error is small.

    The time of a diffusion that is slower than all frequencies has no upper end, but noise gives it
    a minimum. The other elements follow: by the covariance, and if they are many, to their minimum.
    Or there is another minimum, nearly as good.
    """
    spectrum = least.spectrum
    some = np.flatnonzero(spectrum.free & np.any(spectrum.circuit.scaling(), 0))
    every = np.take_along_axis(least.near, np.asarray(in_order(spectrum.circuit, least.near)), -1)
    if (np.abs(every - q)[:, some] > FACTOR).any():
        return np.bool_(True)
    variance = np.diagonal(cov)[some]
    steps = FACTOR * (cov[:, some] / variance).T
    far, before = np.concatenate([q + steps, q - steps]), spectrum.objective(q[None])
    if q.size > FEW:
        held = _Held(spectrum, np.tile(np.arange(q.size) != some[:, None], (2, 1)))
        search = LevenbergMarquardt(damping=1e-2, steps=50)
        far = search(held, far, held.equations(far), SURE / 100).q
    rises = (spectrum.objective(far) - before).reshape(2, -1) / max(least.chi2, 1.0)
    return (rises < np.minimum(SURE, FACTOR**2 / (8 * variance))).any()


def _ordered(
    q: Float[np.ndarray, " element"],
    cov: Float[np.ndarray, "element element"],
    spectrum: Spectrum,
    bounds: Limits,
) -> tuple[Float[np.ndarray, " element"], Float[np.ndarray, "element element"]]:
    """Logarithms and their covariance, with branches that can be exchanged in their order."""
    ends = {name: (low, high) for name, low, high in bounds}
    both = np.array([ends.get(name, (0.0, np.inf)) for name in spectrum.circuit.names()]).T
    told = np.where(np.isfinite(spectrum.width), spectrum.centre, 0.0)
    places = np.asarray(in_order(spectrum.circuit, q, told, spectrum.width, *both))
    return q[places], cov[np.ix_(places, places)]


def _judged(
    least: Least, passive: PassiveFit | None
) -> tuple[Float[np.ndarray, "element element"], bool, int]:
    """Covariance of the logarithms, whether the circuit leaves too much, and remarks.

    If standard errors were given, χ² judges, and widens the covariance. Otherwise three signs show
    a residual that is not white noise, each of which says how large the noise is:

    - runs: neighbours miss alike. With autocorrelation ρ, (1 − ρ) of the mean square is noise
      (von Neumann 1941);
    - another passive circuit misses by less: an F test against the Kramers-Kronig chain;
    - tails: a few impedances make most of the mean square, and the median does not see them.

    The covariance is the larger one, element by element, of two: that of equal noise at all
    frequencies, and the sandwich of the jackknife (MacKinnon and White 1985), which needs no equal
    noise and contains the effect of each single impedance. A residual that is not noise has fewer
    independent values, by (1 − ρ) / (1 + ρ) (Bartlett 1935), but one at least. Priors are as good
    as they say.
    """
    bread, told = inverse(least.equations.matrix[0]), np.diag(1 / least.spectrum.width**2)
    if passive is None:
        meat = least.equations.matrix[0] + (max(least.chi2, 1.0) - 1.0) * _data(least)
        return bread @ meat @ bread, least.chi2 > MISFIT_CHI2, 0
    assert least.equations.rows is not None
    e, slope = least.terms, least.equations.rows[0].T
    n, square = e.size, least.chi2
    of_steps, usual = noise_in(e)
    rho = 1 - of_steps / np.where(square > 0, square, 1.0)
    unit = least.spectrum.noise**2
    runs, tails = rho > RUNS / n**0.5, square > TAILS**2 * usual
    signs = [runs, unit * np.sum(e**2) > passive.most, tails]
    noise = np.stack([of_steps, passive.square / unit, usual])
    excess = np.sqrt(unit * np.max(np.where(np.stack(signs), square - noise, 0.0)))
    fewer = np.where(excess > 0, np.clip((1 + rho) / (1 - rho), 1.0, n), 1.0)
    alone = slope * (e / (1 - np.sum((slope @ bread) * slope, axis=1)))[:, None]
    cov = bread @ (fewer * alone.T @ alone + told) @ bread
    equal = bread @ (fewer * square * _data(least) + told) @ bread
    grown = np.sqrt(np.fmax(np.diagonal(equal) / np.diagonal(cov), 1.0))  # NaN if all are 0
    remark = int(Remark.not_noise) if excess > EXACT else 0
    return cov * np.outer(grown, grown), bool(excess > FAIL), remark


def _data(least: Least) -> Float[np.ndarray, "element element"]:
    """What the impedances say of the logarithms, JᵀJ, without the priors."""
    assert least.equations.rows is not None
    rows = least.equations.rows[0]
    return rows @ rows.T
