import pathlib
import pkgutil
import re
import runpy
import tomllib

import numpy as np
import pytest

import etid
from etid import cli
from etid.files import formats, readers
from etid.recordings import hdf5, schema

FOLDER = pathlib.Path(__file__).parents[1] / "data_schema"


@pytest.mark.parametrize("name", ["recording-1.json", "README.md"])
def test_the_committed_schema_is_what_the_table_gives(name, tmp_path):
    runpy.run_path(str(FOLDER / "make_page.py"))["write"](tmp_path)
    remedy = "run: python data_schema/make_page.py"
    assert (tmp_path / name).read_text("utf-8") == (FOLDER / name).read_text("utf-8"), remedy


def test_the_example_of_the_readme_runs_and_is_read(tmp_path, monkeypatch):
    text = (FOLDER / "README.md").read_text("utf-8")
    example = text.split("```python\n")[1].split("```")[0]
    monkeypatch.chdir(tmp_path)
    exec(compile(example, "README.md", "exec"), {})
    assert hdf5.check("study.h5") == []
    with hdf5.read("study.h5") as study:
        assert list(study) == ["calibration/98k8", "s01/dry/0", "s01/dry/1", "s01/dry/2"]
        assert study["s01/dry/2"].trial == "2"
        assert study["s01/dry/2"].samples["v_th"].stored.dtype == np.int16
        # a code of 9000 of 20 V / 2^16, behind a scale of 0.0535
        expected = 9000 * 20 / 65536 / 0.0535
        assert study["s01/dry/2"].v_th.max() == pytest.approx(expected, rel=1e-15)


def test_texts_of_every_hdf5_kind_are_read_alike():
    field = schema.at("group attribute")["calibration"]
    for value in ("a", b"a", np.bytes_(b"a"), np.array(["a"], object), np.array([b"a"])):
        assert field.parse(value) == ("a",)


def test_a_format_is_declared_once_and_everything_that_lists_formats_comes_from_there(tmp_path):
    suffixes = formats.SUFFIXES
    assert len(suffixes) == len(set(suffixes))
    project = tomllib.loads((FOLDER.parent / "pyproject.toml").read_text("utf-8"))["project"]
    page = (FOLDER / "README.md").read_text("utf-8")
    for one in formats.READERS:
        needed = project["optional-dependencies"].get(one.extra, [""])
        assert [name.partition(">")[0] for name in needed] == [one.package]
        for suffix in one.suffixes:
            assert f"`{suffix}`" in page.split("## Other formats")[1]
            assert f"`{suffix}`" in (etid.import_file.__doc__ or "")
            assert formats.reader_of(tmp_path / f"a{suffix.upper()}") is one
    with pytest.raises(etid.RecordingError, match=", ".join(map(re.escape, suffixes))):
        formats.reader_of(tmp_path / "a.asc")
    modules = {one.name for one in pkgutil.iter_modules(readers.__path__)}
    assert modules == {one.opened.__module__.rpartition(".")[2] for one in formats.READERS}


def test_the_help_of_the_command_lists_the_formats():
    (commands,) = (one for one in cli.parser(["import"])._actions if one.dest == "command")
    help_of = " ".join(commands.choices["import"].format_help().split())  # type: ignore[index,call-overload]
    assert ", ".join(formats.SUFFIXES) in help_of
