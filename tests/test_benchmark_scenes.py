"""What the benchmarks measure on: each record has the fault that its name says, and no other."""

import dataclasses

import h5py
import numpy as np
import pytest

import etid
from benchmarks import amplitudes, failure_axes, failure_draws
from benchmarks.disturbances import Leaky, Nonlinear
from benchmarks.failure_axes import Clipped, Cole, Coloured, TwoLayers, scene
from benchmarks.laboratory import CORNER, SCALE, Output
from benchmarks.ladder import LOADS
from benchmarks.large_file import LAYOUTS, SAMPLES, large_file
from benchmarks.perturbation_list import INVISIBLE, PERTURBATIONS, UNDISTURBED
from benchmarks.perturbed_study import undisturbed
from etid.simulation.scenes import Scene, Trial
from etid.simulation.transformer import Sampler, SkinLoad, TransformerDriver

RATE = 200e3
FEW = 12  # recordings


def study(name):
    return PERTURBATIONS[name](undisturbed(3, 60.0))


def volts(output: Output, samples: int = 10_000) -> np.ndarray:
    """At the converter, without noise."""
    return output.volts(RATE, samples, np.random.default_rng(1))


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


def test_an_element_falls_from_pulse_to_pulse_and_noise_and_calibrations_stay():
    before, after = study("base"), study("rp_linear_0.2")
    assert after.calibrations == before.calibrations
    one, other = before.trials[0].recording(0), after.trials[0].recording(0)
    np.testing.assert_array_equal(one.v_th, other.v_th)
    off = np.abs(one.v_out - other.v_out)
    assert off.max() > 10 * before.trials[0].sigma / SCALE
    assert off[:3333].max() <= one.samples["v_out"].conversion  # the first pulse: the usual skin
    of, truth = after.trials[0].out, after.truths["dry"]
    values = [load.r_p for load in of.loads if isinstance(load, SkinLoad)]
    np.testing.assert_allclose(values, 186e3 * np.array([1.0, 0.9, 0.8]))
    np.testing.assert_allclose([truth.low[1], truth.high[1]], [0.8 * 186e3, 186e3])
    for number, load in enumerate(of.loads):
        inside = slice(3334 * number, 3333 * (number + 1))
        alone = volts(dataclasses.replace(of, loads=(load,)))
        np.testing.assert_array_equal(volts(of)[inside], alone[inside])


def test_pulses_are_missing_double_late_or_at_their_usual_times(dry):
    usual, highest = volts(dry.th), volts(dry.th).max()
    missing, double = (
        volts(study(f"{kind}_pulse_both").trials[0].th) for kind in ("missing", "double")
    )
    assert missing[:3333].max() == pytest.approx(highest, rel=0.1)
    assert missing[3340:6660].max() < 0.05 * highest
    assert double[5000:6660].max() == pytest.approx(highest, rel=0.1)
    same = dataclasses.replace(dry.th, pulses=((0, 1.0), (1, 1.0), (2, 1.0)), over=3)
    np.testing.assert_allclose(volts(same), usual, atol=1e-9)
    late = volts(dataclasses.replace(dry.th, delay=100 / RATE))
    np.testing.assert_allclose(late[:9900], usual[100:], atol=1e-9)
    off = volts(study("rate_1%_all").trials[0].th)
    # Two periods of 60.6 Hz are 66 samples shorter than two of 60 Hz.
    edges = [np.argmax(np.abs(np.diff(v[6000:]))) for v in (usual, off)]
    assert edges[0] - edges[1] == pytest.approx(66, abs=1)


@pytest.mark.parametrize("name", LOADS)
def test_a_leak_makes_other_skin_of_the_same_kind(name):
    """Why nothing can show it: R_s + R_p ‖ C_p and a resistor are another R_s + R_p ‖ C_p."""
    f, skin = np.geomspace(1.0, 1e6, 30), LOADS[name]
    r = 100 * skin.r_p
    high = skin.r_s * r / (skin.r_s + r)
    low = (skin.r_s + skin.r_p) * r / (skin.r_s + skin.r_p + r)
    tau = skin.r_p * skin.c_p * (skin.r_s + r) / (skin.r_s + skin.r_p + r)
    same = SkinLoad(high, low - high, tau / (low - high))
    np.testing.assert_allclose(Leaky(skin, r)(f), same(f), rtol=1e-12)
    off = np.array(dataclasses.astuple(same)) / np.array(dataclasses.astuple(skin)) - 1
    assert np.abs(off).max() < 0.017  # as the list of the invisible says


def test_a_nonlinear_skin_obeys_its_circuit():
    """The current through R_p is v / R_p (1 + k (v / v_0)²), and no other."""
    driver, skin, fall = TransformerDriver(), LOADS["damp"], 0.4
    sampler = Sampler(RATE, 60.0, CORNER * RATE)
    v_out = Nonlinear(skin, fall)(driver, sampler)
    v_th = sampler.pulse_rate * driver.v_th_spectrum(sampler.f)
    current = (v_th - v_out) / driver.z_th(sampler.f)
    v = v_out - skin.r_s * current
    through = current - 2j * np.pi * sampler.f * skin.c_p * v
    v, through = (np.fft.irfft([0, *c], 2**17, norm="forward") for c in (v, through))
    # The harmonics leave out the means, which are those of R_p: v rests near 0 before the pulse.
    v, through = v - v[0], through - through[0]
    law = v * (1 + fall / (1 - fall) * (v / np.abs(v).max()) ** 2) / skin.r_p
    assert np.abs(through - law).max() < 0.02 * np.abs(law).max()


@pytest.mark.parametrize("order", failure_axes.LOST)
def test_the_simplified_transformer_has_as_many_poles_as_it_says(order):
    """The rank of a Loewner matrix, (z_i − z_j) / (s_i − s_j), is the order of z(s)."""
    f = np.geomspace(1.0, 3e6, 40)
    s = np.concatenate([2j * np.pi * f, -2j * np.pi * f])
    z = failure_axes.transformer(order).z_th(f)
    z = np.concatenate([z, np.conj(z)])
    left, right = slice(0, None, 2), slice(1, None, 2)
    loewner = (z[left, None] - z[None, right]) / (s[left, None] - s[None, right])
    scale = np.sqrt(np.abs(s))
    values = np.linalg.svd(scale[left, None] * loewner * scale[None, right], compute_uv=False)
    assert np.sum(values > 1e-12 * values[0]) == order


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


def test_clipping_and_coloured_noise_have_their_sizes():
    recording, rng = scene().simulate(3)["dry/00"], np.random.default_rng(1)
    cut = Clipped(0.02, known=True)(recording, rng)
    limit = np.abs(cut.v_th).max()
    assert (np.abs(recording.v_th) > limit).mean() == pytest.approx(0.02, rel=0.05)
    assert cut.adc_range == pytest.approx((-limit, limit), rel=1e-3)
    loose = Clipped(0.02, sigma=0.01)(recording, rng)
    # A converter step besides, of 6 mV.
    at_limit = np.abs(recording.v_th) > limit
    assert np.std(np.abs(loose.v_th[at_limit])) == pytest.approx(0.01, rel=0.25)
    for band in failure_axes.COLOURS.values():
        changed = Coloured(band, 0.5)(recording, rng)
        added = changed.v_out - recording.v_out
        assert np.std(added) == pytest.approx(0.5, rel=0.02)
        f = np.fft.rfftfreq(added.size, 1 / recording.sample_rate)
        power = np.abs(np.fft.rfft(added)) ** 2
        inside = (f >= band[0] - 65) & (f <= band[1] + 65)  # a tone between two bins leaks
        assert power[inside].sum() > 0.9 * power.sum()
        assert np.std(changed.v_th - recording.v_th - added) > 0.1  # to each record its own


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
