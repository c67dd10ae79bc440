"""Every reader does what it declares: one test for all formats."""

import contextlib
import re
import sys
import wave

import numpy as np
import openpyxl
import pytest

import etid
from etid.files import channel, formats
from etid.files.readers import delimited
from etid.recordings.replacing import check_ending
from tests import lab_files
from tests.lab_files import refused

RATE = 200e3
CODES = np.random.default_rng(6).integers(-3000, 3000, size=(2, 1280))
TH, OUT = CODES / 1024  # exact in a text of ten digits
TOLD = {"v_th": {"channel": "open"}, "v_out": {"channel": "skin"}, "pulse_rate": 60.0, "scale": 1}


def written(path):
    """Write a file as its suffix says; its unit, and the values of channels in this unit."""
    rows = np.stack([TH, OUT])
    unit, held = "mV", {"open": TH, "skin": OUT}
    codes = dict(zip(held, CODES, strict=True))
    match path.suffix:
        case ".csv" | ".txt" | ".dat":
            head = "Sample Interval,5e-6\nopen [mV],skin [mV]"
            np.savetxt(path, rows.T, "%.10f", ",", header=head, comments="")
        case ".mat":
            held["skin"] = rows
            lab_files.matlab(path, 7.3, **held)
        case ".npz":
            held["skin"] = rows
            np.savez(path, **held)
        case ".tdms":
            held = {"a/open": TH, "a/skin": OUT}
            both = {name: (values, {}) for name, values in held.items()}
            lab_files.tdms(path, both, unit_string="mV", wf_increment=1 / RATE)
        case ".abf":
            held = {"ch0": np.trunc(rows * 3276.8) / 3276.8}  # codes are cut off, not rounded
            lab_files.abf(path, rows, RATE, unit)
        case ".rhd" | ".rhs":
            unit, held = "V", {name: one / 3200 for name, one in codes.items()}
            lab_files.intan(path, {name: one + 32768 for name, one in codes.items()})
        case ".smr":
            held = {name: one / 6553.6 for name, one in codes.items()}
            lab_files.spike2(path, codes)
        case ".wav":
            held = {"1": 1000 * CODES[0] / 2**23, "2": 1000 * CODES[1] / 2**23}
            with wave.open(str(path), "wb") as file:
                file.setparams((2, 3, int(RATE), 0, "NONE", ""))  # of 24 bits
                low = (1000 * CODES).T.ravel().astype("<i4").view("u1").reshape(-1, 4)[:, :3]
                file.writeframes(low.tobytes())
        case ".lvm":
            del held["open"]  # in volts
            times = [f"{i / RATE:.6f}" for i in range(len(TH))]
            lab_files.labview(path, times, TH, OUT, unit=unit, step=f"{1 / RATE:.6E}")
        case ".xlsx":
            book = openpyxl.Workbook(write_only=True)
            sheet = book.create_sheet()
            for row in [["open", "skin"], ["mV", "mV"], *rows.T.tolist()]:
                sheet.append(row)
            book.save(path)
    return unit, held


@pytest.fixture(params=formats.SUFFIXES)
def path(request, tmp_path):
    return tmp_path / f"rig{request.param}"


def parts(path, names):
    """Channels of a file by name, each with its samples as they are read in parts."""
    reader = formats.reader_of(path)
    told = {"header_line": 2} if reader.dialect else {}
    with channel.located(str(path)), reader.open(path, path.parent, **told) as contents:
        assert {*names} <= {*contents.names}
        contents.prepare(names)
        for one in map(contents.channel, names):
            trials = range(one.shape[0] if len(one.shape) == 2 else 1)
            yield one, np.squeeze([np.concatenate([*one.blocks(trial)]) for trial in trials])


def test_a_reader_knows_what_it_declares(path, monkeypatch):
    monkeypatch.setattr(channel, "BLOCK", 7)
    monkeypatch.setattr(delimited, "ROWS", 13)
    reader, (unit, held) = formats.reader_of(path), written(path)
    for one, stored in parts(path, held):
        values = one.conversion * stored + one.offset
        np.testing.assert_allclose(values, held[one.name], rtol=0, atol=1e-6)  # digits of a text
        assert (stored.dtype, one.shape, one.notice) == (one.dtype, stored.shape, "")
        assert one.unit == (unit if reader.unit else "")
        assert one.sample_rate == (RATE if reader.rate else None)
    assert any(values.ndim == 2 for values in held.values()) <= bool(reader.trials)
    assert [*path.parent.iterdir()] == [path]


@pytest.mark.parametrize("cut", [3, 0.1, 0.5])
def test_a_file_that_was_cut_off_is_refused_or_remarked_if_samples_are_lost(cut, path):
    held = written(path)[1]
    whole = path.read_bytes()
    path.write_bytes(whole[: -(cut if cut > 1 else round(cut * len(whole)))])
    with contextlib.suppress(etid.RecordingError):
        for one, stored in parts(path, held):
            values = one.conversion * stored + one.offset
            assert one.notice or np.allclose(values, held[one.name], rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    "content",
    [b"", b"ABF ", b"ABF2" + bytes(9000), b"TDSm" + bytes(40), b"PK\x03\x04 not a zip",
     bytes(range(256)) * 4],
)  # fmt: skip
def test_a_file_of_another_format_is_refused(content, path):
    path.write_bytes(content)
    refused(path, TOLD, re.escape(path.name))


@pytest.mark.parametrize("reader", [one for one in formats.READERS if one.package])
def test_without_its_package_a_file_names_what_to_install(reader, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, reader.package.lower(), None)
    for suffix in reader.suffixes:
        (tmp_path / f"a{suffix}").write_bytes(b"anything")
        needed = rf"needs the package {reader.package}.*'etid\[{reader.extra}\]'"
        refused(tmp_path / f"a{suffix}", TOLD, needed)


def test_a_file_of_recordings_is_never_named_as_one_of_another_format(path):
    with pytest.raises(etid.RecordingError, match="is not written as"):
        check_ending(path)


def test_a_known_file_that_cannot_be_read_says_what_to_export(tmp_path):
    known = " ".join(formats.EXPORTS).split()
    assert len({*known, *formats.SUFFIXES}) == len(known) + len(formats.SUFFIXES)
    (tmp_path / "cell.SMRX").touch()
    message = r"cell\.SMRX: is a file of Spike2, which etid cannot read\. Export it as \.smr, or as"
    refused(tmp_path / "cell.SMRX", TOLD, message)
