"""Tables of measured impedances, and files of instruments, which impedance.py reads."""

import numpy as np
import pytest

import etid
from etid import RecordingError

F = np.geomspace(10.0, 1e5, 30)
Z = 33.4e3 + 186e3 / (1 + 2j * np.pi * F * 186e3 * 0.12e-9)
ANGLE = np.degrees(np.angle(Z))


def test_a_table_of_impedances_is_read_and_fitted(tmp_path):
    np.savetxt(tmp_path / "z.csv", np.stack([F, np.real(Z), np.imag(Z)], axis=1), delimiter=",")
    frequency, impedance = etid.read_impedance(tmp_path / "z.csv")
    np.testing.assert_allclose(frequency, F)
    np.testing.assert_allclose(impedance, Z)
    with pytest.raises(RecordingError, match=r"cannot be read|holds no impedances"):
        etid.read_impedance(tmp_path / "z.csv", "gamry")


def written(path, head, columns, between=",", decimal="."):
    """A table with these lines above its numbers."""
    rows = [
        between.join(f"{value:.9e}" for value in row).replace(".", decimal)
        for row in np.stack(columns, axis=1)
    ]
    path.write_text("\n".join([*head, *rows, ""]), encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("head", "columns"),
    [
        (["frequency,Re,Im"], (F, Z.real, Z.imag)),
        (["Frequency (Hz),Z' (ohm),-Z'' (ohm)"], (F, Z.real, -Z.imag)),
        (["freq/Hz,Re(Z)/Ohm,-Im(Z)/Ohm,|Z|/Ohm,Phase(Z)/deg"],
         (F, Z.real, -Z.imag, abs(Z), ANGLE)),  # as of BioLogic
        (["f [kHz],|Z| [kOhm],phase [deg]"], (F / 1e3, abs(Z) / 1e3, ANGLE)),
        (["f,Zmod,Zphz"], (F, abs(Z), ANGLE)),  # these angles are too large for radians
        (["Zmod,theta (rad),f"], (abs(Z), np.angle(Z), F)),
        (["Impedance sweep", "", "Frequency,|Z|,θ", "Hz,Ohm,°"], (F, abs(Z), ANGLE)),
        (["freq_Hz,z_real,z_imag,note"], (F, Z.real, Z.imag, F)),
        ([], (F, Z.real, Z.imag)),
    ],
)  # fmt: skip
@pytest.mark.parametrize(("between", "decimal"), [(",", "."), (";", ","), ("\t", "."), ("  ", ",")])
def test_the_names_of_the_columns_say_what_they_are(head, columns, between, decimal, tmp_path):
    head = [line.replace(",", between) for line in head]
    path = written(tmp_path / "z.txt", head, columns, between, decimal)
    frequency, impedance = etid.read_impedance(path)
    np.testing.assert_allclose(frequency, F, rtol=1e-8)  # ten digits are printed
    np.testing.assert_allclose(impedance, Z, rtol=1e-8)


@pytest.mark.parametrize(
    ("head", "columns", "message"),
    [
        (["f,Re,Ym"], (F, Z.real, Z.imag), "its columns 'f', 'Re', 'Ym' do not say .* Name the"),
        (["f,|Z|,phase"], (F, abs(Z), np.angle(Z)), "'phase' is not said.*degrees or radians"),
        (["f,|Z| [mV],phase [deg]"], (F, abs(Z), ANGLE), "has the unit 'mV'"),
        (["f,Re,Im,|Z|,phase [deg]"], (F, Z.real, -Z.imag, abs(Z), ANGLE), "contradict magnitude"),
        (["f,Re,Im,X"], (F, Z.real, Z.imag, Z.imag), "two columns of the imaginary: 'Im', 'X'"),
        ([], (F, Z.real, Z.imag, F), "has 4 columns without names"),
        (["f,Re,Im"], (F, np.where(F > 1e3, np.nan, Z.real), Z.imag), "line .* 'nan' in column 2"),
    ],
)
def test_what_the_names_leave_open_is_refused(head, columns, message, tmp_path):
    with pytest.raises(RecordingError, match=message) as caught:
        etid.read_impedance(written(tmp_path / "z.csv", head, columns))
    assert caught.value.remedy
    assert caught.value.file.endswith("z.csv")


def test_a_file_without_numbers_or_with_unclear_names_is_refused(tmp_path):
    (tmp_path / "z.csv").write_text("no table here\n")
    with pytest.raises(RecordingError, match="holds no table of numbers"):
        etid.read_impedance(tmp_path / "z.csv")
    for head in (["f  |Z| in ohm  phase"], ["f  Trace |Z|  phase", "Hz  Ohm  deg"]):
        path = written(tmp_path / "z.dat", head, (F, abs(Z), ANGLE), "  ")
        with pytest.raises(RecordingError, match=r"line 1 names \d columns, but there are 3 col"):
            etid.read_impedance(path)


def test_the_file_of_a_potentiostat_is_read(tmp_path):
    """As ZPlot writes it: two lines of a head, names, and a line that ends the comments."""
    heads = "ZPLOT2 ASCII", "Site: dummy cell", "Freq(Hz)\tAmpl\tBias\tTime(Sec)\tZ'(a)\tZ''(b)"
    columns = np.zeros((F.size, 6))
    columns[:, 0], columns[:, 4], columns[:, 5] = F, np.real(Z), np.imag(Z)
    rows = ["\t".join(map(repr, row)) for row in columns.tolist()]
    (tmp_path / "cell.z").write_text("\n".join([*heads, "End Comments", *rows, ""]))
    for instrument in ("zplot", None):  # the names of its columns say the same
        frequency, impedance = etid.read_impedance(tmp_path / "cell.z", instrument)
        np.testing.assert_allclose(frequency, F)
        np.testing.assert_allclose(impedance, Z)


def test_a_real_spectrum_is_read_alike_by_its_names_and_by_its_instrument(reference_data):
    path = reference_data("dummy_circuits_eis") / "Circuit1_EIS_1.z"
    by_names, by_instrument = etid.read_impedance(path), etid.read_impedance(path, "zplot")
    for one, other in zip(by_names, by_instrument, strict=True):
        np.testing.assert_allclose(one, other)
    fit = etid.identify_impedance(*by_names)
    # Its source fitted 29.14 ohm, 46.65 ohm and 10.43 uF, with residuals of 0.4 %.
    np.testing.assert_allclose(fit.circuit.values(), [29.14, 46.65, 10.43e-6], rtol=0.02)


def test_what_is_missing_is_named(tmp_path):
    with pytest.raises(RecordingError, match="Use one of gamry"):
        etid.read_impedance(tmp_path / "z.csv", "gamri")
    with pytest.raises(RecordingError, match="no such file"):
        etid.read_impedance(tmp_path / "z.csv")
