"""A new column of a table of fits is one declaration."""

import csv
import dataclasses
from typing import Any

import h5py
import numpy as np
import pytest

import etid
from etid.report.tables import recordings
from etid.results import columns, fits_file
from etid.results.columns import Column
from tests import pictures

SNR = np.linspace(20.0, 60.0, 12)


class Heard(etid.Fit):
    """A fit that knows one number more."""

    snr: Any = None


@pytest.fixture(autouse=True)
def _declared(monkeypatch):
    added = (
        Column("snr", "snr", unit="decibel", needs="snr", heading="SNR [dB]"),
        Column("left", of=lambda fit: 100 * fit.rrse, shown="always"),
        Column("{}_relative", of=lambda fit: fit.stderr.values() / fit.circuit.values(),
               each="element"),
    )  # fmt: skip
    monkeypatch.setattr(columns, "COLUMNS", (*columns.COLUMNS, *added))
    monkeypatch.setattr(fits_file, "Fit", Heard)


def heard(snr):
    """Fits of a class with a field more."""
    fits = pictures.fits()
    fields = {of.name: getattr(fits.fit, of.name) for of in dataclasses.fields(fits.fit)}
    return dataclasses.replace(fits, fit=Heard(**fields, snr=snr))


def test_a_new_column_is_in_tables_files_exports_and_pages_from_its_declaration_alone(tmp_path):
    fits = heard(SNR)
    table = fits.table()
    np.testing.assert_array_equal(table["snr"], SNR)
    np.testing.assert_array_equal(table["left"], 100 * fits.rrse)
    np.testing.assert_array_equal(table["r_p_relative"], table["r_p_stderr"] / table["r_p"])
    assert (fits[3].table()["snr"], type(fits[3].table()["snr"])) == (SNR[3], float)
    fits.write(tmp_path / "fits.h5")
    with h5py.File(tmp_path / "fits.h5") as file:
        assert file["snr"].attrs["unit"] == "decibel"
    again = etid.Fits.read(tmp_path / "fits.h5")
    assert again.table().keys() == table.keys()
    for name, column in table.items():
        np.testing.assert_array_equal(again.table()[name], column, name)
    for every in (True, False):
        for long in (True, False):
            etid.export_fits(tmp_path / "fits.h5", tmp_path / "a.csv", all=every, long=long)
            with (tmp_path / "a.csv").open(newline="", encoding="utf-8") as text:
                rows = list(csv.DictReader(text))
            assert [float(row["left"]) for row in rows[:: 3 if long else 1]] == [*table["left"]]
            assert {"relative", "r_s_relative"} & {*rows[0]} == (
                {"relative" if long else "r_s_relative"} if every else set()
            )
            told = [float(row["snr [decibel]"]) for row in rows[:: 3 if long else 1] if every]
            assert told == ([*SNR] if every else [])
    page = recordings(fits, {})
    assert [row[page.columns.index("SNR [dB]")] for row in page.rows][:2] == ["20", "24"]


def test_a_file_without_a_column_that_it_does_not_need_is_read(tmp_path):
    old = heard(None)
    old.write(tmp_path / "old.h5")
    with h5py.File(tmp_path / "old.h5") as file:
        assert "snr" not in file
    again = etid.Fits.read(tmp_path / "old.h5")
    assert "snr" not in again.table()
    assert "SNR [dB]" not in recordings(again, {}).columns
    etid.export_fits(tmp_path / "old.h5", tmp_path / "old.csv", all=True)
    both = etid.Fits.concatenate([again, heard(SNR)])
    np.testing.assert_array_equal(both.table()["snr"], [*[np.nan] * 12, *SNR])
