"""The uncertainty budget of a typical recording: what to buy or to record next."""

import contextlib
import dataclasses

import numpy as np

from etid.identify.driver import with_harmonics
from etid.printing import as_symbol
from etid.recordings.hdf5 import read
from etid.recordings.recording import RecordingError
from etid.recordings.study import Study
from etid.report.html import Section, Table
from etid.report.waveforms import calibrations_of, relative_stderr
from etid.results.driver import ContinuousDriver, HarmonicDriver
from etid.results.fit import IdentificationError
from etid.results.instrument import Budget
from etid.results.study_fits import StudyFits


def budgets(found: StudyFits, study: Study | None) -> list[Section]:
    """The budget of the fit whose standard errors are the median; none without its recording.

    Fits by another method than maximum likelihood or by several have none, nor joint fits in files.
    """
    errors = relative_stderr(found.fits)
    errors[~found.fits.fit.usable] = np.nan
    rows = np.argsort(errors)[: np.sum(np.isfinite(errors))]
    if study is None or not rows.size:
        return []
    row = int(rows[(rows.size - 1) // 2])
    path = str(found.fits.labels["path"][row])
    try:
        budget = _of(found, study, row, path)
    except (RecordingError, IdentificationError, KeyError, ValueError):
        return []
    if budget is None:
        return []
    typical = "" if rows.size == 1 else f" of {path}, whose errors are the median of all"
    text = (
        f"What each source adds to the standard errors{typical}. More periods reduce the noise of "
        "the recording, and a longer calibration or a second resistor the error of the driver. "
        "What stands behind “if” was not stated: such an error of the instrument would change the "
        "elements by this size, and is in no standard error."
    )
    budget = dataclasses.replace(budget, names=tuple(map(as_symbol, budget.names)))
    text = " ".join(filter(None, [text, budget.largest]))
    rows_shown = tuple(map(tuple, budget._overview().rows))
    return [Section("Budget", text, (Table(("source", *budget.names), rows_shown),))]


def _of(found: StudyFits, study: Study, row: int, path: str) -> Budget | None:
    """The budget of a fit; None if its driver is no longer known."""
    recording, other = study[path], found.settings.driver if found.settings else ""
    names = calibrations_of(found, study, recording)
    driver = found.drivers.get(names)
    if isinstance(driver, ContinuousDriver) and not isinstance(driver, HarmonicDriver):
        with read(other) if other else contextlib.nullcontext(study) as known:
            driver = with_harmonics(driver, [known[name] for name in names])
    if not isinstance(driver, HarmonicDriver):
        return None
    return found.fits[row].budget(recording, driver)
