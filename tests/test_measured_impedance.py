"""Files of measured impedances, read by impedance.py."""

import numpy as np
import pytest

import etid
from etid import RecordingError

F = np.geomspace(10.0, 1e5, 30)
Z = 33.4e3 + 186e3 / (1 + 2j * np.pi * F * 186e3 * 0.12e-9)


def test_a_table_of_impedances_is_read_and_fitted(tmp_path):
    np.savetxt(tmp_path / "z.csv", np.stack([F, np.real(Z), np.imag(Z)], axis=1), delimiter=",")
    frequency, impedance = etid.read_impedance(tmp_path / "z.csv")
    np.testing.assert_allclose(frequency, F)
    np.testing.assert_allclose(impedance, Z)
    with pytest.raises(RecordingError, match=r"cannot be read|holds no impedances"):
        etid.read_impedance(tmp_path / "z.csv", "gamry")


def test_what_is_missing_is_named(tmp_path):
    with pytest.raises(RecordingError, match="Use one of gamry"):
        etid.read_impedance(tmp_path / "z.csv", "gamri")
    with pytest.raises(RecordingError, match="no such file"):
        etid.read_impedance(tmp_path / "z.csv")
