"""Remarks: what was done to a recording is told in print, in tables and in files."""

import dataclasses

import numpy as np

from etid.recordings.remarks import Remark, remarks_of, texts, words
from etid.results.fits import Fits
from tests import pictures

BOTH = Remark.mains_hum | Remark.aligned


def test_every_set_of_remarks_comes_back_from_its_words():
    for value in range(2 ** len(Remark)):
        assert remarks_of(words(value)) == value


def test_every_remark_has_a_sentence():
    assert all(len(texts(one)) == 1 and texts(one)[0].endswith(".") for one in Remark)


def test_a_fit_and_a_driver_print_their_remarks():
    fit = dataclasses.replace(pictures.fit(), remarks=np.asarray(int(BOTH)))
    driver = dataclasses.replace(pictures.driver(), remarks=np.asarray(int(BOTH)))
    for text in texts(BOTH):
        assert text in str(fit)
        assert text in str(driver)
    assert not any(text in str(pictures.fit()) for text in texts(BOTH))


def test_a_file_of_fits_keeps_remarks(tmp_path):
    fits = pictures.fits()
    remarks = np.arange(len(fits)) % (2 * int(BOTH))
    fits = dataclasses.replace(fits, fit=dataclasses.replace(fits.fit, remarks=remarks))
    fits.write(tmp_path / "fits.h5")
    back = Fits.read(tmp_path / "fits.h5")
    np.testing.assert_array_equal(back.fit.remarks, remarks)
    assert back.table()["remarks"][int(BOTH)] == words(BOTH)
