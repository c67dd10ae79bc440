"""Files that contradict themselves or are cut off: refused, or taken with a notice."""

import re

import numpy as np
import pytest

from tests import lab_files
from tests.lab_files import table

COUNT = 30
V_TH = np.round(np.random.default_rng(8).normal(size=COUNT), 3)
V_OUT = V_TH / 2
GIVEN = {"v_th": "open", "v_out": "skin", "pulse_rate": 60.0, "scale": 1.0}
RATE = {"sample_rate": 200e3}


def imported(path, **given):
    """The recording of a file, and the notices."""
    recordings, [used] = lab_files.imported(path, **{**GIVEN, **given})
    return next(iter(recordings.values())), used.notices


def refused(path, message, **given):
    assert lab_files.refused(path, None, message, **{**GIVEN, **given}).remedy


def rows(sign=".", between=",", end=""):
    """Times, V_th and V_out in text."""
    lines = [
        between.join(f"{x:.6f}".replace(".", sign) for x in (i * 5e-6, a, b)) + end
        for i, (a, b) in enumerate(zip(V_TH, V_OUT, strict=True))
    ]
    return [f"{line}\n" for line in lines]


# Tables


def test_notes_quotes_and_delimiters_at_the_end_are_no_fault(tmp_path):
    ends = ["\n", ",\n", ",fine\n", ',"fine, though"\n', ",,\n"]
    lines = [line[:-1] + ends[i % len(ends)] for i, line in enumerate(rows())]
    lines = [re.sub(r"^([^,]*)", r'"\1"', line) if i % 3 else line for i, line in enumerate(lines)]
    one, notices = imported(table(tmp_path, "t,open,skin,note\n" + "".join(lines)), time="t")
    np.testing.assert_array_equal(one.v_th, V_TH)
    np.testing.assert_allclose(one.v_out, V_OUT, rtol=0, atol=1e-12)
    assert notices == ()


@pytest.mark.parametrize(("sign", "between", "end"), [(".", ",", ""), (",", ";", ";")])
def test_a_table_that_ends_inside_a_number_is_taken_with_a_notice(sign, between, end, tmp_path):
    told = {} if sign == "." else {"delimiter": between, "decimal": sign}
    text = between.join(["t", "open", "skin"]) + end + "\n" + "".join(rows(sign, between, end))
    whole = text.rstrip(end + "\n")
    for shown in (text, whole):  # a line break is often missing
        assert imported(table(tmp_path, shown), **told, **RATE)[1] == ()
    one, [notice] = imported(table(tmp_path, whole[:-4]), **told, **RATE)
    last = whole[:-4].rpartition(between)[2]
    assert notice.startswith(f"the last number, '{last}', is shorter than those above")
    assert one.v_out[-1] == float(last.replace(",", "."))
    refused_end = whole.rpartition(between)[0]
    refused(table(tmp_path, refused_end), "has 2 cells; the table has", **told, **RATE)


def test_the_preamble_of_an_oscilloscope_is_compared_with_its_table(tmp_path):
    body = "t [s],open [V],skin [V]\n" + "".join(rows())

    def scope(length, interval):
        said = f"Model,DPO\nRecord Length,{length}\nSample Interval,{interval}\n"
        return table(tmp_path, said + body)

    told = {"time": "t", "header_line": 4}
    assert imported(scope(30, "5e-06,s"), **told)[1] == ()
    assert imported(scope("3.0e+01", "5,us"), **told)[1] == ()
    without, _ = imported(scope(30, "5e-06"), header_line=4)
    assert without.sample_rate == 200e3
    _, [used] = lab_files.imported(scope(40, "5e-06"), **{**GIVEN, **told})
    notice = "the table has 30 rows, its preamble declares 40 samples"
    assert str(used).endswith(f"\n  note: {notice}")
    refused(scope(30, "1e-05"), "is 200000 Hz from the time 't', but 100000 Hz from the f", **told)


# Other formats


def labview(path, step=5e-6, times=None, **said):
    times = [f"{i * 5e-6:.6f}" for i in range(COUNT)] if times is None else times
    return lab_files.labview(path / "a.lvm", times, V_TH, V_OUT, step=step, **said)


def test_a_labview_file_that_ends_early_is_refused(tmp_path):
    refused(labview(tmp_path, count=31), "'open' has 30 samples, the file declares 31")
    # LabVIEW appends to a file without changing its header.
    one, _ = imported(labview(tmp_path, count=10))
    np.testing.assert_array_equal(one.v_th, V_TH)
    path = labview(tmp_path)
    path.write_text(path.read_text()[:-5])
    assert "the last number" in imported(path)[1][0]


def test_the_interval_of_a_labview_file_fits_its_times(tmp_path):
    refused(labview(tmp_path, step=1e-5), "Delta_X: is 1e-05 s, but the column of times has steps")
    refused(labview(tmp_path, step=2.5e-6), "Delta_X: is 2.5e-06 s, but the column of")
    coarse = [f"{i * 5e-6:.5f}" for i in range(COUNT)]
    again = [f"{i % 10 * 5e-6:.6f}" for i in range(COUNT)]  # appended three times
    for times in ([""] * COUNT, coarse, again):
        assert imported(labview(tmp_path, times=times))[0].sample_rate == 200e3


def test_a_unit_in_the_name_of_a_channel_is_its_unit(tmp_path):
    path = labview(tmp_path, name="open [mV]")
    said = r"v_th: the file says 'Volts' and 'mV' of channel 'open \[mV\]'"
    refused(path, said, v_th="open [mV]")
    path = tmp_path / "a.npz"
    np.savez(path, skin=V_OUT, **{"open [mV]": V_TH})  # pyright: ignore[reportArgumentType]
    one, _ = imported(path, v_th="open [mV]", **RATE)
    np.testing.assert_allclose(one.v_th, V_TH * 1e-3)
