"""The distribution of the elements of one fit.

It evaluates the likelihood of `etid.estimators.maximum_likelihood.load` away from its minimum. The
standard errors of a fit are those at the minimum. At low signal-to-noise ratios the likelihood is
skewed, and its intervals are not symmetric.

**Draws.** The parameters q are the logarithms of the elements, the trigger delay, and the uncertain
part z of Z_th. F(q) = −log p has the curvature H at its minimum, and the first draws have the
covariance H⁻¹ (Laplace; `etid.solvers.importance_sampling`). Of 2000 such draws at 20 dB, less than
15 are effective in one fit of 20; further rounds mend this.

The prior is uniform in the logarithms, times the priors of the fit, and 0 outside its bounds. If a
recording does not exclude that an element is 0, as R_s at 20 dB, the tail of the posterior towards
0 never ends. The draws then cover the surroundings of the fit.

**Curvature.** The unknown true spectrum of V_th is eliminated from F. Below 40 dB F is therefore
too narrow: noise in the unloaded record counts as information (Neyman and Scott 1948). The
covariance of a fit corrects this. The draws of the elements are stretched around the minimum, so
that their curvature there is that covariance (Chandler and Bate 2007; Ribatet, Cooley and Davison
2012). At 20 dB this factor is 1.2 to 1.4, and without it 95 % intervals contain the truth in 85 %.
"""

import dataclasses
from typing import cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from etid.circuits.circuit import AbstractCircuit, Circuit
from etid.estimators.element_limits import Limits, of_circuit
from etid.estimators.element_prior import ElementPrior
from etid.estimators.lanes import Harmonics, HarmonicsWithCurrent
from etid.estimators.maximum_likelihood import load_fit
from etid.estimators.maximum_likelihood.estimator import MaximumLikelihood
from etid.estimators.maximum_likelihood.given_driver import GivenDriver
from etid.estimators.maximum_likelihood.load import Load
from etid.estimators.maximum_likelihood.profile import Records
from etid.estimators.maximum_likelihood.search import minimum as least
from etid.estimators.registry import MAXIMUM_LIKELIHOOD, named
from etid.identify.arguments import fed, require
from etid.identify.fitting import is_shared, known_of, skin
from etid.numpy_tier.tiers import program
from etid.precision import in_float64
from etid.recordings.preflight import Inspected
from etid.recordings.recording import Recording
from etid.recordings.remarks import Remark
from etid.results.driver import Driver, HarmonicDriver
from etid.results.fit import Fit
from etid.results.instrument import BUDGETED, ERRORS, NARROW, Budget, Instrument, by_tolerance
from etid.results.posterior import Posterior
from etid.solvers.importance_sampling import drawn
from etid.solvers.matrices import inverse

AT_ONCE = 16  # draws in one vectorised evaluation


class Known(eqx.Module):
    """What is known besides the recording.

    Attributes:
        driver: Distribution of Z_th, or the measured current.
        elements: Prior of the elements; None without one.
        bounds: Bounds of elements.
    """

    driver: GivenDriver
    elements: ElementPrior | None
    bounds: Limits = eqx.field(static=True, default=())


class Minimum(eqx.Module):
    """The likelihood of a recording, and its minimum.

    Attributes:
        terms: Residuals; half of the sum of their squares is F.
        q: The minimum.
        cov: H⁻¹.
    """

    terms: Load
    q: Float[Array, " q"]
    cov: Float[Array, "q q"]

    @classmethod
    def of(cls, lane: Harmonics, known: Known, circuit: AbstractCircuit) -> "Minimum":
        """The minimum near a fitted circuit."""
        terms = terms_of(lane, known, circuit)
        delays = jnp.zeros(terms.gains.outputs)
        start = jnp.concatenate([circuit.log_values(), delays, known.driver.mean])
        q, _ = least(terms, start)
        return cls(terms, q, inverse(jax.hessian(lambda q: cost(terms, q))(q)))


def terms_of(lane: Harmonics, known: Known, circuit: AbstractCircuit) -> Load:
    """The residuals of a recording."""
    rate, records = jnp.asarray(lane.sample_rate), Records.of(lane.spectrum)
    if isinstance(lane, HarmonicsWithCurrent) and not known.driver.by_current:
        records = Records.of(lane.spectrum, (jnp.asarray(lane.i), jnp.asarray(lane.variance_i)))
    return Load.behind(known.driver, circuit, records, rate, known.elements)


def cost(terms: Load, q: Float[Array, " q"]) -> Float[Array, ""]:
    """F(q)."""
    return 0.5 * jnp.sum(terms(q) ** 2)


@program
def minimum(
    lane: Harmonics, known: Known, circuit: AbstractCircuit
) -> tuple[Float[Array, " q"], Float[Array, "q q"]]:
    """The minimum of F, and H⁻¹."""
    least = Minimum.of(lane, known, circuit)
    return least.q, least.cov


@program
def _costs(
    lane: Harmonics, known: Known, circuit: AbstractCircuit, q: Float[Array, "draw q"]
) -> Float[Array, " draw"]:
    """F of each draw."""
    terms = terms_of(lane, known, circuit)
    return jax.lax.map(lambda at: cost(terms, at), q, batch_size=AT_ONCE)


def stretched(
    q: Float[np.ndarray, "draw q"],
    mean: Float[np.ndarray, " q"],
    cov: Float[np.ndarray, "q q"],
    wanted: Float[np.ndarray, "element element"],
) -> Float[np.ndarray, "draw element"]:
    """Logarithms of the elements, stretched around the minimum.

    Args:
        q: Draws.
        mean: The minimum of F.
        cov: H⁻¹.
        wanted: Covariance of the logarithms of the elements, from the fit.
    """
    size = len(wanted)
    return mean[:size] + (q[:, :size] - mean[:size]) @ _stretch(cov, wanted).T


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
        wanted: As in `stretched`.
    """
    size, back = len(wanted), np.linalg.inv(_stretch(cov, wanted))
    slope = cov[:, :size] @ np.linalg.inv(cov[:size, :size])
    moved = back @ (np.asarray(fit.circuit.log_values()) - mean[:size])
    less = cov[:size, :size] - back @ _determined(fit) @ back.T
    return mean + slope @ moved, cov - slope @ less @ slope.T


@in_float64
def posterior(
    fit: Fit[Circuit],
    recording: Recording | None,
    driver: Driver | None,
    *,
    draws: int,
    seed: int,
) -> Posterior[Circuit]:
    """`Fit.posterior`."""
    if draws < 1:
        raise ValueError(f"draws is {draws}; it must be at least 1, as in 1000")
    lane, known, cov = given(fit, recording, driver)
    least, own = map(np.asarray, minimum(lane, known, fit.circuit))
    if not np.isfinite(own).all():
        raise ValueError(f"the recording does not determine all elements of {fit}")

    names = fit.circuit.names()

    def costs(q: Float[np.ndarray, "draw q"]) -> Float[np.ndarray, " draw"]:
        found = np.array(_costs(lane, known, fit.circuit, jax.device_put(q)))
        elements = np.exp(stretched(q, least, own, cov))
        for name, low, high in known.bounds:
            value = elements[:, names.index(name)]
            found[(value < low) | (value > high)] = np.inf
        return found

    begin = inside(fit, least, own, cov) if known.bounds else (least, own)
    q, weights = drawn(costs, *begin, draws, np.random.default_rng(seed))
    if not np.isfinite(weights).all():
        raise ValueError(f"the recording does not determine all elements of {fit}")
    found = stretched(q, least, own, cov)
    circuit = type(fit.circuit)(**dict(zip(names, np.exp(found.T), strict=True)))
    return Posterior(fit.circuit, np.asarray(fit.cov), circuit, weights)


def given(
    fit: Fit, recording: Recording | None, driver: Driver | None
) -> tuple[Harmonics, Known, Float[np.ndarray, "element element"]]:
    """The harmonics of a fit, what is known besides, and the covariance of the log elements.

    Raises:
        ValueError: As in `Fit.posterior`.
    """
    require("fit", fit, Fit)
    recording, driver = fit.source_or_own(recording, driver)
    if recording is None and fit.measured is not None:
        raise ValueError("a fit to a measured impedance has no draws and no profiles")
    if recording is None:
        raise ValueError(
            "this fit does not know its recording and its driver; pass both, as in "
            "fit.posterior(recording, driver)"
        )
    recording, feed = fed(recording, driver)
    if np.ndim(fit.rrse):
        raise ValueError("this is a batch of fits; take one of them, as in fits[0]")
    if fit.method.partition("(")[0] != MAXIMUM_LIKELIHOOD.name:
        raise ValueError(
            f"this fit was made by {fit.method}; identify the recording with "
            f"method={MAXIMUM_LIKELIHOOD.name!r}"
        )
    cov = _determined(fit)
    seen = Inspected(recording)
    estimator = cast(MaximumLikelihood, named(fit.method))
    lane = (HarmonicsWithCurrent if estimator.with_current else Harmonics).of(seen)
    late = lane.late_by(fit.circuit, feed)  # as `etid.identify.fitting.refitted` does it
    seen.realign(*late)
    lane = lane.realigned(late)
    if int(fit.remarks) & Remark.mains_hum:
        lane = lane.without_mains() or lane
    known = known_of(lane, feed, is_shared(seen, feed), MAXIMUM_LIKELIHOOD)
    told = estimator.known_elements
    elements = ElementPrior.of(told, fit.circuit) if told else None
    if estimator.bounds:  # the draws begin with those of the same fit without bounds
        unbounded = dataclasses.replace(estimator, bounds=())
        of = jax.device_get(skin(lane, feed, known, fit.circuit, unbounded))
        cov = _determined(of)
    return lane, Known(known, elements, of_circuit(estimator.bounds, fit.circuit)), cov


def _determined(fit: Fit) -> Float[np.ndarray, "element element"]:
    """The covariance of the logarithms of the elements.

    Raises:
        ValueError: The recording does not determine all elements.
    """
    values = np.asarray(fit.circuit.values())
    cov = np.asarray(fit.cov) / np.outer(values, values)
    if not (np.isfinite(cov).all() and (np.linalg.eigvalsh(cov) > 0).all()):
        raise ValueError(f"the recording does not determine all elements of {fit}")
    return cov


@program
def _effects(
    lane: Harmonics, known: Known, circuit: AbstractCircuit, driver: HarmonicDriver
) -> Float[Array, "tolerance element"]:
    """Changes of the logarithms of the elements by `BUDGETED`, whose priors are standard normal.

    It is the column of z in H⁻¹ (`etid.estimators.sandwich`).
    """
    load = terms_of(lane, known, circuit)
    gains = load.gains
    start = [circuit.log_values(), jnp.zeros(gains.outputs), known.driver.mean]
    found = least(load, jnp.concatenate(start))[1]
    by_z = load_fit.covariance_of_priors(load, found)[gains.owned :, : gains.elements]
    assert driver.instrument is not None
    errors = len(by_z) - driver.instrument.deviations(driver.calibration.r_load.size).size
    later = by_z[errors - len(driver.cov) : errors]
    drift = jnp.sqrt(jnp.sum(later**2, axis=0))
    return jnp.concatenate([by_tolerance(by_z[errors:]), drift[None]])


@in_float64
def budget(fit: Fit, recording: Recording | None, driver: Driver | None) -> Budget:
    """`Fit.budget`."""
    recording, driver = fit.source_or_own(recording, driver)
    if not isinstance(driver, HarmonicDriver):
        raise ValueError(
            "a budget needs the driver of the fit, with the harmonics of its calibrations; "
            "identify it by maximum likelihood, and pass it as in fit.budget(recording, driver)"
        )
    told = driver.instrument or Instrument()
    stated = told.stored()
    if fit.by_tolerance is None and fit.method == "joint":
        raise ValueError(
            "this joint fit has no budget: pass instrument=etid.Instrument() to identify_jointly, "
            "with the tolerances that you know; files of fits keep none"
        )
    if fit.by_tolerance is None:
        driver = dataclasses.replace(driver, instrument=told.narrow())
        lane, known, _ = given(fit, recording, driver)
        of = dict(
            zip(BUDGETED, np.asarray(_effects(lane, known, fit.circuit, driver)), strict=True)
        )
    else:
        of = dict(zip(ERRORS, np.asarray(fit.by_tolerance), strict=True))
    values = np.asarray(fit.circuit.values())
    cov, shared = (np.diagonal(np.asarray(of)) / values**2 for of in (fit.cov, fit.shared_cov))
    instrument = {name: of[name] for name in stated if name in of}
    rest = shared - sum(part**2 for part in instrument.values())
    return Budget(
        names=fit.circuit.names(),
        parts={
            "recording": np.sqrt(cov - shared),
            "driver": np.sqrt(np.maximum(rest, 0.0)),
            **instrument,
        },
        tolerances=stated,
        unstated={name: part / NARROW for name, part in of.items() if name not in stated},
    )
