"""Files of instruments: what is read is what was written, in volts, and nothing is guessed."""

import pathlib
import struct
import tomllib
from typing import Any

import numpy as np
import pyabf
import pytest

import etid
from etid.files import channel as channels
from etid.files.channel import parse_unit
from etid.files.readers import delimited as text_rows
from etid.recordings.recording import RecordingError
from tests.lab_files import LINE, abf, imported, intan, matlab, refused, rig, spike2, table, tdms

README = pathlib.Path(__file__).parents[1] / "data_schema" / "README.md"
RNG = np.random.default_rng(6)
V_TH, V_OUT = RNG.normal(size=(2, 1000))
CODES = RNG.integers(-3000, 3000, size=1000).astype("i2")
GIVEN: dict[str, Any] = {"pulse_rate": 60.0, "scale": 0.0535}


def pair(v_th="rig/open", v_out="rig/skin", **more):
    return {**GIVEN, "v_th": {"channel": v_th}, "v_out": {"channel": v_out}, **more}


def columns(v_th, v_out, **more):
    """A mapping of columns in volts without a unit in the file."""
    both = {"v_th": v_th, "v_out": v_out}
    return {**GIVEN, **{key: {"channel": name, "unit": "V"} for key, name in both.items()}, **more}


def sweep(number):
    return {"channel": "ch0", "rows": number}


SWEEPS = {**GIVEN, "v_th": sweep(0), "v_out": sweep(1)}  # both records in one channel


# What the README of the schema shows


def example(format):
    """The mapping of one format, as the README has it."""
    section = README.read_text("utf-8").split(f"### {format}\n")[1].split("\n### ")[0]
    return tomllib.loads(section.split("```toml\n")[1].split("```")[0])


def test_the_csv_of_the_readme_is_imported_by_its_mapping(tmp_path):
    section = README.read_text("utf-8").split("### CSV\n")[1]
    path = table(tmp_path, section.split("```text\n")[1].split("```")[0])
    recordings, used = imported(path, example("CSV"))
    one = recordings["s01/dry"]
    assert (one.subject, one.condition, one.pulse_rate) == ("s01", "dry", 60.0)
    assert one.sample_rate == pytest.approx(200e3, rel=1e-12)  # of times with four digits
    np.testing.assert_allclose(one.v_out, np.array([1.25, 1.75, 1.5]) / 53.5, rtol=1e-15)
    assert str(used[0]).splitlines() == [
        "s01/dry: 3 samples at 200000 Hz (time 't'), pulses at 60 Hz",
        "  v_th    'open' in mV (file), divided by 0.0535",
        "  v_out   'skin' in mV (file), divided by 0.0535",
        "  time    't' in ms (file)",
    ]


@pytest.mark.parametrize("version", [5, 7.3])
def test_the_matlab_file_of_the_readme_is_imported_by_its_mapping(version, tmp_path):
    trials = np.stack([V_OUT, V_OUT / 2, V_OUT / 3])
    known, dry = {"open": V_TH, "loaded": V_OUT}, {"open": V_TH, "skin": trials}
    path = matlab(tmp_path / "session.mat", version, known=known, dry=dry)
    recordings, _ = imported(path, example("MATLAB"))
    assert list(recordings) == ["calibration/98k8", "s01/dry/0", "s01/dry/1", "s01/dry/2"]
    assert recordings["calibration/98k8"].r_load == 98.8e3
    for trial in range(3):
        one = recordings[f"s01/dry/{trial}"]
        assert one.calibration == ("calibration/98k8",)
        np.testing.assert_allclose(one.v_out, trials[trial] / 0.0535, rtol=1e-15)
        np.testing.assert_allclose(one.v_th, V_TH / 0.0535, rtol=1e-15)


def test_the_tdms_file_of_the_readme_is_imported_by_its_mapping(tmp_path):
    names = ("known/open", "known/loaded", "s01 dry/open", "s01 dry/skin", "s01 dry/shunt")
    signals = {name: (V_TH * number, {}) for number, name in enumerate(names, 1)}
    path = tdms(tmp_path / "s.tdms", signals, unit_string="Volts", wf_increment=5e-6)
    recordings, used = imported(path, example("TDMS"))
    assert list(recordings) == ["calibration/98k8", "s01/dry"]
    np.testing.assert_allclose(recordings["s01/dry"].v_out, V_TH * 4 / 0.0535, rtol=1e-15)
    current = recordings["s01/dry"].samples["current"].values
    np.testing.assert_allclose(current, V_TH * 5 / 100, rtol=1e-15)
    assert recordings["s01/dry"].sample_rate == 200e3
    assert str(used[1].signals["current"]) == "'s01 dry/shunt' in Volts (file), divided by 100"


def test_the_abf_file_of_the_readme_is_imported_by_its_mapping(tmp_path):
    sweeps = np.stack([V_TH, V_OUT, V_OUT / 2])
    recordings, _ = imported(abf(tmp_path / "cell.abf", sweeps, unit="mV"), example("ABF"))
    assert list(recordings) == ["s01/dry/0", "s01/dry/1"]
    one = recordings["s01/dry/1"]
    assert (one.trial, one.sample_rate) == ("2", 200e3)  # trials are called by their sweeps
    assert one.samples["v_out"].stored.dtype == np.int16
    step = one.samples["v_out"].conversion  # codes are cut off, not rounded
    np.testing.assert_allclose(one.v_out, sweeps[2] * 1e-3 / 0.0535, rtol=0, atol=1.001 * step)
    np.testing.assert_allclose(one.v_th, V_TH * 1e-3 / 0.0535, rtol=0, atol=1.001 * step)


# TDMS


@pytest.mark.parametrize("kind", ["i2", "f4", "f8"])
def test_a_linear_scaling_is_applied_once_and_leaves_samples(kind, tmp_path):
    codes = CODES.astype(kind)
    recordings, _ = imported(rig(tmp_path, V_TH, codes, **LINE), pair())
    record = recordings["loaded/0"].samples["v_out"]
    volts = (2e-3 * CODES + 0.5) / 0.0535
    np.testing.assert_allclose(record.values, volts, rtol=0, atol=1e-13)  # of terms of up to 112
    np.testing.assert_array_equal(record.stored, codes)
    assert record.stored.dtype == codes.dtype
    scaled = rig(tmp_path, V_TH, codes, **LINE, NI_Scaling_Status="scaled")  # before it was written
    np.testing.assert_allclose(imported(scaled, pair())[0]["loaded/0"].v_out, CODES / 0.0535)
    for name, value in (("Slope", 0.0), ("Slope", np.nan), ("Y_Intercept", np.inf)):
        path = rig(tmp_path, V_TH, codes, **LINE | {f"NI_Scale[0]_Linear_{name}": value})
        refused(path, pair(), "v_out: channel 'rig/skin' is scaled with slope")


# MATLAB


@pytest.mark.parametrize("version", [5, 7.3])
def test_matlab_variables_that_are_no_real_arrays_are_refused(version, tmp_path):
    variables: dict = {"open": V_TH, "skin": V_OUT * 1j, "name": "finger"}
    if version == 7.3:
        variables["#refs#"] = {"a": V_TH}  # the cells of other variables
    path = matlab(tmp_path / "m.mat", version, **variables)
    for name, message in (
        ("skin", "v_out: 'skin' is .*must be an array of real numbers"),
        ("name", "v_out: 'name' is .*must be an array of real numbers"),
        ("#refs#.a", r"the names are ['a-z, ]+\. Use"),
    ):
        refused(path, columns("open", name, sample_rate=2e5), message)


# Electrophysiology

CHANNELS = {"open": CODES[:768].astype(int), "skin": CODES[200:968].astype(int)}
BOTH = pair("open", "skin", scale=1)


def test_the_rate_of_an_abf_file_is_not_cut_to_whole_hertz(tmp_path):
    for rate in (150e3, 200e3, 33_333.0, 1e6 / 7):
        recordings, _ = imported(abf(tmp_path / "a.abf", np.stack([V_TH, V_OUT]), rate), SWEEPS)
        assert recordings["loaded/0"].sample_rate == pytest.approx(rate, rel=1e-7)  # a float32


def test_an_abf_file_has_the_values_that_pyabf_reads(tmp_path):
    path = abf(tmp_path / "a.abf", np.stack([V_TH, V_OUT]))
    one = imported(path, {**SWEEPS, "scale": 1})[0]["loaded/0"]
    reference = pyabf.ABF(path)
    for number, values in enumerate((one.v_th, one.v_out)):
        reference.setSweep(number)
        np.testing.assert_allclose(values, reference.sweepY, rtol=1e-6)  # a float32
    # Where later versions say whether the gain of a telegraph counts, this one has samples.
    changed(path, "<h", 4512, 1)
    again = imported(path, {**SWEEPS, "scale": 1})[0]["loaded/0"]
    assert again.samples["v_out"].conversion == one.samples["v_out"].conversion
    changed(path, "<i", 16, 3)  # the number of sweeps
    refused(path, SWEEPS, "has sweeps of different lengths. Export sweeps of equal length")


def changed(path, format, place, *numbers):
    """Overwrite some bytes of a file."""
    data = bytearray(path.read_bytes())
    struct.pack_into(format, data, place, *numbers)
    path.write_bytes(data)


def test_an_intan_file_has_commands_and_no_gaps(tmp_path):
    inputs = {name: codes + 32768 for name, codes in CHANNELS.items()}
    path = intan(tmp_path / "a.rhs", inputs)
    told = {**pair("A-000", "skin", scale=1), "current": {"channel": "A-000_STIM"}}
    one = imported(path, told)[0]["loaded/0"]
    np.testing.assert_allclose(one.v_out, CHANNELS["skin"] / 3200, rtol=0, atol=1e-12)
    np.testing.assert_allclose(one.v_th, 195e-6, rtol=1e-9)
    current = one.samples["current"].values.reshape(-1, 2)
    np.testing.assert_allclose(current - [-3e-6, 5e-6], 0, atol=1e-12)  # a step in float32
    half = path.read_bytes()[: -3 * 128 * 10]  # three of six blocks of five channels
    later = intan(tmp_path / "later.rhs", {name: one[384:] for name, one in inputs.items()}, 385)
    path.write_bytes(half + later.read_bytes()[-3 * 128 * 10 :])
    refused(path, told, "has lost samples: its time stamps have gaps. Copy it again")


def test_an_intan_recording_may_be_a_header_and_files_of_signals(tmp_path):
    path = intan(tmp_path / "info.rhd", CHANNELS)
    codes = np.stack([*CHANNELS.values()], axis=1) + 32768
    for name, samples in (
        ("time", np.arange(len(codes), dtype="<i4")),
        ("amplifier", np.full(len(codes), 1000, "<i2")),
        ("analogin", codes.astype("<u2")),
    ):
        samples.tofile(tmp_path / f"{name}.dat")
    one = imported(path, pair("A-000", "skin", scale=1))[0]["loaded/0"]
    np.testing.assert_allclose(one.v_out, CHANNELS["skin"] / 3200, rtol=0, atol=1e-12)
    np.testing.assert_allclose(one.v_th, 195e-6, rtol=1e-9)


def test_parts_of_a_spike2_file_between_pauses_are_trials(tmp_path):
    path = spike2(tmp_path / "a.smr", CHANNELS, starts=(0, 1000, 5000))
    recordings, [used] = imported(path, BOTH)
    assert [one.trial for one in recordings.values()] == ["0", "1", "2"]
    for one, codes in zip(recordings.values(), np.split(CHANNELS["skin"], 3), strict=True):
        np.testing.assert_allclose(one.v_out, codes / 6553.6e3, rtol=1e-12)
    assert used.notices == ()
    _, [used] = imported(spike2(path, CHANNELS, late=3), BOTH)
    assert used.notices == ("'skin' begins 1.5e-05 s after the first channel",)


def test_a_spike2_file_that_neo_would_read_wrong_is_refused(tmp_path):
    path = spike2(tmp_path / "a.smr", CHANNELS)
    changed(path, "<ii", 9 * 512 + 8, 5 * 900, 5 * 1067)  # a pause in the second channel alone
    refused(path, BOTH, "channel 'skin' has lost samples. Copy it again, or save it again")
    spike2(path, CHANNELS)
    changed(path, "<h", 512 + 14, 3)  # as if the first had more blocks than 16 bits count
    refused(path, BOTH, "channel 'open' has lost samples")


# CSV


@pytest.mark.parametrize(
    "head",
    ["open [mV],skin(mV)", "open (mV),skin [millivolts]", "open,skin\n(mV),(mV)\n",
     "open,skin\nmV,mV", '"open [mV]","skin (mV)"'],
)  # fmt: skip
def test_units_of_a_table_may_stand_in_its_first_or_second_line(head, tmp_path):
    path = table(tmp_path, f"{head}\n1,2\n3,4\n\n5,6\n")
    recordings, _ = imported(path, pair("open", "skin", sample_rate=2e5))
    np.testing.assert_allclose(recordings["loaded/0"].v_out, np.array([2, 4, 6]) / 53.5)


def test_a_table_without_names_has_numbered_columns(tmp_path):
    path = table(tmp_path, "1,2\n3,4\n5,6\n")
    refused(path, pair("1", "2", sample_rate=2e5), r"the columns 1, 2\. .* add --header-line 0")
    recordings, _ = imported(path, columns("1", "2", sample_rate=2e5, header_line=0))
    np.testing.assert_allclose(recordings["loaded/0"].v_out, np.array([2, 4, 6]) / 0.0535)


def test_a_preamble_may_stand_beside_the_numbers(tmp_path):
    beside = ["Record Length,3,s", "Sample Interval,5e-6,s", "Source,CH1,", ",,", ",,"]
    rows = [f"{text},{i / 2e5:.6e},{i},{2 * i},\n" for i, text in enumerate(beside)]
    path = table(tmp_path, "".join(rows))  # as of Tektronix TDS
    refused(path, pair("CH1", "CH2", sample_rate=2e5), "columns 1, 2, 3, 4, 5, 6, 7.*header-line 0")
    told = columns("5", "6", time={"channel": "4", "unit": "s"}, header_line=0)
    recordings, _ = imported(path, told)
    np.testing.assert_allclose(recordings["loaded/0"].v_out, np.arange(0, 10, 2) / 0.0535)


def test_the_clock_may_start_beside_the_units(tmp_path):
    beside_units = "X,CH1,CH2,Start,Increment,\nSequence,VOLT,VOLT,-6e-3,5e-6\n"
    rigol = beside_units + "0,1,2,\n1,3,4,\n2,5,6,\n"
    path, told = table(tmp_path, rigol), pair("CH1", "CH2")
    recordings, [used] = imported(path, {**told, "sample_rate": 2e5})
    np.testing.assert_allclose(recordings["loaded/0"].v_out, np.array([2, 4, 6]) / 0.0535)
    assert str(used.signals["v_out"]).startswith("'CH2' in VOLT (file)")
    assert used.rate_by == "mapping; file 200000 Hz"
    refused(path, {**told, "sample_rate": 1e5}, "200000 Hz from the file")
    for text in (rigol, "CH1(V),CH2(V),t0 =-6e-3, tInc = 5e-6,\n1,2\n3,4\n5,6\n"):
        _, [used] = imported(table(tmp_path, text), told)
        assert (used.sample_rate, used.rate_by) == (2e5, "file")
    path = table(tmp_path, "X,CH1,CH2\nSequence,VOLT,VOLT\n0,1,2\n1,3,4\n")
    refused(path, {**told, "time": {"channel": "X"}}, "the file says 'Sequence' of channel 'X'")


def test_v_th_may_be_a_channel_of_another_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    told = columns("open.csv:a", "skin", sample_rate=2e5)
    pathlib.Path("open.csv").write_text("a\n1\n2\n3\n", encoding="utf-8")
    finger = tmp_path / "finger.csv"
    finger.write_text("skin\n4\n5\n6\n", encoding="utf-8")
    recordings, [used] = imported(finger, told)
    np.testing.assert_allclose(recordings["loaded/0"].v_th, np.array([1, 2, 3]) / 0.0535)
    np.testing.assert_allclose(recordings["loaded/0"].v_out, np.array([4, 5, 6]) / 0.0535)
    assert str(used.signals["v_th"]).startswith("'open.csv:a' in V")
    wrong = columns("open.csv:b", "skin", sample_rate=2e5)
    refused(finger, wrong, "the names are 'skin', 'open.csv:a'")
    pathlib.Path("open.csv").write_text("a\n1\n2\nx\n", encoding="utf-8")
    with pytest.raises(RecordingError, match=r"^open\.csv: line 4 has 'x'"):
        etid.import_file(finger, "t.h5", told)


def test_numbers_and_time_stamps_of_a_table_are_checked_in_every_part(tmp_path, monkeypatch):
    monkeypatch.setattr(channels, "BLOCK", 7)
    monkeypatch.setattr(text_rows, "ROWS", 13)
    times, path = np.arange(1000) / 2e5, tmp_path / "t.csv"
    said = pair("open", "skin", time={"channel": "t"})
    for wrong in (300, 999, 1000):
        stamps = np.where(np.arange(1000) >= wrong, times + 3e-6, times)
        rows = np.column_stack([stamps, V_TH, V_OUT])
        np.savetxt(path, rows, "%.17g", ",", header="t [s],open [V],skin [V]", comments="")
        if wrong < 1000:
            refused(path, said, r"time: is not uniform: sample \d+")
    one = imported(path, said)[0]["loaded/0"]
    np.testing.assert_allclose(one.v_out, V_OUT / 0.0535, rtol=1e-14)
    np.testing.assert_allclose(one.v_th, V_TH / 0.0535, rtol=1e-14)
    assert one.sample_rate == pytest.approx(200e3, rel=1e-12)
    assert [*tmp_path.iterdir()] == [path]


# Units and names


def test_units_are_those_of_the_si_and_their_names():
    for text, factor, unit in (
        ("V", 1, "volt"), ("mV", 1e-3, "volt"), ("Volts", 1, "volt"), (" uA ", 1e-6, "ampere"),
        ("\N{MICRO SIGN}s", 1e-6, "second"), ("\N{GREEK SMALL LETTER MU}V", 1e-6, "volt"),
        ("Milliseconds", 1e-3, "second"), ("pA", 1e-12, "ampere"), ("kV", 1e3, "volt"),
    ):  # fmt: skip
        assert parse_unit(text) == (factor, unit), text
    for text in ("", "MV", "mv", "v", "a", "S", "Ohm", "degC", "V/A", "1"):
        assert parse_unit(text) is None, text


@pytest.mark.parametrize(
    ("head", "name", "unit"),
    [
        ("skin [mV]", "skin", "mV"),
        ("skin / mV", "skin", "mV"),
        ("skin [left]", "skin [left]", ""),
        ("skin (a)", "skin (a)", ""),
        ("rig/V", "rig/V", ""),
        *((f"skin {wrong}", "skin", None) for wrong in ("[mv]", "(MV)", "[uVolt]", "/ mv")),
    ],
)
def test_a_name_contains_a_unit_that_is_known_or_refused(head, name, unit, tmp_path):
    path, told = (
        table(tmp_path, f"open [V],{head}\n1,2\n3,4\n"),
        pair("open", name, sample_rate=1e4),
    )
    if unit is None:
        refused(path, told, rf"v_out\.unit: the file says .* of channel '{name}', which is neither")
        return
    told["v_out"] |= {} if unit else {"unit": "V"}
    _, [used] = imported(path, told)
    assert used.signals["v_out"].unit == (unit or "V")
