"""What the benchmarks measure on: each record has the fault that its name says, and no other."""

import h5py
import numpy as np
import pytest

import etid
from benchmarks import amplitudes, failure_draws
from benchmarks.failure_axes import Cole, TwoLayers, scene
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


@pytest.mark.parametrize("kind", [lambda of: TwoLayers(of, 0.3), lambda of: Cole(of, 0.9)])
def test_elements_of_skin_that_is_not_one_rc_are_the_limits_of_its_impedance(kind):
    load = kind(LOADS["dry"])
    z = load(np.array([1e-9, 1e13]))  # [Hz]; a constant phase arrives slowly
    np.testing.assert_allclose(z[1].real, load.elements.r_s, rtol=1e-4)
    np.testing.assert_allclose(z[0].real, load.elements.r_s + load.elements.r_p, rtol=1e-4)
    if np.isnan(load.elements.c_p):
        bound = failure_draws.bounds(scene(kind))["dry/00"]
        np.testing.assert_array_equal(np.isnan(bound), [False, False, True])
    else:
        reactance = np.abs(load(np.array([1e8])) - load.elements.r_s)
        np.testing.assert_allclose(2 * np.pi * 1e8 * reactance * load.elements.c_p, 1, rtol=1e-4)


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


@pytest.mark.parametrize("number", range(2))
def test_the_reference_of_a_linear_skin_is_its_closed_form(number):
    case = amplitudes.cases(834)[number]
    of = dict(zip(case.skin.names(), case.skin.values().tolist(), strict=True))
    case = case._replace(skin=etid.SkinCurrent(**{**of, "i_0": 1e6}))
    points = 16 * case.samples  # so that nothing of the current pulses aliases
    t = np.arange(points) / points / amplitudes.PULSE_RATE
    s = 2j * np.pi * amplitudes.PULSE_RATE * np.arange(points // 2 + 1)
    z = of["r_s"] + of["r_p"] / (1 + s * of["r_p"] * of["c_p"])
    if case.v_th is None:
        voltage = np.fft.rfft(amplitudes.pulses(t)) * z
    else:
        voltage = np.fft.rfft(case.fine(16)) * z
        voltage /= z + amplitudes.RESISTANCE + amplitudes.INDUCTANCE * s
    expected = np.fft.irfft(voltage)[::16]
    # DOP853 has tolerances of 1e-9 of the peak.
    exact = 1e-8 * np.abs(expected).max()
    np.testing.assert_allclose(amplitudes.reference(case), expected, atol=exact)
