"""Each cell of the report's tables is what its heading says."""

import dataclasses
import re

import numpy as np
import pytest

import etid
from etid.printing import PREFIXES
from etid.report import tables
from tests import pictures

RESISTANCE = np.array([33.4e3, 30e3, 36e3, 5.5])  # [Ω], the last is one of metal
CAPACITANCE = np.array([5e-12, 40e-12, 60e-12, 0.7e-6])  # [F], on both sides of a prefix
SIZES = {symbol: 10.0**power for power, symbol in PREFIXES.items()}


@pytest.fixture(scope="module")
def fits():
    """Four recordings, one unusable, with elements of very different sizes."""
    circuit = etid.SkinRC(RESISTANCE, np.full(4, 186e3), CAPACITANCE)
    verdicts = np.array(["successful", "successful", "misfit", "successful"])
    fit = pictures.fit(verdicts, circuit, own=pictures.RELATIVE, shared=0.001)
    fit = dataclasses.replace(fit, chi2=np.full(4, 1.25), rrse=np.full(4, 0.0033))
    subject = np.array(["s01", "s02", "s03", "s04"])
    return pictures.fits_of(fit, path=np.char.add("r/", subject), subject=subject)


def size_of(heading):
    """The size in SI units of the unit of a heading, such as `median [kΩ]`."""
    found = re.search(r"\[(.?)[ΩF]\]", heading)
    assert found is not None, heading
    return SIZES[found[1]]


def test_a_share_is_of_all_recordings(fits):
    shown = {row[0]: row[1:3] for row in tables.verdicts(fits).rows}
    assert shown == {"successful": ("3", "75.0"), "misfit": ("1", "25.0")}


def test_a_median_of_a_group_is_in_the_unit_of_its_heading(fits):
    rows = fits.summary("subject", "condition")
    table = tables.groups(rows, ("subject", "condition"), fits.circuit.units())
    for number, (name, width) in enumerate(table.groups[1:]):
        column = table.groups[0][1] + number * width
        assert name == ("R_s", "R_p", "C_p")[number]
        assert table.columns[column].startswith("median")
        for group, cells in zip(rows, table.rows, strict=True):
            told = float(cells[column] or "nan") * size_of(table.columns[column])
            # Two digits of an error of 0.5 to 3 %; the smallest values have one digit.
            expected = group[("r_s", "r_p", "c_p")[number]]
            assert told == pytest.approx(expected, rel=0.1, nan_ok=True)


def test_chi2_and_rrse_of_a_recording_stand_below_their_headings(fits):
    table = tables.recordings(fits, {})
    at = dict(zip(table.columns, zip(*table.rows, strict=True), strict=True))
    assert at["χ²"] == ("1.25",) * 4
    assert at["RRSE [%]"] == ("0.33",) * 4
    (heading,) = (name for name in at if name.startswith("C_p"))
    told = [float(cell.partition(" ")[0]) * size_of(heading) for cell in at[heading]]
    np.testing.assert_allclose(told, CAPACITANCE, rtol=0.1)  # as above


def test_own_and_shared_errors_of_one_recording_are_not_exchanged(fits):
    """0.5 % from the noise of the recording, 0.1 % from the driver."""
    table = tables.single(fits.take(np.array([0])))
    assert table.columns[2:] == ("own error", "shared error")
    (r_p,) = (row for row in table.rows if row[0] == "R_p [kΩ]")
    assert r_p[2:] == ("0.93", "0.19")
