"""Joint fits of recordings that measured the current beside V_th."""

import numpy as np
import pytest

import etid
from etid.recordings.remarks import Remark
from tests.skins import DAMP, DRY, off, relative
from tests.test_driver_and_current import LATE, WITHIN, late_record, scene

pytestmark = pytest.mark.slow


def jointly(recordings, **options):
    return etid.identify_jointly(etid.Study.from_recordings(recordings), **options)


@pytest.fixture(scope="module")
def drawn():
    return scene().simulate(seed=2)


@pytest.fixture(scope="module")
def pair(drawn):
    """A calibration and one recording."""
    return [drawn["calibration/0"], drawn["loaded/0"]]


@pytest.fixture(scope="module")
def joint(pair):
    return jointly(pair)


def bound_of(of):
    return np.array(list(etid.bound(of)["loaded/0"].relative.values()))


def test_the_current_makes_a_joint_fit_as_much_more_precise_as_the_bound_says(pair, joint):
    fit = joint.fits[0]
    assert (fit.verdict, fit.method, int(fit.remarks)) == ("successful", "joint", 0)
    assert np.abs(off(fit)).max() < WITHIN
    calibration, recording = pair
    driver = etid.identify_driver(calibration, order=5)
    # One trial: a joint fit has the same data as a single fit.
    without = etid.identify_skin(recording.replace(current=None), driver)
    gained = bound_of(scene()) / bound_of(scene(current_snr_db=None))
    # The bound holds for every kind of driver. Without a current, C_p profits by a tenth from the
    # knowledge that the driver has five poles.
    np.testing.assert_allclose(relative(fit) / relative(without), gained, rtol=0.15)
    np.testing.assert_allclose(relative(fit), bound_of(scene()), rtol=0.05)
    both = etid.identify_skin(recording, driver)
    # The single fit takes Z_th as linear around the calibrations; that is a tenth of an error.
    assert (np.abs(np.subtract(*map(values, (fit, both)))) < 0.1 * errors(both)).all()


def values(fit):
    return np.asarray(fit.circuit.values())


def errors(fit):
    return np.sqrt(np.diagonal(fit.cov))


def spiked(one, size):
    """The current with three samples that are off by so many of its heights."""
    current = np.array(one.current)
    current[1500:1503] += size * np.ptp(current)
    return current


@pytest.mark.parametrize(
    ("change", "verdict"),
    [
        (lambda one: 1.003 * one.current, "inconsistent"),
        (lambda one: -one.current, "misaligned"),
        (lambda one: spiked(one, 3.0), "rate_mismatch"),  # it looks like a pulse
    ],
)
def test_a_current_that_contradicts_the_driver_is_told(pair, joint, change, verdict):
    calibration, recording = pair
    found = jointly([calibration, recording.replace(current=change(recording))])
    assert found.fits.verdicts.tolist() == [verdict]


def test_a_current_without_a_signal_is_left_out(pair):
    calibration, recording = pair
    fit = jointly([calibration, recording.replace(current=0 * recording.current)]).fits[0]
    assert fit.verdict == "successful"
    assert int(fit.remarks) == Remark.current_unused
    assert np.abs(off(fit)).max() < WITHIN


@pytest.mark.parametrize(("name", "late"), [("current", LATE[1]), ("v_out", LATE[2])])
def test_a_lag_of_one_record_is_taken_off(pair, name, late):
    fit = jointly([pair[0], late_record(name, late)]).fits[0]
    assert fit.verdict == "successful"
    assert np.abs(off(fit)).max() < WITHIN
    assert int(fit.remarks) == Remark.aligned


def test_the_tolerance_of_the_known_resistor_is_what_the_current_leaves_of_it(pair, joint):
    """A budget has the effect of another resistor; the fit finds the resistor by its tolerance."""
    calibration, recording = pair
    wrong = 3e-3
    other = calibration.replace(r_load=(1 + wrong) * calibration.r_load)
    contradicted = jointly([other, recording]).fits[0]
    assert contradicted.verdict == "inconsistent"
    moved = values(contradicted) / values(joint.fits[0]) - 1
    budgeted = jointly(pair, instrument=etid.Instrument())
    (driver,) = budgeted.drivers.values()
    told = budgeted.fits[0].budget(recording, driver).unstated["r_load"] * wrong / 1e-3
    # 2nd order of a change of 0.3 %, whose own effect the fits find to a few per cent.
    np.testing.assert_allclose(told, np.abs(moved), rtol=0.05, atol=1e-5)
    assert (told < 0.9 * wrong).all()

    tolerance = etid.Instrument(r_load=wrong)
    doubtful, found = (
        jointly([known, recording], instrument=tolerance).fits[0] for known in (calibration, other)
    )
    assert (doubtful.verdict, found.verdict) == ("successful", "successful")
    assert (np.abs(values(found) - values(doubtful)) < 0.02 * errors(doubtful)).all()
    added = np.diagonal(doubtful.cov - joint.fits[0].cov) / values(doubtful) ** 2
    assert (added > 0).all()
    # The current shows its scale to a tenth of this tolerance.
    assert (np.sqrt(added) < 0.2 * told).all()
    shared = np.diagonal(doubtful.shared_cov - joint.fits[0].shared_cov) / values(doubtful) ** 2
    np.testing.assert_allclose(shared, added, rtol=0.1)


def test_intervals_of_joint_estimates_are_true():
    """Dry skin with an unloaded record for each recording, and damp skin with one for all."""
    z, draws = [], 12
    for circuit, current_snr_db, shared_v_th in ((DRY, 40.0, False), (DAMP, 30.0, True)):
        of = scene(circuit, current_snr_db=current_snr_db, shared_v_th=shared_v_th)
        for seed in range(draws):
            fits = etid.identify_jointly(of.simulate(seed + 2000)).fits
            assert set(fits.verdicts) <= {"successful", "inconsistent", "changed"}, seed
            if (fits.verdicts == "successful").all():
                z.append(off(fits, circuit))
    assert len(z) >= 2 * draws - 2
    # Two fits of a draw share its driver: 24 squares have a mean that is known to 29 %, and these
    # are three of that.
    squares = np.mean(np.square(z), axis=(0, 1))
    assert (squares < 1.9).all(), squares
    assert (squares > 0.13).all(), squares


def test_a_current_helps_the_recordings_without_one(drawn):
    paths = "calibration/0", "loaded/0", "loaded/1"
    calibration, first, second = (drawn[path] for path in paths)
    mixed = jointly([calibration, first, second.replace(current=None)]).fits
    without = jointly([calibration, *(one.replace(current=None) for one in (first, second))]).fits
    assert (mixed.verdicts == "successful").all()
    assert max(np.abs(off(mixed[row])).max() for row in range(2)) < WITHIN
    gained = [relative(mixed[row]) / relative(without[row]) for row in range(2)]
    assert (gained[0] < 0.6).all()
    # It determines Z_th, of whose error the second trial has its share.
    assert (gained[1] < 0.95).all()
    assert (gained[1] > gained[0]).all()


def test_a_record_with_a_disturbed_period_leaves_its_current_out_and_says_so(pair):
    calibration, recording = pair
    fit = jointly([calibration, recording.replace(current=spiked(recording, 0.3))]).fits[0]
    assert fit.verdict == "successful"
    assert int(fit.remarks) & Remark.current_unused
    assert np.abs(off(fit)).max() < WITHIN
