"""The report of a study: its numbers, what it leaves out, and the page as a browser sees it."""

import base64
import dataclasses
import hashlib
import html.parser
import pathlib
import re
import shutil
import warnings
from typing import cast

import h5py
import jax.numpy as jnp
import numpy as np
import pytest

import etid
from etid import cli
from etid.estimators import registry
from etid.files import exporting
from etid.identify.options import Options
from etid.report import figures, methods, tables
from etid.report.budget import budgets
from etid.report.waveforms import find, picture, relative_stderr, worst
from etid.results.driver import ContinuousDriver, DiscreteDriver
from etid.results.study_fits import StudyFits
from etid.results.verdicts import message
from etid.selection.driver_order import TriedOrder, evidence
from etid.simulation.scenes import Scene, Trial
from etid.simulation.transformer import ResistorLoad, SkinLoad
from tests import pictures
from tests.chromium import chromium

EXAMPLE = pathlib.Path(__file__).parents[1] / "data_schema" / "example.h5"
EVIL = r"<script>document.title='$\broken{$'</script>"
TRUE = {"r_s": 33.4e3, "r_p": 186e3, "c_p": 0.12e-9}
PATHS = [*(f"loaded/{i}" for i in range(5)), r"loaded/$\frac$"]
OWN, SHARED = 0.01, 0.02  # standard errors of all elements of the fits made here, relative


def fits_of(values, verdicts, **labels):
    """Fits by hand, of elements in units of `TRUE`, with errors `OWN` and `SHARED`."""
    count = len(verdicts)
    circuit = etid.SkinRC.of_fit(np.asarray(values) * np.array(list(TRUE.values()))[:, None])
    fit = pictures.fit(np.array(verdicts, object), circuit, OWN, SHARED)
    chi2 = np.where(np.asarray(verdicts) == "misfit", 7.0, 1.0) + 0.01 * np.arange(count)
    labels = {"path": np.array([f"loaded/{i}" for i in range(count)])} | labels
    fits = pictures.fits_of(dataclasses.replace(fit, chi2=chi2), **labels)
    return dataclasses.replace(fits, notes=np.array([message(name) for name in verdicts]))


@pytest.fixture(scope="module")
def driver():
    orders = [TriedOrder(4, 9e3, 10, 3000, 90.0, False), TriedOrder(5, 3e3, 12, 3000, 4.0, True)]
    return dataclasses.replace(pictures.driver(), tried=evidence(orders))


@pytest.fixture(scope="module")
def study_file(tmp_path_factory):
    trials = tuple(Trial(PATHS[i], SkinLoad(**TRUE)) for i in range(6))
    scene = Scene(trials, (Trial("calibration/0", ResistorLoad(98.8e3)),), samples=4000)
    file = tmp_path_factory.mktemp("report") / "study.h5"
    scene.simulate(seed=1).write(file)
    return file


@pytest.fixture(scope="module")
def found(study_file, driver):
    """Six fits of one subject with a bad name and one with a good one."""
    fits = fits_of(
        [1.0, 1.1, 0.9, 1.0, 1.3, np.nan],
        ["successful"] * 4 + ["misfit", "flat"],
        path=np.array(PATHS),
        subject=np.array([EVIL, "s02"] * 3),
        condition=np.array([r"dry & $\hot$"] * 6),
    )
    with etid.read(study_file) as study:
        settings = Options((etid.SkinRC(),)).settings(study, 6)
    drivers = {("calibration/0",): driver}
    return StudyFits(fits, drivers, {("calibration/1",): "r_load <b>is</b> missing"}, settings)


@pytest.fixture(scope="module")
def page(found, study_file):
    """The report on these fits."""
    etid.write_report(found, study_file.with_name("page.html"))
    return study_file.with_name("page.html")


class _Read(html.parser.HTMLParser):
    """Elements, attributes and text of a page; each element is closed where it was opened."""

    def __init__(self, page):
        super().__init__()
        self.elements, self.attributes, self.text, self.open = [], [], "", []
        self.feed(page.read_text(encoding="utf-8"))
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.elements.append(tag)
        self.attributes += attrs
        if tag not in ("meta", "img"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data


def test_names_and_notes_of_a_file_are_text_and_nothing_else(page, found):
    seen = _Read(page)
    assert EVIL in seen.text
    assert "r_load <b>is</b> missing" in seen.text
    assert not {"b", "link", "iframe"} & set(seen.elements)
    assert seen.elements.count("script") == 1  # that of etid, and its hash allows no other
    script = (pathlib.Path(etid.__file__).parent / "report/templates/table.js").read_text("utf-8")
    text = page.read_text("utf-8")
    assert f"<script>{script}</script>" in text
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert f"script-src 'sha256-{digest}'\"" in text
    assert not [name for name, _ in seen.attributes if name.startswith("on")]
    targets = [value for name, value in seen.attributes if name in ("src", "href")]
    assert all(value.startswith(("data:", "#")) for value in targets)
    anchors = {value for name, value in seen.attributes if name == "id"}
    assert {value[1:] for value in targets if value.startswith("#")} == anchors
    assert {f"waveform-{i}" for i in range(len(found.fits))} <= anchors
    assert seen.elements.count("img") == len([n for n, v in seen.attributes if n == "alt" and v])


def test_worst_fits_are_drawn_with_what_was_measured(page):
    text = _Read(page).text
    assert "loaded/4: misfit (unusable). χ² 7.04, R_s 43.4" in text
    assert f"{PATHS[5]}: flat (unusable). No prediction: no circuit was identified." in text
    assert "loaded/3: successful (largest χ² among the usable)" in text
    assert "loaded/0: successful (largest standard error among the usable)" in text
    assert "not found" not in text
    assert "has changed" not in text


def test_fits_from_a_current_are_drawn_beside_an_unloaded_voltage_too(found):
    recording = pictures.with_current()
    fits = fits_of([1.0], ["successful"], path=np.array([recording.path]))
    by_current = dataclasses.replace(found, fits=fits, drivers={}, failures={})
    shown = picture(by_current, etid.Study.from_recordings([recording]), 0, "")
    assert shown is not None
    assert "predicted" in shown.alt
    assert "No prediction" not in shown.caption


def test_recordings_are_looked_for_where_they_were_and_beside_the_fits(found, study_file, tmp_path):
    def look(given=None, fits=found):
        study, problem = find(fits, tmp_path / "fits.h5", given)
        there = study is not None and fits.fits.labels["path"][4] in study
        if study is not None and study is not given:
            study.close()
        return there, problem

    old, new = tmp_path / "old" / "study.h5", tmp_path / "study.h5"
    moved = dataclasses.replace(found.settings, source=str(old))
    elsewhere = dataclasses.replace(found, settings=moved)
    assert look() == (True, "")
    there, problem = look(fits=elsewhere)
    assert not there
    assert problem.startswith(f"The recordings were not found: there is no {old} and {new}")
    shutil.copy(study_file, new)
    assert look(fits=elsewhere) == (True, "")
    with h5py.File(new, "a") as opened:
        opened["more"] = np.ones(1000)
    there, problem = look(fits=elsewhere)
    assert there
    assert "has changed since the fits were made" in problem
    new.write_bytes(b"damaged")
    there, problem = look(fits=elsewhere)
    assert not there
    assert "is not an HDF5 file" in problem
    with etid.read(study_file) as study:
        assert look(given=study, fits=elsewhere) == (True, "")


def test_fits_without_settings_are_reported_with_what_they_lack(found, tmp_path):
    found.fits.write(tmp_path / "fits.h5")
    assert StudyFits.read(tmp_path / "fits.h5").settings is None
    etid.write_report(tmp_path / "fits.h5", tmp_path / "page.html")
    text = _Read(tmp_path / "page.html").text
    assert "These fits do not say with which driver they were made." in text
    assert "The fits do not say where their recordings are." in text
    assert "This file of fits does not say from which recordings" in text


def test_a_file_of_fits_gives_back_drivers_and_settings(found, driver, tmp_path):
    found.write(tmp_path / "fits.h5")
    again = StudyFits.read(tmp_path / "fits.h5")
    assert again.settings == found.settings
    assert again.failures == found.failures
    (stored,) = again.drivers.values()
    frequency = jnp.geomspace(60.0, 1e5, 20)
    for name in ("response", "response_stderr"):
        expected = np.asarray(getattr(driver, name)(frequency))
        np.testing.assert_array_equal(np.asarray(getattr(stored, name)(frequency)), expected)
    assert (stored.verdict, stored.method, stored.order) == ("successful", driver.method, 5)
    assert isinstance(stored, ContinuousDriver)
    assert stored.tried.orders == [4, 5]
    for name in ("bic", "missing_pole", "adequate"):
        one, other = (np.asarray(getattr(of.tried, name)) for of in (stored, driver))
        np.testing.assert_array_equal(one, other)
    again.write(tmp_path / "again.h5")
    assert (tmp_path / "again.h5").read_bytes() == (tmp_path / "fits.h5").read_bytes()
    assert etid.Fits.read(tmp_path / "fits.h5").counts() == found.fits.counts()
    exporting.export_fits(tmp_path / "fits.h5", tmp_path / "fits.csv")  # drivers are no column
    assert len((tmp_path / "fits.csv").read_text().splitlines()) == 1 + len(found.fits)


def test_a_driver_without_a_continuous_impedance_is_kept_as_well(
    found, driver, study_file, tmp_path
):
    plain = pictures.as_kind(driver, DiscreteDriver)
    dataclasses.replace(found, drivers={("calibration/0",): plain}).write(tmp_path / "fits.h5")
    again = StudyFits.read(tmp_path / "fits.h5")
    assert [type(of) for of in again.drivers.values()] == [DiscreteDriver]
    with etid.read(study_file) as study:
        shown = picture(again, study, 4, "misfit")
    assert shown is not None
    assert "No prediction: this driver was identified by maximum_likelihood, which" in shown.caption


def test_spread_of_subjects_and_recordings_and_errors_are_told_apart():
    factors = np.array([0.5, 1.0, 2.0])  # of three subjects
    trials = np.array([-0.06, -0.02, 0.02, 0.06])
    values = (factors[:, None] * (1 + trials)).ravel()
    fits = fits_of(
        values, ["successful"] * 12,
        subject=np.repeat(["a", "b", "c"], 4), condition=np.full(12, "dry"),
    )  # fmt: skip
    groups = fits.summary("subject", "condition")
    for one in tables.components(fits, groups):
        assert (one.subjects, one.usable) == (3, 12)
        assert one.median == pytest.approx(TRUE[one.name])
        assert one.parts["between subjects"] == pytest.approx(np.std(factors, ddof=1))
        # The median of four is their mean here, and so is the median of their errors.
        # But `between` subtracts the mean of their squares, and they grow with the values.
        within = np.sqrt(np.var(trials, ddof=1) - OWN**2 * np.mean((1 + trials) ** 2))
        assert one.parts["between recordings"] == pytest.approx(within, rel=1e-9)
        assert list(one.parts.values())[2:] == pytest.approx([OWN, SHARED])


@pytest.mark.parametrize(
    ("values", "subjects"),
    [([1.0], [""]), ([1.0, np.inf], ["a", "b"])],  # the second in a damaged file
)
def test_one_recording_and_an_infinite_element_tell_no_spread(values, subjects):
    fits = fits_of(values, ["successful"] * len(values), subject=np.array(subjects))
    found = tables.components(fits, fits.summary("subject", "condition"))
    for one in found:
        assert np.isnan(one.parts["between subjects"])
        assert np.isnan(one.parts["between recordings"])
        assert list(one.parts.values())[2:] == pytest.approx([OWN, SHARED])
    for row in tables.show_components(found, fits.circuit.units()).rows:
        assert row[6:] == ("", "", "1.0", "2.0")


def test_the_variation_between_subjects_is_relative_to_the_median_that_the_table_prints():
    subjects = np.array(["a", "b", "c", "c", "c"])
    fits = fits_of([1.0, 2.0, 4.0, 4.0, 4.0], ["successful"] * 5, subject=subjects)
    for one in tables.components(fits, fits.summary("subject", "condition")):
        between = np.std([1.0, 2.0, 4.0], ddof=1) * TRUE[one.name]
        assert one.parts["between subjects"] * one.median == pytest.approx(between)


def test_a_distribution_has_every_fit():
    """Of five fits the quantile at 3/5 was the fourth, for 3/5 is 0.6000000000000001."""
    fits = fits_of([1.0, 1.1, 1.2, 1.3, 1.4], ["successful"] * 5)
    [line] = pictures.of_report(figures.distributions, fits).axes[0].lines
    values = np.asarray(fits.circuit.r_s)[[0, 0, 1, 2, 3, 4]] / 1e3
    np.testing.assert_allclose(np.asarray(line.get_xdata()), values)
    np.testing.assert_allclose(np.asarray(line.get_ydata()), [0, 20, 40, 60, 80, 100])


def test_groups_are_in_the_order_of_their_numbers():
    electrodes = np.array(["E12", "E3", "E7"])
    fits = fits_of([1.0, 2.0, 3.0], ["successful"] * 3, electrode=electrodes, subject=electrodes)
    assert [row["electrode"] for row in fits.summary("electrode")] == ["E3", "E7", "E12"]
    for figure in (etid.plotting.figure_of(fits), pictures.of_report(figures.by_subject, fits)):
        ticks = figure.axes[-1].get_xticklabels()
        assert [tick.get_text() for tick in ticks] == ["E3", "E7", "E12"]


def test_figures_of_a_report_are_whole_and_clear():
    fits = fits_of(
        np.linspace(1.0, 1.3, 12), ["successful"] * 12, subject=np.repeat(["a", "b"], 6),
        condition=np.array(["dry", "damp", "after washing"] * 4),
    )  # fmt: skip
    both = np.linspace(0.9, 1.03, 5), np.linspace(3.19e-3, 3.34e-3, 5)
    drawn = [
        pictures.of_report(figures.quality, *both),
        pictures.of_report(figures.distributions, fits),
        pictures.of_report(figures.by_subject, fits),
        pictures.of_report(figures.components, *pictures.components(fits)),
    ]
    assert [pictures.faults(figure) for figure in drawn] == [[]] * 4
    assert [len(figure.legends) for figure in drawn] == [0, 1, 1, 1]


def test_the_worst_are_of_every_verdict_and_of_every_reason():
    verdicts = ["successful"] * 20 + ["flat"] * 9 + ["misfit"] * 3 + ["saturated"]
    fits = fits_of(np.linspace(1.0, 2.0, 33), verdicts)
    cov = fits.cov.copy()
    cov[5:7] *= 4.0
    fits = dataclasses.replace(fits, fit=dataclasses.replace(fits.fit, cov=cov))
    rows = list(worst(fits))
    assert len(rows) == len(set(rows)) == 10
    # In turn flat, misfit, saturated, the largest χ² of each first: that grows with the row.
    assert rows[:6] == [28, 31, 32, 27, 30, 26]
    assert rows[6:8] == [19, 18]  # the largest χ² among the usable
    assert sorted(rows[8:]) == [5, 6]  # the largest standard errors
    assert list(worst(fits_of([1.0], ["successful"]))) == [0]


def test_any_labels_and_elements_without_success_are_drawn_without_a_warning(tmp_path):
    """The font of the pictures lacks some letters, and only usable fits are positive."""
    subjects = np.array(["\u88ab\u9a13\u8005", "\u0633", "s" * 1300, "s01"])
    verdicts = ["successful", "successful", "insensitive", "unstable"]
    fits_of([1.0, 1.1, 0.0, -3e4], verdicts, subject=subjects, trial=subjects).write(
        tmp_path / "fits.h5"
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        etid.write_report(etid.Fits.read(tmp_path / "fits.h5"), tmp_path / "page.html")
    assert str(subjects[0]) in _Read(tmp_path / "page.html").text


def test_a_file_with_an_element_of_zero_is_refused(tmp_path):
    fits_of(np.ones(3), ["successful"] * 3).write(tmp_path / "fits.h5")
    with h5py.File(tmp_path / "fits.h5", "r+") as file:
        cast(h5py.Dataset, file["r_s"])[1] = 0.0
    with pytest.raises(etid.RecordingError, match=r"fits.h5, r_s: 0 is no value of an element"):
        etid.Fits.read(tmp_path / "fits.h5")


@pytest.mark.parametrize(
    ("shown", "text"),
    [
        (tables.significant(0.01234), "0.012"),
        (tables.significant(123.4), "120"),
        (tables.significant(5.0), "5.0"),
        (tables.significant(186.0, 4), "186.0"),
        (tables.significant(0.9999, 3), "1.00"),
        (tables.significant(0.0), "0"),
        (tables.significant(3e7), "3.0e+07"),
        (tables.significant(np.nan), ""),
        (tables.significant(np.inf), ""),
        (tables.element(186e3, 1e3, 1e3), "186.0 ± 1.0"),
        (tables.element(186e3, 400e3, 1e3), "not determined (± 400)"),
        (tables.element(186e3, np.inf, 1e3), "not determined"),
        (tables.element(186e3, np.nan, 1e3), "186"),
        (tables.element(np.nan, np.nan, 1e3), ""),
    ],
)
def test_numbers_are_rounded_to_two_digits_and_not_told_if_they_are_not_determined(shown, text):
    assert shown == text


def test_large_studies_are_condensed_and_say_so(tmp_path, monkeypatch):
    monkeypatch.setattr(tables, "SINGLE", 650)
    count = tables.SINGLE + 200
    rng = np.random.default_rng(1)
    fits = fits_of(
        rng.lognormal(0.0, 0.3, count), rng.choice(["successful", "misfit"], count, p=[0.9, 0.1]),
        subject=np.array([f"s{i:04d}" for i in np.arange(count) // 5]),
        condition=rng.choice(list("abcdefg"), count), electrode=rng.choice(list("xy"), count),
    )  # fmt: skip
    etid.write_report(fits, tmp_path / "page.html")
    assert (tmp_path / "page.html").stat().st_size < 3e6
    page = _Read(tmp_path / "page.html")
    groups = len(fits.summary("subject", "condition"))
    assert f"{tables.ROWS} of {groups} groups are shown" in page.text
    assert re.search(r"Quality\s+\d+ fits cannot be used", page.text)
    assert f"Of {count // 5} subjects {figures.CROWD} are drawn" in page.text
    assert page.elements.count("tr") < 5 * tables.ROWS + tables.SINGLE
    assert f"{tables.SINGLE} of {count} recordings are shown" in page.text
    assert "For maps, give the places of the electrodes: etid report --layout FILE." in page.text


def test_electrodes_with_a_place_have_a_map_of_each_element_above_their_folded_table(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(figures, "MAPS", 2)
    file, places = tmp_path / "fits.h5", tmp_path / "places.csv"
    names = np.array(["A", "B"] * 3)
    fits_of(
        np.linspace(1.0, 2.0, 6), ["successful"] * 5 + ["flat"], electrode=names,
        session=np.repeat(["d1", "d2", "d3"], 2),
    ).write(file)  # fmt: skip
    places.write_text("electrode,x,y\nA,0,0\nB,0.002,0\n", "utf-8")
    assert cli.main(["report", str(file), "--layout", str(places)]) == 0
    page = (tmp_path / "fits.html").read_text("utf-8")
    drawn = re.findall(r'alt="Maps of (\w+)', page)
    assert drawn == ["R_s", "R_p", "C_p"]
    assert "2 of 3 maps are drawn" in page
    assert page.index("Maps of C_p") < page.index("<summary>Table of 2 rows</summary>")


def test_the_table_of_few_subjects_is_not_folded(page):
    _, subjects = page.read_text("utf-8").split(">Subjects</h2>")
    table, _ = subjects.split("</section>", 1)
    assert "<table" in table
    assert "<details" not in table


def test_no_success_at_all_and_no_fit_at_all(tmp_path):
    etid.write_report(fits_of([np.nan] * 2, ["flat"] * 2), tmp_path / "page.html")
    assert "No fit can be used" in _Read(tmp_path / "page.html").text
    with pytest.raises(ValueError, match="no fit to report on"):
        etid.write_report(fits_of(np.ones(0), []), tmp_path / "page.html")


def test_one_recording_gives_a_page_about_one_recording(tmp_path):
    one = fits_of([1.0], ["successful"])
    fit = dataclasses.replace(
        one.fit, circuit=etid.Resistor(one.circuit.r_p), cov=one.cov[:, 1:2, 1:2],
        shared_cov=one.fit.shared_cov[:, 1:2, 1:2],
    )  # fmt: skip
    etid.write_report(dataclasses.replace(one, fit=fit), tmp_path / "page.html")
    text = _Read(tmp_path / "page.html").text
    assert "One recording, loaded/0, identified as Resistor" in text
    assert "The load is the circuit Resistor, Z_L = R." in text
    assert "186.0 ± 4.2" in text
    for of_others in ("Subjects", "Between recordings", "Worst fits", "r_s", "R_s"):
        assert of_others not in text


def test_one_recording_without_elements_has_no_empty_numbers(tmp_path):
    etid.write_report(fits_of([np.nan], ["saturated"]), tmp_path / "page.html")
    read = _Read(tmp_path / "page.html")
    assert "One recording, loaded/0, unusable: saturated." in read.text
    assert "The fit is unusable: saturated." in read.text
    assert "medians" not in read.text
    assert "is ;" not in read.text
    assert "table" not in read.elements


CITED = {  # what a reader sees, and the key of the entry that it must have
    "Pintelon and Schoukens, 2012": "pintelon2012",
    "Ljung, 1999": "ljung1999",
    "McBride": "steiglitz1965",
    "Söderström, 2007": "soderstrom2007",
    "White, 1980": "white1980",
    "Kennedy and O'Hagan, 2001": "kennedy2001",
    "Patterson and Thompson, 1971": "patterson1971",
    "Bell and Cathey, 1993": "bell1993",
    "Willsky and Jones, 1976": "willsky1976",
    "Lowry et al., 1992": "lowry1992",
    "Rader et al., 2024": "optimistix2024",
    "Bradbury et al., 2018": "jax2018",
}


def test_the_methods_are_told_in_120_words_and_in_full_behind_them(found, study_file, page):
    section = methods.methods_section(found)
    assert len(section.text.split()) <= 120
    for words in ("maximum likelihood", "SkinRC", "order 5", "98.8 kΩ", "4 fits (66.7 %)"):
        assert words in section.text
    _, full = page.read_text("utf-8").split("<summary>In full</summary>")
    assert section.code.splitlines()[0] in full
    with etid.read(study_file) as study:
        settings = Options((etid.SkinRC(),), order="auto").settings(study, 6)
    by_calibrations = methods.methods_section(dataclasses.replace(found, settings=settings))
    assert "Schwarz's criterion (1978)" in by_calibrations.details
    assert "{schwarz1978," in by_calibrations.code


def test_the_budget_is_that_of_the_fit_with_the_median_error(tmp_path):
    with etid.read(EXAMPLE) as study:
        found = etid.identify_study(study)
        found.write(tmp_path / "fits.h5")
        errors = relative_stderr(found.fits)
        row = int(np.argsort(errors)[2])
        path = found.fits.labels["path"][row]
        wanted = found.fits[row].budget(study[path], *found.drivers.values())
        again = StudyFits.read(tmp_path / "fits.h5")
        for of in (found, again):  # a file holds no harmonics of the calibrations
            [section] = budgets(of, study)
            assert path in section.text
            [table] = section.tables
            assert table.rows == tuple(wanted._overview().rows)
        assert budgets(found, None) == []


@pytest.mark.parametrize("method", ["maximum_likelihood", "output_error", "joint"])
def test_methods_of_fits_from_a_current_tell_of_no_driver(found, method):
    fits = dataclasses.replace(found.fits, fit=dataclasses.replace(found.fits.fit, method=method))
    by_current = dataclasses.replace(found, fits=fits, drivers={}, failures={})
    section = methods.methods_section(by_current)
    for words in ("Z_th", "driver", "calibration", "resistors", "joint", "gains", "McBride"):
        assert words not in section.text + section.details
    assert "scales of current and voltage" in section.details
    assert "steiglitz1965" not in section.code


def test_methods_count_the_recordings(found):
    one = dataclasses.replace(found, fits=found.fits.take(np.array([0])))
    for of, words in (
        (one, "The recording of study.h5 was"),
        (found, "The 6 recordings of study.h5 were"),
    ):
        assert f"{words} identified with etid" in methods.methods_section(of).details


def test_methods_count_the_calibrations(found):
    alone = dataclasses.replace(found, failures={})
    for of, calibrations in ((alone, "a calibration"), (found, "calibrations")):
        words, section = f"from {calibrations} with a known", methods.methods_section(of)
        assert words in section.text
        assert words in section.details


@pytest.mark.parametrize("method", [*registry.names(), "joint", "online"])
def test_methods_cite_what_they_name_and_say_the_settings(found, method):
    fit = dataclasses.replace(found.fits.fit, method=method)
    settings = dataclasses.replace(found.settings, order=4)
    told = etid.Instrument(gain=1e-3, r_load=1e-3).as_arrays()
    by = method
    drivers = {
        paths: dataclasses.replace(driver, method=by, instrument=told)
        for paths, driver in found.drivers.items()
    }
    section = methods.methods_section(
        dataclasses.replace(
            found, fits=dataclasses.replace(found.fits, fit=fit), settings=settings, drivers=drivers
        )
    )
    entries = set(re.findall(r"^@\w+\{(\w+),", section.code, flags=re.MULTILINE))
    for words, key in CITED.items():
        assert (words in section.details) <= (key in entries), words
    named = {key for words, key in CITED.items() if words in section.details}
    assert entries - named <= {"etid", "fingertip", "steiglitz1965"}
    assert "rational function of order 4" in section.details
    assert "98.8 kΩ" in section.details
    for version in settings.versions:
        assert version in section.details
    without_errors = method == "steiglitz_mcbride"
    assert ("gain 0.001, r_load 0.001" in section.details) != without_errors
    assert "do not contain the tolerance" not in section.details
    assert ("gives no standard errors" in section.details) == without_errors


def test_every_entry_is_whole_bibtex():
    everything = methods.bibtex(methods.entries())
    entries = everything.split("\n\n")
    assert len(entries) == len(methods.entries())
    for entry in entries:
        assert entry.count("{") == entry.count("}")
        assert re.fullmatch(r"@\w+\{\w+,\n(.+\n)+\}", entry), entry
    assert f"version = {{{etid.__version__}}}" in everything
    with pytest.raises(KeyError, match="unknown"):
        methods.bibtex(["unknown"])


def test_the_command_writes_beside_the_fits_and_replaces_no_file_that_it_reads(
    study_file, tmp_path, capsys
):
    file = tmp_path / "fits.h5"
    fits_of([np.nan], ["flat"]).write(file)  # the fewest pictures
    assert cli.main(["report", str(file)]) == 0
    assert (tmp_path / "fits.html").exists()
    before = file.read_bytes()
    for page in (file, study_file):
        with pytest.raises(ValueError, match="would replace a file that is read"):
            etid.write_report(file, page, recordings=study_file)
    assert file.read_bytes() == before
    assert cli.main(["report", str(study_file)]) == 1
    assert "run etid fit first" in capsys.readouterr().err


def test_a_browser_shows_the_whole_page_without_complaint(page):
    with chromium() as browser:
        browser.open(page)
        assert browser.requests == [page.as_uri()]
        widths = browser.evaluate("[...document.images].map(i => i.complete ? i.naturalWidth : 0)")
        assert len(widths) == 11
        assert min(widths) > 100
        # Nothing but a table may be wider than the window.
        assert browser.evaluate("document.documentElement.scrollWidth <= innerWidth")
        for scheme, media, background in (
            ("light", "", "rgb(255, 255, 255)"),
            ("dark", "", "rgb(26, 26, 26)"),
            ("dark", "print", "rgb(255, 255, 255)"),
        ):
            features = [{"name": "prefers-color-scheme", "value": scheme}]
            browser.call("Emulation.setEmulatedMedia", media=media, features=features)
            of_page = browser.evaluate("getComputedStyle(document.documentElement).backgroundColor")
            of_image = browser.evaluate("getComputedStyle(document.images[0]).filter")
            assert (of_page, "invert" in of_image) == (background, "26" in background)
        printed = browser.call("Page.printToPDF", preferCSSPageSize=True, printBackground=True)
        assert base64.b64decode(printed["data"]).startswith(b"%PDF")
        assert browser.complaints == []
