"""Waveforms of single fits of a study, if the recordings are found, and which fits are shown."""

import itertools
import os
import pathlib

import numpy as np
from matplotlib.figure import Figure

from etid.plotting import figure_of
from etid.plotting.style import svg
from etid.printing import as_symbol, significant
from etid.recordings.hdf5 import read
from etid.recordings.recording import Recording, RecordingError
from etid.recordings.study import Study
from etid.report.html import Picture, Section
from etid.results.driver import Driver
from etid.results.fit import Fit
from etid.results.fits import Fits
from etid.results.study_fits import StudyFits, sha256
from etid.results.verdicts import USABLE


def find(
    found: StudyFits, file: pathlib.Path | None, given: str | os.PathLike[str] | Study | None
) -> tuple[Study | None, str]:
    """The recordings of fits, if they are found, and a sentence if there is a problem with them.

    Args:
        found: The fits.
        file: File of the fits; the recordings may be in the same folder.
        given: The recordings or their file; None to look for them.

    Raises:
        RecordingError: `given` is not a file of recordings.
    """
    if isinstance(given, Study):
        return given, ""
    settings = found.settings
    remedy = "Name their file: etid report FITS --recordings FILE."
    if given is not None:
        places = [pathlib.Path(given)]
    elif settings is not None and settings.source:
        places = [pathlib.Path(settings.source)]
        if file is not None:
            places.append(file.absolute().parent / places[0].name)
    else:
        return None, f"The fits do not say where their recordings are. {remedy}"
    path = next((one for one in places if given is not None or one.is_file()), None)
    if path is None:
        tried = " and ".join(dict.fromkeys(map(str, places)))
        return None, f"The recordings were not found: there is no {tried}. {remedy}"
    try:
        study = read(path)
    except RecordingError as error:
        if given is not None:
            raise
        return None, f"{error}. {remedy}"
    if settings is None or settings.source_sha256 in ("", sha256(path)):
        return study, ""
    return study, (
        f"{path} has changed since the fits were made: its SHA-256 is no longer "
        f"{settings.source_sha256}. The waveforms may differ from the fits."
    )


def calibrations_of(found: StudyFits, study: Study, recording: Recording) -> tuple[str, ...]:
    """Paths of the calibrations of a recording, by which `found.drivers` has its driver."""
    if found.settings is not None and found.settings.driver:
        return next(iter(found.drivers), ())  # the only driver, of another file
    return recording.calibration or tuple(study.calibrations)


def picture(found: StudyFits, study: Study, row: int, reason: str) -> Picture | None:
    """One measured and predicted pulse of a fit; None if its recording cannot be read."""
    path, fit = str(found.fits.labels["path"][row]), found.fits[row]
    try:
        recording = study[path]
    except (RecordingError, KeyError):
        return None
    # Such a fit needs no driver, also where the file has an unloaded voltage beside the current.
    by_current = found.by_current or recording.cause == "current"
    driver = None if by_current else found.drivers.get(calibrations_of(found, study, recording))
    figure, why = _predicted(recording, fit, driver, by_current=by_current)
    named = (one.partition(" ") for one in fit.elements)
    elements = ", ".join(f"{as_symbol(name)} {value}" for name, _, value in named)
    about = f"{path}: {fit.verdict}{f' ({reason})' if reason else ''}."
    alt = f"One pulse of {path}: measured, predicted and residual voltage. {elements}"
    caption = f"{about} χ² {significant(float(fit.chi2), 3)}, {elements}."
    if why:
        alt = f"Measured voltages of {path}; no prediction."
        caption = f"{about} No prediction: {why}"
    return Picture(caption, svg(figure), alt, anchor=f"waveform-{row}")


def _predicted(
    recording: Recording, fit: Fit, driver: Driver | None, *, by_current: bool
) -> tuple[Figure, str]:
    """A figure of one pulse, with its prediction or the reason why there is none."""
    values = np.asarray(fit.circuit.values())
    if driver is None and not by_current:
        return figure_of(recording), "the fits hold no driver for it."
    if (values <= 0).any():
        return figure_of(recording), "an element is not positive."
    why = "" if np.isfinite(values).all() else "no circuit was identified."
    try:
        return figure_of(fit, recording, driver), why
    except ValueError as error:
        return figure_of(recording), f"{error}."


def waveforms(found: StudyFits, study: Study | None, problem: str) -> Section:
    """Measured and predicted pulses of the worst fits; `problem` is that with the recordings."""
    text = (
        "First unusable fits: for each verdict those with the largest χ². Then usable "
        "fits with the largest χ² and with the largest standard error. One pulse of each."
    )
    heading, chosen = "Worst fits", worst(found.fits)
    if len(found.fits) == 1:
        heading, text, chosen = "Waveform", "One pulse.", {0: ""}
    text += (
        " If the model is right, the residual is noise. At the edges of a pulse it also contains "
        "frequencies near half the sample rate, which are aliased and not fitted. The lowest panel "
        "shows it by frequency, beside the noise that the fit expects there."
    )
    pictures, missing = [], []
    for row, reason in chosen.items():
        path = str(found.fits.labels["path"][row])
        drawn = None if study is None else picture(found, study, row, reason)
        if drawn is None:
            missing.append(f"{path} ({reason})" if reason else path)
        else:
            pictures.append(drawn)
    if missing:
        text += f"\n\nThese recordings cannot be read and have no waveform: {', '.join(missing)}."
    return Section(heading, text, (), tuple(pictures), warning=problem)


def relative_stderr(fits: Fits) -> np.ndarray:
    """Largest relative standard error of the elements of each fit; NaN if one is NaN or both 0."""
    with np.errstate(all="ignore"):  # an element without effect may be 0, a failed fit anything
        ratios = np.asarray(fits.stderr.values()) / np.abs(np.asarray(fits.circuit.values()))
    return ratios.max(axis=-1)


def worst(fits: Fits) -> dict[int, str]:
    """Rows of the worst fits, with the reason: 6 unusable, 2 of large χ², 2 of large errors.

    The unusable fits have different verdicts if possible, frequent verdicts first. One cause
    with many recordings therefore does not hide another. Among the fits with one verdict, the
    largest χ² comes first.
    """
    names = fits.verdicts
    chi2 = np.where(np.isfinite(fits.chi2), fits.chi2, -np.inf)
    failing = [_largest(chi2, names == name) for name in fits.counts() if name not in USABLE]
    in_turn = itertools.chain.from_iterable(itertools.zip_longest(*(rows[:6] for rows in failing)))
    failed = [row for row in in_turn if row is not None]
    taken = dict.fromkeys(failed[:6], "unusable")
    for size, reason in (
        (chi2, "largest χ² among the usable"),
        (relative_stderr(fits), "largest standard error among the usable"),
    ):
        rows = _largest(size, fits.fit.usable & np.isfinite(size))
        taken |= dict.fromkeys([row for row in rows if row not in taken][:2], reason)
    return taken


def _largest(size: np.ndarray, among: np.ndarray) -> list[int]:
    """Rows in descending order of size; rows of equal size keep their order."""
    rows = np.flatnonzero(among)
    return rows[np.argsort(-size[rows], kind="stable")].tolist()
