"""Statistics of the paper's tables, computed from identified studies.

A preset of `etid.scenes` makes the study. Another study must have the same paths and labels.
Errors are in per cent. A fit without a circuit (an estimate that is negative or complex) enters no
statistics.
"""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from etid.circuits.circuit import Resistor, SkinRC
from etid.identify.driver import identify_driver
from etid.identify.skins import identify_skins
from etid.recordings.study import Study
from etid.results.driver import Driver
from etid.results.fits import Fits
from etid.simulation.published import TABLE_1, TABLE_4
from etid.simulation.scenes import resistor_label

CALIBRATION = "calibration/98k8"
# With `noisy`, the errors of the paper's method are about as large as in the paper's Table IV.
LABORATORIES: Mapping[str, Mapping[str, float]] = {
    "quiet": {"snr_db": 60.0},
    "noise 40 dB": {"snr_db": 40.0},
    "noise 30 dB": {"snr_db": 30.0},
    "delays 200 ns": {"snr_db": 60.0, "trigger_jitter_rms": 200e-9},
    "noisy": {"snr_db": 40.0, "trigger_jitter_rms": 200e-9},
}
METHODS: tuple[str, ...] = ("maximum_likelihood", "steiglitz_mcbride")  # of etid, of the paper
ORDER = ("r_p", "c_p", "r_s")  # as in the paper's tables

Truth = Mapping[str, Mapping[str, float]]
"""True elements of each recording by its path, from `etid.scenes.Scene.truth`."""
Row = dict[str, Any]


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


Groups = Mapping[tuple[str, str], Sequence[Outcome]]
"""The studies of each laboratory and method."""


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


def resistors(groups: Groups) -> list[Row]:
    """Errors of five known resistors, over the studies (Table I)."""
    rows = []
    for (laboratory, method), outcomes in groups.items():
        found = [resistor_errors(outcome) for outcome in outcomes]
        for r, paper in TABLE_1.items():
            every = np.array([of[r] for of in found])
            some = every[np.isfinite(every)]
            row = {"laboratory": laboratory, "method": method, "r": r, "paper_error": paper}
            row |= {"error": _mean(some), "spread": _sd(some)}
            row |= {"rms": float(np.sqrt(_mean(some**2)))}
            rows.append({**row, "circuits": some.size, "fits": every.size})
    return rows


def built_circuit(groups: Groups) -> list[Row]:
    """The built circuit: mean error and scatter of the trials of a study (Table IV).

    `error` is the mean over all studies, `between` the standard deviation of the studies' means,
    which is the error of their calibrations; `scatter` that of the trials within a study.
    `stderr` is the standard error of a study's mean as the fits tell it: what they share, and the
    mean of what they do not.
    """
    rows = []
    for (laboratory, method), outcomes in groups.items():
        truth = outcomes[0].truth
        every = [outcome.skins.where(condition="built") for outcome in outcomes]
        some = [fits for fits in map(_with_circuit, every) if len(fits) > 1]
        for i, name in enumerate(SkinRC.names()):
            found = [errors(fits, truth)[name] for fits in some]
            means = np.array([errors.mean() for errors in found])
            row: Row = {"laboratory": laboratory, "method": method, "element": name}
            row["paper_error"], row["paper_scatter"] = TABLE_4[name]
            row |= {"error": _mean(means), "between": _sd(means)}
            row["scatter"] = float(np.sqrt(_mean(errors.var(ddof=1) for errors in found)))
            row["stderr"] = _mean(_stderr_of_mean(fits, truth, i) for fits in some)
            row["rrse"] = 100 * float(np.median([np.median(fits.rrse) for fits in every]))
            counts = {
                "successful": sum(len(fits.usable()) for fits in every),
                "circuits": sum(len(_with_circuit(fits)) for fits in every),
                "fits": sum(map(len, every)),
            }
            rows.append({**row, **counts, "studies": len(some)})
    return sorted(rows, key=lambda row: ORDER.index(row["element"]))


def _with_circuit(fits: Fits) -> Fits:
    """The fits that found a circuit."""
    values = np.array([getattr(fits.circuit, name) for name in fits.circuit.names()])
    return fits.take(np.asarray(np.isfinite(values).all(axis=0)))


def _sd(values: np.ndarray) -> float:
    return float(np.std(values, ddof=1)) if values.size > 1 else np.nan


def _mean(values: Iterable[float]) -> float:
    finite = [value for value in values if np.isfinite(value)]
    return float(np.mean(finite)) if finite else np.nan


def _stderr_of_mean(fits: Fits, truth: Truth, i: int) -> float:
    """Standard error of the mean of element i over trials with one driver [%]."""
    known = truth[str(fits.labels["path"][0])][SkinRC.names()[i]]
    total, shared = (np.asarray(cov)[:, i, i].mean() for cov in (fits.cov, fits.fit.shared_cov))
    return float(100 / known * np.sqrt(shared + (total - shared) / len(fits)))
