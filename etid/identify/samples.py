"""Identification of plain arrays, which JAX can transform."""

import dataclasses
from typing import Any, cast

import numpy as np
from jaxtyping import Array, Float

from etid.circuits.circuit import AbstractCircuit
from etid.estimators.estimator import AbstractEstimator
from etid.estimators.lanes import AbstractLane, Harmonics, constant
from etid.estimators.registry import MAXIMUM_LIKELIHOOD, Method
from etid.identify.arguments import require
from etid.identify.options import Options, candidates_of
from etid.precision import array_function, in_float64, namespace, unmasked, untraced
from etid.recordings.remarks import Remark
from etid.results.driver import Driver, HarmonicDriver
from etid.results.feed import AbstractFeed
from etid.results.fit import Fit
from etid.signals.harmonics import harmonics, same_unloaded, whole_periods
from etid.signals.noise import Measurement, floor, noise
from etid.signals.transfer import AnyArray


@in_float64
def identify_samples(
    v_th: Float[Array | np.ndarray, " time"],
    v_out: Float[Array | np.ndarray, " time"],
    driver: Driver,
    *,
    sample_rate: float,
    pulse_rate: float,
    resolution: float = 0.0,
    circuit: AbstractCircuit | str | None = None,
    method: Method | None = None,
) -> Fit:
    """`identify_skin` for plain arrays; `jax.grad`, `jax.jit` and `jax.vmap` can transform it.

    The elements are differentiable with respect to both records and to every number in `driver`,
    for example its resistors `driver.calibration.r_load`. The derivatives come from implicit
    differentiation of the minimum. They are as accurate as the minimum itself: a thousandth of a
    standard error. What is estimated before the fit is held: the noise of both records, and the
    choice of harmonics. There is no pre-flight, but there is a verdict.

    Args:
        v_th: Unloaded voltage [V].
        v_out: Loaded voltage [V].
        driver: Identified driver.
        sample_rate: Samples per second [Hz].
        pulse_rate: Pulses per second [Hz].
        resolution: Step of the converter [V] at the terminal; 0 if not known.
        circuit: As in `identify_skin`.
        method: As in `identify_driver`. The records are harmonics if they hold several whole
            periods. The function does not check that these begin between pulses.

    Returns:
        Elements, standard errors and verdict; arrays of NumPy unless JAX traces the call.

    Raises:
        ValueError: The method cannot use this driver or this circuit.
    """
    require("driver", driver, Driver)
    options = Options.of(candidates_of(circuit), method=method)
    estimator = cast(AbstractEstimator, options.estimator or MAXIMUM_LIKELIHOOD)
    estimator.check_driver(driver, sample_rate)
    lane, known = given(v_th, v_out, driver, estimator, sample_rate, pulse_rate, resolution)
    fit = estimator.fit_load(lane, driver, known, options.circuit)
    # No harmonic is left out here, so a remark about hum would be untrue.
    remarks = fit.remarks & ~int(Remark.mains_hum)
    return dataclasses.replace(fit, remarks=namespace(remarks).asarray(remarks))


@array_function
def given(
    v_th: Float[AnyArray, "*row time"],
    v_out: Float[AnyArray, "*row time"],
    driver: AbstractFeed,
    estimator: AbstractEstimator,
    sample_rate: float,
    pulse_rate: float,
    resolution: float,
) -> tuple[AbstractLane, Any]:
    """The lane of plain arrays, and what is known of the driver for it.

    Arrays of NumPy if JAX traces none of them. Whole periods are harmonics, other records bins.
    """
    # A mask would be lost.
    plain = tuple(map(unmasked, (v_th, v_out, resolution, sample_rate)))
    v_th, v_out, step, rate = untraced(plain)
    recorded, xp = v_th, namespace(v_th, v_out)
    v_th, v_out, step = (xp.asarray(value, float) for value in (v_th, v_out, step))
    periods = whole_periods(v_out.shape[-1], sample_rate, pulse_rate)
    # At harmonics the noise is measured, and its floor is needed only. White noise is a median: by
    # its derivative, few samples would have most of the weight.
    kind = estimator.lane_of_periods(periods[0])
    of = floor if issubclass(kind, Harmonics) else noise
    step = xp.broadcast_to(step, v_out.shape[:-1])
    of_th, of_out = (constant(xp.asarray(of(v, step))) for v in (v_th, v_out))
    rates = xp.broadcast_to(rate, v_out.shape[:-1])
    lane = kind.of_samples(Measurement(v_th, v_out, of_th, of_out, rates), periods)
    known = None
    if isinstance(lane, Harmonics):
        shared = kind.periodic and _may_share(recorded, driver, periods)
        first = lane.frequency.reshape(-1, lane.frequency.shape[-1])[0]
        known = estimator.known(*untraced((driver, first)), shared)
    return lane, known


def _may_share(recorded: AnyArray, driver: AbstractFeed, periods: tuple[int, int]) -> bool:
    """Whether an unloaded record may be that of a calibration; what JAX traces may be.

    Without one that they share, a program and its derivative are a fifth smaller.
    """
    if not isinstance(driver, HarmonicDriver):
        return False
    recorded, known = untraced((recorded, driver.spectra.x))
    if not isinstance(known, np.ndarray):
        return True
    x = harmonics(recorded.astype(float), *periods)[..., None, :]
    return bool(np.any(same_unloaded(x, known[:, : x.shape[-1]])))
