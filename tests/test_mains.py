"""Mains hum costs nothing but the harmonics on which it falls, and a fit says that it was there."""

import numpy as np
import pytest

import etid
from benchmarks import perturbed_study
from benchmarks.laboratory import hum
from benchmarks.ladder import LOADS
from benchmarks.perturbed_study import all_records, both
from etid.recordings.preflight import Inspected
from etid.recordings.recording import Samples
from etid.recordings.remarks import Remark
from etid.signals import mains, quick_looks
from etid.simulation import scenes
from etid.simulation.scenes import Scene
from tests import kept_numbers
from tests.skins import off

SCALE = Scene().scale
DRY = scenes.paper_dry()


def hummed(recording, frequency, volts, seed=0, signals=("v_th", "v_out")):
    """A recording with hum [V at the converter] of this frequency and its multiples 2, 3 and 5."""
    rng = np.random.default_rng(seed)
    time = np.arange(recording.v_th.size) / recording.sample_rate
    samples = {"v_th": recording.samples["v_th"], "v_out": recording.samples["v_out"]}
    for name in signals:
        of = samples[name]
        turns = frequency * time + rng.random()
        added = sum(
            volts * (1.0 if h == 1 else 0.3) * np.sin(2 * np.pi * (h * turns + rng.random()))
            for h in (1, 2, 3, 5)
        )
        codes = np.rint(of.stored + added / SCALE / of.conversion)
        samples[name] = Samples(codes.astype(of.stored.dtype), of.conversion, of.offset)
    return recording.replace(**samples)


def study_of(**settings):
    return Scene(DRY.trials[:1], DRY.calibration, **settings).simulate(seed=1)


@pytest.fixture(scope="module")
def records():
    return tuple(study_of().values())


@pytest.fixture(scope="module")
def quiet(records):
    driver = etid.identify_driver(records[0])
    return driver, etid.identify_skin(records[1], driver)


def in_errors(fit, other):
    return np.abs(fit.circuit.values() - other.circuit.values()) / np.sqrt(np.diag(other.cov))


def test_lines_are_the_harmonics_on_multiples_of_50_or_60_hz():
    sixty = np.arange(1, 20) * 60.0
    np.testing.assert_array_equal(np.flatnonzero(mains.lines(sixty)) + 1, range(1, 8))
    hundred = np.arange(1, 20) * 100.06
    np.testing.assert_array_equal(np.flatnonzero(mains.lines(hundred)) + 1, [1, 2, 3])
    assert not mains.lines(np.array([55.0, 80.0, 1000.0])).any()


@pytest.mark.parametrize(
    ("frequency", "samples"), [(50.0, 10_000), (49.93, 10_000), (59.98, 100_000)]
)
def test_hum_between_the_harmonics_is_subtracted(frequency, samples):
    clean = study_of(samples=samples)["calibration/98k8"]
    seen = Inspected.of(hummed(clean, frequency, 0.1))
    assert seen.remarks == Remark.mains_hum
    periods, length = seen.periods
    left = np.fft.rfft((seen.v_out - clean.v_out)[:length]) / length
    frequencies = np.arange(left.size) / length * clean.sample_rate
    noise = float(seen.sigma[1]) / np.sqrt(length)
    # What is subtracted is as uncertain as noise beside the hum, and less farther away.
    far = np.abs(frequencies[:, None] - frequency * np.arange(1, 8)).min(1)
    far = (far > clean.sample_rate / length) & (np.arange(left.size) % periods == 0)
    assert np.abs(left[far]).max() < 3 * noise
    assert np.abs(left[far])[10:].max() < noise


@pytest.mark.parametrize(
    "settings",
    [{}, pytest.param({"pulse_rate_ppm": 150.0}, marks=pytest.mark.slow), {"samples": 16_667}],
)
@pytest.mark.parametrize("snr_db", [20.0, 40.0, 80.0])
def test_no_hum_is_seen_where_there_is_none(settings, snr_db):
    for recording in study_of(snr_db=snr_db, offset_rms=0.1, **settings).values():
        assert Inspected.of(recording).remarks == Remark(0)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_record_that_is_not_finite_has_no_hum(value):
    v = np.sin(np.arange(10_000.0))
    v[7] = value
    assert not quick_looks.humming(v[None], np.array([0.01]), 200e3, 60.0, 3, 10_000).any()
    assert mains.separated(v, 0.01, 200e3, 3, 10_000) is None


def test_every_record_too_long_for_a_quick_look_is_examined_for_hum():
    v = np.zeros((1, quick_looks.PROBED + 1))
    assert quick_looks.humming(v, np.array([1e-6]), 200e3, 60.0, 60, v.size).all()


@pytest.mark.parametrize("volts", [0.0, 0.002])
def test_hum_is_not_hidden_by_what_pulses_of_broken_periods_leak(volts):
    """Three periods are 10 000.4 samples: pulses of 1 V leak less than 2 mV of hum does."""
    place = np.arange(10_001.0)
    pulses = np.exp(-(((place / 10_000.4 * 3 % 1 - 0.4) / 0.05) ** 2))
    v = pulses + volts * np.sin(2 * np.pi * 50 / 200e3 * place)
    rate = 3 * 200e3 / 10_000.4
    found = quick_looks.humming(v[None], np.array([1e-3]), 200e3, rate, 3, 10_000)
    assert found.all() == (volts > 0)


@pytest.mark.parametrize("frequency", [50.0, 60.0, 59.97])
def test_elements_are_those_without_hum(records, quiet, frequency):
    calibration, skin = (hummed(one, frequency, 0.1, seed) for seed, one in enumerate(records))
    driver = etid.identify_driver(calibration)
    fit = etid.identify_skin(skin, driver)
    # What seven of 1 666 harmonics told, of R_p up to a third, moves the estimate by what it is.
    assert in_errors(fit, quiet[1]).max() < 1
    assert (np.diag(fit.cov) / np.diag(quiet[1].cov)).max() < 1.6
    assert int(driver.remarks) == int(fit.remarks) == Remark.mains_hum
    kept_numbers.check(f"hum_{frequency:g}_hz", kept_numbers.of_fit(fit))


def test_hum_in_a_batch_costs_the_other_recordings_nothing(records, quiet, caplog):
    driver, fit = quiet
    loud = hummed(records[1], 60.0, 0.02, signals=("v_out",))
    with caplog.at_level("INFO", "etid"):
        fits = etid.identify_skins([records[1], loud, records[1]], driver)
    again = [line for line in caplog.messages if "fitted again" in line]
    assert len(again) == 1
    assert again[0].endswith("without the mains harmonics; the second fit is kept.")
    alone = etid.identify_skins([records[1]], driver)  # the program of a single fit is another one
    np.testing.assert_array_equal(fits.fit.remarks, [0, Remark.mains_hum, 0])
    assert set(fits.verdicts) == {"successful"}
    assert (np.asarray(fits.circuit.r_p)[[0, 2]] == np.asarray(alone.circuit.r_p)).all()
    np.testing.assert_allclose(np.asarray(fits.circuit.r_p)[1], fit.circuit.r_p, rtol=2e-3)


def test_a_wrong_gain_is_no_hum(records, quiet):
    """It is more on the low harmonics than noise explains, as hum is, but on all alike."""
    of = records[1].samples["v_out"]
    louder = records[1].replace(v_out=Samples(of.stored, 1.01 * of.conversion))
    fit = etid.identify_skin(louder, quiet[0], throw=False)
    assert fit.verdict == "inconsistent"
    kept_numbers.check("wrong_gain", kept_numbers.of_fit(fit))
    assert int(fit.remarks) == 0


@pytest.mark.slow
def test_a_joint_fit_leaves_hum_out():
    study = Scene(DRY.trials[:3], DRY.calibration).simulate(seed=1)
    loud = [hummed(one, 60.0, 0.02, seed) for seed, one in enumerate(study.values())]
    found = etid.identify_jointly(etid.Study.from_recordings(loud))
    assert set(found.fits.verdicts) == {"successful"}
    # The study has no delays, and the joint fit says so too.
    assert (np.asarray(found.fits.fit.remarks) & Remark.mains_hum).all()
    for name in ("r_s", "r_p", "c_p"):
        off = np.asarray(getattr(found.fits.circuit, name)) - getattr(DRY.trials[0].load, name)
        error = np.asarray(getattr(found.fits.stderr, name))
        assert (np.abs(off) < 4 * error).all()  # nine numbers exceed it once in 1 800 draws
        assert (error < 0.01 * getattr(DRY.trials[0].load, name)).all()


@pytest.mark.parametrize("samples", [3334, pytest.param(5000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("added", [hum(50.0, 0.05), hum(60.0, 0.1), hum(1.0, 0.5)])
def test_hum_and_wander_are_among_the_states_of_a_record_that_is_not_whole_periods(added, samples):
    """In all records; without such states the driver takes them, or the search does not end."""
    study = perturbed_study.lasting(samples)(perturbed_study.undisturbed(0, 60.0))
    disturbed = all_records(both(added=(added,)))(study).recordings()
    driver = etid.identify_driver(list(disturbed.calibrations.recordings()))
    for path, load in LOADS.items():
        fit = etid.identify_skin(disturbed[path], driver)
        assert fit.verdict == "successful"
        # 18 normal numbers for each length: one in 800 such tests.
        assert (np.abs(off(fit, load)) < 4).all()
