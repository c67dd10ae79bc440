"""Files of recordings become one, and each recording keeps its calibration."""

import numpy as np
import pytest

import etid
from etid import cli


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Two subjects in two files whose recordings have the same paths."""
    folder = tmp_path_factory.mktemp("merged")
    for name, seed in (("s01", 1), ("s02", 2)):
        scene = etid.scenes.paper_dry(samples=400)
        kept = [one for one in scene.simulate(seed).recordings()][:3]
        kept[2] = kept[2].replace(calibration=())
        etid.Study.from_recordings(kept).write(folder / f"{name}.h5")
    return folder


def test_each_file_becomes_a_group_and_keeps_its_calibration(files, tmp_path, capsys):
    target = tmp_path / "study.h5"
    sources = [files / "s01.h5", files / "s02.h5"]
    assert cli.main(["merge", *map(str, sources), "-o", str(target)]) == 0
    assert capsys.readouterr().out.splitlines() == ["s01: 3 recordings", "s02: 3 recordings"]
    assert etid.check(target) == []
    with etid.read(target) as merged:
        assert len(merged) == 6
        for source in sources:
            with etid.read(source) as study:
                (calibration,) = study.calibrations
                for path, one in study.items():
                    other = merged[f"{source.stem}/{path}"]
                    stored = one.samples["v_out"].stored
                    np.testing.assert_array_equal(other.samples["v_out"].stored, stored)
                    assert (other.subject, other.trial) == (one.subject, one.trial)
                    if one.metadata.kind == "loaded":
                        assert other.calibration == (f"{source.stem}/{calibration}",)


def test_files_of_one_name_and_fits_are_refused(files, tmp_path, capsys):
    target = tmp_path / "study.h5"
    twice = str(files / "s01.h5")
    assert cli.main(["merge", twice, twice, "-o", str(target)]) == 1
    assert "another file has the name 's01'" in capsys.readouterr().err
    assert cli.main(["merge", str(files / "absent.h5"), "-o", str(target)]) == 1
    assert "there is no such file" in capsys.readouterr().err
    assert not target.exists()
