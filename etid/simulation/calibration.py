"""What a calibration is worth, while the resistor is still connected.

The driver is identified from the calibrations. Recordings of skin behind it, as they would be made
with the same pulses and the same noise, are imitated and fitted: their standard errors are those to
expect. The same is done with a further known resistor, to see whether it would help.
"""

import dataclasses
import os
from collections.abc import Mapping, Sequence

import jax
import numpy as np

from etid.circuits.circuit import Resistor, SkinRC
from etid.circuits.display import per_cent, rounded, several
from etid.circuits.overview import Overview, Overviewed
from etid.identify.arguments import check_new
from etid.identify.driver import identify_driver
from etid.identify.skins import identify_skin
from etid.precision import in_float64
from etid.recordings.hdf5 import read_calibrations
from etid.recordings.preflight import Inspected
from etid.recordings.recording import Recording
from etid.results.driver import AUTO, Driver, Order
from etid.results.fit import Fit, IdentificationError
from etid.simulation.published import TYPICAL

SKINS = {name: SkinRC(**dataclasses.asdict(skin)) for name, skin in TYPICAL.items()}
DECADE = np.array([1.0, 2.2, 4.7])  # resistors that a laboratory has
LONGER = 4.0  # times as many periods
NOW, MORE = "as now", f"{LONGER:g} times as many periods"  # what is recorded
BAND = np.geomspace(300.0, 60e3, 24)  # [Hz] where drivers are compared
MOVED = 4.0  # standard errors; two good calibrations differ by more once in 2 000 pairs
GOAL = 0.01  # standard error of an element for which the number of periods is told


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class CheckedCalibration(Overviewed):
    """A driver, the errors to expect with it, and what it has become since a former day.

    Attributes:
        driver: The driver.
        noise: Standard deviation of the noise of V_out in each of its recordings [V].
        expected: Relative standard errors of the elements, by skin and by what is recorded.
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
        errors = Overview(
            "standard errors to expect of skin:",
            rows,
            ("skin", "recorded", *SkinRC().names()),
            notes=[*self._what_helps(), *self._since()],
        )
        known = Overview(several(len(records), "calibration") + ":", records, heads)
        return dataclasses.replace(self.driver._overview(), then=(known, errors))

    def _what_helps(self) -> list[str]:
        """What makes the largest error smaller, and how many periods make it 1 %."""
        if not self.expected:
            return []
        error, skin, name = max(
            (error, skin, name)
            for skin, by in self.expected.items()
            for name, error in by[NOW].items()
        )
        then, what = min(
            (errors[name], what) for what, errors in self.expected[skin].items() if what != NOW
        )
        text = f"{name} of {skin} skin is least known; {what} helps most: {per_cent(then)}"
        times = np.ceil((error / GOAL) ** 2)
        return [text + (f"; 1 % takes {times:.0f} times as many periods" if times > 1 else "")]

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
    order: Order = AUTO,
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
    noise = [float(Inspected(one).sigma[1]) for one in records]
    trials = {name: imitated(records[0], driver, skin, 0) for name, skin in SKINS.items()}
    now = {name: _fitted(trial, driver) for name, trial in trials.items()}
    expected = {name: {NOW: _errors(fit), MORE: _errors(fit, LONGER)} for name, fit in now.items()}
    r = _further(driver, [one.r_load or 0.0 for one in records])
    found = _with_resistor(records, driver, r)
    for name, skin in SKINS.items():
        if found is not None:
            errors = _errors(_fitted(imitated(records[0], found, skin, 0), found))
            expected[name][f"also with {r / 1e3:g} kΩ"] = errors
    known = CheckedCalibration(driver, noise, expected)
    if former is None:
        return known
    shifts = {name: _shift(now[name], _fitted(trial, former)) for name, trial in trials.items()}
    return _compared(dataclasses.replace(known, shifts=shifts), former)


def read_driver(path: str | os.PathLike[str], *, order: Order = AUTO) -> Driver:
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


def imitated(recording: Recording, driver: Driver, load: SkinRC | Resistor, seed: int) -> Recording:
    """The recording as it would be with another load: whole periods, with noise of its own."""
    seen = Inspected(recording)
    _, size = seen.whole_periods
    f = jax.device_put(np.fft.rfftfreq(size, 1 / recording.sample_rate)[1:])
    z, z_th = np.asarray(load.response(f)), np.asarray(driver.response(f))
    spectrum = np.fft.rfft(recording.v_th[:size])
    spectrum[1:] *= z / (z + z_th)
    noise = np.random.default_rng(seed).standard_normal(size) * float(seen.sigma[1])
    r_load = float(load.r) if isinstance(load, Resistor) else None
    return recording.replace(
        v_th=recording.v_th[:size],
        v_out=np.fft.irfft(spectrum, size) + noise,
        r_load=r_load,
        path=f"imitated/{seed}",
        adc_range=None,
        instrument=None if r_load is None else recording.instrument,
    )


def _fitted(recording: Recording, driver: Driver) -> Fit:
    return identify_skin(recording, driver, throw=False)


def _shift(fit: Fit, other: Fit) -> dict[str, float]:
    """Relative differences of the elements of another fit."""
    ratio = np.asarray(other.circuit.values()) / np.asarray(fit.circuit.values())
    return dict(zip(fit.circuit.names(), (ratio - 1).tolist(), strict=True))


def _errors(fit: Fit, periods: float = 1.0) -> dict[str, float]:
    """Relative standard errors, with so many times the periods of calibration and skin."""
    errors = np.sqrt(np.diagonal(np.asarray(fit.cov))) / np.asarray(fit.circuit.values())
    return dict(zip(fit.circuit.names(), (errors / np.sqrt(periods)).tolist(), strict=True))


def _further(driver: Driver, known: Sequence[float]) -> float:
    """A further resistor [ohm] near |Z_th|, which shows most; ten times that if it is known."""
    z_th = float(np.abs(np.asarray(driver.response(jax.device_put(np.array([1e3])))))[0])
    near = np.outer(10.0 ** np.arange(0, 8), DECADE).ravel()
    r = float(near[np.argmin(np.abs(np.log(near / z_th)))])
    return 10 * r if any(0.5 < r / one < 2 for one in known) else r


def _with_resistor(records: Sequence[Recording], driver: Driver, r: float) -> Driver | None:
    """The driver with a further calibration; None if it gives none."""
    size = Inspected(records[0]).whole_periods[1]
    own = [
        one.replace(v_th=one.v_th[:size], v_out=one.v_out[:size], adc_range=None) for one in records
    ]
    try:
        return identify_driver(
            [*own, imitated(records[0], driver, Resistor(r), 1)], order=driver.order
        )
    except IdentificationError:
        return None


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
