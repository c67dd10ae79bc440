"""The residual of a fit: in time, relative to its noise by frequency, and by lag."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from etid.circuits.circuit import AbstractCircuit
from etid.estimators.element_prior import FIXED, ElementPrior
from etid.estimators.estimator import serving
from etid.estimators.lanes import Harmonics
from etid.estimators.maximum_likelihood.rows import calibrated, loads_of, source_of
from etid.estimators.registry import MAXIMUM_LIKELIHOOD
from etid.identify.arguments import fed, require
from etid.identify.fitting import as_fitted
from etid.identify.predict import predict
from etid.likelihood.search import minimum
from etid.precision import array_function, in_float64, one_thread
from etid.recordings.preflight import Inspected
from etid.recordings.recording import Recording
from etid.recordings.remarks import Remark
from etid.recordings.repeats import ALIASES, repeats
from etid.results.driver import ContinuousDriver, Driver
from etid.results.feed import AbstractFeed, MeasuredCurrent
from etid.results.fit import Fit
from etid.results.residual import ByPeriod, Correlation, Residual, lags


class Whitened(NamedTuple):
    """The residual of a recording with a given load, at the frequencies that a fit uses.

    Attributes:
        frequency: These frequencies [Hz].
        of: The residual of V_out, predicted − measured, relative to its noise.
        x: Estimate of the input there.
    """

    frequency: Float[np.ndarray, " frequency"]
    of: Complex[np.ndarray, " frequency"]
    x: Complex[np.ndarray, " frequency"]


@one_thread()
@array_function
def whitened(
    recording: Recording, feed: AbstractFeed, circuit: AbstractCircuit, *, hums: bool = False
) -> Whitened:
    """The residual with a load whose elements are held; Z_th and delays are fitted.

    Args:
        recording: The recording.
        feed: Its driver, or the measured current.
        circuit: The load.
        hums: Whether the harmonics of the mains are left out.
    """
    if not isinstance(feed, MeasuredCurrent):
        feed = serving(feed, ContinuousDriver, MAXIMUM_LIKELIHOOD.name)
    seen = Inspected.of(recording)
    kind = MAXIMUM_LIKELIHOOD.lane_of(seen)
    assert issubclass(kind, Harmonics)
    lane, known = as_fitted(seen, kind, circuit, feed, hums)
    values = np.asarray(circuit.values())
    held = ElementPrior(values, np.full(values.size, FIXED))
    load = loads_of([lane], source_of(known), circuit, held, calibrated(known))
    rest = np.zeros(load.gains.exact - load.gains.elements)
    start = np.concatenate([np.log(values), rest, load.gains.source.mean])
    profile = minimum(load, start[None, None]).near.profile
    used, at = np.asarray(lane.selected), np.asarray(lane.frequency)
    of = -(profile.innovations / np.sqrt(profile.expected))[0, 0, used]
    return Whitened(at[used], of, profile.x[0, used])


def _by_period(recording: Recording) -> ByPeriod | None:
    """How far each period of a recording is from their mean."""
    (of,) = repeats([Inspected.of(recording)])
    if of is None:
        return None
    plain = of.frequency < ALIASES * of.sample_rate  # above, aliases of edges differ, too
    alone = 2 * of.variance * (1 - 1 / len(of.gain))
    squares = (np.abs(of.gain) ** 2 / alone)[:, plain].mean(1)
    return ByPeriod(np.sqrt(squares), 2 * int(np.count_nonzero(plain)))


@in_float64
def residual(fit: Fit, recording: Recording | None, driver: Driver | None) -> Residual:
    """`Fit.residual`."""
    require("fit", fit, Fit)
    fit.refuse_batch()
    if not np.isfinite(np.asarray(fit.circuit.values())).all():
        raise ValueError(
            f"this fit has no elements, so that nothing is predicted: {fit._overview().title}"
        )
    recording, driver = fit.source_or_own(recording, driver)
    name = f"{type(fit.circuit).__name__} ({fit.verdict})"
    if recording is None and fit.measured is not None:
        return _of_impedance(fit, name)
    if recording is None:
        raise fit.without_source("fit.residual")
    own, feed = fed(recording, driver)
    found = whitened(own, feed, fit.circuit, hums=bool(int(fit.remarks) & Remark.mains_hum))
    in_time = np.full(own.v_out.size, np.nan)
    if own.cause != "current" or own.filters is None:  # else nothing is predicted in time
        in_time = np.asarray(predict(recording, driver, fit.circuit)) - own.v_out
    step = 1 / (2 * found.frequency[-1])  # such lags are about independent
    later = step * np.arange(1, lags(found.frequency.size) + 1)
    return Residual(
        title=f"{name} at {own.path!r}" if own.path else name,
        time=np.asarray(own.time),
        in_time=in_time,
        frequency=found.frequency,
        whitened=found.of,
        own=Correlation.of_power(np.abs(found.of) ** 2, found.frequency, later),
        with_input=Correlation.with_input(
            found.of, found.x, found.frequency, np.concatenate([-later[::-1], [0.0], later])
        ),
        by_period=_by_period(own),
    )


@np.errstate(invalid="ignore")  # that of an exact resistor is 0
def _of_impedance(fit: Fit, name: str) -> Residual:
    """The residual of a measured impedance."""
    of = fit.measured
    assert of is not None
    rising = np.argsort(of.frequency, kind="stable")
    frequency, z = of.frequency[rising], of.z[rising]
    missed = np.asarray(fit.circuit.response(frequency)) - z
    if of.stderr is None:  # the noise is taken to be a part of |Z|
        missed = missed / np.abs(z)
        noise = np.sqrt(np.mean(np.abs(missed) ** 2))
    else:  # of the real and of the imaginary part
        noise = np.sqrt(2) * np.broadcast_to(of.stderr, z.shape)[rising]
    whitened = missed / noise
    return Residual(
        title=f"{name} at an impedance",
        time=np.zeros(0),
        in_time=np.zeros(0),
        frequency=frequency,
        whitened=whitened,
        own=Correlation.of_neighbours(whitened),
        with_input=None,
        by_period=None,
    )
