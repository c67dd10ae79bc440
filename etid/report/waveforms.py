"""Waveforms of single fits of a study, if the recordings are found, and which fits are shown."""

import os
import pathlib
from collections.abc import Iterable

import numpy as np
from matplotlib.figure import Figure

from etid.plotting import figure_of
from etid.recordings.fields import LABELS
from etid.recordings.hdf5 import read
from etid.recordings.recording import Recording, RecordingError
from etid.recordings.study import Study
from etid.report.figures import plain, svg
from etid.report.html import Picture, Section
from etid.report.tables import significant
from etid.results.driver import Driver
from etid.results.fit import Fit
from etid.results.fits import Fits
from etid.results.study_fits import StudyFits, sha256

FAILED, STRAINED, UNCERTAIN = 6, 2, 2  # largest number of fits of each kind


class Recordings:
    """The recordings of fits, if they are found.

    Attributes:
        study: The recordings; None if they were not found.
        problem: A sentence on the problem with the recordings; empty if there is none.
    """

    def __init__(
        self,
        found: StudyFits,
        file: pathlib.Path | None,
        given: str | os.PathLike[str] | Study | None,
    ) -> None:
        """Look for the recordings.

        Args:
            found: The fits.
            file: File of the fits; the recordings may be in the same folder.
            given: The recordings or their file; None to look for them.

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
        if settings is not None and settings.source_sha256 not in ("", sha256(path)):
            self.problem = (
                f"{path} has changed since the fits were made: its SHA-256 is no longer "
                f"{settings.source_sha256}. The waveforms may differ from the fits."
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
        """Close the file if this object opened it."""
        if self.study is not None and self._opened:
            self.study.close()

    def picture(self, path: str, fit: Fit, text: str, anchor: str = "") -> Picture | None:
        """One measured and predicted pulse; None if the recording cannot be read.

        Args:
            path: Path of the recording.
            fit: Fit of the recording.
            text: Text for the caption.
            anchor: Name of the picture in a link.
        """
        if self.study is None:
            return None
        try:
            recording = self.study[path]
        except (RecordingError, KeyError):
            return None
        names = ("path", *LABELS)
        shown = recording.replace(**{name: plain(getattr(recording, name)) for name in names})
        names = recording.calibration or tuple(self.study.calibrations)
        if self._found.settings is not None and self._found.settings.driver:
            names = next(iter(self._found.drivers), ())  # the only driver, of another file
        by_current = recording.cause == "current"  # the fit needs no driver then
        driver = None if by_current else self._found.drivers.get(names)
        figure, why = _predicted(shown, fit, driver)
        elements = ", ".join(fit.elements)
        about = f"{path}: {fit.verdict}{f' ({text})' if text else ''}."
        if why:
            alt = f"Measured voltages of {path}; no prediction."
            caption = f"{about} No prediction: {why}"
        else:
            alt = f"One pulse of {path}: measured, predicted and residual voltage. {elements}"
            caption = f"{about} χ² {significant(float(fit.chi2), 3)}, {elements}."
        return Picture(caption, svg(figure), alt, anchor=anchor)


def _predicted(recording: Recording, fit: Fit, driver: Driver | None) -> tuple[Figure, str]:
    """A figure of one pulse, with its prediction or the reason why there is none."""
    values = np.asarray(fit.circuit.values())
    if driver is None and recording.cause == "v_th":
        return figure_of(recording), "the fits hold no driver for it."
    if (values <= 0).any():
        return figure_of(recording), "an element is not positive."
    why = "" if np.isfinite(values).all() else "no circuit was identified."
    try:
        return figure_of(fit, recording, driver), why
    except ValueError as error:
        return figure_of(recording), f"{error}."


def waveforms(fits: Fits, place: Recordings) -> Section:
    """Measured and predicted pulses of the worst fits."""
    text = (
        "First fits without success: for each verdict those with the largest χ². Then successful "
        "fits with the largest χ² and with the largest standard error. One pulse of each."
    )
    chosen = worst(fits)
    if len(fits) == 1:
        text, chosen = "One pulse.", {0: ""}
    text += (
        " If the model is right, the residual is noise. At the edges of a pulse it also contains "
        "frequencies near half the sample rate, which are aliased and not fitted."
    )
    pictures, missing = [], []
    for row, reason in chosen.items():
        path = str(fits.labels["path"][row])
        picture = place.picture(path, fits[row], reason, f"waveform-{row}")
        if picture is None:
            missing.append(f"{path} ({reason})" if reason else path)
        else:
            pictures.append(picture)
    if missing:
        text += f"\n\nThese recordings cannot be read and have no waveform: {', '.join(missing)}."
    heading = "Worst fits" if len(fits) > 1 else "Waveform"
    return Section(heading, text, (), tuple(pictures), warning=place.problem)


def relative_stderr(fits: Fits) -> np.ndarray:
    """Largest relative standard error of the elements of each fit; NaN if one is NaN or both 0."""
    with np.errstate(all="ignore"):  # an element without effect may be 0, a failed fit anything
        stacked = np.stack(
            [
                np.asarray(getattr(fits.stderr, name))
                / np.abs(np.asarray(getattr(fits.circuit, name)))
                for name in fits.circuit.names()
            ]
        )
    return np.where(np.isnan(stacked).any(axis=0), np.nan, stacked.max(axis=0))


def worst(fits: Fits) -> dict[int, str]:
    """Rows of the worst fits, with the reason: no success, then large χ², then large errors.

    The fits without success have different verdicts if possible, frequent verdicts first. One cause
    with many recordings therefore does not hide another. Among the fits with one verdict, the
    largest χ² comes first.
    """
    names = fits.verdicts
    chi2 = np.where(np.isfinite(fits.chi2), fits.chi2, -np.inf)
    failing = [
        _largest(np.flatnonzero(names == name), chi2)
        for name in fits.counts()
        if name != "successful"
    ]
    taken = dict.fromkeys(_in_turn(failing, FAILED), "without success")
    good = np.flatnonzero(names == "successful")
    for size, count, reason in (
        (chi2, STRAINED, "largest χ² among the successful"),
        (relative_stderr(fits), UNCERTAIN, "largest standard error among the successful"),
    ):
        known = good[np.isfinite(size[good])]
        left = [row for row in _largest(known, size) if row not in taken]
        taken |= dict.fromkeys(left[:count], reason)
    return taken


def _largest(rows: np.ndarray, size: np.ndarray) -> list[int]:
    """The first rows in descending order of size; rows of equal size keep their order."""
    order = np.argsort(-size[rows], kind="stable")[: FAILED + STRAINED + UNCERTAIN]
    return rows[order].tolist()


def _in_turn(queues: Iterable[list[int]], count: int) -> list[int]:
    """The first row of each queue, then the second of each, and so on; at most `count`."""
    ranked = [(place, i, row) for i, queue in enumerate(queues) for place, row in enumerate(queue)]
    return [row for _, _, row in sorted(ranked)][:count]
