"""What the identification of a study came to, in memory and in a file of fits.

The file is that of `etid.Fits` with two additions, which readers of fits alone do not notice: the
settings as attributes of the file, and a dataset `drivers` with one line of JSON for each driver.
"""

import dataclasses
import json
import os
from collections.abc import Iterable, Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np

from etid.circuits import AbstractCircuit
from etid.driver import Calibration, Driver, SourceImpedance
from etid.remarks import remarks_of, words
from etid.results import SCHEMA, Fits
from etid.settings import Settings
from etid.tables import read_table, write_table
from etid.verdicts import verdicts_of

_SETTINGS = {field.name for field in dataclasses.fields(Settings)}


@dataclasses.dataclass(frozen=True, eq=False)
class StudyFits:
    """What `identify_study`, `identify_jointly` and `fit_file` return, and what their file holds.

    Attributes:
        fits: One fit per loaded recording.
        drivers: The drivers, by the paths of their calibrations. Those from a file predict and have
            standard errors, but hold no harmonics of their calibrations: they serve output error,
            not maximum likelihood.
        failures: Why a driver could not be identified, by the paths of its calibrations.
        settings: With what they were made; None if the file does not say.
    """

    fits: Fits
    drivers: Mapping[tuple[str, ...], Driver]
    failures: Mapping[tuple[str, ...], str]
    settings: Settings | None = None

    @classmethod
    def concatenate(cls, parts: Iterable["StudyFits"]) -> "StudyFits":
        """One of several parts of a study, which were made with equal settings."""
        found = list(parts)
        drivers = {paths: driver for part in found for paths, driver in part.drivers.items()}
        failures = {paths: text for part in found for paths, text in part.failures.items()}
        fits = Fits.concatenate([part.fits for part in found])
        return cls(fits, drivers, failures, found[0].settings)

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write the fits, the drivers and the settings to an HDF5 file.

        `etid.Fits.read` and `StudyFits.read` both read it.
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
        """Read a file of fits; what an older one does not hold is empty.

        Args:
            path: The file.
            circuit: The kind of circuit, if it is not one of etid's own.

        Raises:
            ValueError: The file is not a file of fits, or `circuit` is not the one it holds.
        """
        columns, attributes = read_table(path, SCHEMA)
        fits = Fits.of_table(columns, attributes, path, circuit)
        drivers: dict[tuple[str, ...], Driver] = {}
        failures: dict[tuple[str, ...], str] = {}
        for line in columns.get("drivers", ()):
            stored = json.loads(line)
            paths = tuple(stored["calibrations"])
            if "failure" in stored:
                failures[paths] = stored["failure"]
            else:
                drivers[paths] = _from_json(stored)
        return cls(fits, drivers, failures, _settings(attributes))


def _settings(attributes: Mapping[str, Any]) -> Settings | None:
    if not attributes.keys() >= _SETTINGS:
        return None
    values: dict[str, Any] = {}
    for name in _SETTINGS:
        value = np.asarray(attributes[name]).tolist()
        values[name] = tuple(value) if isinstance(value, list) else value
    return Settings(**values)


def _lists(module: Any) -> dict[str, Any]:
    """The arrays of a module as nested lists."""
    names = (field.name for field in dataclasses.fields(module))
    return {name: np.asarray(getattr(module, name)).tolist() for name in names}


def _to_json(paths: tuple[str, ...], driver: Driver) -> str:
    known = driver.calibration
    return json.dumps(
        {
            "calibrations": paths,
            "method": driver.method,
            "verdict": driver.verdict,
            "steps": int(driver.steps),
            "remarks": words(int(driver.remarks)),
            "drift": None if driver.drift is None else float(driver.drift),
            "rrse": float(driver.rrse),
            "chi2": float(driver.chi2),
            "b": np.asarray(driver.b).tolist(),
            "a": np.asarray(driver.a).tolist(),
            "sample_rate": float(driver.sample_rate),
            "source": None if driver.source is None else _lists(driver.source),
            "cov": None if driver.cov is None else np.asarray(driver.cov).tolist(),
            "r_load": None if known is None else np.asarray(known.r_load).tolist(),
            "delay": None if known is None else np.asarray(known.delay).tolist(),
            "delay_std": None if known is None else float(known.delay_std),
        }
    )


def _from_json(stored: Mapping[str, Any]) -> Driver:
    def array(value: Any) -> Any:
        return None if value is None else jnp.asarray(value, dtype=float)

    source = known = None
    if stored["source"] is not None:
        source = SourceImpedance(**{name: array(v) for name, v in stored["source"].items()})
    if stored["r_load"] is not None:
        r_load, delay_std = array(stored["r_load"]), array(stored["delay_std"])
        known = Calibration(r_load, delay_std, array(stored["delay"]), spectra=None)
    return Driver(
        b=array(stored["b"]),
        a=array(stored["a"]),
        sample_rate=stored["sample_rate"],
        source=source,
        cov=array(stored["cov"]),
        calibration=known,
        rrse=array(stored["rrse"]),
        chi2=array(stored["chi2"]),
        result=verdicts_of(np.asarray(stored["verdict"])),
        steps=jnp.asarray(stored["steps"]),
        method=stored["method"],
        remarks=np.asarray(remarks_of(stored.get("remarks", ""))),
        drift=array(stored.get("drift")),
    )
