"""What the benchmarks measure on: each record has the fault that its name says, and no other."""

import h5py
import numpy as np
import pytest

import etid
from benchmarks.laboratory import SCALE
from benchmarks.ladder import LOADS
from benchmarks.large_file import LAYOUTS, SAMPLES, large_file
from benchmarks.perturbation_list import INVISIBLE, PERTURBATIONS, UNDISTURBED
from benchmarks.perturbed_study import undisturbed
from etid.simulation.scenes import Scene, Trial

FEW = 12  # recordings


def study(name):
    return PERTURBATIONS[name](undisturbed(3, 60.0))


@pytest.fixture(scope="module")
def dry():
    return study("base_no_delay").trials[0]


def test_an_undisturbed_recording_is_that_of_a_scene(dry):
    found = dry.recording(0)
    of = Scene((Trial("dry", LOADS["dry"]),), driver=dry.out.driver, snr_db=60.0)
    theirs = of.simulate(0)["dry"]
    for name in ("v_th", "v_out"):
        ours, other = getattr(found, name), getattr(theirs, name)
        # Both are the same voltage with white noise of one size: their difference is noise alone.
        assert np.std(ours - other) == pytest.approx(np.sqrt(2) * dry.sigma / SCALE, rel=0.03)
    assert found.adc_range == pytest.approx(theirs.adc_range)
    assert (found.sample_rate, found.pulse_rate) == (theirs.sample_rate, theirs.pulse_rate)


def test_every_perturbation_changes_what_is_recorded_or_told():
    before = undisturbed(3, 60.0)
    assert UNDISTURBED.keys() | INVISIBLE.keys() < PERTURBATIONS.keys()
    for name, change in PERTURBATIONS.items():
        after = change(before)
        assert set(after.truths) == {of.path for of in after.trials} == set(LOADS), name
        same = (after.calibrations, after.trials) == (before.calibrations, before.trials)
        assert same == (name == "base"), name


def test_large_files_follow_the_schema_in_all_layouts_and_are_made_once(tmp_path):
    stacks = []
    for layout in LAYOUTS:
        path = large_file(tmp_path, FEW, layout)
        assert etid.check(path) == []
        with etid.read(path) as of:
            assert (len(of.loaded), len(of.calibrations)) == (FEW, 1)
            assert of["s0000/skin/0"].v_out.size == SAMPLES
        before = path.stat().st_mtime_ns
        assert large_file(tmp_path, FEW, layout).stat().st_mtime_ns == before
        with h5py.File(path) as file:
            stacks.append(np.asarray(file["s0000/skin/v_out"]))
    np.testing.assert_array_equal(stacks[0], stacks[1])
    np.testing.assert_array_equal(stacks[0], stacks[2])
    assert (stacks[0][0] != stacks[0][1]).any()
