"""Waveforms of single fits of a study, if its recordings can be found."""

import os
import pathlib

import numpy as np

from etid.circuits import DISPLAY
from etid.driver import Driver
from etid.hdf5 import read
from etid.identify import predict
from etid.plotting import plot_fit, plot_recording
from etid.recording import Recording, RecordingError
from etid.report import Picture
from etid.results import Fit, plus_minus
from etid.study import Study
from etid.study_figures import plain, svg
from etid.study_fits import StudyFits
from etid.study_tables import significant


class Recordings:
    """The recordings that fits were made from, wherever they are now.

    Attributes:
        study: The recordings; None if they were not found.
        problem: What is wrong with them, in words; empty if nothing is.
    """

    def __init__(
        self,
        found: StudyFits,
        file: pathlib.Path | None,
        given: str | os.PathLike[str] | Study | None,
    ):
        """Look for them.

        Args:
            found: The fits.
            file: Their file, beside which the recordings may lie.
            given: The recordings or their file, if they need not be looked for.

        Raises:
            RecordingError: `given` is not a file of recordings.
        """
        self.study: Study | None = None
        self.problem = ""
        self._opened = False
        self._found = found
        if isinstance(given, Study):
            self.study = given
        elif given is not None:
            self._open(pathlib.Path(given))
        else:
            self._look(file)

    def _open(self, path: pathlib.Path) -> None:
        self.study, self._opened = read(path), True
        settings = self._found.settings
        if settings is not None and settings.source_size not in (0, path.stat().st_size):
            self.problem = (
                f"{path} has changed since the fits were made: it had {settings.source_size} bytes "
                f"and has {path.stat().st_size} now. What is drawn may not be what was identified."
            )

    def _look(self, file: pathlib.Path | None) -> None:
        settings = self._found.settings
        remedy = "Name their file: etid report FITS --recordings FILE."
        if settings is None or not settings.source:
            self.problem = f"The fits do not say where their recordings are. {remedy}"
            return
        places = [pathlib.Path(settings.source)]
        if file is not None:
            places.append(file.absolute().parent / places[0].name)
        for path in places:
            if path.is_file():
                try:
                    self._open(path)
                except RecordingError as error:
                    self.problem = f"{error}. {remedy}"
                return
        tried = " and ".join(dict.fromkeys(map(str, places)))
        self.problem = f"The recordings were not found: there is no {tried}. {remedy}"

    def close(self) -> None:
        """Close the file, if it was opened here."""
        if self.study is not None and self._opened:
            self.study.close()

    def picture(self, path: str, fit: Fit, text: str) -> Picture | None:
        """One pulse as it was measured and as it is predicted; None if it cannot be read.

        Args:
            path: Of the recording.
            fit: What was identified in it.
            text: Below the picture.
        """
        if self.study is None:
            return None
        try:
            recording = self.study[path]
        except (RecordingError, KeyError):
            return None
        predicted, why = self._predict(recording, fit)
        recording = recording.replace(path=plain(path))
        elements = _elements(fit)
        about = f"{path}: {fit.verdict} ({text})."
        if predicted is None:
            figure = plot_recording(recording)
            alt = f"Measured voltages of {path}, whole record and one pulse; no prediction."
            caption = f"{about} No prediction: {why}"
        else:
            figure = plot_fit(recording, predicted)
            alt = f"One pulse of {path}: measured, predicted and residual voltage. {elements}"
            caption = f"{about} χ² {significant(float(fit.chi2), 3)}, {elements}."
        return Picture(caption, svg(figure), alt)

    def _predict(self, recording: Recording, fit: Fit) -> tuple[np.ndarray | None, str]:
        """The terminal voltage [V], or why there is none."""
        values = np.asarray(fit.circuit.values())
        if not (np.isfinite(values) & (values > 0)).all():
            return None, "no circuit was identified."
        driver = self._driver(recording)
        if driver is None:
            return None, "the fits hold no driver for it."
        try:
            predicted = predict(recording, driver, fit.circuit)
        except ValueError as error:
            return None, f"{error}."
        if not np.isfinite(predicted).any():
            return None, "the identified circuit is unstable."
        return predicted, ""

    def _driver(self, recording: Recording) -> Driver | None:
        assert self.study is not None
        names = recording.calibration or tuple(self.study.calibrations)
        return self._found.drivers.get(names)


def _elements(fit: Fit) -> str:
    """The elements with their standard errors, in words."""
    parts = []
    for name, unit in fit.circuit.units().items():
        scale, symbol = DISPLAY[unit]
        value = float(getattr(fit.circuit, name)) / scale
        error = float(getattr(fit.stderr, name)) / scale
        parts.append(" ".join(f"{name} {plus_minus(value, error)} {symbol}".split()))
    return ", ".join(parts)
