"""The report on a study: one page with results, errors, failures and methods.

The page needs no network and can be printed. It has a few megabytes at most for any number of fits.
"""

import dataclasses
import os
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from etid.circuits.circuit import AbstractCircuit
from etid.plotting.layout import FINGERTIP, Layout
from etid.plotting.style import listed
from etid.precision import in_float64
from etid.printing import as_symbol, several
from etid.recordings.fields import DESCRIBING
from etid.recordings.study import Study
from etid.report import figures
from etid.report import tables as study_tables
from etid.report.budget import budgets
from etid.report.html import Picture, Section, Table, write_page
from etid.report.methods import methods_section, succeeded, words
from etid.report.waveforms import find, relative_stderr, waveforms
from etid.results.fits import Fits
from etid.results.study_fits import StudyFits
from etid.results.verdicts import USABLE, message, own_part


@np.errstate(all="ignore")  # a fit that failed may hold any number
@in_float64
def write_report(
    fits: str | os.PathLike[str] | StudyFits | Fits,
    page: str | os.PathLike[str],
    *,
    recordings: str | os.PathLike[str] | Study | None = None,
    circuit: type[AbstractCircuit] | None = None,
    layout: Layout = FINGERTIP,
) -> None:
    """Write a report on the fits of a study: one HTML page that needs no other file.

    The report shows the verdicts and the drivers. It separates the variation between subjects and
    recordings from the errors. It has tables, distributions, the budget of a typical recording, the
    worst fits with their waveforms, and a methods section with BibTeX.

    Args:
        fits: File of fits, or the result of an identification.
        page: HTML file to write.
        recordings: The recordings or their file, for the waveforms of the worst fits. If not given,
            `write_report` looks at the path that is stored with the fits, then in the folder of the
            file of fits. If it does not find the recordings, the report says so.
        circuit: As in `Fits.read`.
        layout: Places of the electrodes, for maps of the elements; default: those of the paper's
            display, `E1` to `E98`. Fits of electrodes without a place have no maps.

    Raises:
        ValueError: `fits` is not a file of fits, holds no fit, or fits of measured impedances, or
            `page` would replace a file that is read.
        RecordingError: `recordings` is not a file of recordings.
    """
    file = None
    if isinstance(fits, StudyFits):
        found = fits
    elif isinstance(fits, Fits):
        found = StudyFits(fits, {}, {})
    else:
        file = pathlib.Path(fits)
        found = StudyFits.read(file, circuit)
    if not len(found.fits):
        raise ValueError(f"{file or 'fits'}: there is no fit to report on")
    if found.fits.fit.of_impedance:
        raise ValueError(
            f"{file or 'fits'}: a report is on recordings, and these are fits of measured "
            "impedances; use fit.report() for each, or etid export for a table"
        )
    for read in (file, None if isinstance(recordings, Study) else recordings):
        if read and all(map(os.path.exists, (read, page))) and os.path.samefile(read, page):
            raise ValueError(f"{page} would replace a file that is read; name another page")
    study, problem = find(found, file, recordings)
    try:
        drawn, budget = waveforms(found, study, problem), budgets(found, study)
    finally:
        if study is not None and study is not recordings:
            study.close()
    if len(found.fits) == 1:
        sections = [
            _single(found.fits),
            drawn,
            *budget,
            _drivers(found),
            methods_section(found),
        ]
    else:
        groups = found.fits.summary("subject", "condition")
        sections = [
            _verdicts(found.fits),
            _drivers(found),
            _elements(found.fits, groups),
            _subjects(found.fits, groups),
            *_electrodes(found.fits, layout),
            _quality(found.fits),
            *budget,
            _recordings(found.fits, drawn),
            drawn,
            methods_section(found),
        ]
    name = "fits" if file is None else file.name
    write_page(page, f"Report on {name}", summary(found), sections)


def summary(found: StudyFits) -> str:
    """Two sentences on the study."""
    fits, settings = found.fits, found.settings
    if len(fits) == 1:
        path = str(fits.labels["path"][0])
        kind, method = type(fits.circuit).__name__, words(fits.fit.method)
        text = f"One recording, {path or 'without a path'}, "
        if not listed(fits[0]):
            return f"{text}unusable: {fits.verdicts[0]}."
        return f"{text}identified as {kind} by {method}."
    source = pathlib.Path(settings.source).name if settings is not None else ""
    text = f"{several(len(fits), 'recording')}{f' of {source}' if source else ''}"
    for name, field in DESCRIBING.items():
        column = fits.labels[name]
        if field.type == "number":
            known = column[np.isfinite(column)]
            if known.size:
                text += f", {name} {known.min():.4g} to {known.max():.4g} {field.unit}"
        elif name != "trial":
            count = len(set(map(str, column)) - {""})
            text += f", {several(count, name)}" if count else ""
    text += f", identified as {type(fits.circuit).__name__} by {words(fits.fit.method)}. "
    return text + succeeded(fits)


def _verdicts(fits: Fits) -> Section:
    text = f"Every recording ends in a verdict; {' and '.join(USABLE)} ones can be used."
    return Section("Verdicts", text, (study_tables.verdicts(fits),))


def _drivers(found: StudyFits) -> Section:
    if found.by_current:
        text = "The loads were identified from their measured currents, which needs no driver."
        return Section("Drivers", text)
    if not (found.drivers or found.failures):
        text = "These fits do not say with which driver they were made."
        return Section("Drivers", warning=text)
    text = (
        "The source impedance Z_th was identified from calibrations with known resistors R_L. Its "
        "error passes into all fits made with it. χ² is 1 if the residual is noise only."
    )
    count = len(found.drivers) + len(found.failures)
    if count > study_tables.ROWS:
        text += f" {study_tables.ROWS} of {count} are shown, unusable ones first."
    most, pictures = 4, ()  # drivers in one diagram
    named = {", ".join(paths): driver for paths, driver in found.drivers.items()}
    shown = dict(sorted(named.items())[:most])
    if shown:
        caption = "Source impedance"
        if len(found.drivers) > most:
            caption += f" of the first {most} of {len(found.drivers)} drivers"
        caption += ", with bands of two standard errors where the method has one."
        alt = f"Bode diagram of Z_th of {', '.join(shown)}."
        pictures = (Picture(caption, figures.drivers(shown), alt),)
    table = study_tables.drivers(found.drivers, found.failures)
    return Section("Drivers", text, (table,), pictures)


def _elements(fits: Fits, groups: Sequence[Mapping[str, Any]]) -> Section:
    found = study_tables.components(fits, groups)
    if not found:
        return Section("Elements", warning="No fit can be used: there is nothing to average.")
    units = fits.circuit.units()
    text = (
        "How large each element is, how much it varies, and how well one fit knows it. The last "
        "four columns are in per cent of the median:\n\n"
        "Between subjects: how much the subjects differ, the standard deviation of their "
        "medians.\n\n"
        "Between recordings: how much the recordings of one subject differ beyond the noise, "
        "sqrt(spread² - own²); 0 if noise explains all of the spread.\n\n"
        "Own error: the standard error of one fit from the noise of its recording. A mean of more "
        "recordings has less of it.\n\n"
        "Shared error: the standard error of one fit from the driver. All recordings with that "
        "driver share it: their spread does not show it, and more recordings do not reduce it.\n\n"
        "The last three are medians over the subjects. A cell is empty if the study cannot "
        "determine the number."
    )
    text += _pooled(fits)
    conditions = len(set(map(str, fits.labels["condition"])))
    if conditions > study_tables.CONDITIONS:
        text += (
            f" The {study_tables.CONDITIONS} most frequent of {conditions} conditions are shown."
        )
    shown = "each condition"
    if conditions > figures.SERIES:
        shown = f"the {figures.SERIES} most frequent conditions"
    pictures = (
        Picture(
            f"Part of the usable fits below a value, for {shown} (number of fits).",
            figures.distributions(fits),
            f"Distribution functions of {', '.join(map(as_symbol, units))} by condition; quantiles "
            "are in the table.",
            whole=True,
        ),
        Picture(
            f"What varies and what is error, in per cent of the median, for {shown}. Zeros are "
            "left out.",
            figures.components(found, study_tables.frequent(fits, figures.SERIES)),
            "Between subjects, between recordings, own error and shared error of each element by "
            "condition, on a logarithmic scale; the numbers are in the table.",
            whole=True,
        ),
    )
    return Section("Elements", text, (study_tables.show_components(found, units),), pictures)


def _subjects(fits: Fits, groups: Sequence[Mapping[str, Any]]) -> Section:
    good = fits.usable()
    text = (
        "Medians of the usable fits, to two digits of their standard error. In per cent of the "
        "median: the variation between the recordings, their own error and their shared error."
    )
    pictures = ()
    if len(good) > 300:
        caption = (
            "Each subject's median, the middle half of the usable fits (thick) and nine tenths "
            "of them (thin)."
        )
        count = len({str(group["subject"]) for group in groups})
        if count > figures.CROWD:
            caption += (
                f" Of {count} subjects {figures.CROWD} are drawn, evenly spaced in the order "
                "of their medians."
            )
        alt = "Medians and quantiles of each element by subject and condition."
        pictures = (Picture(caption, figures.by_subject(fits), alt, whole=True),)
    elif len(good):
        caption = "All fits with their standard errors; hollow if unusable."
        alt = "Each element of each fit by subject and condition, with standard errors."
        pictures = (Picture(caption, figures.each_fit(fits), alt, whole=True),)
    more, table = _grouped(fits, groups, ("subject", "condition"))
    return Section("Subjects", text + _pooled(fits) + more, (table,), pictures)


def _pooled(fits: Fits) -> str:
    """A sentence on what a group of one subject in one condition holds together."""
    names = [f"{name}s" for name in fits.pooled("subject", "condition")]
    return f" Each subject's {' and '.join(names)} are pooled." if names else ""


def _electrodes(fits: Fits, layout: Layout) -> list[Section]:
    names = set(map(str, fits.labels["electrode"])) - {""}
    if len(names) < 2:
        return []
    by = ("electrode", "condition")
    more, table = _grouped(fits, fits.summary(*by), by)
    if not names <= set(layout.electrodes):
        text = (
            "The same by electrode. Subjects are part of what varies here. For maps, give the "
            "places of the electrodes: etid report --layout FILE."
        )
        return [Section("Electrodes", text + more, (table,))]
    shown, count = figures.mapped(fits)
    text = (
        "Median of the usable trials of each electrode, on one scale. The table has the same "
        "by electrode; subjects are part of what varies in it."
    )
    if count > figures.MAPS:
        text += f" {figures.MAPS} of {count} maps are drawn; etid.plot(fits, map=…) draws others."
    pictures = tuple(
        Picture(
            f"{as_symbol(name)} at each electrode; an electrode without a usable fit has the mark "
            "of its verdict.",
            figures.electrodes(shown, name, layout),
            f"Maps of {as_symbol(name)} by subject, session, site and condition.",
            whole=True,
        )
        for name in fits.circuit.units()
    )
    folded = dataclasses.replace(table, folded=True)
    return [Section("Electrodes", text + more, (folded,), pictures)]


def _grouped(
    fits: Fits, rows: Sequence[Mapping[str, Any]], by: tuple[str, ...]
) -> tuple[str, Table]:
    """The table of a summary by labels, and what to say if it does not show all groups."""
    text = ""
    if len(rows) > study_tables.ROWS:
        call = ", ".join(f'"{name}"' for name in by)
        text = (
            f" {study_tables.ROWS} of {len(rows)} groups are shown, those with the largest share "
            f"of unusable fits; etid.Fits.summary({call}) has all."
        )
    return text, study_tables.groups(rows, by, fits.circuit.units())


def _quality(fits: Fits) -> Section:
    good, failed = fits.usable(), int(np.sum(~fits.fit.usable))
    pictures = ()
    if len(good):
        caption = (
            "Usable fits: χ² per degree of freedom, 1 (dotted) where the residual is noise, "
            "and the standard error of the element that is known worst."
        )
        alt = "Histograms of χ² and of the largest relative standard error."
        drawn = figures.quality(np.asarray(good.chi2), relative_stderr(good))
        pictures = (Picture(caption, drawn, alt, whole=True),)
    text = "All fits are usable."
    if failed:
        text = (
            f"{several(failed, 'fit')} cannot be used: the tables of verdicts and recordings say "
            "why."
        )
    return Section("Quality", text, (), pictures)


def _single(fits: Fits) -> Section:
    """The page about one recording begins with its verdict and its elements."""
    verdict = str(fits.verdicts[0])
    text = message(verdict) if verdict != "successful" else "The fit is successful."
    if chi2 := study_tables.significant(float(fits.chi2[0]), 3):
        text += f" χ² per degree of freedom is {chi2}; it is 1 if the residual is noise."
    tables = ()
    if listed(fits[0]):
        text += (
            " Own error: standard error from the noise of the recording. Shared error: standard "
            "error from the driver."
        )
        tables = (study_tables.single(fits),)
    said = own_part(verdict, str(fits.notes[0]))
    if not fits[0].usable:
        return Section("Result", text, tables, warning=said)
    outside = fits[0].outside  # in a note of `out_of_bounds` it stands already
    text = " ".join(filter(None, (text, said, outside)))
    return Section("Result", text, tables)


def _recordings(fits: Fits, waveforms: Section) -> Section:
    links = {}
    for picture in waveforms.pictures:
        row = int(picture.anchor.removeprefix("waveform-"))
        links[str(fits.labels["path"][row])] = picture.anchor
    text = "Click a heading to sort. A recording with a link has its waveform below."
    if len(fits) > study_tables.SINGLE:
        text += (
            f" {study_tables.SINGLE} of {len(fits)} recordings are shown: the unusable ones, "
            "and every few of the others. The file of fits has all."
        )
    return Section("Recordings", text, (study_tables.recordings(fits, links),))
