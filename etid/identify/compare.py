"""How well fitted circuits predict recordings to which they were not fitted."""

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from etid.circuits.circuit import AbstractCircuit
from etid.identify.arguments import fed, given_circuit
from etid.identify.arguments import recordings as list_of
from etid.identify.predict import predict
from etid.identify.residual import whitened
from etid.precision import in_float64
from etid.printing import Overview, Overviewed, per_cent, rounded, several
from etid.recordings.recording import Recording
from etid.recordings.remarks import Remark
from etid.recordings.study import Study
from etid.results.driver import Driver
from etid.results.fit import Fit, rrse

Predicting = Fit | AbstractCircuit | str


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Comparison(Overviewed):
    """Predictions of recordings by circuits, as `etid.compare` returns them.

    Attributes:
        recordings: Paths of the recordings.
        names: Names of the circuits.
        rrse: Root relative squared error of V_out over all predicted samples. That of a fit is of
            the mean of the periods, whose noise is smaller.
        chi2: Mean square residual at the frequencies of a fit, relative to the noise of the
            recording; 1 if only noise is left.
    """

    recordings: tuple[str, ...]
    names: tuple[str, ...]
    rrse: Float[np.ndarray, "recording name"]
    chi2: Float[np.ndarray, "recording name"]

    @property
    def percent(self) -> Float[np.ndarray, "recording name"]:
        """MATLAB's fit, 100 (1 − ‖V − W‖ / ‖V − mean V‖) [%]; 100 for a perfect prediction."""
        return 100 * (1 - self.rrse)

    def _overview(self) -> Overview:
        rows = [
            (path, name, f"{self.percent[at]:.2f} %", per_cent(self.rrse[at], 3), chi2)
            for row, path in enumerate(self.recordings)
            for column, name in enumerate(self.names)
            for at in [(row, column)]
            for chi2 in [rounded(self.chi2[at], 3)]
        ]
        what = several(len(self.names), "circuit"), several(len(self.recordings), "recording")
        title = f"Comparison of {what[0]} at {what[1]}"
        return Overview(title, rows, ("recording", "circuit", "fit", "RRSE", "chi2"))


@in_float64
def compare(
    fits: Predicting | Mapping[str, Predicting] | Iterable[Predicting],
    recordings: Recording | Study | Iterable[Recording],
    driver: Driver | None = None,
) -> Comparison:
    """How well fitted circuits predict recordings to which they were not fitted.

    The elements are held. Trigger delay, offset and the state at the start are those of each
    recording (`etid.predict`); for χ², Z_th moves within its uncertainty too.

    Args:
        fits: Fits, circuits or circuit strings by name, or without names.
        recordings: Recordings, or a part of a study, as `study.where(condition="dry")`.
        driver: The driver of the recordings. If not given, it is the one that a fit knows; a
            circuit is then predicted from the measured current.

    Returns:
        Fit percentage, RRSE and χ² of each recording and circuit; `print` shows a table.

    Raises:
        ValueError: There is nothing to compare, an argument has another type, or a recording cannot
            be predicted (`etid.predict`).
    """
    named = _named(fits)
    if isinstance(recordings, Recording):
        recordings = [recordings]
    every = recordings.values() if isinstance(recordings, Study) else recordings
    every = list_of("recordings", every)
    if not named or not every:
        raise ValueError("there is nothing to compare: give fits and recordings")
    found = [[_judged(one, of, driver) for of in named.values()] for one in every]
    error, chi2 = np.moveaxis(np.array(found), -1, 0)
    return Comparison(tuple(one.path for one in every), tuple(named), error, chi2)


def _named(fits: Any) -> dict[str, Any]:
    """Fits and circuits by name; the same circuit again has a number."""
    if isinstance(fits, Mapping):
        return dict(fits)
    found: dict[str, Any] = {}
    for one in [fits] if isinstance(fits, Predicting) else fits:
        of = one.circuit if isinstance(one, Fit) else one
        name = kind = of if isinstance(of, str) else type(of).__name__
        number = 1
        while name in found:
            number += 1
            name = f"{kind} {number}"
        found[name] = one
    return found


def _judged(recording: Recording, of: Any, driver: Driver | None) -> tuple[float, float]:
    """RRSE and χ² of one prediction."""
    hums = False
    if isinstance(of, Fit):
        of.refuse_batch()
        hums = bool(int(of.remarks) & Remark.mains_hum)
        driver, of = of.driver if driver is None else driver, of.circuit
    circuit = given_circuit("fits", of)
    if not np.isfinite(np.asarray(circuit.values())).all():  # a fit that failed
        return np.nan, np.nan
    predicted = np.asarray(predict(recording, driver, circuit))
    known = np.isfinite(predicted)
    error = rrse(predicted[known], np.asarray(recording.v_out)[known])
    left = whitened(*fed(recording, driver), circuit, hums=hums).of
    return float(error), float(np.mean(np.abs(left) ** 2))
