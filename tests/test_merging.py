"""Files of recordings become one, and each recording keeps its calibration."""

import h5py
import numpy as np
import pytest

import etid
from etid import cli
from etid.recordings.hdf5 import merge_files


def test_each_file_becomes_a_group_and_keeps_its_calibration(tmp_path, capsys):
    target = tmp_path / "study.h5"
    sources = [tmp_path / "s01.h5", tmp_path / "s02.h5"]
    for seed, source in enumerate(sources):  # recordings of two subjects have the same paths
        kept = list(etid.scenes.paper_dry(samples=400).simulate(seed).recordings())[:3]
        kept[2] = kept[2].replace(calibration=())
        etid.Study.from_recordings(kept).write(source)
    for wrong, words in (("s01.h5", "another file has the name 's01'"), ("x.h5", "no such file")):
        again = ["merge", str(sources[0]), str(tmp_path / wrong), "-o", str(target)]
        assert cli.main(again) == 1
        assert words in capsys.readouterr().err
        assert not target.exists()
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


@pytest.mark.parametrize("current_snr_db", [None, 60.0])
def test_a_recording_without_a_calibration_gets_none_of_another_file(current_snr_db, tmp_path):
    scene = etid.scenes.paper_dry(samples=400, current_snr_db=current_snr_db)
    known, dry, *_ = scene.simulate(1).recordings()
    alone, other = tmp_path / "alone.h5", tmp_path / "other.h5"
    etid.Study.from_recordings([dry.replace(calibration=())]).write(alone)
    etid.Study.from_recordings([known]).write(other)
    with pytest.raises(etid.RecordingError, match=rf"alone\.h5, '{dry.path}': has no calibration"):
        merge_files([other, alone], tmp_path / "study.h5")


def test_a_recording_without_v_th_needs_no_calibration(tmp_path):
    scene = etid.scenes.paper_dry(samples=400, current_snr_db=60.0)
    known, dry, *_ = scene.simulate(1).recordings()
    for name, one in (("known.h5", known), ("dry.h5", dry.replace(calibration=(), v_th=None))):
        etid.Study.from_recordings([one]).write(tmp_path / name)
    counts = merge_files([tmp_path / "known.h5", tmp_path / "dry.h5"], tmp_path / "study.h5")
    assert counts == {"known": 1, "dry": 1}


def test_of_two_calibrations_of_its_file_a_recording_that_names_none_gets_none(tmp_path):
    known, dry, *_ = etid.scenes.paper_dry(samples=400).simulate(1).recordings()
    two = [known.replace(path=f"calibration/{name}") for name in "ab"]
    named = dry.replace(path="named", calibration=("calibration/b",))
    source, target = tmp_path / "s.h5", tmp_path / "study.h5"
    etid.Study.from_recordings([*two, dry.replace(calibration=()), named]).write(source)
    merge_files([source], target)
    with etid.read(target) as merged:
        assert merged[f"s/{dry.path}"].calibration == ()
        assert merged["s/named"].calibration == ("s/calibration/b",)


def test_a_file_with_a_broken_recording_is_not_merged(tmp_path):
    known, dry, *_ = etid.scenes.paper_dry(samples=400).simulate(1).recordings()
    source = tmp_path / "s.h5"
    etid.Study.from_recordings([known, dry]).write(source)
    with h5py.File(source, "r+") as file:
        del file[f"{dry.path}/v_out"].attrs["unit"]
    with pytest.raises(etid.RecordingError, match=r"v_out\.unit: is missing"):
        merge_files([source], tmp_path / "study.h5")
    assert not (tmp_path / "study.h5").exists()
