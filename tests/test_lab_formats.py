"""WAV, LabVIEW, Excel and npz files, arrays, and one long record that holds several trials."""

import struct
from typing import Any

import numpy as np
import openpyxl
import pytest
import scipy.io.wavfile

import etid
from etid import RecordingError
from tests import lab_files
from tests.lab_files import labview, refused

RATE, PULSES = 20e3, 60.0
PERIOD = RATE / PULSES
FIELDS = {"pulse_rate": PULSES, "scale": 1.0}
NAMES = {"v_th": "open", "v_out": "skin"}


def pulses(periods=6, before=0):
    """Pulses of 48 V, and what a divider leaves of them."""
    time = np.arange(round(periods * PERIOD)) + 0.5 * PERIOD
    th = np.where(time % PERIOD < 0.04 * PERIOD, 48.0, 0.0)
    th = np.concatenate([np.zeros(before), th])
    return th, 0.75 * th


def long_record():
    """Three trains of 4, 6 and 5 pulses with pauses."""
    trains = [pulses(count, before=2000)[0] for count in (4, 6, 5)]
    th = np.concatenate([*trains, np.zeros(2000)])
    return th, 0.75 * th


def imported(path, **given):
    recordings, used = lab_files.imported(path, **{**FIELDS, **given})
    return list(recordings.values()), used


def of_arrays(folder, arrays, **given):
    """The recordings of an npz file of the channels `th`, `out` and others."""
    np.savez(folder / "a.npz", **arrays)
    told = {"v_th": "th", "v_out": "out", "sample_rate": RATE, **given}
    return imported(folder / "a.npz", **told)


@pytest.mark.parametrize("kind", [np.int16, np.int32, np.uint8, np.float32])
def test_a_wav_file_holds_fractions_of_full_scale(kind, tmp_path):
    th, out = pulses()
    both = np.stack([th, out], axis=1) / 100
    full = {np.int16: 2**15, np.int32: 2**31, np.uint8: 2**7, np.float32: 1}[kind]
    middle = 128 if kind is np.uint8 else 0
    codes = (both * full + middle).round(0 if full > 1 else 9).astype(kind)
    scipy.io.wavfile.write(tmp_path / "a.wav", int(RATE), codes)
    with (tmp_path / "a.wav").open("ab") as file:
        file.write(b"LIST" + (4).to_bytes(4, "little") + b"INFO")  # as sound editors append it
    [recording], [used] = imported(tmp_path / "a.wav", v_th="1", v_out="2", scale=0.01)
    assert (recording.sample_rate, used.rate_by) == (RATE, "file")
    np.testing.assert_allclose(recording.v_th, th, atol=100 / full if full > 1 else 1e-5)
    np.testing.assert_allclose(recording.v_out, out, atol=100 / full if full > 1 else 1e-5)


@pytest.mark.parametrize("missing", [0, 4])
def test_a_wav_file_of_more_than_4_gb_says_its_length_elsewhere(missing, tmp_path):
    """As RF64 (EBU Tech 3306): lengths of 64 bits stand before the samples; here of a short one."""
    th, out = pulses()
    codes = np.stack([32 * th, 32 * out], axis=1).astype("<i2").tobytes()
    path, unknown = tmp_path / "a.wav", 2**32 - 1
    path.write_bytes(
        struct.pack("<4sI4s", b"RF64", unknown, b"WAVE")
        + struct.pack("<4sIQQQI", b"ds64", 28, 86 + len(codes), len(codes), len(th), 0)
        + struct.pack("<4sIHHIIHH", b"fmt ", 16, 1, 2, int(RATE), 4 * int(RATE), 4, 16)
        + struct.pack("<4sI6s", b"note", 5, b"odd")  # a filling byte is not counted
        + struct.pack("<4sI", b"data", unknown)
        + codes[: len(codes) - missing]
    )
    names = {**FIELDS, "v_th": "1", "v_out": "2", "scale": 2**-10}
    if missing:
        refused(path, None, "is truncated: its samples end at byte", **names)
    else:
        [recording], _ = imported(path, **names)
        np.testing.assert_array_equal(recording.v_out, out)


def virtual(path, times=None, step=1 / RATE, **said):
    """A LabVIEW file of pulses."""
    times = [f"{i / RATE:.6f}" for i in range(2000)] if times is None else times
    return labview(path / "a.lvm", times, *pulses(), step=f"{step:.6E}", **said)


@pytest.mark.parametrize(
    ("separator", "decimal", "columns"),
    [("Tab", ".", "One"), ("Tab", ",", "No"), ("Comma", ".", "One")],
)
def test_a_labview_file_says_how_it_is_written(separator, decimal, columns, tmp_path):
    th, out = pulses()
    path = virtual(
        tmp_path, [""] * 2000 if columns == "No" else None, separator=separator,
        decimal=decimal, columns=columns, unit="mV",
    )  # fmt: skip
    [recording], [used] = imported(path, **NAMES)
    np.testing.assert_allclose(recording.v_out, out / 1e3, atol=1e-9)
    np.testing.assert_allclose(recording.v_th, th, atol=1e-6)
    assert recording.sample_rate == RATE
    assert str(used.signals["v_out"]) == "'skin' in mV (file)"


@pytest.mark.parametrize(
    ("said", "message"),
    [
        ({"count": 2001}, "'open' has 2000 samples, the file declares 2001"),
        ({"step": 2 / RATE}, "Delta_X: is 0.0001 s, but the column of times has steps of 5e-05 s"),
        ({"step": 0.5 / RATE}, "Delta_X: is 2.5e-05 s, but the column of times has steps"),
        ({"name": "open [mV]"}, r"v_th: the file says 'Volts' and 'mV' of channel 'open \[mV\]'"),
    ],
)
def test_a_labview_file_that_contradicts_itself_is_refused(said, message, tmp_path):
    names = {**NAMES, "v_th": said.get("name", "open")}
    assert refused(virtual(tmp_path, **said), None, message, **names, **FIELDS).remedy


def test_a_labview_file_without_times_and_intervals_needs_a_sample_rate(tmp_path):
    path = virtual(tmp_path, [""] * 2000)
    text = path.read_text()
    path.write_text("\n".join(one for one in text.split("\n") if not one.startswith("Delta_X")))
    refused(path, None, "sample_rate", **NAMES, **FIELDS)
    assert imported(path, **NAMES, sample_rate=RATE)[0][0].sample_rate == RATE


def test_a_labview_file_may_have_coarse_times_more_samples_and_a_cut_end(tmp_path):
    coarse = [f"{i / RATE:.4f}" for i in range(2000)]
    again = [f"{i % 500 / RATE:.6f}" for i in range(2000)]  # appended three times
    for times in ([""] * 2000, coarse, again):
        assert imported(virtual(tmp_path, times), **NAMES)[0][0].sample_rate == RATE
    # LabVIEW appends to a file without changing its header.
    [one], _ = imported(virtual(tmp_path, count=10), **NAMES)
    np.testing.assert_array_equal(one.v_th, pulses()[0])
    path = virtual(tmp_path)
    path.write_text(path.read_text()[:-5])
    assert "the last number" in imported(path, **NAMES)[1][0].notices[0]


def test_columns_of_a_workbook_have_the_names_of_their_first_row(tmp_path):
    th, out = pulses(2)
    book: Any = openpyxl.Workbook()
    book.active.append(["t (s)", "open", "finger [mV]"])
    for i, (a, b) in enumerate(zip(th, out, strict=True)):
        book.active.append([i / RATE, float(a), 1e3 * float(b)])
    other = book.create_sheet("second")
    for row in [["open"], *([2 * float(a)] for a in th)]:
        other.append(row)
    book.save(tmp_path / "a.xlsx")
    [recording], _ = imported(tmp_path / "a.xlsx", v_th="open", v_out="finger", time="t")
    np.testing.assert_allclose(recording.v_th, th)
    np.testing.assert_allclose(recording.v_out, out)
    assert recording.sample_rate == pytest.approx(RATE)
    [recording], _ = imported(tmp_path / "a.xlsx", v_th="second/open", v_out="open", time="t")
    np.testing.assert_allclose(recording.v_th, 2 * th)
    book["second"].insert_rows(2)
    book["second"]["A2"] = "(mV)"
    book.save(tmp_path / "a.xlsx")
    [recording], _ = imported(tmp_path / "a.xlsx", v_th="second/open", v_out="open", time="t")
    np.testing.assert_allclose(recording.v_th, 2e-3 * th)


def test_arrays_of_an_npz_file_are_channels(tmp_path):
    th, out = pulses()
    arrays = {"open": th, "finger": np.stack([out, out / 2]), "note": np.array("text")}
    arrays["mV [mV]"] = 1e3 * th
    recordings, _ = of_arrays(tmp_path, arrays, v_th="mV [mV]", v_out="finger")
    assert [one.path for one in recordings] == ["loaded/0", "loaded/1"]
    np.testing.assert_array_equal(recordings[1].v_out, out / 2)
    np.testing.assert_allclose(recordings[1].v_th, th)
    for name, message in (
        ("opn", "the names are 'open', 'finger', 'note', "),
        ("note", "must be an array of real numbers"),
    ):
        with pytest.raises(RecordingError, match=message):
            of_arrays(tmp_path, arrays, v_th=name, v_out="finger")


def test_a_long_record_is_split_at_its_pauses(tmp_path):
    th, out = long_record()
    recordings, [used] = of_arrays(tmp_path, {"th": th, "out": out}, split="pulses")
    assert [one.trial for one in recordings] == ["0", "1", "2"]
    assert [round(one.periods, 2) for one in recordings] == [4, 6, 5]
    assert used.paths == ("loaded/0", "loaded/1", "loaded/2")
    for one in recordings:
        rises = np.count_nonzero(np.diff(one.v_th) > 10)
        assert rises == round(one.periods)
        np.testing.assert_array_equal(one.v_out, 0.75 * one.v_th)
    whole = etid.Recording(th, out, sample_rate=RATE, pulse_rate=PULSES, path="long")
    for one, other in zip(whole.split(), recordings, strict=True):
        np.testing.assert_array_equal(one.v_th, other.v_th)
        assert one.path == f"long/{one.trial}"


def test_all_trials_of_a_resistor_are_calibrations_of_every_trial(tmp_path):
    th, out = pulses()
    np.savez(tmp_path / "known.npz", th=th, out=np.stack([out, out]))
    arrays = {"th": th, "out": np.stack([out, out / 2, out / 3])}
    calibrations = {tmp_path / "known.npz": "98k8"}
    recordings, _ = of_arrays(tmp_path, arrays, calibrations=calibrations)
    known = tuple(one.path for one in recordings if one.r_load == 98.8e3)
    assert known == ("calibration/known/0", "calibration/known/1")
    assert [one.calibration for one in recordings[2:]] == [known] * 3


def in_turn(rests=(2000, 2000)):
    """Four trains of three pulses: two electrodes in two rounds, and a trigger."""
    trains = [pulses(3, before=before)[0] for before in (rests[0], 500, 500, 500)]
    sizes = [len(train) for train in trains]
    trigger = np.concatenate([np.arange(size) == 100 for size in sizes]).astype(float)
    th = np.concatenate([*trains, np.zeros(rests[1])])
    level = np.repeat([0.5, 0.25, 0.5, 0.25], sizes)
    out = th * np.append(level, np.zeros(rests[1]))
    return {"th": th, "out": out, "trigger": np.append(trigger, np.zeros(rests[1]))}


@pytest.mark.parametrize("split", ["pulses", "trigger"])
def test_electrodes_that_fire_in_turn_become_recordings_of_each(tmp_path, split):
    th, out = pulses()
    np.savez(tmp_path / "known.npz", th=th, out=out)
    calibrations = {tmp_path / "known.npz": 98.8e3}
    given = {"split": split, "electrode": ["E7", "E12"], "calibrations": calibrations}
    (known, *recordings), _ = of_arrays(tmp_path, in_turn(), **given)
    assert (known.path, known.electrode) == ("calibration/known", "")
    found = {one.path.replace("/a/", "/"): (one.electrode, one.trial) for one in recordings}
    assert found == {f"loaded/{e}/{n}": (e, n) for e in ("E7", "E12") for n in ("0", "1")}
    for one in recordings:
        assert round(one.periods, 2) == 3
        level = {"E7": 0.5, "E12": 0.25}[one.electrode]
        np.testing.assert_array_equal(one.v_out, level * one.v_th)


def test_electrodes_may_fire_without_a_pause(tmp_path):
    th = np.concatenate([pulses(6)[0], np.zeros(500)])
    trigger = np.isin(np.arange(th.size), [100, round(3 * PERIOD) + 100]).astype(float)
    arrays = {"th": th, "out": th / 2, "trigger": trigger}
    recordings, _ = of_arrays(tmp_path, arrays, split="trigger", electrode=["E1", "E2"])
    assert [one.electrode for one in recordings] == ["E1", "E2"]
    assert [round(one.periods, 1) for one in recordings] == [3, 3]


def test_a_train_that_an_end_of_the_record_cuts_is_left_out_with_a_note(tmp_path):
    arrays = in_turn()
    end = arrays["th"].size - 2000 - round(PERIOD)  # inside the last train
    arrays = {name: array[:end] for name, array in arrays.items()}
    recordings, [used] = of_arrays(tmp_path, arrays, split="pulses")
    assert [one.trial for one in recordings] == ["0", "1", "2"]
    note = "the end of the record cuts 1 train of pulses, which is left out"
    assert (used.notices, str(used).splitlines()[-1]) == ((note,), f"  note: {note}")
    first = {name: array[2100 : 2000 + round(3 * PERIOD)] for name, array in arrays.items()}
    first["trigger"][10] = 1.0
    with pytest.raises(RecordingError, match="the end of the record cuts the last"):
        of_arrays(tmp_path, first, split="trigger")


def test_a_record_may_begin_with_its_first_pulse(tmp_path):
    arrays = in_turn()
    begin = np.flatnonzero(np.diff(arrays["th"]) > 10)[0] - 5
    begun = {name: array[begin:] for name, array in arrays.items()}
    recordings, [used] = of_arrays(tmp_path, begun, split="pulses")
    assert [round(one.periods, 2) for one in recordings] == [3, 3, 3, 3]
    assert not used.notices


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"electrode": ["E7", "E12"]}, "the list .*Give split too"),
        ({"split": "pulses", "electrode": []}, "is the list"),
        ({"split": "pulses", "electrode": ["E1", "E2", "E3"]},
         "names 3 electrodes, but the record has 4 trains"),
        ({"split": "pulses", "electrode": ["E7", "E12"], "rests": (0, 0)},
         "cuts the last"),
        ({"split": "what"}, "there is no 'what'"),
        ({"split": "trigger", "electrode": ["E7", "E12"], "trial": 3}, "has 1 label for 4 trials"),
        ({"split": "pulses", "v_out": "stack"}, "can be split"),
    ],
)  # fmt: skip
def test_refusals_of_a_record_that_is_split(tmp_path, given, message):
    given = {"rests": (2000, 2000), **given}
    held = in_turn(given.pop("rests"))
    more = {"stack": np.stack([held["out"]] * 2)}
    with pytest.raises(RecordingError, match=message):
        of_arrays(tmp_path, {**held, **more}, **given)


def test_a_long_record_is_split_at_the_edges_of_a_trigger(tmp_path):
    th, out = long_record()
    trigger = np.zeros(th.size)
    for start in (1900, 1900 + 3600, 1900 + 7300):  # before the trains, which begin with a rest
        trigger[start : start + 50] = 5.0
    recordings, _ = of_arrays(tmp_path, {"th": th, "out": out, "trig": trigger}, split="trig")
    whole = etid.Recording(th, out, sample_rate=RATE, pulse_rate=PULSES)
    # As by the pauses: a trial has whole periods, without the pause after them.
    for one, by_edge, by_pause in zip(recordings, whole.split(trigger), whole.split(), strict=True):
        np.testing.assert_array_equal(one.v_th, by_pause.v_th)
        np.testing.assert_array_equal(by_edge.v_th, by_pause.v_th)
        assert by_edge.path == by_pause.path
    for wrong, message in (
        (np.zeros(th.size), "no rising edge"),
        (np.zeros(5), r"has shape \(5,\), must be"),
        (np.arange(th.size) > th.size - 100, "no pulse follows a rising edge"),
    ):
        with pytest.raises(RecordingError, match=message):
            whole.split(wrong)
    with pytest.raises(RecordingError, match="without a pause"):
        etid.Recording(*pulses(), sample_rate=RATE, pulse_rate=PULSES).split()


def test_arrays_become_a_study():
    th, out = pulses()
    study = etid.Study.from_arrays(
        th,
        np.stack([out, out / 2]),
        calibrations={98.8e3: (th, 0.9 * th), 21.6e3: (th, 0.6 * th)},
        sample_rate=RATE,
        pulse_rate=PULSES,
        subject="s01",
    )
    assert list(study) == ["calibration/0", "calibration/1", "loaded/0", "loaded/1"]
    assert study["calibration/1"].r_load == 21.6e3
    loaded = study["loaded/1"]
    assert (loaded.subject, loaded.trial) == ("s01", "1")
    assert loaded.calibration == ("calibration/0", "calibration/1")
    np.testing.assert_array_equal(loaded.v_out, out / 2)
    with pytest.raises(RecordingError, match=r"v_th \(3, 2000\), v_out \(2, 2000\)"):
        etid.Study.from_arrays(
            np.stack([th] * 3), np.stack([out] * 2), sample_rate=RATE, pulse_rate=PULSES
        )
