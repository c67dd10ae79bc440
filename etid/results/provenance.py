"""Settings of a run: the facts that a methods section needs and that a file of fits stores."""

import dataclasses
import functools
import importlib.metadata

# |Z_th| [Ω] at 1 kHz: from the transformer of a microphone to the transformer of a tube.
PLAUSIBLE = (300.0, 300e3)


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
        plausible: As in `identify_driver`. Files of earlier versions do not store it.
        instrument: Tolerances of the instrument that are not 0 [SI], such as `"gain 0.001"`. Files
            of earlier versions do not store them.
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
    plausible: tuple[float, ...] = PLAUSIBLE
    instrument: tuple[str, ...] = ()


@functools.cache
def versions() -> tuple[str, ...]:
    """Packages and their versions; to look them up on disk takes as long as three skins."""
    packages = ("etid", "jax", "jaxlib", "optimistix", "equinox", "numpy")
    return tuple(f"{name} {importlib.metadata.version(name)}" for name in packages)
