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


def test_the_file_of_a_potentiostat_is_read(tmp_path):
    """As ZPlot writes it: two lines of a head, names, and a line that ends the comments."""
    heads = "ZPLOT2 ASCII", "Site: dummy cell", "Freq(Hz)\tAmpl\tBias\tTime(Sec)\tZ'(a)\tZ''(b)"
    columns = np.zeros((F.size, 6))
    columns[:, 0], columns[:, 4], columns[:, 5] = F, np.real(Z), np.imag(Z)
    rows = ["\t".join(map(repr, row)) for row in columns.tolist()]
    (tmp_path / "cell.z").write_text("\n".join([*heads, "End Comments", *rows, ""]))
    frequency, impedance = etid.read_impedance(tmp_path / "cell.z", "zplot")
    np.testing.assert_allclose(frequency, F)
    np.testing.assert_allclose(impedance, Z)


def test_what_is_missing_is_named(tmp_path):
    with pytest.raises(RecordingError, match="Use one of gamry"):
        etid.read_impedance(tmp_path / "z.csv", "gamri")
    with pytest.raises(RecordingError, match="no such file"):
        etid.read_impedance(tmp_path / "z.csv")
