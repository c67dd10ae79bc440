"""A load or a driver that changes during its record, between periods: seen, and told by element."""

import dataclasses

import numpy as np
import pytest
import scipy.stats

import etid
from benchmarks import perturbed_study as lab
from benchmarks.ladder import CALIBRATION, LOADS, TRIAL, rung
from etid.circuits.directions import FALSE_ALARMS
from etid.identify import changes
from etid.recordings.preflight import Inspected
from etid.recordings.repeats import repeats
from etid.results.fits import Fits
from etid.signals.deviations import _noise_of_single
from etid.simulation.scenes import Scene, Trial
from etid.simulation.transformer import TransformerDriver
from tests import pictures

NAMES = ("r_s", "r_p", "c_p")


def trial(scene: Scene, seed=1):
    """The trial of a scene, as it is recorded beside a calibration."""
    return dataclasses.replace(scene, calibration=()).simulate(seed)[TRIAL]


def recorded(scene: Scene, loads, seed=1):
    """A recording whose load is another one in each period."""
    scenes = [dataclasses.replace(scene, trials=(Trial(TRIAL, load),)) for load in loads]
    records = [trial(one, seed) for one in scenes]
    v_out = records[0].v_out.copy()
    for number, record in enumerate(records):
        start = round(number * scene.sample_rate / scene.pulse_rate)
        v_out[start:] = record.v_out[start:]
    return records[0].replace(v_out=v_out)


def falling(load, name, share, periods=3):
    """The load in each period, of which one element falls by a share of its value."""
    value = getattr(load, name)
    parts = np.linspace(0, share, periods)
    return [dataclasses.replace(load, **{name: value * (1 - part)}) for part in parts]


def repeats_of(recording):
    [of] = repeats([Inspected.of(recording)])
    assert of is not None
    return of


def change_of(of, scene, load, allowed=0.0):
    """Of a recording or of its periods, with the true driver and load, without a fit."""
    of = repeats_of(of) if isinstance(of, etid.Recording) else of
    z, z_th, by = load(of.frequency), scene.driver.z_th(of.frequency), []
    for name in NAMES:
        more = dataclasses.replace(load, **{name: getattr(load, name) * (1 + 1e-6)})
        by.append((more(of.frequency) - z) / 1e-6 * z_th / (z * (z + z_th)))
    found = changes.found([of], np.array([by]), np.full((1, 3), allowed))
    return changes.Change(*(part[0] for part in found))


@pytest.fixture(scope="module")
def driver():
    return etid.identify_driver(rung("dry").simulate(0)[CALIBRATION])


@pytest.mark.parametrize("load", LOADS)
@pytest.mark.parametrize("after", [0.1e-3, 0.3e-3, 0.5e-3, 0.8e-3])
def test_nothing_changes_in_a_record_that_begins_in_a_pulse_or_on_its_tail(load, after):
    """Cuts are up to half a sample beside their place, and the voltage is steep there."""
    scene = dataclasses.replace(rung(load), start=TransformerDriver().lead_in + after)
    for seed in range(2):
        assert not change_of(trial(scene, seed), scene, LOADS[load]).seen


@pytest.mark.parametrize("load", LOADS)
def test_the_element_that_moves_is_named(load):
    for name in NAMES:
        scene = rung(load)
        change = change_of(recorded(scene, falling(LOADS[load], name, 0.1)), scene, LOADS[load])
        assert change.seen
        assert_falls(name, change.size, change.stderr)


def assert_falls(name, size, stderr):
    """By 10 %, alone."""
    expected = np.array([-0.1 * (one == name) for one in (*NAMES, "amplitude")])
    # Four standard errors, and what is not linear in a change of 10 %: half its square.
    assert (np.abs(size - expected) < 4 * stderr + 0.005).all()


def test_a_gain_behind_a_current_is_right_at_all_frequencies_if_periods_begin_between_samples():
    """A resistor of another size in each period; the cuts are up to a third of a sample late."""
    size, place = np.array([0.0, -0.02, 0.05]), np.arange(10_000)
    pulses = np.exp(-0.5 * ((place % (10_000 / 3) - 5_000 / 3) / 1.5) ** 2)
    noise = 1e-5 * np.random.default_rng(0).standard_normal((2, place.size))
    load = 5e3 * (1 + size[(place / (10_000 / 3)).astype(int)])
    current, v_out = 1e-3 * (pulses + noise[0]), load * 1e-3 * (pulses + noise[1])
    one = etid.Recording(v_out=v_out, current=current, sample_rate=200e3, pulse_rate=60.0)
    of = repeats_of(one)
    far = (of.frequency > 5e3) & (of.frequency < 50e3)  # from the lines of a drift and the noise
    expected = np.broadcast_to((size - size.mean())[:, None], of.gain[:, far].shape)
    np.testing.assert_allclose(of.gain[:, far], expected, atol=1.5e-3)  # of first order in `size`


@pytest.mark.parametrize(
    ("share", "seed", "settings", "allowed", "seen"),
    [
        (0.1, 1, {}, 0.08, True),  # a change matters from the size that is allowed on
        (0.1, 1, {}, 0.13, False),
        # One of the records in which χ² of all four elements is too small.
        (0.05, 29, {"snr_db": 40.0}, 0.0, True),
        # Aliases exceed the noise from a quarter of this rate on; low bands do not see them.
        (0.01, 1, {"sample_rate": 100e3, "samples": 5_000}, 0.0, True),
    ],
)
def test_a_fall_of_r_p_is_seen_where_it_matters(share, seed, settings, allowed, seen):
    scene, skin = rung("dry", **settings), LOADS["dry"]
    moving = recorded(scene, falling(skin, "r_p", share), seed)
    assert change_of(moving, scene, skin, allowed).seen == seen


def test_the_standard_errors_of_changes_are_what_the_changes_scatter_by():
    off = []
    for load, skin in LOADS.items():
        scene, moves = rung(load), falling(skin, "r_p", 0.03)
        for seed in range(6):
            change = change_of(recorded(scene, moves, seed), scene, skin)
            off.append((change.size - [0, -0.03, 0, 0]) / change.stderr)
    # Of 48 numbers, of which some 36 are independent: four standard errors of a standard deviation.
    assert 0.53 < np.sqrt(np.mean(np.square(off))) < 1.47


@pytest.mark.parametrize(("freedom", "count"), [(1, 1), (1, 3), (4, 16), (9, 40)])
def test_a_square_is_unlikely_as_rarely_as_it_says(freedom, count):
    limit = scipy.stats.chi2.isf(FALSE_ALARMS / count, freedom)
    squares = np.array([0.0, 0.999 * limit, 1.001 * limit, np.inf, np.nan])
    is_unlikely = changes.unlikely(squares, freedom, count)
    np.testing.assert_array_equal(is_unlikely, [False, False, True, True, False])
    assert not changes.unlikely(squares[:1], freedom, count).any()


def test_a_step_and_a_single_period_are_seen_as_well_as_a_line():
    scene, skin = rung("dry", samples=33_334), LOADS["dry"]
    other = dataclasses.replace(skin, r_p=0.9 * skin.r_p)
    for loads in ([skin] * 6 + [other] * 4, [skin] * 4 + [other] + [skin] * 5):
        change = change_of(recorded(scene, loads), scene, skin)
        assert change.seen
        # The step itself, not its mean slope.
        assert abs(change.size[1] + 0.1) < 4 * change.stderr[1] + 0.005


def test_courses_are_a_line_each_step_and_each_single_period():
    steps = [np.arange(5) >= first for first in (1, 2, 3, 4)]
    inner = [np.arange(5) == one for one in (1, 2, 3)]
    expected = np.array([np.arange(5), *steps, *inner], float)
    expected -= expected.mean(axis=1, keepdims=True)
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    np.testing.assert_allclose(changes.courses(5), expected)


def test_noise_that_is_larger_between_periods_than_within_is_no_change():
    """Coloured noise: three times the scatter between periods makes three times the error."""
    scene, skin = rung("dry", samples=16_667), LOADS["dry"]
    of = repeats_of(recorded(scene, [skin] * 5))
    middle = of.gain.mean(0)
    one, other = (
        change_of(of._replace(gain=middle + size * (of.gain - middle)), scene, skin)
        for size in (2.0, 6.0)
    )
    assert not one.seen
    assert not other.seen
    # Of the logarithms.
    np.testing.assert_allclose(
        other.stderr / (1 + other.size), 3 * one.stderr / (1 + one.size), rtol=1e-6
    )


UNDISTURBED = {
    "20 dB": {"snr_db": 20.0},
    "80 dB": {"snr_db": 80.0},
    "delays": {"snr_db": 80.0, "trigger_jitter_rms": 5e-6},
    "offset": {"snr_db": 80.0, "offset_rms": 0.1},
    "14 bits": {"snr_db": 80.0, "bits": 14},
    "two periods": {"snr_db": 80.0, "samples": 6_667},
    "100 kHz": {"snr_db": 80.0, "sample_rate": 100e3, "samples": 5_000},
    "whole samples": {"snr_db": 80.0, "sample_rate": 240e3, "samples": 12_000},
    "1 MHz": {"snr_db": 80.0, "sample_rate": 1e6, "samples": 50_000},
    "one V_th": {"snr_db": 80.0, "shared_v_th": True},
}


@pytest.mark.parametrize("name", UNDISTURBED)
def test_what_does_not_change_raises_no_alarm(name):
    """However little a change would matter."""
    for load, skin in LOADS.items():
        scene = rung(load, **UNDISTURBED[name])
        change = change_of(trial(scene), scene, skin)
        assert not change.seen
        assert (np.abs(change.size) < 6 * change.stderr).all()


@pytest.mark.parametrize("rate", [100e3, 200e3])
def test_cuts_between_samples_leave_the_amplitude_of_v_th_alone(rate):
    """Thirds of a sample; sums of four samples had 1.4e-3 at 200 kHz, and 12 times the alarms."""
    scene = rung("dry", snr_db=100.0, sample_rate=rate, samples=round(rate / 20))
    of = repeats_of(trial(scene, 0))
    assert np.abs(of.unloaded).max() < np.sqrt(of.unloaded_variance) < changes.UNEQUAL


@pytest.mark.slow
@pytest.mark.parametrize("snr_db", [20.0, 30.0, 80.0])
def test_false_alarms_are_as_rare_as_they_are_said_to_be(snr_db):
    """A tenth is expected in 1000 recordings; more than two have a probability of 2e-4."""
    load, count = LOADS["dry"], round(0.1 / FALSE_ALARMS)
    trials = tuple(Trial(str(number), load) for number in range(count))
    scene = dataclasses.replace(rung("dry", snr_db=snr_db), trials=trials, calibration=())
    seen = (change_of(one, scene, load).seen for one in scene.simulate(seed=1).values())
    assert sum(map(bool, seen)) <= 2


def test_hum_wander_and_a_record_that_begins_within_a_pulse_are_no_change_of_the_skin():
    scene, skin = rung("dry"), LOADS["dry"]
    recording = trial(scene, 1)
    for frequency in (1.0, 50.0):
        volts = 0.02 / scene.scale * np.sin(2 * np.pi * frequency * recording.time + 1)
        change = change_of(recording.replace(v_out=recording.v_out + volts), scene, skin, 0.01)
        assert not change.seen
    # Early by 50 samples, more than the 24 before the first pulse.
    early = change_of(recording.replace(v_out=np.roll(recording.v_out, -50)), scene, skin)
    assert not early.seen
    # The same samples: what moves from the end of the record to its begin holds next to nothing.
    np.testing.assert_allclose(early.stderr, change_of(recording, scene, skin).stderr, rtol=0.1)


@pytest.mark.parametrize(
    "method",
    ["maximum_likelihood", pytest.param("output_error", marks=pytest.mark.slow)],
)
def test_skin_that_changes_is_refused_and_said(driver, method):
    """R_p falls by 5 %: its fit would be 25 of its standard errors from either end."""
    recording = recorded(rung("dry"), falling(LOADS["dry"], "r_p", 0.05))
    fit = etid.identify_skin(recording, driver, method=method, throw=False)
    assert fit.verdict == "changed"
    assert fit.change is not None
    assert fit.change_stderr is not None
    assert abs(fit.change[1] + 0.05) < 4 * fit.change_stderr[1]
    assert f"r_p {100 * fit.change[1]:+.2g} ±" in str(fit)
    with pytest.raises(etid.IdentificationError, match=r"changed.* r_p -"):
        etid.identify_skin(recording, driver, method=method)
    if method == "maximum_likelihood":
        fits = etid.identify_skins([trial(rung("dry"), 1), recording], driver)
        assert fits.verdicts.tolist() == ["successful", "changed"]
        assert "r_p -" in fits.notes[1]
        np.testing.assert_allclose(fits.table()["r_p_change"][1], fit.change[1], rtol=1e-6)


def test_a_choice_of_the_circuit_hides_no_change():
    """At 40 dB other circuits are fitted too; none is taken in place of the one that changed."""
    scene = rung("damp", snr_db=40.0)
    of = etid.identify_driver(scene.simulate(0)[CALIBRATION])
    recording = recorded(scene, falling(LOADS["damp"], "r_p", 0.2))
    alone = etid.identify_skin(recording, of, circuit="auto", throw=False)
    batch = etid.identify_skins([recording, trial(scene, 2)], of, circuit="auto")
    chosen = etid.select_circuit(recording, of, throw=False)
    assert len(chosen.fits) > 1
    for verdict in (alone.verdict, batch.verdicts[0], chosen.fit.verdict):
        assert verdict == "changed"
    assert "r_p -" in chosen.residual
    assert not chosen.late


def drifting(recording, name, share):
    """With a gain that rises by a share over the record."""
    rise = 1 + share * recording.time / recording.duration
    return recording.replace(**{name: getattr(recording, name) * rise})


def test_an_amplitude_that_drifts_is_seen_in_either_record_and_in_a_calibration(driver):
    skin, known = trial(rung("dry"), 1), rung("dry").simulate(0)[CALIBRATION]
    for name in ("v_out", "v_th"):
        fit = etid.identify_skin(drifting(skin, name, 0.01), driver, throw=False)
        assert fit.verdict == "changed"
    of = etid.identify_driver(drifting(known, "v_out", 0.02), throw=False)
    assert of.verdict == "changed"


def test_a_file_of_fits_keeps_changes(tmp_path):
    fits = pictures.fits()
    size = np.random.default_rng(0).normal(size=(len(fits), 4))
    fit = dataclasses.replace(fits.fit, change=size, change_stderr=size**2)
    dataclasses.replace(fits, fit=fit).write(tmp_path / "fits.h5")
    back = Fits.read(tmp_path / "fits.h5")
    np.testing.assert_array_equal(back.fit.change, size)
    np.testing.assert_array_equal(back.fit.change_stderr, size**2)
    np.testing.assert_array_equal(back.table()["amplitude_change"], size[:, 3])


def driven(loads, current_factor=(1.0, 1.0, 1.0)):
    """V_out and current of loads behind the transformer, another one in each period."""
    scenes = [
        Scene((Trial(TRIAL, load),), snr_db=40.0, current_snr_db=40.0, trigger_jitter_rms=50e-9)
        for load in loads
    ]
    records = [scene.simulate(seed=1)[TRIAL].without_v_th() for scene in scenes]
    period = np.clip((records[0].time * records[0].pulse_rate).astype(int), 0, 2)
    v_out, current = (
        np.choose(period, [getattr(record, name) for record in records])
        for name in ("v_out", "current")
    )
    return records[0].replace(v_out=v_out, current=current * np.take(current_factor, period))


@pytest.mark.parametrize("name", NAMES)
def test_an_element_that_moves_behind_a_measured_current_is_named(name):
    """Behind a source impedance, the current changes with the load; V_out alone hides it."""
    fit = etid.identify_skin(driven(falling(LOADS["dry"], name, 0.1)), throw=False)
    assert fit.verdict == "changed"
    assert_falls(name, np.asarray(fit.change), np.asarray(fit.change_stderr))


def test_a_driver_that_changes_moves_no_load_behind_a_measured_current():
    """The current probe loses gain in one recording, both channels in another one."""
    steady = [LOADS["dry"]] * 3
    assert etid.identify_skin(driven(steady, (1, 1, 0.98)), throw=False).verdict == "changed"
    record = driven(steady, (1, 1, 0.8))
    both = record.replace(v_out=np.where(record.time < 2 / 60, 1, 0.8) * record.v_out)
    assert etid.identify_skin(both).verdict == "successful"


def test_noise_of_bands_is_that_of_their_second_differences():
    """Bands with unequal weights: unit variance over the weight, about a smooth change."""
    rng, weight = np.random.default_rng(7), np.array([[1.0, 4.0, 0.5, 2.0, 9.0, 1.0]])
    real, imaginary = rng.normal(size=(2, 1, 20_000, 6)) * np.sqrt(0.5 / weight)
    gain = real + 1j * imaginary + np.arange(6.0)
    # The mean over the periods is taken from each, which is one degree of freedom less.
    [found] = _noise_of_single(gain - gain.mean(axis=1, keepdims=True), weight, np.array([19_999]))
    assert found == pytest.approx(0.5, rel=0.02)  # 80 000 differences know it to 0.5 %


@pytest.mark.parametrize(("number", "path"), [(4, "damp"), (9, "dry")])
def test_aliases_of_a_card_without_a_filter_are_no_change(number, path):
    """With a clock 50 ppm fast, six periods are cut at six phases: those of fs + f show, too."""
    change = lab.lasting(20_000, lab.instrument("multifunction_card"))
    study = change(lab.undisturbed(number, 60.0)).recordings()
    driver = etid.identify_driver(list(study.calibrations.recordings()))
    assert etid.identify_skin(study[path], driver).verdict == "successful"
