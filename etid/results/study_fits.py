"""Results of the identification of a study, in memory and in a file of fits.

The file is a file of `etid.Fits` with two additions: the settings as attributes of the file, and a
dataset `drivers` with one line of JSON for each driver. `etid.Fits.read` ignores both.
"""

import dataclasses
import functools
import hashlib
import importlib.metadata
import itertools
import json
import math
import os
import typing
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

import etid
from etid.circuits.circuit import AbstractCircuit
from etid.precision import in_float64
from etid.printing import ROWS, Overview, Overviewed, rounded, several
from etid.recordings.recording import RecordingError
from etid.recordings.remarks import remarks_of, words
from etid.results.driver import (
    Calibration,
    ContinuousDriver,
    DiscreteDriver,
    Driver,
    OrderEvidence,
)
from etid.results.fits import SCHEMA, VERSION, Fits
from etid.results.hdf5_table import REMEDY, Table, opened_table, write_table
from etid.results.instrument import Instrument
from etid.results.tree import as_tree, of_tree
from etid.results.verdicts import verdicts_of

# |Z_th| [Ω] at 1 kHz: from the transformer of a microphone to the transformer of a tube.
PLAUSIBLE = (300.0, 300e3)


@dataclasses.dataclass(frozen=True)
class Settings:
    """Settings of a run. They hold no date, so that equal runs have equal settings.

    Attributes:
        source: Absolute path of the file of recordings; empty if they were in memory.
        source_sha256: Checksum of the file, which detects another file of the same name; empty if
            the recordings were in memory.
        recordings: Number of recordings to identify.
        asked_method: The method that the user chose; empty if etid chose it for each recording.
        order: Number of poles of Z_th; 0 if etid chose it from the calibrations of each driver.
        start: Typical values of the elements [SI]; fits start around them.
        candidates: Names of the circuits from which that of all recordings was chosen; empty if
            the user chose it.
        fixed: Known elements and their values [SI], such as `"r_s 500.0"`.
        prior: Elements with a prior, values and standard deviations [SI], such as
            `"r_s 500.0 ± 50.0"`.
        bounds: Elements with bounds [SI], such as `"r_s 100.0 to 2000.0"` or
            `"r_s above 100.0"`.
        precision: Floating-point type of the computation.
        backend: Backend of JAX, such as `"cpu"`.
        versions: Packages and their versions, such as `"jax 0.10.2"`.
        accept: What a circuit may leave beyond the noise, relative to the signal.
        plausible: As in `identify_driver`.
        instrument: Tolerances of the instrument that are not 0 [SI], such as `"gain 0.001"`.
        driver: Absolute path of the file of the driver; empty if the recordings name their own
            calibrations.
    """

    source: str
    recordings: int
    asked_method: str
    order: int
    start: tuple[float, ...]
    candidates: tuple[str, ...]
    fixed: tuple[str, ...]
    prior: tuple[str, ...]
    bounds: tuple[str, ...]
    accept: float
    precision: str
    backend: str
    versions: tuple[str, ...]
    plausible: tuple[float, ...]
    instrument: tuple[str, ...]
    source_sha256: str
    driver: str = ""


def sha256(path: str | os.PathLike[str]) -> str:
    """Checksum of a file."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@functools.cache
def versions() -> tuple[str, ...]:
    """Packages and their versions; to look them up on disk takes as long as three skins."""
    packages = ("jax", "jaxlib", "optimistix", "equinox", "numpy")
    return (f"etid {etid.__version__}", *(f"{name} {_version(name)}" for name in packages))


def _version(package: str) -> str:
    """Version of a package; one on a search path that was never installed does not say it."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "of unknown version"


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class StudyFits(Overviewed):
    """Fits and drivers of a study, from `identify_study`, `identify_jointly`, `fit_file` or a file.

    Attributes:
        fits: One fit for each loaded recording.
        drivers: The drivers. The keys are the paths of their calibrations. Drivers from a file can
            predict and have standard errors. They hold no harmonics of their calibrations, so they
            serve fits, but no joint fit.
        failures: Reasons why a driver could not be identified. The keys are the paths of its
            calibrations.
        settings: Settings of the run; None if the file does not hold them.
    """

    fits: Fits
    drivers: Mapping[tuple[str, ...], Driver]
    failures: Mapping[tuple[str, ...], str]
    settings: Settings | None = None

    @property
    def by_current(self) -> bool:
        """Whether the run needed no driver: all recordings measured their current."""
        return self.settings is not None and not (self.drivers or self.failures)

    @classmethod
    def concatenate(cls, parts: Iterable["StudyFits"]) -> "StudyFits":
        """One result from the parts of a study. All parts must have equal settings."""
        parts = list(parts)
        drivers = {paths: driver for part in parts for paths, driver in part.drivers.items()}
        failures = {paths: text for part in parts for paths, text in part.failures.items()}
        fits = Fits.concatenate([part.fits for part in parts])
        return cls(fits, drivers, failures, parts[0].settings)

    def _overview(self) -> Overview:
        return dataclasses.replace(self.fits._overview(), then=(self._drivers(),))

    def _drivers(self) -> Overview:
        rows = [
            (
                ", ".join(paths),
                str(driver.order),
                driver.verdict,
                rounded(float(driver.chi2), 3),
            )
            for paths, driver in itertools.islice(self.drivers.items(), ROWS)
        ]
        failed = dict(self.failures) | {
            paths: f"{driver.verdict}. {driver.note}"
            for paths, driver in self.drivers.items()
            if not driver.usable
        }
        return Overview(
            f"{several(len(self.drivers) + len(self.failures), 'driver')}, {len(failed)} failed",
            rows,
            ("calibrations", "order", "verdict", "chi2"),
            [f"{', '.join(paths)}: {text}" for paths, text in list(failed.items())[:ROWS]],
            count=len(self.drivers),
        )

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write the fits, the drivers and the settings to an HDF5 file.

        `etid.Fits.read` and `StudyFits.read` can both read this file.
        """
        columns, units, attributes = self.fits.as_table()
        lines = [_to_json(paths, driver) for paths, driver in self.drivers.items()]
        lines += [
            json.dumps({"calibrations": paths, "failure": text})
            for paths, text in self.failures.items()
        ]
        columns["drivers"] = np.array(sorted(lines), dtype=object)
        if self.settings is not None:
            attributes |= {
                name: list(value) if isinstance(value, tuple) else value
                for name, value in dataclasses.asdict(self.settings).items()
            }
        write_table(path, columns, units=units, attributes=attributes)

    @classmethod
    def read(
        cls, path: str | os.PathLike[str], circuit: type[AbstractCircuit] | None = None
    ) -> "StudyFits":
        """Read a file of fits; one of `Fits.write` has neither drivers nor settings.

        Args:
            path: The file.
            circuit: As in `Fits.read`.

        Raises:
            RecordingError: As in `Fits.read`.
        """
        with opened_table(path, SCHEMA, VERSION) as table:
            fits = Fits.of_table(table, circuit)
            lines = table.read(table.column("drivers", "text")) if "drivers" in table else ()
            settings = _settings(table, len(fits))
        drivers: dict[tuple[str, ...], Driver] = {}
        failures: dict[tuple[str, ...], str] = {}
        for number, line in enumerate(lines):
            try:
                paths, found = _of_line(line)
            except Exception as error:  # the line of JSON is damaged
                raise RecordingError(
                    f"holds a driver that cannot be read ({type(error).__name__}: {error})",
                    file=os.fspath(path),
                    field=f"drivers[{number}]",
                    remedy=REMEDY,
                ) from error
            if isinstance(found, Driver):
                drivers[paths] = found
            else:
                failures[paths] = found
        return cls(fits, drivers, failures, settings)


def _settings(table: Table, recordings: int) -> Settings | None:
    """The settings in a file; None if it has none.

    One that the version of etid which wrote the file did not have is empty.

    Args:
        table: The file.
        recordings: Number of its fits.
    """
    kinds = {field.name: field.type for field in dataclasses.fields(Settings)}
    known = table.attributes & kinds.keys()
    if not known:
        return None
    values: dict[str, Any] = {}
    for name, kind in kinds.items():
        if name not in known:
            empty: Any = typing.get_origin(kind) or kind
            values[name] = recordings if name == "recordings" else empty()
            continue
        value = table.attribute(name)
        several = typing.get_args(kind)  # only tuples; the file stores them as a list or one item
        items = value if several and isinstance(value, list) else [value]
        item_kind: Any = several[0] if several else kind
        allowed = (int, float) if item_kind is float else item_kind
        if not all(isinstance(item, allowed) and not isinstance(item, bool) for item in items):
            raise RecordingError(
                f"is {value!r}, must be {kind}", file=table.name, field=name, remedy=REMEDY
            )
        values[name] = tuple(items) if several else value
    return Settings(**values)


def _of_line(line: str) -> tuple[tuple[str, ...], Driver | str]:
    """Paths of the calibrations, and the driver or the reason why there is none.

    A damaged line raises any error of `json` or of an array.
    """
    stored = json.loads(line)
    paths = stored["calibrations"]
    if not isinstance(paths, list) or not all(isinstance(path, str) for path in paths):
        raise TypeError(f"calibrations is {paths!r}, must be paths")
    if "failure" not in stored:
        return tuple(paths), _from_json(stored)
    if not isinstance(stored["failure"], str):
        raise TypeError(f"failure is {stored['failure']!r}, must be text")
    return tuple(paths), stored["failure"]


# What a file holds of a driver as it is; `_to_json` adds the rest.
_NUMBERS = "method", "steps", "rrse", "chi2", "b", "a", "sample_rate"


def _to_json(paths: tuple[str, ...], driver: Driver) -> str:
    words_of = {"verdict": driver.verdict, "remarks": words(int(driver.remarks))}
    stored = {"calibrations": paths, **words_of, **as_tree(driver, *_NUMBERS)}
    if isinstance(driver, ContinuousDriver):
        instrument = None if driver.instrument is None else driver.instrument.stored()
        own = as_tree(driver, "cov", "source", "tried")
        stored |= own | as_tree(driver.calibration) | {"instrument": instrument}
    return json.dumps(stored)


@in_float64
def _from_json(stored: Mapping[str, Any]) -> Driver:
    """A driver from the result of `_to_json`, which does not hold harmonics of calibrations."""
    others: dict[str, Any] = {
        "result": verdicts_of(np.asarray(stored["verdict"])),
        "remarks": np.asarray(remarks_of(stored["remarks"])),
    }
    if not 0 < stored["sample_rate"] < math.inf:
        raise ValueError(f"sample_rate is {stored['sample_rate']}")
    if "source" not in stored:
        return of_tree(DiscreteDriver, stored, **others)
    told = stored["instrument"]
    instrument = None if told is None else of_tree(Instrument, told).as_arrays()
    calibration = of_tree(Calibration, stored)
    if instrument is None:
        calibration = dataclasses.replace(calibration, errors=None)
    others |= {"instrument": instrument, "calibration": calibration}
    driver = of_tree(ContinuousDriver, stored, **others)
    known = calibration.errors, driver.cov, driver.tried.bic
    count = instrument and instrument.deviations(calibration.r_load.size).size
    wanted = count, driver.source.vector().size, OrderEvidence.none().bic.size
    for of, size in zip(known, wanted, strict=True):
        if of is not None and len(of) != size:
            raise ValueError(f"{len(of)} numbers stand where {size} are needed")
    return driver
