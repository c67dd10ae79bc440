"""The benchmark of perturbations: the records are what their names say, and answers are counted."""

import csv
import dataclasses

import numpy as np
import pytest
from numpy.typing import ArrayLike

from benchmarks import perturbations, visibility
from benchmarks.disturbances import Hum, Leaky, Nonlinear, Pink, Spike
from benchmarks.laboratory import CORNER, SCALE, Output
from benchmarks.ladder import LOADS
from benchmarks.perturbation_draws import KINDS, Answer, error_of, table
from benchmarks.perturbation_list import INVISIBLE, PERTURBATIONS, UNDISTURBED
from benchmarks.perturbed_study import Truth, undisturbed
from etid.simulation.scenes import Scene, Trial
from etid.simulation.transformer import Sampler, SkinLoad, TransformerDriver

RATE, PERIOD = 200e3, 1 / 60.0
PULSE = slice(0, 3333)  # samples of the first period


def study(name: str, snr_db: float = 60.0):
    return PERTURBATIONS[name](undisturbed(3, snr_db))


def volts(output: Output, samples: int = 10_000) -> np.ndarray:
    """At the converter, without noise."""
    return output.volts(RATE, samples, np.random.default_rng(1))


@pytest.fixture(scope="module")
def dry():
    return study("base_no_delay").trials[0]


def test_an_undisturbed_recording_is_that_of_a_scene(dry):
    found = dry.recording(0)
    scene = Scene((Trial("dry", LOADS["dry"]),), driver=dry.out.driver, snr_db=60.0)
    theirs = scene.simulate(0)["dry"]
    for name in ("v_th", "v_out"):
        ours, other = getattr(found, name), getattr(theirs, name)
        # Both are the same voltage with white noise of one size: their difference is noise alone.
        assert np.std(ours - other) == pytest.approx(np.sqrt(2) * dry.sigma / SCALE, rel=0.03)
    assert found.adc_range == pytest.approx(theirs.adc_range)
    assert (found.sample_rate, found.pulse_rate) == (theirs.sample_rate, theirs.pulse_rate)


def test_every_perturbation_changes_what_is_recorded_or_told():
    before = undisturbed(3, 60.0)
    assert UNDISTURBED.keys() < PERTURBATIONS.keys()
    assert INVISIBLE.keys() < PERTURBATIONS.keys()
    for name, change in PERTURBATIONS.items():
        after = change(before)
        assert set(after.truths) == {of.path for of in after.trials} == set(LOADS), name
        same = (after.calibrations, after.trials) == (before.calibrations, before.trials)
        assert same == (name == "base"), name


def test_drivers_differ_and_a_number_is_always_the_same_driver():
    one, other = undisturbed(1, 60.0), undisturbed(2, 60.0)
    assert one.trials == undisturbed(1, 60.0).trials
    assert one.trials[0].out.driver != other.trials[0].out.driver
    assert one.trials[0].out.driver == one.calibrations[0].out.driver


def test_a_change_of_skin_leaves_the_noise_and_the_other_records():
    before, after = study("base"), study("rp_linear_0.2")
    assert after.calibrations == before.calibrations
    one, other = before.trials[0].recording(0), after.trials[0].recording(0)
    np.testing.assert_array_equal(one.v_th, other.v_th)
    off = np.abs(one.v_out - other.v_out)
    assert off.max() > 10 * before.trials[0].sigma / SCALE
    assert off[PULSE].max() <= one.samples["v_out"].conversion  # the first pulse has the usual skin


def test_an_element_falls_from_the_first_pulse_to_the_last():
    of = study("rp_linear_0.2")
    dry, truth = of.trials[0], of.truths["dry"]
    values = [load.r_p for load in dry.out.loads if isinstance(load, SkinLoad)]
    np.testing.assert_allclose(values, 186e3 * np.array([1.0, 0.9, 0.8]))
    assert truth.moves
    np.testing.assert_allclose([truth.low[1], truth.high[1]], [0.8 * 186e3, 186e3])
    found = volts(dry.out)
    for number, load in enumerate(dry.out.loads):
        alone = volts(dataclasses.replace(dry.out, loads=(load,)))
        inside = slice(3334 * number, 3333 * (number + 1))
        np.testing.assert_array_equal(found[inside], alone[inside])


def test_a_pulse_is_missing_or_comes_twice(dry):
    usual = volts(dry.th)
    missing = volts(study("missing_pulse_both").trials[0].th)
    double = volts(study("double_pulse_both").trials[0].th)
    highest = usual.max()
    assert missing[PULSE].max() == pytest.approx(highest, rel=0.1)
    assert missing[3340:6660].max() < 0.05 * highest
    assert double[5000:6660].max() == pytest.approx(highest, rel=0.1)
    out = study("missing_pulse_out").trials[0]
    assert volts(out.th)[3340:6660].max() == pytest.approx(highest, rel=0.1)
    assert volts(out.out)[3340:6660].max() < 0.05 * highest


def test_pulses_at_their_usual_times_are_the_usual_voltage(dry):
    usual = dataclasses.replace(dry.out, pulses=((0, 1.0), (1, 1.0), (2, 1.0)), over=3)
    np.testing.assert_allclose(volts(usual), volts(dry.out), atol=1e-9)


@pytest.mark.parametrize("samples", [5, 100])
def test_a_delay_moves_the_loaded_voltage_by_whole_samples(dry, samples):
    late = dataclasses.replace(dry.out, delay=samples / RATE)
    np.testing.assert_allclose(volts(late)[: 10_000 - samples], volts(dry.out)[samples:], atol=1e-9)
    name = f"delay_{samples}_samples_skin"
    before, after = study("base").trials[0], study(name).trials[0]
    assert after.out.delay - before.out.delay == pytest.approx(samples / RATE)
    assert after.th == before.th


def test_the_pulse_rate_is_as_far_off_as_it_says(dry):
    off = volts(study("rate_1%_all").trials[0].th)
    late = volts(dry.th)
    # Two periods of 60.6 Hz are 66 samples shorter than two of 60 Hz.
    shift = np.argmax(np.abs(np.diff(late[6000:]))) - np.argmax(np.abs(np.diff(off[6000:])))
    assert shift == pytest.approx(66, abs=1)


def test_hum_has_its_size_and_may_have_one_phase_in_both_records():
    time, rng = np.arange(10_000) / RATE, np.random.default_rng(0)
    one, other = (Hum(60.0, 0.02)(time, rng) for _ in range(2))
    assert np.abs(one).max() == pytest.approx(0.02, rel=1e-3)
    assert np.abs(one - other).max() > 1e-3
    locked = Hum(60.0, 0.02, phase=0.2)
    np.testing.assert_array_equal(locked(time, rng), locked(time, rng))
    [voltage] = study("hum60_0.02V_out_skin_only").trials[0].out.added
    assert voltage == Hum(60.0, 0.02)
    assert not study("hum60_0.02V_out_skin_only").trials[0].th.added


def test_a_spike_is_in_one_place_and_noise_of_1_f_has_its_size():
    time, rng = np.arange(20_000) / RATE, np.random.default_rng(0)
    spike = Spike(0.5, 5e-3)(time, rng)
    assert spike.max() == pytest.approx(0.5, rel=1e-3)
    assert np.count_nonzero(spike) == pytest.approx(1000, abs=2)
    pink = Pink(0.01)(time, rng)
    assert np.std(pink) == pytest.approx(0.01)
    power = np.abs(np.fft.rfft(pink)) ** 2
    low, high = power[1:11].mean(), power[1001:1011].mean()
    assert low / high == pytest.approx(200, rel=0.8)  # ten harmonics: exponential draws


def test_converters_round_and_may_hide_their_codes():
    coarse = study("bits8_4V").trials[0].recording(0)
    assert coarse.samples["v_out"].resolution == pytest.approx(8 / 256 / SCALE)
    volts = study("bits8_4V_float").trials[0].recording(0)
    assert volts.samples["v_out"].resolution is None
    np.testing.assert_allclose(volts.v_out, coarse.v_out, rtol=1e-12)
    clean = study("bits8_4V_nonoise").trials[0]
    assert clean.sigma == 0.0


def test_jittered_samples_are_the_voltage_at_other_times(dry):
    """A Taylor series of three terms: what is left of half a volt is its fourth."""
    jittered = dataclasses.replace(dry.out, sampling_jitter=100e-9)
    rng = np.random.default_rng(4)
    early = 100e-9 * np.random.default_rng(4).standard_normal(200)
    found = jittered.volts(RATE, 200, rng)
    exact = [volts(dataclasses.replace(dry.out, delay=d), 200)[i] for i, d in enumerate(early)]
    np.testing.assert_allclose(found, exact, atol=2e-3 * np.ptp(exact))
    assert np.std(found - volts(dry.out, 200)) > 1e-4 * np.ptp(exact)


def test_the_file_may_say_what_is_not_true():
    rate = study("says_100kHz").trials[0].recording(0)
    true = study("base").trials[0].recording(0)
    assert (rate.sample_rate, true.sample_rate) == (100e3, 200e3)
    np.testing.assert_array_equal(rate.v_out, true.v_out)
    assert study("says_20Hz").calibrations[0].recording(0).pulse_rate == 20.0
    assert study("says_98.8ohm").calibrations[0].recording(0).r_load == pytest.approx(98.8)
    swapped = study("swapped").trials[0].recording(0)
    np.testing.assert_array_equal(swapped.v_th, true.v_out)
    copied = study("calibration_v_out_is_v_th").calibrations[0].recording(0)
    np.testing.assert_array_equal(copied.v_th, copied.v_out)


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
    z_th = driver.z_th(sampler.f)
    v_th = sampler.pulse_rate * driver.v_th_spectrum(sampler.f)
    current = (v_th - v_out) / z_th
    v = v_out - skin.r_s * current
    through = current - 2j * np.pi * sampler.f * skin.c_p * v
    grid = 2**17
    v, through = (np.fft.irfft([0, *c], grid, norm="forward") for c in (v, through))
    # The harmonics leave out the means, which are those of R_p: v rests near 0 before the pulse.
    v, through = v - v[0], through - through[0]
    law = v * (1 + fall / (1 - fall) * (v / np.abs(v).max()) ** 2) / skin.r_p
    assert np.abs(through - law).max() < 0.02 * np.abs(law).max()
    np.testing.assert_allclose(
        Nonlinear(skin, 1e-9)(driver, sampler),
        v_th * skin(sampler.f) / (skin(sampler.f) + z_th),
        atol=1e-9 * np.abs(v_th).max(),
    )


NOTHING = np.full(3, np.nan)


def answer(error, verdict="successful", stderr: ArrayLike = 0.01, bound=0.01, **more) -> Answer:
    arrays = [np.broadcast_to(np.asarray(x, float), 3) for x in (error, stderr, bound)]
    return Answer(
        "base", 60.0, "dry", "default", 0, verdict, arrays[0], arrays[1], arrays[2], **more
    )


@pytest.mark.parametrize(
    ("of", "kind"),
    [
        (answer((0.04, 0, 0)), "right"),
        (answer((0.04, 0, 0), "misfit"), "refused"),
        (answer((0.06, 0, 0)), "silent"),
        (answer((0.06, 0, 0), "misfit"), "said"),
        (answer((0, -0.25, 0), stderr=0.1), "silent"),  # determined, and off by more than 20 %
        (answer((0, -0.25, 0), stderr=0.1, bound=0.2), "right"),
        (answer((0, -0.25, 0), stderr=0.1, bound=np.nan), "right"),
        (answer((0.15, 0, 0), words=True), "right"),
        (answer((0.25, 0, 0), words=True), "silent"),
        (answer((0.06, 0, 0), stderr=np.nan), "silent"),  # a method without standard errors
        (answer(NOTHING, "saturated"), "said"),
        (answer((np.inf, 0, 0), stderr=(np.inf, 0.1, 0.1), bound=0.5), "silent"),
    ],
)
def test_an_answer_is_right_or_refused_or_says_so_or_is_silent(of, kind):
    assert of.kind == kind


def test_an_element_that_moves_is_wrong_unless_the_answer_says_so():
    skin = LOADS["dry"]
    lower = dataclasses.replace(skin, r_p=0.8 * skin.r_p)
    truth = Truth.of(skin, lower, moves=True)
    middle = np.array([skin.r_s, 0.9 * skin.r_p, skin.c_p])
    np.testing.assert_allclose(error_of(middle, truth, True), 0, atol=1e-12)
    np.testing.assert_allclose(error_of(middle, truth, False), [0, 0.125, 0], atol=1e-12)
    beyond = middle * [1, 1.2, 1]
    np.testing.assert_allclose(error_of(beyond, truth, True), [0, 0.08, 0], atol=1e-12)
    no_capacitor = Truth(truth.low * [1, 1, np.nan], truth.high * [1, 1, np.nan])
    assert error_of(middle, no_capacitor, False)[2] == 0.0


def test_a_table_counts_and_names_the_worst_silent_answer():
    every = [answer((0.04, 0, 0)), answer((0, 0.08, 0)), answer((0.06, 0, 0))]
    [row] = table(every, ("perturbation", "snr_db"))
    assert [row[kind] for kind in KINDS] == [1, 0, 0, 2]
    assert (row["worst_element"], row["worst_error"]) == ("r_p", 0.08)
    assert row["worst_stderrs"] == pytest.approx(8)
    assert row["verdicts"] == "3 successful"


def test_a_silent_answer_misses_the_target_unless_nothing_can_show_it(capsys):
    wrong = answer((0.06, 0, 0))
    assert perturbations.met([dataclasses.replace(wrong, perturbation="leak_100Rp")])
    assert not perturbations.met([dataclasses.replace(wrong, perturbation="swapped")])
    assert "silent: swapped, dry at 60 dB, 1 of 1" in capsys.readouterr().out
    noisy = dataclasses.replace(wrong, perturbation="gain_out_+1%_all", snr_db=40.0)
    assert perturbations.met([noisy])
    assert not perturbations.met([dataclasses.replace(noisy, snr_db=60.0)])


def test_as_many_silent_answers_are_excused_as_the_best_test_would_miss(capsys):
    """Of gains of the skin alone, 1 % at 40 dB, it misses 95 % behind damp, 0.2 % behind dry."""
    wrong = dataclasses.replace(
        answer((0.06, 0, 0)), perturbation="gain_out_+1%_skin", snr_db=40.0, path="damp"
    )
    assert perturbations.met([wrong] * 10)
    dry = dataclasses.replace(wrong, path="dry")
    seen = dataclasses.replace(dry, verdict="misfit")
    assert perturbations.met([dry] + [seen] * 9)
    assert not perturbations.met([dry] * 2 + [seen] * 8)
    assert "gain_out_+1%_skin, dry at 40 dB, 2 of 10" in capsys.readouterr().out


def test_more_than_two_per_cent_of_undisturbed_recordings_refused_misses_the_target():
    fine, refused = answer((0, 0, 0)), answer((0, 0, 0), "misfit")
    assert perturbations.met([fine] * 98 + [refused] * 2)
    assert not perturbations.met([fine] * 97 + [refused] * 3)
    swapped = dataclasses.replace(refused, perturbation="swapped")
    assert perturbations.met([swapped])


@pytest.mark.slow
def test_a_few_perturbations_are_drawn_counted_and_written(tmp_path):
    names = ("base", "polarity_out", "driver_Rload_wrong_5%")
    assert perturbations.run(names, 1, (60.0,), ("default",), tmp_path, 1)
    with (tmp_path / "perturbations.csv").open() as file:
        rows = {(row["perturbation"], row["path"]): row for row in csv.DictReader(file)}
    assert rows["base", "dry"]["right"] == "1"
    assert rows["polarity_out", "damp"]["said"] == "1"
    assert rows["driver_Rload_wrong_5%", "dry"]["silent"] == "1"  # which nothing can show
    assert (tmp_path / "perturbations.svg").read_text().startswith("<?xml")


@pytest.mark.parametrize(
    ("change", "dry", "damp"),
    [
        (visibility.gain(0.01, True), 3.2, 4.3),
        (visibility.gain(0.02, False), 11.8, 2.7),
        (visibility.crosstalk(0.01), 5.9, 1.3),
        (visibility.lowpass(30e3), 4.3, 0.8),
        (visibility.series(0.05 * TransformerDriver().r_protection), 0.6, 1.3),
    ],
)
def test_how_faint_what_is_called_invisible_is_at_40_db_by_the_fisher_information(
    change, dry, damp
):
    found = [visibility.deviations(LOADS[name], 40.0, change) for name in ("dry", "damp")]
    np.testing.assert_allclose(found, [dry, damp], atol=0.05)
    clear = [visibility.deviations(LOADS[name], 60.0, change) for name in ("dry", "damp")]
    np.testing.assert_allclose(clear, np.multiply(found, 10), rtol=0.05)  # but for the rounding


def test_a_gain_that_is_the_skins_alone_is_seen_by_what_its_own_error_is():
    """Half the change at half the deviations: ε is a size in units of the change."""
    whole = visibility.deviations(LOADS["damp"], 40.0, visibility.gain(0.02, False))
    half = visibility.deviations(LOADS["damp"], 40.0, visibility.gain(0.01, False))
    assert whole == pytest.approx(2 * half)
