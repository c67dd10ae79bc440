"""A sample that the recorder lost or stored twice: the periods are aligned."""

import numpy as np
import pytest

import etid
from benchmarks.ladder import CALIBRATION, LOADS, TRIAL, rung
from etid.recordings.causes import how_shifted
from etid.recordings.preflight import Inspected
from etid.recordings.remarks import Remark, texts
from tests.skins import off
from tests.test_changes import falling, recorded

PERIOD = 10_000 / 3
FAULTS = ("lost", "doubled")


def faulty(recording, fault, place, which="v_out"):
    """The recording with one fault; a sample from a period before fills its end."""
    v = getattr(recording, which)
    if fault == "lost":
        v = np.append(np.delete(v, place), v[-round(PERIOD)])
    else:
        v = np.insert(v, place, v[place - 1])[: v.size]
    return recording.replace(**{which: v})


@pytest.fixture(scope="module")
def records():
    """Six periods with each load, with noise of 40 dB."""
    return {load: rung(load, snr_db=40.0, samples=20_000).simulate(1)[TRIAL] for load in LOADS}


@pytest.mark.parametrize("load", LOADS)
@pytest.mark.parametrize("which", ["v_th", "v_out"])
@pytest.mark.parametrize("fault", FAULTS)
def test_the_period_after_which_a_sample_is_missing_or_too_many_is_found(
    records, load, which, fault
):
    for period in (1, 4):
        one = faulty(records[load], fault, round((period - 0.3) * PERIOD), which)
        seen = Inspected.of(one)
        assert seen.shifts is not None
        assert not seen.shifts.bad.any()
        later = (fault == "doubled") == (which == "v_out")
        steps = np.diff(seen.shifts.late)
        expected = np.where(np.arange(1, steps.size + 1) == period, 1 if later else -1, 0)
        np.testing.assert_array_equal(steps, expected)
        word = "later" if later else "earlier"
        assert f"from period {period + 1} on, v_out is 1 sample {word}" in how_shifted(seen)
        assert seen.remarks & Remark.periods_shifted


@pytest.mark.parametrize("load", LOADS)
@pytest.mark.parametrize("fault", FAULTS)
def test_a_period_whose_pulse_has_the_fault_is_left_out(records, load, fault):
    for period in (0, 2, 5):
        one = faulty(records[load], fault, round(period * PERIOD) + 90)
        seen = Inspected.of(one)
        assert seen.shifts is not None
        np.testing.assert_array_equal(np.flatnonzero(seen.shifts.bad), [period])
        assert np.median(np.delete(seen.shifts.late, period)) == 0  # most periods stay in place
        assert seen.periods[0] == 5
        assert seen.remarks & Remark.periods_left_out
        assert f"pulse of period {period + 1}" in how_shifted(seen)


@pytest.mark.parametrize("load", LOADS)
def test_noise_jitter_and_other_skin_do_not_shift_periods(load):
    for snr_db in (20.0, 30.0, 60.0):
        for jitter in (0.0, 5e-6):
            scene = rung(load, snr_db=snr_db, trigger_jitter_rms=jitter)
            assert Inspected.of(scene.simulate(3)[TRIAL]).shifts is None
    for name in ("r_s", "r_p", "c_p"):
        for fall in (0.3, 0.6):
            one = recorded(rung(load), falling(LOADS[load], name, fall))
            assert Inspected.of(one).shifts is None


@pytest.mark.parametrize("begins", [0, 200])
@pytest.mark.parametrize("jitters", [False, True])
def test_a_record_that_begins_on_an_edge_is_periodic_unless_its_pulses_jitter(begins, jitters):
    """R_s was 1.5 % wrong, five standard errors, and successful."""
    rate, pulse_rate, periods = 100e3, 50.0, 4
    size = round(periods * rate / pulse_rate)
    # Rounding errors of this product move some edges by one sample.
    samples = np.arange(size)
    phase = samples / rate * pulse_rate % 1 if jitters else samples % 2000 / 2000
    current = 1e-3 * ((phase < 0.05) * 1.0 - ((phase >= 0.05) & (phase < 0.1)))
    window = np.hanning(9) / np.hanning(9).sum()
    current = np.roll(np.convolve(np.tile(current, 3), window, "same")[size : 2 * size], begins)
    s = 2j * np.pi * np.fft.rfftfreq(size, 1 / rate)
    z = 4e3 + 40e3 / (1 + s * 40e3 * 8e-9)
    v_out = np.fft.irfft(np.fft.rfft(current) * z, size)
    rng = np.random.default_rng(0)
    one = etid.Recording(
        v_out=v_out + 0.02 * rng.standard_normal(size),
        current=current + 1e-6 * rng.standard_normal(size),
        sample_rate=rate,
        pulse_rate=pulse_rate,
    )
    assert Inspected.of(one).is_periodic == (begins > 0 or not jitters)


@pytest.mark.slow
@pytest.mark.parametrize("load", LOADS)
def test_elements_behind_a_lost_sample_are_right(records, load):
    """R_s of damp skin was 61 % wrong, 25 standard errors, and successful."""
    driver = etid.identify_driver(rung(load, snr_db=40.0).simulate(0)[CALIBRATION])
    places = [2000, 5500, 9000, 12_000, 15_000]
    faults = [(fault, which) for fault in FAULTS for which in ("v_out", "v_th")]
    all_faults = [(*fault, place) for fault in faults for place in places]
    fits = etid.identify_skins(
        [faulty(records[load], fault, place, which) for fault, which, place in all_faults], driver
    )
    assert set(fits.verdicts) == {"successful"}
    assert np.abs(off(fits, LOADS[load])).max() < 4.0  # one noise for all: three normal numbers
    # A doubled sample in v_th makes its pulses seem rarer: of the record, five periods remain.
    told = (np.asarray(fits.fit.remarks) & int(Remark.periods_shifted)) > 0
    fifth = [fault == ("doubled", "v_th", 15_000) for fault in all_faults]
    np.testing.assert_array_equal(told, np.logical_not(fifth))


def test_samples_that_both_records_lost_are_a_likely_cause_of_another_pulse_rate():
    """Its fit was successful with ± that are four times as large, and no word."""
    one = rung("dry", snr_db=60.0).simulate(1)[TRIAL]
    both = {
        name: np.delete(getattr(one, name), np.arange(4000, 4004)) for name in ("v_th", "v_out")
    }
    (said,) = texts(Inspected.of(one.replace(**both)).remarks)
    assert "a sample lost or recorded twice in both records" in said
