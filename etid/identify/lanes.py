"""What of a recording is fitted, and the functions that are compiled for it.

A lane is a tuple of arrays: the harmonics of a recording, or its samples. The same functions serve
one recording and a batch.
"""

import dataclasses
import math
import zlib
from collections.abc import Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from etid.circuits.circuit import AbstractCircuit
from etid.estimators import baseline, refinement
from etid.estimators.judgement import MISFIT_CHI2
from etid.estimators.maximum_likelihood import given_driver
from etid.estimators.maximum_likelihood.given_driver import GivenDriver
from etid.estimators.registry import CONTINUOUS, HARMONIC, Method, iterations, serving
from etid.estimators.score_tests.unloaded import UnloadedShape, shape_of
from etid.identify.compiled import stored_jit
from etid.recordings.preflight import Inspected
from etid.recordings.remarks import Remark
from etid.results.driver import ContinuousDriver, Driver, HarmonicDriver
from etid.results.fits import Fit
from etid.results.verdicts import message, verdict
from etid.signals import mains, rounding
from etid.signals.alignment import rest, shifted
from etid.signals.harmonics import ALIASED, Spectrum, spectrum
from etid.signals.measurement import Measurement, measure, trusted

LEFT = 0.75  # samples that are worth another fit; the delay that a fit allows for is 0.5
_Outcome = TypeVar("_Outcome", Fit, Driver)
# All that is the same for the loads of one driver: for maximum likelihood, for others on harmonics.
Known = GivenDriver | UnloadedShape | None
STEPS = 4  # lengths in an octave: the longest filling is a fifth


def arrays(seen: Inspected) -> tuple[np.ndarray, ...]:
    """Both voltages, aligned, both resolutions, and the sample rate."""
    steps = np.asarray(seen.step_th), np.asarray(seen.step_out)
    return *seen.aligned, *steps, np.asarray(seen.recording.sample_rate)


def lane(seen: Inspected, method: Method) -> tuple[np.ndarray, ...]:
    """What is fitted of a recording: its harmonics and their noise, or its samples.

    Without JAX, which would compile for every length of a record: there are as many harmonics for
    all lengths, and samples are filled up to one of few lengths.
    """
    rate = np.asarray(seen.recording.sample_rate)
    sigma_th = np.asarray(trusted(seen.v_th, seen.sigma_th))
    sigma_out = np.asarray(trusted(seen.v_out, seen.sigma_out))
    if method in HARMONIC:
        fields = spectrum(seen.v_th, seen.v_out, sigma_th, sigma_out, rate, *seen.periods)
        frequency, x, y, variance_x, variance_y, selected = map(np.asarray, fields)
        for v, step, variance in (
            (seen.recorded_th, seen.coarse_th, variance_x),
            (seen.recorded_out, seen.coarse_out, variance_y),
        ):
            if step > 0:
                rounded = rounding.variance(v, step, *seen.periods)
                variance[: rounded.size] = rounded
        selected = selected & ~seen.covered(frequency)
        one = frequency, x, y, variance_x, variance_y, selected, rate
    elif method == "output_error":
        size = seen.v_th.size
        room = math.ceil(2 ** (math.ceil(STEPS * math.log2(size)) / STEPS)) - size
        filled = (np.pad(v, (0, room)) for v in (seen.v_th, seen.v_out))
        one = *filled, sigma_th, sigma_out, rate, np.asarray(size)
    else:
        return arrays(seen)
    return realigned(one, method, seen.lag)


def realigned(lane: tuple[np.ndarray, ...], method: Method, late: int) -> tuple[np.ndarray, ...]:
    """The same, of harmonics or for output error, with a `v_out` that is earlier by whole samples.

    Periodic voltages are turned at each harmonic, e^(jω late / fs); of others the ends that no
    longer overlap are left out.
    """
    if late == 0:
        return lane
    if method in HARMONIC:
        frequency, x, y, *others, rate = lane
        return frequency, x, y * np.exp(2j * np.pi * late / rate * frequency), *others, rate
    v_th, v_out, *others, size = lane
    records = shifted(v_th[: int(size)], v_out[: int(size)], late)
    room = (0, v_th.size - records[0].size)
    filled = (np.pad(v, room) for v in records)
    return *filled, *others, np.asarray(records[0].size)


def late_by(lane: tuple[np.ndarray, ...], method: Method, fit: Fit, driver: Driver) -> int:
    """Whole samples by which a lane is later than what was fitted to it, if that is a misfit.

    A fit that is a sample or more away from the alignment finds the elements, but calls it a
    misfit: edges that the load smoothes let its record look later than it is.
    """
    known = method in HARMONIC or method == "output_error"
    if fit.verdict != "misfit" or not known or not isinstance(driver, ContinuousDriver):
        return 0
    if method in HARMONIC:
        frequency, x, y, variance_x, variance_y, selected, rate = lane
    else:
        v_th, v_out, _, _, rate, _ = lane
        frequency = np.fft.rfftfreq(v_th.size, 1 / rate)[1:]
        x, y = np.fft.rfft(v_th)[1:], np.fft.rfft(v_out)[1:]
        # Edges, as if both had been differentiated.
        variance_x = variance_y = frequency**-2.0
        selected = frequency < ALIASED * rate
    at = jnp.asarray(frequency)
    z = np.asarray(fit.circuit.response(at))
    gain = z / (z + np.asarray(driver.source.response(at)))
    weight = selected / (variance_y + np.abs(gain) ** 2 * variance_x)
    late = rest(gain * x, y, weight, 2 * np.pi * frequency / rate)
    return round(late) if abs(late) > LEFT else 0


def without_mains(lane: tuple[np.ndarray, ...], method: Method) -> tuple[np.ndarray, ...] | None:
    """The same without the harmonics on which mains hum may fall; None if there is none."""
    if method not in HARMONIC:
        return None
    *fields, selected, rate = lane
    suspect = mains.lines(fields[0])
    return (*fields, selected & ~suspect, rate) if (selected & suspect).any() else None


def needs_another(fit: Fit | Driver) -> bool:
    """Whether hum is seen in a fit, or it misses the recording, be it for hum or not."""
    return bool(int(fit.remarks) & Remark.mains_hum) or not fit.chi2 < MISFIT_CHI2


def of_both(first: _Outcome, second: _Outcome) -> _Outcome:
    """A fit, or the `second` without the mains harmonics, if it is good and they show hum."""
    if second.verdict == "successful" and int(second.remarks) & Remark.mains_hum:
        return second
    return dataclasses.replace(first, remarks=np.zeros((), int))


def remarked(fit: Fit, remarks: int) -> Fit:
    """The fit with these remarks; what a coarse converter leaves open is `resolution`."""
    if remarks & Remark.coarse_converter and fit.verdict == "insensitive":
        fit = dataclasses.replace(fit, result=verdict("resolution"))
    return dataclasses.replace(fit, remarks=np.asarray(remarks))


def stacked(lanes: Sequence[tuple[np.ndarray, ...]]) -> tuple[Array, ...]:
    """Lanes of equal shapes along a leading axis."""
    return tuple(jnp.asarray(np.stack(column)) for column in zip(*lanes, strict=True))


def checksum(seen: Inspected) -> int:
    """What tells an unloaded record from others."""
    return zlib.crc32(seen.v_th.tobytes())


def is_shared(seen: Inspected, driver: Driver) -> bool:
    """Whether the unloaded record of a recording may be that of a calibration."""
    known = driver.unloaded if isinstance(driver, HarmonicDriver) else None
    return known is None or checksum(seen) in known


@stored_jit
def driver_of(
    samples: Any,
    r_load: Float[Array, " record"],
    order: int,
    method: Method,
    spectra: Spectrum | None,
) -> Driver:
    """Identify a driver; `spectra` are the harmonics of its calibrations, if they are needed."""
    m = jax.vmap(measure)(*samples)
    if method in CONTINUOUS:
        return refinement.driver_by_refinement(m, r_load, order, spectra)
    return baseline.driver_by_steiglitz_mcbride(m, r_load, order, iterations(method))


@stored_jit
def unloaded(driver: Driver, frequency: Float[Array, " harmonic"]) -> UnloadedShape | None:
    """The unloaded voltage that loads of a driver must have, for other methods on harmonics."""
    return shape_of(driver, frequency)


@stored_jit
def given(
    driver: HarmonicDriver, frequency: Float[Array, " harmonic"], shared: bool
) -> GivenDriver:
    """What all loads of a driver need to know of it for maximum likelihood."""
    return given_driver.given(driver, frequency, shared)


def known_driver(
    lane: tuple[np.ndarray, ...], driver: Driver, method: Method, shared: bool
) -> Known:
    """What the method needs to know of a driver, for this lane and all with harmonics like it."""
    if method not in HARMONIC:
        return None
    frequency = jnp.asarray(lane[0])
    if method == "maximum_likelihood":
        return given(serving(driver, HarmonicDriver, method), frequency, shared)
    return unloaded(driver, frequency)


def skin_lane(
    lane: Any,
    driver: Driver,
    known: Known,
    circuit: AbstractCircuit,
    method: Method,
) -> Fit:
    """Identify one lane; differentiable code, to be jitted and batched by the caller."""
    if method == "output_error":
        *fields, samples = lane
        continuous = serving(driver, ContinuousDriver, method)
        return refinement.skin_by_output_error(Measurement(*fields), samples, continuous, circuit)
    if method not in HARMONIC:
        m = measure(*lane)
        return baseline.skin_by_steiglitz_mcbride(m, driver, iterations(method))
    *fields, rate = lane
    spectrum = Spectrum(*fields)
    if isinstance(known, GivenDriver):
        return refinement.skin_by_maximum_likelihood(spectrum, rate, driver, known, circuit)
    if method == "harmonic_steiglitz_mcbride":
        continuous = serving(driver, ContinuousDriver, method)
        return baseline.skin_by_harmonic_steiglitz_mcbride(spectrum, rate, continuous, known)
    harmonic = serving(driver, HarmonicDriver, method)
    return refinement.skin_by_non_parametric(spectrum, rate, harmonic, known, circuit)


skin = stored_jit(skin_lane)


def explained(seen: Inspected, name: str) -> str:
    """What a verdict of `etid.recordings.preflight` means, with the numbers that were found."""
    found = seen.train.mismatch if name == "rate_mismatch" else ""
    return f"{found} {message(name)}".strip()
