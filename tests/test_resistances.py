"""Known resistors as people write them, read alike everywhere."""

import re

import pytest

import etid
from etid import cli
from etid.recordings import schema


@pytest.mark.parametrize(
    ("text", "ohm"),
    [("98800", 98.8e3), ("98.8e3", 98.8e3), ("98k8", 98.8e3), ("98K8", 98.8e3), ("98.8k", 98.8e3),
     ("4R7", 4.7), ("1M", 1e6), ("4.7 ohm", 4.7), ("21k62", 21.62e3)],
)  # fmt: skip
def test_a_resistance_is_read_alike_everywhere(text, ohm, tmp_path, capsys):
    """In options, names of files, tables, mappings and Python."""
    root, target = tmp_path / "week", tmp_path / "a.h5"
    root.mkdir()
    table, words = root / f"cal_{text}.csv", ["--v-th", "a", "--v-out", "b", "--scale", "1"]
    table.write_text("a,b\n1,2\n3,4\n")
    words += ["--pulse-rate", "60", "--sample-rate", "1e4", "-o", str(target), "--force"]
    given = {"v_th": "a", "v_out": "b", "scale": 1.0, "pulse_rate": 60.0, "sample_rate": 1e4}

    def found():
        with etid.read(target) as study:
            (one,) = study.calibrations.recordings()
            return one.r_load

    assert cli.main(["import", str(table), "--r-load", text, *words]) == 0
    assert found() == pytest.approx(ohm)
    assert cli.main(["import", str(table), "--calibration", str(table), text, *words]) == 0
    assert found() == pytest.approx(ohm)
    etid.import_file(table, target, r_load=text, **given)
    assert found() == pytest.approx(ohm)
    volts = {"v_th": {"channel": "a", "unit": "V"}, "v_out": {"channel": "b", "unit": "V"}}
    etid.import_file(table, target, {**given, **volts, "r_load": text})
    assert found() == pytest.approx(ohm)
    if "." not in text:  # it separates the name from its ending
        etid.import_folder(root, target, "cal_{r_load}.csv", **given)
        assert found() == pytest.approx(ohm)
    table.rename(root / "known.csv")
    (root / "calibrations.csv").write_text(f"file, ohm\nknown.csv, {text}\n")
    etid.import_folder(root, target, "{trial}.csv", **given)
    assert found() == pytest.approx(ohm)
    one = etid.Recording([1.0, 2.0], [1.0, 2.0], sample_rate=1e4, pulse_rate=60.0, r_load=text)
    assert one.r_load == pytest.approx(ohm)
    capsys.readouterr()


@pytest.mark.parametrize("text", ["98.8 kOhm", "ten", "", "-5", "1e999", "98k8k", "nan"])
def test_what_is_no_resistance_is_refused_alike(text, tmp_path, capsys):
    table = tmp_path / "a.csv"
    table.write_text("a,b\n1,2\n3,4\n")
    for option in (["--r-load", text], ["--calibration", str(table), text]):
        option = [f"--r-load={text}"] if option[0] == "--r-load" else option
        words = ["import", str(table), "-o", str(tmp_path / "a.h5"), "--v-th", "a", "--v-out", "b"]
        words += ["--scale", "1", "--pulse-rate", "60", "--sample-rate", "1e4", *option]
        assert cli.main(words) == 1
        assert re.search(r"r_load: is .*(no resistance|real number)", capsys.readouterr().err)
    with pytest.raises(etid.RecordingError, match="r_load: is"):
        etid.Recording([1.0, 2.0], [1.0, 2.0], sample_rate=1e4, pulse_rate=60.0, r_load=text)


def test_a_resistance_in_a_file_of_etid_is_a_number(tmp_path):
    with pytest.raises(etid.RecordingError, match="must be a finite real number"):
        schema.at("group attribute")["r_load"].parse("98k8")


def test_numbers_of_options_have_the_letters_of_resistances(tmp_path, capsys):
    table = tmp_path / "a.csv"
    table.write_text("a,b\n1,2\n3,4\n")
    words = ["import", str(table), "-o", str(tmp_path / "a.h5"), "--v-th", "a", "--v-out", "b"]
    words += ["--scale", "1", "--pulse-rate", "60Hz", "--sample-rate"]
    for text in ("200k", "200kHz", "200e3"):
        (tmp_path / "a.h5").unlink(missing_ok=True)
        assert cli.main([*words, text]) == 0
        assert "at 200000 Hz (command), pulses at 60 Hz" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        cli.main([*words, "fast"])
    assert "'fast' is no number; write it as 200e3, 200k or 200kHz" in capsys.readouterr().err
    arguments = cli.parser(["fit"]).parse_args(
        ["fit", "a.h5", "-o", "b.h5", "--fix", "r_s=20k", "--bound", "r_p=98k8:1M"]
    )
    assert arguments.fix == [("r_s", 20e3)]
    assert arguments.bound == [("r_p", (98.8e3, 1e6))]
