"""Statistics of the paper's tables, computed from identified studies.

A preset of `etid.scenes` makes the study. Another study must have the same paths and labels.
"""

import dataclasses
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from etid.circuits.circuit import Resistor, SkinRC
from etid.identify.driver import identify_driver
from etid.identify.skins import identify_skins
from etid.recordings.study import Study
from etid.results.driver import Driver
from etid.results.fits import Fits
from etid.simulation.published import TABLE_1
from etid.simulation.scenes import resistor_label

CALIBRATION = "calibration/98k8"
# With `noisy`, the errors of the paper's method are about as large as in the paper's Table IV.
LABORATORIES: Mapping[str, Mapping[str, float]] = {
    "quiet": {"snr_db": 60.0},
    "noisy": {"snr_db": 40.0, "trigger_jitter_rms": 200e-9},
}
METHODS: tuple[str, ...] = ("maximum_likelihood", "steiglitz_mcbride")  # of etid, of the paper
ORDER = ("r_p", "c_p", "r_s")  # as in the paper's tables

Truth = Mapping[str, Mapping[str, float]]
"""True elements of each recording by its path, from `etid.scenes.Scene.truth`."""


@dataclasses.dataclass(frozen=True, eq=False)
class Outcome:
    """One study identified by one method.

    Attributes:
        laboratory: Name of the laboratory, a key of `LABORATORIES`.
        method: Name of the estimator.
        truth: True elements of each recording.
        driver: Identified driver.
        skins: Fits of all loads except the test resistors.
        resistors: Fits of the test resistors. Maximum likelihood fits one resistor.
            Steiglitz-McBride fits eq. 7; the resistance is then Z(0) = R_s + R_p.
    """

    laboratory: str
    method: str
    truth: Truth
    driver: Driver
    skins: Fits
    resistors: Fits

    @property
    def names(self) -> tuple[str, str]:
        """First two cells of a row: laboratory and method."""
        return self.laboratory, self.method


def identify(
    laboratory: str, study: Study, truth: Truth, method: str, *, progress: bool = False
) -> Outcome:
    """Driver, test resistors and skins of a study, identified by one method.

    Args:
        laboratory: Name of the laboratory.
        study: Recordings of the laboratory.
        truth: True elements of each of them.
        method: Name of the estimator.
        progress: Whether to show the number of fitted skins.
    """
    driver = identify_driver(study[CALIBRATION], method=method, throw=False)
    resistors = study.where(condition="resistors")
    skins = [study[path] for path in study.loaded if path not in resistors]
    circuit = Resistor() if method == "maximum_likelihood" else SkinRC()
    return Outcome(
        laboratory,
        method,
        truth,
        driver,
        identify_skins(skins, driver, method=method, progress=progress),
        identify_skins(resistors, driver, circuit=circuit, method=method),
    )


def errors(fits: Fits, truth: Truth) -> dict[str, Float[np.ndarray, " fit"]]:
    """Errors of the elements of each fit [%]; NaN if the fit has no circuit."""
    known = [truth[str(path)] for path in fits.labels["path"]]
    return {
        name: 100 * (np.asarray(getattr(fits.circuit, name)) / [of[name] for of in known] - 1)
        for name in fits.circuit.names()
    }


def resistor_errors(outcome: Outcome) -> dict[float, float]:
    """Error of each test resistor [%], by its true resistance [Ω] (Table I)."""
    found = {}
    for r in TABLE_1:
        circuit = outcome.resistors.where(path=f"resistors/{resistor_label(r)}").circuit
        value = circuit.r if isinstance(circuit, Resistor) else circuit.r_s + circuit.r_p
        found[r] = float(100 * (np.asarray(value).item() / r - 1))
    return found
