"""The distribution of the elements of one fit.

It evaluates the likelihood of `etid.likelihood.load.Load` away from its minimum. The standard
errors of a fit are those at the minimum. At low signal-to-noise ratios the likelihood is skewed,
and its intervals are not symmetric.

**Draws.** The parameters q are the logarithms of the elements, the trigger delay, and the uncertain
part z of Z_th. F(q) = −log p has the curvature H at its minimum. At 20 dB a record of damp skin
determines R_s + R_p to 0.5 %, and R_s to 30 %: in the logarithms this is a curved valley. The draws
are therefore of the impedances, R and 1/C, in which it is nearly straight. The first ones have the
covariance H⁻¹ there (Laplace; `etid.solvers.importance_sampling`).

The prior is uniform in these impedances above 0, and in the logarithms of elements that are none,
times the priors of the fit; it is 0 outside their bounds.

**Curvature.** The unknown true spectrum of V_th is eliminated from F. Below 40 dB F is therefore
too narrow: noise in the unloaded record counts as information (Neyman and Scott 1948). The
covariance of a fit corrects this. The draws of the elements are stretched around the minimum, so
that their curvature there is that covariance (Chandler and Bate 2007; Ribatet, Cooley and Davison
2012). At 20 dB this factor is 1.2 to 1.4, and without it 95 % intervals contain the truth in 85 %.
"""

import dataclasses
from typing import NamedTuple, cast

import numpy as np
from jaxtyping import Bool, Float

from etid.circuits.circuit import AbstractCircuit, Circuit
from etid.estimators.element_limits import Limits, of_circuit
from etid.estimators.element_prior import FIXED, ElementPrior
from etid.estimators.lanes import Harmonics, taken
from etid.estimators.maximum_likelihood.estimator import MaximumLikelihood
from etid.estimators.maximum_likelihood.given_driver import GivenDriver
from etid.estimators.maximum_likelihood.rows import calibrated, loads_of, source_of
from etid.estimators.registry import MAXIMUM_LIKELIHOOD, named
from etid.identify.arguments import fed, require
from etid.identify.fitting import as_fitted, fits_of
from etid.identify.spectrum import Spectrum, chain_of
from etid.identify.spectrum_fit import Solved, Told, solved
from etid.likelihood.approximate import approximated, departs
from etid.likelihood.load import ROWS, Load
from etid.likelihood.search import minimum
from etid.precision import array_function, in_float64, one_thread
from etid.recordings.preflight import Inspected
from etid.recordings.recording import Recording
from etid.recordings.remarks import Remark
from etid.results.driver import Driver, HarmonicDriver
from etid.results.feed import MEASURED_CURRENT
from etid.results.fit import Fit
from etid.results.instrument import BUDGETED, Budget, Effects
from etid.results.method_options import fixed
from etid.results.posterior import Posterior
from etid.solvers.importance_sampling import drawn
from etid.solvers.matrices import inverse, inverse_root, is_definite

STEP = 3e-3  # [standard errors] of the second differences of F


@dataclasses.dataclass(frozen=True)
class Known:
    """What is known besides the recording.

    Attributes:
        driver: Distribution of Z_th, or the measured current; a measured impedance has that of 1 A.
        elements: Prior of the elements; None without one.
        bounds: Bounds of elements.
    """

    driver: GivenDriver
    elements: ElementPrior | None
    bounds: Limits = ()

    def allows(self, circuits: AbstractCircuit) -> Bool[np.ndarray, " draw"]:
        """Whether the elements of each circuit are finite and inside their bounds."""
        of = {name: np.asarray(getattr(circuits, name)) for name in circuits.names()}
        inside = [(of[name] >= low) & (of[name] <= high) for name, low, high in self.bounds]
        return np.all([*map(np.isfinite, of.values()), *inside], axis=0)


class Minimum(NamedTuple):
    """The likelihood of a recording or of a measured impedance, and its minimum.

    Attributes:
        load: The recording, as one row, or the impedance; its objective is F.
        q: The minimum.
        cov: H⁻¹.
    """

    load: Load | Spectrum
    q: Float[np.ndarray, " q"]
    cov: Float[np.ndarray, "q q"]

    @classmethod
    def of_spectrum(cls, of: Solved) -> "Minimum":
        """The minimum of a measured impedance, with the noise that the circuit leaves."""
        spectrum, chi2 = of.least.spectrum, of.least.chi2
        if spectrum.sigma is None:
            spectrum = dataclasses.replace(spectrum, noise=spectrum.noise * np.sqrt(chi2))
        root = inverse_root(spectrum.equations(of.q[None]).matrix[0])
        return cls(spectrum, of.q, _inverse_curvature(spectrum, of.q, root))

    @classmethod
    def of(cls, lane: Harmonics, known: Known, fit: Fit) -> "Minimum":
        """The minimum near a fit; with δ if the standard errors contain what its circuit leaves."""
        circuit = fit.circuit
        driver = source_of(known.driver), circuit, known.elements, calibrated(known.driver)
        load = loads_of([lane], *driver)
        rest = np.zeros(load.gains.exact - load.gains.elements)
        start = np.concatenate([np.log(circuit.values()), rest, load.gains.source.mean])
        found = minimum(load, start[None, None])
        # Of fits in a file, the verdict alone says it, and not that of a successful one.
        if fit.inexact or (fit.usable and departs(load, found.near).any()):
            of = approximated(load, found, start[None])
            load, found = of.load, of.least
        rows, q = found.near.jacobian[0], found.q[0]
        root = inverse_root(rows @ rows.T + load.told(q).matrix)
        return cls(load, q, _inverse_curvature(load, q, root))


@array_function
def costs(load: Load | Spectrum, q: Float[np.ndarray, "draw q"]) -> Float[np.ndarray, " draw"]:
    """F of each draw."""
    parts = np.array_split(q, -(-len(q) // ROWS))
    return np.concatenate([load.of(np.zeros(len(of), int)).objective(of) for of in parts])


def _inverse_curvature(
    load: Load | Spectrum, q: Float[np.ndarray, " q"], root: Float[np.ndarray, "q q"]
) -> Float[np.ndarray, "q q"]:
    """H⁻¹ by central second differences of F.

    The differences are along the columns of `root`, along which F has a curvature of about 1. They
    cost little: at 60 dB rounding errors change H by 6e-6; in the curved valley of damp skin at
    20 dB terms of higher order change standard errors by 2e-4.
    """
    size = q.size
    i, j = np.tril_indices(size)
    each = STEP * root.T
    ways = each[i] + np.where(i == j, 0.0, 1.0)[:, None] * each[j]
    found = costs(load, np.concatenate([q[None], q + ways, q - ways]))
    ahead, behind = np.split(found[1:], 2)
    along = (ahead + behind - 2 * found[0]) / STEP**2
    own = along[i == j]
    curvature = np.zeros((size, size))
    curvature[i, j] = curvature[j, i] = np.where(i == j, along, (along - own[i] - own[j]) / 2)
    return root @ inverse(curvature) @ root.T


class Impedances(NamedTuple):
    """Impedances of the elements in place of their logarithms; other parameters are as in q.

    Attributes:
        least: The minimum of F, at which each impedance is 1.
        powers: To which each impedance is proportional, such as −1 for a capacitance; 0 for
            parameters that are none.
    """

    least: Float[np.ndarray, " q"]
    powers: Float[np.ndarray, " q"]

    @classmethod
    def of_circuit(cls, circuit: AbstractCircuit, least: Float[np.ndarray, " q"]) -> "Impedances":
        """Those of the elements of a circuit, at the minimum of F."""
        powers = circuit.scaling()[0]
        return cls(least, np.pad(powers, (0, least.size - powers.size)))

    def of(self, q: Float[np.ndarray, " q"]) -> Float[np.ndarray, " q"]:
        """The impedances."""
        return np.where(self.powers != 0, np.exp(self.powers * (q - self.least)), q)

    def logs(self, x: Float[np.ndarray, "draw part"]) -> Float[np.ndarray, "draw part"]:
        """The parameters q, or those of them that come first; NaN for an impedance below 0."""
        powers, least = (of[: x.shape[1]] for of in (self.powers, self.least))
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(powers != 0, least + np.log(x) / powers, x)

    def moments(
        self, mean: Float[np.ndarray, " q"], cov: Float[np.ndarray, "part part"]
    ) -> tuple[Float[np.ndarray, " q"], Float[np.ndarray, "part part"]]:
        """The impedances at a mean of q, and the covariance of the first ones, to first order."""
        x = self.of(mean)
        slopes = np.where(self.powers != 0, self.powers * x, 1.0)[: len(cov)]
        return x, cov * np.outer(slopes, slopes)


def stretched(
    x: Float[np.ndarray, "draw q"],
    mean: Float[np.ndarray, " q"],
    cov: Float[np.ndarray, "q q"],
    wanted: Float[np.ndarray, "element element"],
) -> Float[np.ndarray, "draw element"]:
    """Draws of the elements, stretched around the minimum.

    Args:
        x: Draws of all parameters.
        mean: The minimum of F.
        cov: H⁻¹.
        wanted: Covariance of the elements, from the fit.
    """
    size = len(wanted)
    return mean[:size] + (x[:, :size] - mean[:size]) @ _stretch(cov, wanted).T


def _stretch(
    cov: Float[np.ndarray, "q q"], wanted: Float[np.ndarray, "element element"]
) -> Float[np.ndarray, "element element"]:
    size = len(wanted)
    return np.linalg.cholesky(wanted) @ np.linalg.inv(np.linalg.cholesky(cov[:size, :size]))


def inside(
    fit: Fit,
    mean: Float[np.ndarray, " q"],
    cov: Float[np.ndarray, "q q"],
    wanted: Float[np.ndarray, "element element"],
) -> tuple[Float[np.ndarray, " q"], Float[np.ndarray, "q q"]]:
    """Mean and covariance of all parameters, if the elements have those of a fit with bounds.

    Args:
        fit: The fit with bounds.
        mean: The minimum of F, without bounds.
        cov: H⁻¹.
        wanted: Covariance of the logarithms of the elements, from the fit.
    """
    size, back = len(wanted), np.linalg.inv(_stretch(cov, wanted))
    slope = cov[:, :size] @ np.linalg.inv(cov[:size, :size])
    moved = back @ (np.log(fit.circuit.values()) - mean[:size])
    less = cov[:size, :size] - back @ _determined(fit) @ back.T
    return mean + slope @ moved, cov - slope @ less @ slope.T


@in_float64
@one_thread()
def posterior(
    fit: Fit[Circuit], recording: Recording | None, driver: Driver | None, *, draws: int, seed: int
) -> Posterior[Circuit]:
    """`Fit.posterior`."""
    if draws < 1:
        raise ValueError(f"draws is {draws}; it must be at least 1, as in 1000")
    (load, least, own), known, cov = minimum_of(fit, recording, driver, "fit.posterior")
    if isinstance(load, Load) and load.gains.discrepancy is not None:
        raise ValueError(
            "the circuit of this fit leaves more than noise, and ± contain it; the unknown numbers "
            "of what it leaves are too many for draws. Use fit.profile or fit.intervals()"
        )
    if not np.isfinite(own).all():
        raise _undetermined(fit)
    impedances = Impedances.of_circuit(fit.circuit, least)
    at_least, (_, wanted) = impedances.moments(least, own), impedances.moments(least, cov)

    def elements(x: Float[np.ndarray, "draw q"]) -> Circuit:
        logs = impedances.logs(stretched(x, *at_least, wanted))
        return fit.circuit.with_values(np.exp(logs))

    def f(x: Float[np.ndarray, "draw q"]) -> Float[np.ndarray, " draw"]:
        q = impedances.logs(x)
        possible = np.isfinite(q).all(axis=1) & known.allows(elements(x))
        q[~possible] = least
        return np.where(possible, costs(load, q), np.inf)

    begin = impedances.moments(*inside(fit, least, own, cov)) if known.bounds else at_least
    x, weights = drawn(f, *begin, draws, np.random.default_rng(seed))
    if not np.isfinite(weights).all():
        raise _undetermined(fit)
    possible = weights > 0
    found = elements(x[possible])
    return Posterior(fit.circuit, np.asarray(fit.cov), found, weights[possible])


def minimum_of(
    fit: Fit, recording: Recording | None, driver: Driver | None, call: str
) -> tuple[Minimum, Known, Float[np.ndarray, "element element"]]:
    """The minimum of a fit, what is known besides, and the covariance of the log elements.

    Args:
        fit: The fit.
        recording: Its recording, if the fit does not know it.
        driver: Its driver, if there is a recording.
        call: What the user called, such as `fit.posterior`.

    Raises:
        ValueError: As in `Fit.posterior`.
    """
    require("fit", fit, Fit)
    measured = fit.measured if recording is None else None
    if measured is None:
        lane, known, cov = given(fit, recording, driver, call)
        return Minimum.of(lane, known, fit), known, cov
    told = Told.of(fit.method)
    of, own = solved(measured, fit.circuit, chain_of(measured), told), told.bounds
    cov = of.cov if own else _determined(fit)  # the draws begin with those without bounds
    feed = GivenDriver.measured(measured.frequency)
    known = Known(feed, ElementPrior.of(told.known, fit.circuit), own)
    return Minimum.of_spectrum(of), known, cov


def given(
    fit: Fit, recording: Recording | None, driver: Driver | None, call: str = "fit.posterior"
) -> tuple[Harmonics, Known, Float[np.ndarray, "element element"]]:
    """The harmonics of a fit, what is known besides, and the covariance of the log elements.

    Raises:
        ValueError: As in `Fit.posterior`.
    """
    require("fit", fit, Fit)
    recording, driver = fit.source_or_own(recording, driver)
    if recording is None:
        raise fit.without_source(call)
    recording, feed = fed(recording, driver)
    fit.refuse_batch()
    if fit.method.partition("(")[0] != MAXIMUM_LIKELIHOOD.name:
        raise ValueError(
            f"this fit was made by {fit.method}; identify the recording with "
            f"the method {MAXIMUM_LIKELIHOOD.name}"
        )
    cov = _determined(fit)
    seen = Inspected.of(recording)
    estimator = cast(MaximumLikelihood, named(fit.method))
    kind = cast(type[Harmonics], estimator.lane_of(seen))
    hums = bool(int(fit.remarks) & Remark.mains_hum)
    lane, known = as_fitted(seen, kind, fit.circuit, feed, hums)
    elements = ElementPrior.of(estimator.known_elements, fit.circuit)
    if estimator.bounds:  # the draws begin with those of the same fit without bounds
        unbounded = dataclasses.replace(estimator, bounds=())
        of = fits_of([lane], feed, known, fit.circuit, unbounded)
        cov = _determined(taken(of, 0))
    return lane, Known(known, elements, of_circuit(estimator.bounds, fit.circuit)), cov


def _determined(fit: Fit) -> Float[np.ndarray, "element element"]:
    """The covariance of the logarithms of the elements.

    Raises:
        ValueError: The recording does not determine all elements.
    """
    values = np.asarray(fit.circuit.values())
    cov = np.asarray(fit.cov) / np.outer(values, values)
    for name in fixed(fit.method) if fit.measured else ():
        cov[(place := fit.circuit.names().index(name)), place] = FIXED**2
    if not is_definite(cov):
        raise _undetermined(fit)
    return cov


def _undetermined(fit: Fit) -> ValueError:
    return ValueError(f"the recording does not determine all elements: {fit._overview().title}")


@in_float64
def budget(fit: Fit, recording: Recording | None, driver: Driver | None) -> Budget:
    """`Fit.budget`."""
    effects = fit.by_tolerance
    if effects is None or not np.isfinite(effects.moved).any():
        effects = _effects(fit, *fit.source_or_own(recording, driver))
    by_driver = np.isfinite(effects.moved).any()  # not by a measured current
    stated = dict(zip(BUDGETED, np.nan_to_num(np.asarray(effects.stated)).tolist(), strict=True))
    moved = zip(BUDGETED, np.asarray(effects.moved), strict=True)
    of = {name: part for name, part in moved if np.isfinite(part).all()}
    values = np.asarray(fit.circuit.values())
    cov, shared = (np.diagonal(np.asarray(of)) / values**2 for of in (fit.cov, fit.shared_cov))
    instrument = {name: part for name, part in of.items() if stated[name]}
    rest = shared - sum(part**2 for part in instrument.values())
    left = np.asarray(effects.discrepancy)
    return Budget(
        names=fit.circuit.names(),
        parts={
            "recording": np.sqrt(np.maximum(cov - shared - left**2, 0.0)),
            **({"circuit": left} if left.any() else {}),
            **({"driver": np.sqrt(np.maximum(rest, 0.0))} if by_driver else {}),
            **instrument,
        },
        tolerances=stated,
        unstated=effects.unstated,
    )


def _effects(fit: Fit, recording: Recording | None, driver: Driver | None) -> Effects:
    """The effects of errors of the instrument on a fit of a file, from its recording."""
    if fit.measured is not None:
        raise ValueError("a fit to a measured impedance has no budget: ± contain its noise alone")
    if fit.method == "joint":
        raise ValueError(
            "this joint fit has no budget: pass instrument=etid.Instrument() to identify_jointly, "
            "with the tolerances that you know; files of fits keep none"
        )
    if driver is not None and not isinstance(driver, HarmonicDriver):
        raise ValueError(
            "a budget needs the driver of the fit, with the harmonics of its calibrations; "
            "identify it by maximum likelihood, and pass it as in fit.budget(recording, driver)"
        )
    lane, known, _ = given(fit, recording, driver, "fit.budget")
    of = MEASURED_CURRENT if driver is None else driver, known.driver, fit.circuit
    found = taken(fits_of([lane], *of, named(fit.method)), 0)
    assert found.by_tolerance is not None
    return found.by_tolerance
