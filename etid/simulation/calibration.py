"""What a calibration is worth, while the resistor is still connected.

The driver is identified from the calibrations. The standard errors to expect of skin behind it are
the Cramer-Rao bound of its fit, for the same pulses and the same noise. Unlike `etid.bound`, which
holds for every driver, this bound knows what the fit knows: a Z_th with as many poles, and the
tolerances of the instrument. No random number is drawn. A further resistor or further periods
therefore never make an expected error larger.
"""

import dataclasses
import math
import os
from collections.abc import Mapping, Sequence

import jax
import numpy as np
import scipy
from jaxtyping import Float

from etid.circuits.circuit import AbstractCircuit, SkinRC
from etid.estimators.lanes import Harmonics
from etid.estimators.maximum_likelihood import given_driver
from etid.estimators.maximum_likelihood.rows import loads_of, source_of
from etid.identify.arguments import check_new
from etid.identify.driver import identify_driver, with_harmonics
from etid.identify.skins import identify_skin
from etid.likelihood.calibrations import Calibrations
from etid.likelihood.linear import diagonal, inverse
from etid.likelihood.load import Near
from etid.likelihood.source_prior import delay_std
from etid.precision import array_function, in_float64, one_thread
from etid.printing import Overview, Overviewed, per_cent, rounded, several
from etid.recordings.hdf5 import read_calibrations
from etid.recordings.preflight import Inspected
from etid.recordings.recording import Recording
from etid.results.driver import Calibration, ContinuousDriver, Driver, HarmonicDriver, Order
from etid.signals.harmonics import signal_share
from etid.signals.transfer import as_complex
from etid.simulation.published import TYPICAL
from etid.solvers.matrices import inverse_root

SKINS = {name: SkinRC(**dataclasses.asdict(skin)) for name, skin in TYPICAL.items()}
DECADE = np.array([1.0, 2.2, 4.7])  # resistors that a laboratory has
LONGER = 4.0  # times as many periods
NOW, MORE = "as now", f"{LONGER:g} times as many periods"  # what is recorded
BAND = np.geomspace(300.0, 60e3, 24)  # [Hz] where drivers are compared
MOVED = 4.0  # standard errors; two good calibrations differ by more once in 2 000 pairs
GOAL = 0.01  # standard error of an element for which the number of periods is told
MOST = 1e4  # times as many periods


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class CheckedCalibration(Overviewed):
    """A driver, the errors to expect with it, and what it has become since a former day.

    Attributes:
        driver: The driver.
        noise: Standard deviation of the noise of V_out in each of its recordings [V].
        expected: Relative standard errors of the elements, by skin and by what is recorded; empty
            if the calibrations hold no whole pulse period.
        times: Times as many periods of calibrations and skin that make the least known element
            known to `GOAL`; infinite if it takes more than `MOST`, NaN if it is known now.
        moved: Largest difference of |Z_th| from that of the former driver [standard errors]; NaN
            without one.
        shifts: Relative change of the elements of skin if they are identified with the former
            driver; empty without one.
        r_load: Resistor of the first calibration that would explain the difference [ohm]; None if
            none does.
    """

    driver: Driver
    noise: Sequence[float]
    expected: Mapping[str, Mapping[str, Mapping[str, float]]]
    moved: float = float("nan")
    shifts: Mapping[str, Mapping[str, float]] = dataclasses.field(default_factory=dict)
    r_load: float | None = None
    times: float = float("nan")

    def _overview(self) -> Overview:
        records = [
            (one.path, f"{(one.r_load or 0.0) / 1e3:g} kΩ", f"{rounded(1e3 * noise)} mV")
            for one, noise in zip(self.driver.recordings, self.noise, strict=True)
        ]
        heads = ("calibration", "resistor", "noise of V_out")
        rows = [
            (skin, what, *(per_cent(error) for error in errors.values()))
            for skin, by in self.expected.items()
            for what, errors in by.items()
        ]
        notes, known = self._since(), several(len(records), "calibration") + ":"
        if not rows:
            then = (Overview(known, records, heads, notes=notes),)
            return dataclasses.replace(self.driver._overview(), then=then)
        errors = Overview(
            "standard errors to expect of typical skin:",
            rows,
            ("skin", "recorded", *SkinRC().names()),
            notes=[*self._what_helps(), *notes],
        )
        then = Overview(known, records, heads), errors
        return dataclasses.replace(self.driver._overview(), then=then)

    def _least_known(self) -> tuple[float, str, str]:
        """The largest error as it is recorded now, its skin and its element."""
        return max(
            (error, skin, name)
            for skin, by in self.expected.items()
            for name, error in by[NOW].items()
        )

    def _what_helps(self) -> list[str]:
        """What makes the largest error smaller, and how many periods make it 1 %."""
        error, skin, name = self._least_known()
        then, what = min(
            (errors[name], what) for what, errors in self.expected[skin].items() if what != NOW
        )
        now, then = (f"± {per_cent(of)}" for of in (error, then))
        notes = [f"least known is {name} of {skin} skin, {now}; what helps most: {what}, {then}"]
        if self.times <= MOST:
            notes += [f"1 % takes {np.ceil(self.times):.0f} times as many periods"]
        elif np.isinf(self.times):
            notes += [f"not even {MOST:g} times as many periods make it 1 %"]
        return notes

    def _since(self) -> list[str]:
        if not np.isfinite(self.moved):
            return []
        moved = f"|Z_th| differs from the former driver by {self.moved:.1f} standard errors"
        if self.moved <= MOVED:
            return [moved]
        told = f"{(self.driver.recordings[0].r_load or 0.0) / 1e3:.4g} kΩ"
        if self.r_load is None:
            cause = f"no other resistor explains it: were {told} connected, and this driver?"
        else:
            cause = f"a resistor of {self.r_load / 1e3:.4g} kΩ in place of {told} would explain it"
        return [
            f"Warning: {moved}",
            cause,
            *(
                f"with the former driver, {skin} skin would be wrong by "
                + ", ".join(f"{name} {100 * shift:+.2g} %" for name, shift in by.items())
                for skin, by in self.shifts.items()
            ),
        ]


@in_float64
def calibrate(
    calibrations: Recording | Sequence[Recording],
    *,
    order: Order = 5,
    former: Driver | None = None,
) -> CheckedCalibration:
    """Identify a driver, and say what it is worth and whether it has changed.

    Args:
        calibrations: Recordings with known resistors.
        order: Number of poles of Z_th, or `"auto"`.
        former: The driver of a former day.

    Returns:
        The driver with the standard errors of dry and damp skin to expect: as it is recorded now,
        with `LONGER` times as many periods of calibrations and skin, and with a further resistor
        near |Z_th|.

    Raises:
        IdentificationError: The calibrations give no driver; the message names cause and remedy.
    """
    records = [calibrations] if isinstance(calibrations, Recording) else list(calibrations)
    driver = identify_driver(records, order=order)
    noise = [float(Inspected.of(one).sigma[1]) for one in records]
    r = _further(driver, [one.r_load or 0.0 for one in records])
    known = CheckedCalibration(driver, noise, {})
    if all(Inspected.of(one).whole_periods[0] for one in records):
        assert isinstance(driver, ContinuousDriver)  # as the default methods make it
        feed = driver if isinstance(driver, HarmonicDriver) else with_harmonics(driver, records)
        ways = {NOW: (None, 1.0), MORE: (None, LONGER), f"also with {r / 1e3:g} kΩ": (r, 1.0)}
        expected = {
            name: {what: expected_errors(feed, skin, *way) for what, way in ways.items()}
            for name, skin in SKINS.items()
        }
        known = dataclasses.replace(known, expected=expected)
        known = dataclasses.replace(known, times=_times(feed, *known._least_known()))
    if former is None:
        return known
    trials = {name: imitated(records[0], driver, skin) for name, skin in SKINS.items()}
    shifts = {name: _shift(trial, driver, former) for name, trial in trials.items()}
    return _compared(dataclasses.replace(known, shifts=shifts), former)


@in_float64
def expected_errors(
    driver: HarmonicDriver,
    circuit: AbstractCircuit,
    further: float | None = None,
    periods: float = 1.0,
) -> dict[str, float]:
    """The standard errors to expect of a load behind a driver.

    Args:
        driver: The driver; the load is recorded with the pulses and the noise of its first
            calibration, and has an unloaded record of its own.
        circuit: The load, with its elements.
        further: Resistor of one more calibration, which has an unloaded record of its own [ohm].
        periods: Times as many periods of all calibrations and of the load.

    Returns:
        Relative standard errors of the elements, by name.
    """
    errors = _bound(driver, np.array([] if further is None else [further]), periods, circuit)
    return dict(zip(circuit.names(), errors.tolist(), strict=True))


@one_thread()
@array_function
def _bound(
    driver: HarmonicDriver,
    further: Float[np.ndarray, " resistor"],
    periods: float,
    circuit: AbstractCircuit,
) -> Float[np.ndarray, " element"]:
    """Bound of the standard errors of the logarithms of the elements: H⁻¹ without any noise."""
    now = jax.tree.map(np.asarray, Calibrations.of(driver))
    model = _as_recorded(now, further, periods)
    common = model.start()
    linear = model.linear(model.near(common))
    # The width of the prior of Z_th is that of the known resistors as they are now.
    source, (_, weak) = slice(driver.cov.shape[0]), now.weak(now.start())
    prior = np.array(linear.precision)
    prior[source, source] = (weak @ weak.T)[source, source]
    information = linear.told(linear.jacobian) + prior
    later = np.diag(np.asarray(driver.drift_std()))
    later = np.pad(later, ((0, common.size - len(later)), (0, 0)))
    directions = np.concatenate([inverse_root(information), later], axis=1)
    first, count = jax.tree.map(lambda leaf: leaf[0], model.spectra), directions.shape[1]
    known = np.zeros(count), np.eye(count)
    given = given_driver.around(model, common, directions, first.frequency, False, *known)
    fields = first.x, first.y, first.variance_x, first.variance_y, first.selected
    lane = Harmonics(first.frequency, *fields, model.rate)
    load = loads_of([lane], source_of(given), circuit, None, None)
    unknown = np.zeros(load.gains.outputs.count + count)  # the delay and z
    q = np.concatenate([circuit.log_values(), unknown])[None]
    y = load.gains(q) * load.records.x[:, None]
    load = dataclasses.replace(load, records=load.records._replace(y=y))
    near = Near.of(load, load.gains.at(load.knots.index), q)
    share = signal_share(near.profile.x, load.records.variance_x)[:, None, None]
    share = near.condensed.means([near.profile], load.knots, share)
    expected = (near.jacobian * share) @ near.jacobian.swapaxes(-1, -2)
    variance = diagonal(inverse(expected + np.diag(1 / load.width**2)))[0]
    return np.sqrt(variance[: load.gains.elements])


def _as_recorded(
    model: Calibrations, further: Float[np.ndarray, " resistor"], periods: float
) -> Calibrations:
    """Calibrations without noise in V_out, with further ones and times as many periods."""
    of, spectra = model.calibration, model.spectra
    more = jax.tree.map(lambda leaf: np.repeat(leaf[:1], further.size, axis=0), spectra)
    # Another unloaded record with the same power, on which alone the information depends.
    more = dataclasses.replace(more, x=as_complex(np.abs(more.x)))
    spectra = jax.tree.map(lambda *both: np.concatenate(both), spectra, more)
    variances = spectra.variance_x / periods, spectra.variance_y / periods
    spectra = dataclasses.replace(spectra, variance_x=variances[0], variance_y=variances[1])
    r_load = np.concatenate([of.r_load, further])
    delays = np.concatenate([of.delay_samples, np.zeros_like(further)])
    of = Calibration(r_load, delays, delay_std(r_load))
    model = dataclasses.replace(model, calibration=of, spectra=spectra)
    y = model.gains(model.start()) * spectra.x
    return dataclasses.replace(model, spectra=dataclasses.replace(spectra, y=y))


def _times(driver: HarmonicDriver, now: float, skin: str, name: str) -> float:
    """`CheckedCalibration.times`, to half a per cent."""

    def excess(log: float) -> float:
        return expected_errors(driver, SKINS[skin], periods=math.exp(log))[name] - GOAL

    if now <= GOAL:
        return float("nan")
    if excess(math.log(MOST)) > 0:
        return float("inf")
    return math.exp(float(scipy.optimize.brentq(excess, 0.0, math.log(MOST), xtol=5e-3)))


def read_driver(path: str | os.PathLike[str], *, order: Order = 5) -> Driver:
    """Identify the driver of the calibrations in a file, as `Driver.write` writes it.

    Args:
        path: File of recordings; only its calibrations are used.
        order: Number of poles of Z_th, or `"auto"`.

    Raises:
        RecordingError: The file cannot be read, or has calibrations of no driver or of several.
        IdentificationError: The calibrations give no driver.
    """
    return identify_driver(calibrations_in([path]), order=order)


def calibrations_in(paths: Sequence[str | os.PathLike[str]]) -> list[Recording]:
    """The recordings with known resistors of some files.

    Raises:
        RecordingError: A file cannot be read, or has such recordings of no driver or of several, or
            two recordings have the same samples.
    """
    records: list[Recording] = []
    first: dict[bytes, str] = {}
    for path in paths:
        with read_calibrations(path) as study:
            for one in study.recordings():
                check_new(f"{os.fspath(path)}:{one.path}", one, first)
                records.append(one)
    return records


def imitated(recording: Recording, driver: Driver, skin: SkinRC) -> Recording:
    """The recording as it would be with skin: whole periods, with noise of its own."""
    seen = Inspected.of(recording)
    _, size = seen.whole_periods
    f = jax.device_put(np.fft.rfftfreq(size, 1 / recording.sample_rate)[1:])
    z, z_th = np.asarray(skin.response(f)), np.asarray(driver.response(f))
    spectrum = np.fft.rfft(recording.v_th[:size])
    spectrum[1:] *= z / (z + z_th)
    noise = np.random.default_rng(0).standard_normal(size) * float(seen.sigma[1])
    return recording.replace(
        v_th=recording.v_th[:size],
        v_out=np.fft.irfft(spectrum, size) + noise,
        r_load=None,
        path="imitated",
        adc_range=None,
        instrument=None,
    )


def _shift(recording: Recording, driver: Driver, other: Driver) -> dict[str, float]:
    """Relative change of the elements by another driver; both fits have the same noise."""
    now, then = (identify_skin(recording, of, throw=False).circuit for of in (driver, other))
    ratio = np.asarray(then.values()) / np.asarray(now.values())
    return dict(zip(now.names(), (ratio - 1).tolist(), strict=True))


def _further(driver: Driver, known: Sequence[float]) -> float:
    """A further resistor [ohm] near |Z_th|, which shows most; ten times that if it is known."""
    z_th = float(np.abs(np.asarray(driver.response(jax.device_put(np.array([1e3])))))[0])
    near = np.outer(10.0 ** np.arange(0, 8), DECADE).ravel()
    r = float(near[np.argmin(np.abs(np.log(near / z_th)))])
    return 10 * r if any(0.5 < r / one < 2 for one in known) else r


def _compared(of: CheckedCalibration, former: Driver) -> CheckedCalibration:
    """How far |Z_th| is from that of a former driver, and which resistor would explain it."""
    f, drivers = jax.device_put(BAND), (of.driver, former)
    z, old = (np.asarray(one.response(f)) for one in drivers)
    # Of ln |Z_th| and of the phase, which a wrong resistor leaves as it is.
    spread = np.hypot(*(np.asarray(one.log_response_stderr(f)) for one in drivers))
    change = np.stack([np.log(np.abs(z / old)), np.angle(z / old)])
    ratio = float(np.average(change[0], weights=1 / spread[0] ** 2))
    explains = bool(np.max(np.abs(change - [[ratio], [0.0]]) / spread) < MOVED)
    r_load = of.driver.recordings[0].r_load or float("nan")
    return dataclasses.replace(
        of,
        moved=float(np.max(np.abs(change[0]) / spread[0])),
        r_load=r_load / np.exp(ratio) if explains else None,
    )
