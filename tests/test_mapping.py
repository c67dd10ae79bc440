"""Mapping files: what they say, and what they must not leave open or contradict."""

import numpy as np
import pytest

import etid
from etid import cli
from etid.recordings.recording import RecordingError
from tests.lab_files import abf, imported, tdms

COUNT = 800
TH, OUT = np.random.default_rng(7).normal(size=(2, COUNT))
GIVEN = """
pulse_rate = 60.0
scale = 0.0535
v_th = {channel = "rig/open"}
v_out = {channel = "rig/skin"}
"""


@pytest.fixture
def rig(tmp_path):
    """A file that says its units and its rate, and one channel that says neither."""
    known = {"unit_string": "mV", "wf_increment": 5e-6}
    return tdms(
        tmp_path / "rig.tdms",
        {
            "rig/open": (TH, known),
            "rig/skin": (OUT, known),
            "rig/plain": (OUT, {}),
            "rig/slow": (OUT, {**known, "wf_increment": 1e-3}),
            "rig/odd": (OUT, {**known, "unit_string": "furlong"}),
            "rig/shunt": (OUT, known),
            "rig/near": (OUT, {**known, "wf_increment": 5.0001e-6}),
        },
    )


@pytest.fixture
def run(rig, tmp_path):
    """Import the file by a mapping; the recordings and what was used for what."""

    def run(text, source=rig):
        (tmp_path / "rig.toml").write_text(text, encoding="utf-8")
        return imported(source, tmp_path / "rig.toml")

    return run


def test_what_the_file_says_need_not_be_said(run):
    current = 'current = {channel = "rig/shunt", scale = 50.0}\n'
    recordings, used = run(current + GIVEN)
    one = recordings["loaded/0"]
    np.testing.assert_allclose(one.v_out, OUT * 1e-3 / 0.0535, rtol=1e-14)
    np.testing.assert_allclose(one.current, OUT * 1e-3 / 50, rtol=1e-15)
    assert (one.sample_rate, one.pulse_rate) == (200e3, 60.0)
    assert (used[0].rate_by, used[0].signals["v_out"].unit_by) == ("file", "file")
    same = GIVEN.replace('"rig/skin"', '"rig/skin", unit = "millivolts"')
    recordings, used = run(same + "sample_rate = 200004.0")
    assert recordings["loaded/0"].sample_rate == 200004.0  # measured, within 100 ppm of the nominal
    assert used[0].rate_by == "mapping; file 200000 Hz"
    assert used[0].signals["v_out"].unit_by == "file and mapping"


def test_what_the_file_does_not_say_is_said_by_mapping_or_command(run, rig):
    text = GIVEN.replace('"rig/skin"', '"rig/plain", unit = "V", scale = 2')
    one = run(text)[0]["loaded/0"]
    np.testing.assert_allclose(one.v_out, OUT / 2, rtol=1e-15)  # a scale of its own
    given = {"v_th": "rig/open", "v_out": "rig/plain", "pulse_rate": 60.0, "scale": 0.0535}
    recordings, [used] = imported(rig, **given)
    other = recordings["loaded/0"]
    for each in (one, other):
        np.testing.assert_allclose(each.v_th, TH * 1e-3 / 0.0535, rtol=1e-14)
    np.testing.assert_allclose(other.v_out, OUT / 0.0535, rtol=1e-15)
    units = {name: (used.unit, used.unit_by) for name, used in used.signals.items()}
    assert units == {"v_th": ("mV", "file"), "v_out": ("V", "command")}


def test_one_error_proposes_options_for_all_that_is_missing(rig):
    with pytest.raises(RecordingError, match="are not given, and are not guessed") as caught:
        imported(rig)
    assert caught.value.field == "v_th, v_out, pulse_rate, scale"
    options = "--v-th NAME --v-out NAME --pulse-rate 60 --scale 1; or name the measured"
    assert options in caught.value.remedy
    with pytest.raises(RecordingError, match=r"as in --v-th NAME --scale 1; ") as caught:
        imported(rig, v_out="rig/skin", pulse_rate=60.0)
    assert caught.value.field == "v_th, scale"


A, B = "[[recording]]\npath = 'a'\n", "[[recording]]\npath = 'b'\n"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("rig/skin", "rig/Skin", r"v_out: there is no 'rig/Skin'; the names are 'rig/open', "),
        ('v_out = {channel = "rig/skin"}', "", r"v_out: is not given.* channels are 'rig/open', "),
        ("pulse_rate = 60.0", "", "pulse_rate: is not given, and is not guessed"),
        ("scale = 0.0535", "", "scale: is not given.*values at the terminal"),
        ("rig/skin", "rig/plain", "v_out.unit: is not given of channel 'rig/plain', the file"),
        ('"rig/skin"', '"rig/skin", unit = "V"', "v_out.unit: the mapping says 'V'.*says 'mV'"),
        ('"rig/skin"', '"rig/skin", unit = "furlong"', "unit: is 'furlong', which is not a unit"),
        ('"rig/skin"', '"rig/skin", unit = 3', "v_out.unit: is 3, which is not a unit"),
        ("rig/skin", "rig/odd", "v_out.unit: the file says 'furlong' of channel 'rig/odd'"),
        ("rig/skin", "rig/slow", "differs between the channels: .* 'rig/slow' 1000 Hz"),
        ("rig/skin", "rig/near", "differs between the channels: .* 'rig/near' 199996 Hz"),
        ("scale", "sample_rate = 100e3\nscale", "sample_rate: is 100000 Hz from the mapping"),
        ("0.0535", "true", "scale: is True, must be a finite real number"),
        ("60.0", "inf", "pulse_rate: is inf, must be a finite real"),
        ("scale", "subject = 1.5\nscale", "subject: is 1.5, must be text"),
        ("scale", 'calibration = "c/0"\nscale', "calibration: 'c/0' is not a calibration of the"),
        ("scale", "samplerate = 2e5\nscale", "samplerate: is no key.*did you mean sample_rate"),
        ("channel = ", "chanel = ", "v_th: names no channel"),
        ('{channel = "rig/skin"}', '"rig/skin"', "v_out: names no channel. Write v_out = {"),
        ('"rig/skin"', '"rig/skin", sweep = 1', r"v_out\.sweep: is no key of a mapping"),
        ('"rig/skin"', '"rig/skin", rows = 1', r"v_out\.rows: row 1 does not exist: .* has 1"),
        ('"rig/skin"', '"rig/skin", rows = -1', r"v_out\.rows: is -1, must be"),
        ('"rig/skin"', '"rig/skin", rows = []', r"v_out\.rows: is \[\], must be"),
        ('"rig/skin"', '"rig/skin", scale = 0', r"v_out\.scale: is 0, must be"),
        ("scale", 'current = {channel = "rig/shunt"}\nscale', "unit: .* in volt.*per ampere"),
        ("scale", 'time = {channel = "rig/open"}\nscale', "time.unit: .*must be in second"),
        ("scale", "trial = [1, 2]\nscale", "trial: has 2 labels for 1 trial"),
        ("scale", 'path = "../x"\nscale', "path: '../x' cannot be the path"),
        ("scale", "recording = 3\nscale", "recording: must be a list of tables"),
        ("scale", "scale = ", "is not TOML"),
        ("", "[[recording]]\n[[recording]]\n", "path: is not given"),
        ("", A + A, "'a': two recordings have this"),
        ("", A + "[[recording]]\npath = 'a/b'\n", "'a/b': lies inside another"),
        ("", A + B + "r_load = 0\n", "'b', r_load: is 0"),
        ("", A + B + "v_th = {channel = 'x'}\n", "'b', v_th: there is no 'x'"),
        ("", A + B + "v_th = {channel = 'rig/slow'}\n", "'b', sample_rate: differs"),
    ],
)  # fmt: skip
def test_one_error_says_where_what_and_what_there_is(old, new, message, run, rig, tmp_path):
    assert old in GIVEN
    before = sorted(tmp_path.iterdir())
    with pytest.raises(RecordingError, match=message) as caught:
        run(GIVEN.replace(old, new, 1) if old else GIVEN + new)
    assert "rig.t" in caught.value.file or "rig.h5" in caught.value.file
    assert sorted(tmp_path.iterdir()) == sorted([*before, tmp_path / "rig.toml"])


@pytest.mark.parametrize(
    ("mapping", "given", "message"),
    [
        ("none.toml", {}, r"none\.toml: there is no such mapping"),
        ({}, {"pulse_rate": 60.0}, "pulse_rate: cannot be an argument"),
        ({}, {"subject": "s01"}, "subject: cannot be an argument"),
    ],
)
def test_what_is_asked_beside_a_mapping_is_refused(mapping, given, message, rig, tmp_path):
    with pytest.raises(RecordingError, match=message):
        etid.import_file(rig, tmp_path / "a.h5", mapping, **given)


def test_several_recordings_share_what_is_said_above_them(run):
    recordings, used = run(
        GIVEN
        + """
        [[recording]]
        path = "calibration/98k8"
        r_load = 98.8e3
        [[recording]]
        path = "s01/dry"
        calibration = "calibration/98k8"
        subject = 1
        trial = 7
        electrode = "E17"
        adc_range = [-186.9, 186.9]
        v_out = {channel = "rig/shunt"}
        """
    )
    assert list(recordings) == ["calibration/98k8", "s01/dry"]
    known, dry = recordings.values()
    assert (known.r_load, dry.r_load) == (98.8e3, None)
    assert (dry.subject, dry.trial, dry.electrode) == ("1", "7", "E17")
    assert (dry.calibration, dry.adc_range) == (("calibration/98k8",), (-186.9, 186.9))
    assert [each.signals["v_out"].channel for each in used] == ["rig/skin", "rig/shunt"]


def test_rows_choose_sweeps_and_their_labels_may_be_given(run, tmp_path):
    sweeps = np.stack([TH, OUT, OUT / 2, OUT / 4])
    source = abf(tmp_path / "a.abf", sweeps)
    text = """
        pulse_rate = 60.0
        scale = 1
        path = "s01/dry"
        trial = ["first", "second"]
        v_th = {channel = "ch0", rows = [0, 0]}
        v_out = {channel = "ch0", rows = [3, 1]}
        """
    recordings, used = run(text, source)
    assert [one.trial for one in recordings.values()] == ["first", "second"]
    assert used[0].paths == ("s01/dry/0", "s01/dry/1")
    step = recordings["s01/dry/0"].samples["v_out"].conversion
    for one, row in zip(recordings.values(), (3, 1), strict=True):
        np.testing.assert_allclose(one.v_out, sweeps[row], rtol=0, atol=1.001 * step)
        np.testing.assert_allclose(one.v_th, sweeps[0], rtol=0, atol=1.001 * step)
    with pytest.raises(RecordingError, match=r"v_th: 3 rows of 'ch0' with 800 samples, v_o"):
        run(text.replace("rows = [0, 0]", "rows = [0, 1, 2]"), source)
    single = run(
        text.replace("[3, 1]", "2").replace("[0, 0]", "0").replace('", "second', ""), source
    )
    assert list(single[0]) == ["s01/dry"]


def test_the_command_takes_a_mapping(rig, tmp_path, capsys):
    mapping, target = tmp_path / "rig.toml", tmp_path / "rig.h5"
    mapping.write_text(GIVEN, encoding="utf-8")
    assert cli.main(["import", str(rig), "-o", str(target), "--mapping", str(mapping)]) == 0
    assert "'rig/skin' in mV (file), divided by 0.0535" in capsys.readouterr().out
