import pathlib
import runpy

import numpy as np
import pytest

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
