"""Settings of a run: the facts that a methods section needs and that a file of fits stores."""

import dataclasses
import functools
import importlib.metadata
import math
import os
from collections.abc import Sequence

import jax
import numpy as np

from etid.circuits.circuit import AbstractCircuit
from etid.recordings.study import Study
from etid.results.tried_orders import AUTO, Order


@dataclasses.dataclass(frozen=True)
class Settings:
    """Settings of a run. They hold no date, so that equal runs have equal settings.

    Attributes:
        source: Absolute path of the file of recordings; empty if they were in memory.
        source_size: Size of the file [byte], which detects another file of the same name; 0 if
            the recordings were in memory.
        recordings: Number of recordings to identify.
        asked_method: The method that the user chose; empty if etid chose it for each recording.
        order: Number of poles of Z_th; 0 if etid chose it from the calibrations of each driver.
        start: Typical values of the elements [SI]; fits start around them.
        candidates: Names of the circuits from which that of all recordings was chosen; empty if
            the user chose it.
        r_load_tolerance: Relative standard deviation of the known resistors that is included in
            the standard errors.
        driver_drift: As in `identify_driver`.
        fixed: Known elements and their values [SI], such as `"r_s 500.0"`.
        prior: Elements with a prior, values and standard deviations [SI], such as
            `"r_s 500.0 ± 50.0"`.
        bounds: Elements with bounds [SI], such as `"r_s 100.0 to 2000.0"` or
            `"r_s above 100.0"`.
        precision: Floating-point type of the computation.
        backend: Backend of JAX, such as `"cpu"`.
        versions: Packages and their versions, such as `"jax 0.10.2"`.
    """

    source: str
    source_size: int
    recordings: int
    asked_method: str
    order: int
    start: tuple[float, ...]
    candidates: tuple[str, ...]
    r_load_tolerance: float
    driver_drift: float
    fixed: tuple[str, ...]
    prior: tuple[str, ...]
    bounds: tuple[str, ...]
    precision: str
    backend: str
    versions: tuple[str, ...]

    @classmethod
    def of(
        cls,
        study: Study,
        count: int,
        order: Order,
        method: str,
        candidates: Sequence[AbstractCircuit],
        r_load_tolerance: float = 0.0,
        driver_drift: float = 0.0,
        known: Sequence[tuple[str, float, float]] = (),
        bounds: Sequence[tuple[str, float, float]] = (),
    ) -> "Settings":
        """The settings of a run in this process.

        Args:
            study: The recordings.
            count: Number of recordings to identify.
            order: As in `identify_driver`.
            method: Name of the estimator that the user chose; empty if none.
            candidates: The circuit of the fits, then the others from which it was chosen.
            r_load_tolerance: As in `identify_jointly`.
            driver_drift: As in `identify_driver`.
            known: Names, values and standard deviations of known elements [SI]; the standard
                deviation of a fixed element is 0.
            bounds: Names, lower and upper bounds of elements [SI]; infinity for no upper
                bound.
        """
        source = os.path.abspath(study.file) if study.file else ""
        return cls(
            source=source,
            source_size=os.path.getsize(source) if source else 0,
            recordings=count,
            asked_method=method,
            order=0 if order == AUTO else order,
            start=tuple(np.asarray(candidates[0].values()).tolist()),
            candidates=tuple(type(one).__name__ for one in candidates)
            if len(candidates) > 1
            else (),
            r_load_tolerance=float(r_load_tolerance),
            driver_drift=float(driver_drift),
            fixed=tuple(f"{name} {value!r}" for name, value, error in known if not error),
            prior=tuple(f"{name} {value!r} ± {error!r}" for name, value, error in known if error),
            bounds=tuple(
                f"{name} above {low!r}" if high == math.inf else f"{name} {low!r} to {high!r}"
                for name, low, high in bounds
            ),
            precision="float64",
            backend=jax.default_backend(),
            versions=_versions(),
        )


@functools.cache
def _versions() -> tuple[str, ...]:
    """Packages and their versions; to look them up on disk takes as long as three skins."""
    packages = ("etid", "jax", "jaxlib", "optimistix", "equinox", "numpy")
    return tuple(f"{name} {importlib.metadata.version(name)}" for name in packages)
