import pathlib
import runpy
from typing import Any

import h5py
import hypothesis.extra.numpy as hnp
import jaxtyping
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from etid.recordings import hdf5
from etid.recordings.fields import SIGNALS
from etid.recordings.recording import Recording, RecordingError, Samples
from etid.recordings.study import Study

FOLDER = pathlib.Path(__file__).parents[1] / "data_schema"
RATES = {"sample_rate": 200e3, "pulse_rate": 60.0}
CODES = np.arange(12, dtype="i2").reshape(3, 4)


@pytest.fixture
def path(tmp_path):
    """A valid file by plain h5py: a calibration, a stack of three trials, a single recording."""
    path = tmp_path / "study.h5"
    with h5py.File(path, "w") as file:
        file.attrs.update(schema="etid/recording", schema_version="1.0")
        known = file.create_group("calibration/98k8")
        known.attrs.update(kind="calibration", r_load=98.8e3, **RATES)
        stack = file.create_group("s01/dry")
        stack.attrs.update(kind="loaded", subject="s01", calibration="calibration/98k8", **RATES)
        stack.attrs["trial"] = [1, 2, 3]
        single = file.create_group("s01/damp")
        single.attrs.update(kind="loaded", subject="s01", trial="only", **RATES)
        for group, out in ((known, CODES[0]), (stack, CODES), (single, CODES[1])):
            for name, codes in (("v_th", CODES[0]), ("v_out", out)):
                group[name] = codes
                group[name].attrs.update(unit="volt", conversion=0.5, offset=1.0)
    return path


@pytest.fixture
def edit(path):
    """Change the valid file with a function of the open file."""

    def change(function):
        with h5py.File(path, "r+") as file:
            function(file)
        return path

    return change


def contents(study):
    """What a study holds, for comparison."""

    def held(of):
        return of.stored.dtype, of.stored.tobytes(), of.conversion, of.offset

    return {
        path: (one.metadata, {name: held(of) for name, of in one.samples.items()})
        for path, one in study.items()
    }


# reading


def test_without_a_conversion_and_an_offset_samples_are_in_their_unit(edit):
    def forget(file):
        for name in ("conversion", "offset"):
            del file[f"{DAMP}/v_out"].attrs[name]

    with hdf5.read(edit(forget)) as study:
        np.testing.assert_array_equal(study[DAMP].v_out, CODES[1])


def test_a_file_with_more_than_the_schema_knows_is_read_in_order_of_its_paths(edit):
    def annotate(file):
        file.attrs.update(laboratory="ours", schema_version="1.17")
        file["s01"].attrs["age"] = 30
        file[DAMP].attrs["humidity"] = 0.4
        file[f"{DAMP}/temperature"] = np.zeros((2, 2, 2))
        file["notes"] = "free text"
        file.create_group("s01/photos/left")

    path = edit(annotate)
    assert hdf5.check(path) == []
    with hdf5.read(path) as study:
        assert list(study) == ["calibration/98k8", "s01/damp"] + [f"s01/dry/{i}" for i in range(3)]
        assert study.problems == {}
        assert study.file == str(path)


def test_rows_of_a_stack_are_recordings_with_their_own_label_and_a_common_v_th(path):
    with hdf5.read(path) as study:
        one = study["s01/dry/1"]
        assert (one.trial, one.subject, one.path) == ("2", "s01", "s01/dry/1")
        assert one.calibration == ("calibration/98k8",)
        assert one.samples["v_out"].stored.dtype == np.int16
        np.testing.assert_array_equal(one.v_out, CODES[1] * 0.5 + 1.0)
        np.testing.assert_array_equal(one.v_th, CODES[0] * 0.5 + 1.0)
        assert study["s01/dry/2"].samples["v_th"] is one.samples["v_th"]
        assert study[one.calibration[0]].r_load == 98.8e3


def test_samples_are_not_read_before_they_are_asked_for(path, monkeypatch):
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)  # it looks at an item
    with hdf5.read(path) as study:
        monkeypatch.setattr(h5py.Dataset, "__getitem__", None)
        assert list(study.where(subject="s01", trial="only")) == ["s01/damp"]
        assert list(study.calibrations) == ["calibration/98k8"]
        assert study.metadata("s01/dry/2").trial == "3"
        assert "s01/dry/2" in study
        with pytest.raises(RecordingError, match="cannot read it"):
            study["s01/damp"]


@pytest.mark.parametrize("link", [h5py.SoftLink("/s01/dry/v_th"), None])
def test_records_may_be_shared_by_links_inside_the_file(edit, link):
    def share(file):
        del file["s01/damp/v_th"]
        file["s01/damp/v_th"] = link or file["s01/dry/v_th"]

    path = edit(share)
    assert hdf5.check(path) == []
    with hdf5.read(path) as study:
        np.testing.assert_array_equal(study["s01/damp"].samples["v_th"].stored, CODES[0])


# what is wrong with a recording


def attribute(place, name, value):
    """Write an attribute; one of None is deleted."""

    def change(file):
        if value is None:
            del file[place].attrs[name]
        else:
            file[place].attrs[name] = value

    return change


def put(name, data, unit="volt"):
    """Another dataset v_th, v_out or current in s01/damp; None is a group."""

    def change(file):
        group = file[DAMP]
        if name in group:
            del group[name]
        if data is None:
            group.create_group(name)
            return
        group[name] = data
        if unit and isinstance(group.get(name), h5py.Dataset):
            group[name].attrs["unit"] = unit

    return change


def make_virtual(file):
    layout = h5py.VirtualLayout((4,), "i2")
    layout[:] = h5py.VirtualSource("other.h5", "v", (4,))
    del file[f"{DAMP}/v_out"]
    file[DAMP].create_virtual_dataset("v_out", layout)


def make_external_storage(file):
    del file[f"{DAMP}/v_out"]
    where = [("/dev/zero", 0, 8)]
    file[DAMP].create_dataset("v_out", (4,), "i2", external=where).attrs["unit"] = "volt"


def detour(file):
    file[f"{DAMP}/out"] = ELSEWHERE
    put("v_out", h5py.SoftLink(f"/{DAMP}/out/v"))(file)


def misspell_offset(file):
    attributes = file[f"{DAMP}/v_th"].attrs
    attributes["ofset"] = attributes.pop("offset")


def make_sequence(file):
    dtype = h5py.vlen_dtype(np.dtype("i4"))
    data = np.empty(1, dtype)
    data[0] = np.array([1, 2], "i4")
    file[DAMP].attrs.create("subject", data, dtype=dtype)


DAMP, KNOWN = "s01/damp", "calibration/98k8"
ELSEWHERE = h5py.ExternalLink("b.h5", "/x")
PROBLEMS = [
    (attribute(DAMP, "sample_rate", None), "sample_rate: is missing. Add sample_rate [hertz]"),
    (attribute(DAMP, "sample_rate", 0.0), "sample_rate: is 0 hertz, must be > 0"),
    (attribute(DAMP, "sample_rate", "200k"), "is '200k', must be a finite real number"),
    (attribute(DAMP, "sample_rate", True), "sample_rate: is True, must be"),
    (attribute(DAMP, "sample_rate", 1j), "must be a finite real number"),
    (attribute(DAMP, "sample_rate", [1.0, 2.0]), "sample_rate: has shape (2,)"),
    (attribute(DAMP, "sample_rate", []), "sample_rate: is empty"),
    (attribute(DAMP, "pulse_rate", np.nan), "pulse_rate: is nan"),
    (attribute(DAMP, "pulse_rate", 1e5), "pulse_rate: is 100000 Hz, must be below"),
    (attribute(DAMP, "pulse_rate", h5py.Empty("f8")), "pulse_rate: is empty"),
    (attribute(DAMP, "kind", "skin"), "kind: is 'skin'. The schema requires kind"),
    (attribute(DAMP, "kind", None), "kind: is missing"),
    (attribute(DAMP, "kind", 3), "kind: is 3, must be text"),
    (attribute(DAMP, "subject", 1.5), "subject: is 1.5, must be text or an integer"),
    (attribute(DAMP, "subject", np.bytes_(b"\xff")), "not UTF-8"),
    (attribute(DAMP, "r_load", 1e3), "r_load: a loaded recording must not have it"),
    (attribute(DAMP, "calibration", "x"), "calibration: 'x' is not in the file"),
    (attribute(DAMP, "calibration", [KNOWN, "s01/dry"]), "'s01/dry' is a loaded recording"),
    (attribute(DAMP, "trial", ["a", "b"]), "trial: has 2 labels. Write one label"),
    (attribute(DAMP, "trial", [[1, 2]]), "trial: has shape (1, 2)"),
    (attribute(DAMP, "adc_range", [1.0, -1.0]), "adc_range: is (1.0, -1.0)"),
    (attribute(DAMP, "adc_range", [1.0, 2.0, 3.0]), "must be two increasing numbers"),
    (attribute(DAMP, "calibration", np.zeros(2, "i4,i4")), "calibration: is a compound value"),
    (attribute(f"{DAMP}/v_out", "unit", "mV"), "v_out.unit: is 'mV'"),
    (attribute(f"{DAMP}/v_out", "unit", None), "v_out.unit: is missing. It must be 'volt'"),
    (attribute(f"{DAMP}/v_th", "conversion", 0.0), "v_th.conversion: is 0"),
    (attribute(f"{DAMP}/v_th", "offset", np.inf), "v_th.offset: is inf"),
    (lambda file: file[DAMP].attrs.update(calibration=file["s01"].ref), "is an HDF5 reference"),
    (attribute(DAMP, "Condition ", 1), "did you mean condition? Rename it"),
    (misspell_offset, "v_th.ofset: is not in the schema, did you mean"),
    (make_sequence, "subject: is array([1, 2], dtype=int32), must be text or an integer"),
    (put("curent", [1.0]), "curent: is not in the schema, did you mean current?"),
    (put("v_out", np.array([b"a", b"b"])), "v_out: has dtype |S1"),
    (put("v_out", np.zeros(4, complex)), "v_out: has dtype complex128"),
    (put("v_out", np.zeros(5)), "shapes do not fit each other: v_th (4,), v_out (5,)"),
    (put("v_out", 1.0), "v_out: is one number"),
    (put("v_out", np.zeros((1, 1, 4))), "v_out: has shape (1, 1, 4)"),
    (put("v_out", np.zeros((0, 4))), "v_out: is empty"),
    (put("v_out", h5py.Empty("f8")), "v_out: is empty"),
    (put("v_th", np.zeros((3, 4))), "shapes do not fit each other: v_th (3, 4)"),
    (put("current", np.zeros(4)), "current.unit: is 'volt'. It must be 'ampere'"),
    (put("current", np.zeros(3), "ampere"), "current (3,)"),
    (put("v_out", None), "v_out: is a group"),
    (put("v_out", np.dtype("f8"), ""), "v_out: is a datatype"),
    (lambda file: file[DAMP].__delitem__("v_out"), "v_out: is missing. Add v_out [volt]"),
    (put("v_out", h5py.SoftLink("/nowhere")), "v_out: is a dangling link to '/nowhere'"),
    (put("v_out", ELSEWHERE), "is a link to another file, 'b.h5'"),
    (detour, "v_out: is a dangling link"),
    (make_virtual, "v_out: its samples are in another file"),
    (make_external_storage, "v_out: its samples are in another file"),
]


@pytest.mark.parametrize(("change", "message"), PROBLEMS, ids=[message for _, message in PROBLEMS])
def test_a_recording_that_breaks_a_rule_is_one_problem_and_the_others_are_read(
    change, message, edit
):
    path = edit(change)
    found = hdf5.check(path)
    assert [problem.path for problem in found] == [DAMP], list(map(str, found))
    assert str(found[0]).startswith(f"{path}, '{DAMP}'")
    assert message in str(found[0])
    with hdf5.read(path) as study:
        assert list(study) == [KNOWN, "s01/dry/0", "s01/dry/1", "s01/dry/2"]
        assert str(study.problems[DAMP]) == str(found[0])
        assert DAMP not in study
        with pytest.raises(RecordingError) as caught:
            study[DAMP]
        assert caught.value is study.problems[DAMP]


def test_all_problems_of_a_recording_are_found(edit):
    def spoil(file):
        del file[DAMP].attrs["sample_rate"]
        file[DAMP].attrs["pulse_rate"] = "fast"
        del file[f"{DAMP}/v_th"].attrs["unit"]
        file[f"{DAMP}/v_out"].attrs["unit"] = "V"

    fields = {problem.field for problem in hdf5.check(edit(spoil))}
    assert fields == {"sample_rate", "pulse_rate", "v_th.unit", "v_out.unit"}


def stack_calibrations(file):
    file["s01/dry"].attrs.update(kind="calibration", r_load=1.0)
    del file["s01/dry"].attrs["calibration"]


def made(place, **attributes):
    return lambda file: file.create_group(place).attrs.update(attributes)


def linked(place, of):
    """A link, or a second name of what is at a place."""
    return lambda file: file.__setitem__(place, file[of] if isinstance(of, str) else of)


STRUCTURE = [
    (attribute("s01/dry", "trial", [1, 2]), "s01/dry", "Write 3 labels"),
    (attribute("s01/dry", "trial", "a"), "s01/dry", "trial: has 1 label"),
    (attribute("/", "kind", "loaded"), "/", "root of a file cannot be a recording"),
    (attribute(KNOWN, "r_load", None), KNOWN, "r_load: is missing"),
    (attribute(KNOWN, "calibration", KNOWN), KNOWN, "a calibration recording must not have it"),
    (stack_calibrations, "s01/dry", "holds 3 stacked calibrations"),
    (linked("again", h5py.SoftLink("/s01")), "again", "is a soft link to the group '/s01'"),
    (linked("t", DAMP), "t", "is the same group as 's01/damp'"),
    (linked("s01/up", "/"), "s01/up", "same group as '/'"),
    (linked("s02", h5py.SoftLink("/nowhere")), "s02", "is a dangling link to '/nowhere'"),
    (linked("s02", ELSEWHERE), "s02", "is a link to another file, 'b.h5'"),
    (lambda file: file.copy(KNOWN, f"{DAMP}/inner"), f"{DAMP}/inner", "lies inside the recording"),
    (lambda file: file.create_dataset("s02", data=1.0).attrs.update(kind="loaded"), "s02",
     "but must be a group"),
    (lambda file: file.create_dataset("s02/v_th", data=1.0), "s02/v_th", "is a dataset outside of"),
    (made("s02", Kind="loaded"), "s02", "did you mean kind?"),
]  # fmt: skip


@pytest.mark.parametrize(("change", "place", "message"), STRUCTURE)
def test_a_wrong_structure_is_reported_at_its_place(change, place, message, edit):
    path = edit(change)
    found = {str(problem) for problem in hdf5.check(path) if problem.path == place}
    assert any(message in text for text in found), found
    with hdf5.read(path) as study, pytest.raises(RecordingError):
        study[place]


def test_samples_that_are_not_finite_are_counted_by_check_and_readable(edit):
    path = edit(put("v_out", np.array([0.0, np.nan, np.inf, 1.0])))
    assert "v_out: 2 of 4 samples are not finite" in str(hdf5.check(path)[0])
    with hdf5.read(path) as study:
        assert np.isnan(study["s01/damp"].v_out[1])


# what is wrong with a file


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (attribute("/", "schema", None), "schema: is missing"),
        (lambda file: file.attrs.__setitem__("Schema", file.attrs.pop("schema")),
         "schema: is missing, did you mean schema by Schema"),
        (attribute("/", "schema", "nwb"), "schema: is 'nwb'"),
        (attribute("/", "schema", 1), "schema: is 1, must be text"),
        (attribute("/", "schema_version", None), "schema_version: is missing"),
        (attribute("/", "schema_version", "2.0"), "schema_version: is 2.0.*reads 1.x"),
        (attribute("/", "schema_version", 1.0), "schema_version: is 1.0, must be text"),
        (attribute("/", "schema_version", "1"), "schema_version: is '1', must be 'major.minor'"),
        (attribute("/", "schema_version", "new"), "is 'new', must be 'major.minor'"),
    ],
)  # fmt: skip
def test_a_file_of_another_schema_is_refused_whole(change, message, edit):
    path = edit(change)
    with pytest.raises(RecordingError, match=message) as caught:
        hdf5.read(path)
    assert caught.value.file == str(path)
    assert [str(problem) for problem in hdf5.check(path)] == [str(caught.value)]


def test_files_that_are_none_are_refused(tmp_path):
    for name, content in (("text.h5", b"hello"), ("empty.h5", b"")):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(RecordingError, match=rf"{name}: is not an HDF5 file"):
            hdf5.read(tmp_path / name)
    for name in ("none.h5", "."):
        with pytest.raises(RecordingError, match="there is no such file"):
            hdf5.read(tmp_path / name)


def test_a_file_that_another_program_writes_is_not_called_damaged(path):
    fcntl = pytest.importorskip("fcntl", reason="this system has no locks of files")
    with open(path) as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        with pytest.raises(RecordingError, match=r"another program has opened it.*Close it"):
            hdf5.read(path)


def test_a_truncated_file_is_never_more_than_an_error(path, tmp_path):
    whole = path.read_bytes()
    damaged = tmp_path / "damaged.h5"
    for length in np.linspace(0, len(whole) - 1, 60, dtype=int):
        damaged.write_bytes(whole[:length])
        with pytest.raises(RecordingError, match="damaged"):
            hdf5.read(damaged)
        assert len(hdf5.check(damaged)) == 1


# writing

text = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=8)
dtypes = st.sampled_from(["i1", "i2", "<i4", ">i4", "u2", "u8", "f4", "<f8", ">f8"])
scales = st.floats(1e-9, 1e9) | st.floats(-1e9, -1e-9)


@st.composite
def fields(draw, path):
    """Arguments of a recording; its making would type-check, which draws at random."""
    length = draw(st.integers(1, 5))
    calibration = path.startswith("c")
    return {
        **{
            name: (draw(hnp.arrays(draw(dtypes), length)), draw(scales), draw(scales))
            for name in ("v_th", "v_out", *draw(st.sampled_from([(), ("current",)])))
        },
        "sample_rate": draw(st.floats(1e3, 1e7)),
        "pulse_rate": draw(st.floats(0.1, 400)),  # a period no longer than a record may be
        "r_load": draw(st.floats(1e-3, 1e9)) if calibration else None,
        "subject": draw(text),
        "condition": draw(text),
        "electrode": draw(text),
        "trial": draw(text),
        "calibration": () if calibration else draw(st.sampled_from([(), ("c",), ("c", "cc/1")])),
        "adc_range": draw(st.none() | st.just((-1.5, 2.5))),
        "path": path,
    }


paths = st.lists(st.sampled_from(["a", "b/0", "b/1", "d/0", "d/x/0", "é/µ"]), unique=True)
studies = paths.flatmap(lambda own: st.tuples(*map(fields, ["c", "cc/1", "cc/0", *own])))


@settings(
    max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(drawn=studies)
def test_what_is_written_is_read_again(drawn, tmp_path):
    def made(one: dict[str, Any]) -> Recording:
        records = {name: Samples(*one[name]) for name in SIGNALS if name in one}
        arguments: dict[str, Any] = {**one, **records}
        return Recording(**arguments)

    study = Study.from_recordings(map(made, drawn))
    target = tmp_path / "written.h5"
    study.write(target)
    with hdf5.read(target) as copy:
        assert copy.problems == {}
        assert contents(copy) == contents(study)
        again = tmp_path / "again.h5"
        copy.write(again)
    with hdf5.read(again) as second:
        assert contents(second) == contents(study)


def trials(count, shared, **fields):
    th = Samples(CODES[0], 0.5)
    return [
        Recording(
            th if shared else Samples(CODES[0] + i, 0.5),
            Samples(CODES[1] + i, 0.5),
            **RATES,
            **dict[str, Any]({"trial": i + 1, "path": f"s/{i}", **fields}),
        )
        for i in range(count)
    ]


@pytest.mark.parametrize("shared", [True, False])
def test_trials_that_differ_in_samples_and_label_alone_are_stacked(shared, tmp_path):
    study = Study.from_recordings(trials(12, shared))
    for target in (tmp_path / "a.h5", tmp_path / "b.h5"):
        study.write(target)
        with h5py.File(target) as file:
            group: Any = file["s"]
            assert group["v_out"].shape == (12, 4)
            assert group["v_th"].shape == ((4,) if shared else (12, 4))
            assert group.attrs["trial"][11] == b"12"
        study = hdf5.read(target)  # a study of a file is written alike
        assert contents(study) == contents(Study.from_recordings(trials(12, shared)))
    study.close()


@pytest.mark.parametrize(
    "other",
    [
        {"path": "s/3"},
        {"path": "s/x"},
        {"path": "s/2/x"},
        {"path": "s/2", "subject": "s02"},
        {"path": "s/2", "sample_rate": 1e5},
        {"path": "s/2", "v_out": Samples(CODES[0], 0.25)},
        {"path": "s/2", "v_out": Samples(CODES[0].astype("i4"), 0.5)},
        {"path": "s/2", "r_load": 1e3},
    ],
)
def test_trials_that_differ_in_more_are_not_stacked(other, tmp_path):
    recordings = trials(3, True)
    study = Study.from_recordings([*recordings[:2], recordings[2].replace(**other)])
    study.write(tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5") as file:
        assert "kind" not in file["s"].attrs
    with hdf5.read(tmp_path / "a.h5") as copy:
        assert contents(copy) == contents(study)


def test_labels_of_more_than_64_kilobytes_fit(tmp_path):
    label = "session of the first of January, the same finger, again and again, number {}"
    recordings = [one.replace(trial=label.format(one.trial)) for one in trials(1000, True)]
    Study.from_recordings(recordings).write(tmp_path / "a.h5")
    with hdf5.read(tmp_path / "a.h5") as study:
        assert study.metadata("s/999").trial == label.format(1000)


def test_a_study_can_replace_the_file_it_is_read_from(path):
    with hdf5.read(path) as study:
        before = contents(study)
        study.loaded.where(subject="nobody").write(path)
        assert contents(study) == before
    with hdf5.read(path) as study:
        assert len(study) == 0


@pytest.mark.parametrize("name", ["missing/a.h5", "."])
def test_a_file_that_cannot_be_written_is_an_error(name, tmp_path):
    with pytest.raises(RecordingError, match="cannot be written"):
        Study.from_recordings(trials(2, True)).write(tmp_path / name)
    assert list(tmp_path.iterdir()) == []


def test_a_study_without_its_calibration_is_not_written(path, tmp_path):
    """A part finds it in the whole; recordings alone do not."""
    with hdf5.read(path) as study:
        words = "calibration: 'calibration/98k8' is not a calibration of the study"
        with pytest.raises(RecordingError, match=words):
            Study.from_recordings(study.loaded.recordings()).write(tmp_path / "a.h5")
        study.loaded.write(tmp_path / "a.h5")
        with hdf5.read(tmp_path / "a.h5") as again:
            assert contents(again) == contents(study)


def test_recordings_that_cannot_be_read_are_not_dropped_by_writing(edit, tmp_path):
    with hdf5.read(edit(attribute(DAMP, "sample_rate", None))) as study:
        with pytest.raises(RecordingError, match="1 recording of the study cannot be read"):
            study.write(tmp_path / "a.h5")
        Study.from_recordings(study.recordings()).write(tmp_path / "a.h5")
    assert hdf5.check(tmp_path / "a.h5") == []


# the example that comes with the schema


def test_the_example_file_is_small_valid_and_what_its_script_makes(tmp_path):
    example = FOLDER / "example.h5"
    assert example.stat().st_size < 1_000_000
    assert hdf5.check(example) == []
    runpy.run_path(str(FOLDER / "make_example.py"))["main"](str(tmp_path / "example.h5"))
    with hdf5.read(example) as study, hdf5.read(tmp_path / "example.h5") as fresh:
        assert len(study) == 6
        for own, one in study.items():
            assert fresh.metadata(own) == one.metadata
            for name, samples in one.samples.items():
                assert samples.stored.dtype == np.int16
                # transcendental functions may round otherwise elsewhere: one code at a boundary
                difference = fresh[own].samples[name].stored.astype(int) - samples.stored
                assert np.abs(difference).max() <= 1
