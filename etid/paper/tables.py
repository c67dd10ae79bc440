"""The paper's experiments: the statistics that it prints, of identified studies.

A study is made by a preset of `etid.scenes`, or has its paths and labels.
"""

import dataclasses
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from etid.circuits.circuit import Resistor, SkinRC
from etid.identify.driver import identify_driver
from etid.identify.many import identify_skins
from etid.recordings.study import Study
from etid.results.driver import Driver
from etid.results.fits import Fits
from etid.simulation.published import TABLE_1
from etid.simulation.scenes import resistor_label

CALIBRATION = "calibration/98k8"
# `noisy` is where the paper's method makes errors of the size that the paper prints in Table IV.
LABORATORIES: Mapping[str, Mapping[str, float]] = {
    "quiet": {"snr_db": 60.0},
    "noisy": {"snr_db": 40.0, "trigger_jitter_rms": 200e-9},
}
METHODS: tuple[str, ...] = ("maximum_likelihood", "steiglitz_mcbride")  # ours, the paper's
ORDER = ("r_p", "c_p", "r_s")  # as the paper's tables have them

Truth = Mapping[str, Mapping[str, float]]
"""Elements by path, as `etid.scenes.Scene.truth` has them."""


@dataclasses.dataclass(frozen=True, eq=False)
class Outcome:
    """One study identified by one method.

    Attributes:
        laboratory: Who made the study.
        method: Name of the estimator.
        driver: The driver.
        skins: Everything but the test resistors.
        resistors: The test resistors, as one resistor by maximum likelihood. Steiglitz-McBride
            identifies eq. 7 only; the resistance is then Z(0) = R_s + R_p.
    """

    laboratory: str
    method: str
    driver: Driver
    skins: Fits
    resistors: Fits

    @property
    def names(self) -> tuple[str, str]:
        """First two cells of its rows."""
        return self.laboratory, self.method


def identify(laboratory: str, study: Study, method: str, *, progress: bool = False) -> Outcome:
    """Identify the driver, the test resistors as resistors, everything else as skin.

    Args:
        laboratory: Who made the study.
        study: Its recordings.
        method: The estimator.
        progress: Show how many skins are done.
    """
    driver = identify_driver(study[CALIBRATION], method=method, throw=False)
    resistors = study.where(condition="resistors")
    skins = [study[path] for path in study.loaded if path not in resistors]
    circuit = Resistor() if method == "maximum_likelihood" else SkinRC()
    return Outcome(
        laboratory,
        method,
        driver,
        identify_skins(skins, driver, method=method, progress=progress),
        identify_skins(resistors, driver, circuit=circuit, method=method),
    )


def errors(fits: Fits, truth: Truth) -> dict[str, Float[np.ndarray, " fit"]]:
    """Errors of the elements of each fit [%], NaN where there is no circuit."""
    known = [truth[str(path)] for path in fits.labels["path"]]
    return {
        name: 100 * (np.asarray(getattr(fits.circuit, name)) / [of[name] for of in known] - 1)
        for name in fits.circuit.names()
    }


def resistor_errors(outcome: Outcome) -> dict[float, float]:
    """Error of each test resistor [%] by its resistance (Table I)."""
    found = {}
    for r in TABLE_1:
        circuit = outcome.resistors.where(path=f"resistors/{resistor_label(r)}").circuit
        value = circuit.r if isinstance(circuit, Resistor) else circuit.r_s + circuit.r_p
        found[r] = float(100 * (np.asarray(value).item() / r - 1))
    return found


@dataclasses.dataclass(frozen=True)
class Fingertips:
    """One element of fingertips in one state (a row of Table II or III).

    Attributes:
        typical: Median of the trials of the typical fingertip [SI].
        error: Median error of these [%].
        spread: Standard deviation between them [%].
        lowest: Smallest of the medians of the subjects [SI].
        highest: Largest of these [SI].
        subject_error: Median of the absolute errors of the subjects' medians [%].
        worst: Largest of these [%].
    """

    typical: float
    error: float
    spread: float
    lowest: float
    highest: float
    subject_error: float
    worst: float


def fingertips(fits: Fits, truth: Truth, name: str) -> Fingertips:
    """Statistics of one element; a fit without a circuit makes them NaN.

    Args:
        fits: The skins of one condition, the typical fingertip and the subjects.
        truth: Elements by path.
        name: The element.
    """
    typical = fits.where(subject="typical")
    values, error = np.asarray(getattr(typical.circuit, name)), errors(typical, truth)[name]
    many = fits.take(fits.labels["subject"] != "typical")
    trials = [many.where(subject=subject) for subject in np.unique(many.labels["subject"])]
    medians = np.array([np.median(getattr(of.circuit, name)) for of in trials])
    actual = np.array([truth[str(of.labels["path"][0])][name] for of in trials])
    subjects = 100 * np.abs(medians / actual - 1)
    return Fingertips(
        float(np.median(values)),
        float(np.median(error)),
        float(np.std(error, ddof=1)),
        float(medians.min()),
        float(medians.max()),
        float(np.median(subjects)),
        float(subjects.max()),
    )
