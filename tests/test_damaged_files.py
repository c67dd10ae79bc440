"""Damaged files end in an answer or in one error of etid's own: no crash, no hang, no memory."""

import re
import tracemalloc

import h5py
import numpy as np
import pytest

import etid
from benchmarks import fuzz, specimens
from etid.files.readers import matlab_5
from etid.recordings import hdf5, limits, untrusted
from etid.results.study_fits import StudyFits

FEW = 4  # files of each kind in the ordinary tests
MANY = 1000  # files in the slow one
ONCE_WRONG = {  # damage that once ended in a foreign error or in a hang
    "fits": (3028246,),  # damaged bytes in a list of texts
    "matlab5": (3031157,),  # no such class
    "recordings": (6001032,),  # a dataset that looks virtual, with a heap that is a loop
}


@pytest.fixture(scope="module")
def kinds():
    return specimens.kinds()


@pytest.mark.parametrize("name", fuzz.SHARES)
def test_a_damaged_file_is_read_or_refused(kinds, name, tmp_path):
    for seed in (*range(1, FEW + 1), *ONCE_WRONG.get(name, ())):
        path = fuzz.damage(tmp_path, kinds[name], seed)
        assert fuzz.judge(path, kinds[name], seed)[0] in fuzz.FINE, seed


@pytest.mark.slow
def test_a_thousand_damaged_files_neither_crash_nor_hang():
    cases = [(fuzz.kind_of(seed), seed) for seed in range(MANY)]
    wrong = [found for found in fuzz.run(cases, 5.0) if found["outcome"] not in fuzz.FINE]
    assert wrong == []


# Recordings


@pytest.fixture
def texts(kinds, tmp_path):
    """A study with texts of variable length, as h5py writes them by itself."""
    path = tmp_path / "study.h5"
    path.write_bytes(kinds["recordings"].good[1])
    return path


@pytest.mark.parametrize(
    ("place", "value"),
    [
        (16, bytes(16)),  # a free object of size 0: the library never ends
        (8, (2 << 30).to_bytes(8, "little")),  # more than the file holds, before it is allocated
    ],
)
def test_a_heap_whose_objects_go_in_a_circle_or_beyond_the_file_is_an_error(texts, place, value):
    data = bytearray(texts.read_bytes())
    heap = data.find(b"GCOL\x01") + place
    data[heap : heap + len(value)] = value
    texts.write_bytes(data)
    assert "the heap of texts" in hdf5.check(texts)[0].message
    with pytest.raises(etid.RecordingError, match="the heap of texts"):
        with untrusted.guarded(str(texts)) as file:
            untrusted.attribute(file["s02/dry"], "kind")


def test_whatever_needs_a_damaged_heap_is_an_error_and_no_hang(texts):
    """Not only what the schema knows: this dataset was once opened without a guard."""
    with h5py.File(texts, "r+") as file:
        layout = h5py.VirtualLayout((4,), "f8")
        layout[...] = h5py.VirtualSource("elsewhere.h5", "part", (4,))
        file.create_virtual_dataset("other", layout)
    data = bytearray(texts.read_bytes())
    heap = data.rfind(b"GCOL\x01", 0, data.find(b"elsewhere.h5"))
    data[heap + 16 : heap + 32] = bytes(16)  # as above
    texts.write_bytes(data)
    assert any("the heap of texts" in problem.message for problem in hdf5.check(texts))
    with etid.read(texts) as study:
        assert "other" in study.problems


@pytest.mark.parametrize("libver", ["earliest", "latest"])
@pytest.mark.parametrize(
    ("kind", "lost"),  # lost: the address of the heap, too
    [("attribute", False), ("attribute", True), ("attributes", True)],
)
def test_a_text_that_is_said_to_be_long_is_refused_before_its_length_is_allocated(
    tmp_path, libver, kind, lost
):
    path = tmp_path / "texts.h5"
    texts = ["calibration/0", "s01"]
    with h5py.File(path, "w", libver=libver) as file:
        file.attrs["named"] = texts if kind == "attributes" else texts[0]

    def read():
        with untrusted.guarded(str(path)) as file:
            return file.attrs["named"]

    assert np.size(np.asarray(read())) == (2 if kind == "attributes" else 1)
    data = bytearray(path.read_bytes())
    heap = data.find(b"GCOL\x01")
    descriptor = np.array([len(texts[0]), heap, 0], "u4").tobytes()
    at = data.find(descriptor)
    assert at > 0
    data[at : at + 4] = (2**31 - 1).to_bytes(4, "little")
    if lost:
        data[at + 4 : at + 12] = (heap + 1).to_bytes(8, "little")
    path.write_bytes(data)
    with pytest.raises(etid.RecordingError, match="a text of 2147483647 bytes"):
        read()


def stored_again(path, *arguments, **options):
    """Another dataset `s02/dry/v_out` with its attributes; where its first chunk is."""
    with h5py.File(path, "r+") as file:
        attributes = dict(file["s02/dry/v_out"].attrs)
        del file["s02/dry/v_out"]
        data = file.create_dataset("s02/dry/v_out", *arguments, **options)
        data.attrs.update(attributes)
        file.flush()
        return data.id.get_chunk_info(0).byte_offset if data.id.get_num_chunks() else None


@pytest.mark.parametrize(
    ("shape", "chunks", "message"),
    [
        ((limits.SAMPLES + 1,), (64,), "samples are read"),
        ((limits.TRIALS + 1, 64), (64, 64), "trials of"),
        ((limits.FREE,), (64,), "only 0 bytes are stored"),
        ((limits.FREE_TRIALS + 1, 4), (64, 4), "only 0 bytes are stored"),
        ((limits.CHUNK,), (limits.CHUNK,), "samples are read|chunks of"),
    ],
)
def test_what_is_declared_beyond_a_limit_is_refused_before_it_is_read(
    texts, shape, chunks, message
):
    stored_again(texts, shape, "i2", chunks=chunks)
    (problem,) = hdf5.check(texts)
    assert (problem.path, problem.field) == ("s02/dry", "v_out")
    assert problem.remedy
    assert re.search(message, problem.message)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda f: f.create_group("/".join("g" * (limits.DEPTH + 2))), "groups deep"),
        (lambda f: [f["s01"].attrs.update({f"x{i}": i}) for i in range(limits.NAMES + 1)],
         "attributes, at most"),
        (lambda f: f.__setitem__("s01/x", h5py.SoftLink("/s01/x")), "in a loop"),
    ],
)  # fmt: skip
def test_depth_counts_and_links_have_limits(texts, change, message):
    with h5py.File(texts, "r+", libver="latest") as file:
        change(file)
    assert any(message in problem.message for problem in hdf5.check(texts))


def test_a_damaged_chunk_costs_its_own_recording(texts):
    """Its checksum no longer fits, as after a bad sector; that is seen when samples are read."""
    with etid.read(texts) as study:
        codes = study["s02/dry"].samples["v_out"].stored
    offset = stored_again(texts, data=codes, chunks=codes.shape, fletcher32=True)
    assert offset is not None
    with texts.open("r+b") as raw:
        raw.seek(offset + 50)
        raw.write(b"\xff\x00\xff")
    with etid.read(texts) as study:
        assert "s02/dry" in study
        with pytest.raises(etid.RecordingError, match="'s02/dry', v_out: "):
            study["s02/dry"]
        assert study["s01/dry/0"].v_out.size > 0


# Files of fits


@pytest.fixture
def fits(tmp_path):
    path = tmp_path / "fits.h5"
    specimens.study_fits().write(path)
    return path


def column(name, values):
    def change(file):
        del file[name]
        if values is not None:
            file[name] = values

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (column("chi2", None), "chi2: the column is missing"),
        (column("steps", np.zeros(6)), "steps: is of type float64, must be integer"),
        (column("cov", np.zeros((6, 2, 2))), "cov: has shape"),
        (column("verdict", ["fine"] * 6), "verdict: 'fine' is not a verdict"),
        (column("drivers", ["{"]), r"drivers\[0\]: holds a driver that cannot be read"),
        (column("drivers", ["[" * 10**5]), r"drivers\[0\]: holds a driver .*RecursionError"),
        (column("drivers", ['{"calibrations": 1}']), "calibrations is 1, must be paths"),
        (lambda file: file.attrs.update(order="five"), "order: is 'five', must be"),
        (lambda file: file.attrs.update(start="x"), "start: is 'x', must be"),
    ],
)
def test_wrong_fits_are_one_error_that_names_file_column_and_remedy(fits, change, message):
    with h5py.File(fits, "r+") as file:
        change(file)
    with pytest.raises(etid.RecordingError, match=message) as caught:
        StudyFits.read(fits)
    assert caught.value.file == str(fits)
    assert caught.value.remedy


def test_a_column_whose_texts_are_said_to_be_long_is_refused_before_it_is_read(fits):
    with h5py.File(fits) as file:
        start = file["path"].id.get_offset()
    data = bytearray(fits.read_bytes())
    for row in range(6):  # each is shorter than the file, all of them are not
        at = start + 16 * row
        data[at : at + 4] = (len(data) // 3).to_bytes(4, "little")
    fits.write_bytes(data)
    with pytest.raises(etid.RecordingError, match="path: declares texts of"):
        StudyFits.read(fits)


# Files of other formats


@pytest.mark.parametrize("seed", [2010688, 2010930, 2014648])
def test_tdms_that_declares_long_texts_allocates_no_more_than_the_file_holds(kinds, tmp_path, seed):
    path = fuzz.damage(tmp_path, kinds["tdms"], seed)
    tracemalloc.start()
    try:
        assert fuzz.judge(path, kinds["tdms"], seed)[0] == "refused"
        assert tracemalloc.get_traced_memory()[1] < 1 << 26
    finally:
        tracemalloc.stop()


def test_matlab_that_declares_a_huge_shape_is_refused_at_once(kinds, tmp_path):
    path = tmp_path / "rig.mat"
    path.write_bytes(kinds["matlab"].good[0])
    with h5py.File(path, "r+") as file:
        del file["skin"]
        data = file.create_dataset("skin", (2**40, 1), "f8", chunks=(64, 1))
        data.attrs["MATLAB_class"] = np.bytes_("double")
    with pytest.raises(etid.RecordingError, match="only 0 bytes are stored"):
        kinds["matlab"].use(path, 0)


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        (145, 0x08, "without its numbers"),  # says that it is complex: of what follows
        (144, 5, "without its numbers"),  # says that it is sparse: the same
        (176, 8, "of type 8, which does not exist"),
        (178, 5, "has a short element of 5 bytes"),  # it has room for four
    ],
)
def test_a_damaged_matlab_5_is_refused_before_scipy_ends_the_process(
    kinds, place, value, message, tmp_path
):
    path = tmp_path / "rig.mat"
    data = bytearray(kinds["matlab5"].good[0])
    assert (data[144:146], data[176]) == (b"\x06\x00", 9)  # a real double, and its numbers
    matlab_5.check(_written(path, data))
    data[place] = value
    with pytest.raises(etid.RecordingError, match=message):
        matlab_5.check(_written(path, data))


def _written(path, data):
    path.write_bytes(data)
    return path


def test_an_archive_that_declares_more_than_it_holds_is_refused(kinds, tmp_path):
    path = tmp_path / "codes.npz"
    codes = np.broadcast_to(np.int16(1), (1, 1 + limits.FREE // 2))
    np.savez_compressed(path, adc_th=codes, adc_out=codes[:, :1], adc_ref=codes[:, :1],
                        R_ref=1.0, fs=2e5, f0=60.0, lsb=1.0, scale=1.0)  # fmt: skip
    with pytest.raises(etid.RecordingError, match="adc_th: declares int16 of shape"):
        etid.import_file(path, tmp_path / "out.h5")


@pytest.mark.parametrize(
    "text", ["v_th = " + "[" * 10**4, ".".join("a" * 30_000) + " = 1", "a = " + "{a=" * 10**4]
)
def test_a_deep_mapping_is_refused_at_once(tmp_path, text):
    path = tmp_path / "deep.toml"
    path.write_text(text)
    (tmp_path / "rig.csv").write_text("open,skin\n1,2\n")
    with pytest.raises(etid.RecordingError, match="is not TOML") as caught:
        etid.import_file(tmp_path / "rig.csv", tmp_path / "out.h5", path)
    assert caught.value.file == str(path)
