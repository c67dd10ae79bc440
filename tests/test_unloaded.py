"""A driver that has changed since its calibration shows it in its unloaded voltage."""

import dataclasses
import functools
from typing import Any

import numpy as np
import pytest
import scipy.stats

import etid
from etid.circuits.directions import FALSE_ALARMS
from etid.estimators.lanes import Harmonics
from etid.likelihood.profile import Records
from etid.likelihood.unloaded import SEEN, differs, shape
from etid.recordings.preflight import Inspected
from etid.recordings.study import Study
from etid.simulation.scenes import Scene, Trial
from etid.simulation.transformer import ResistorLoad, SkinLoad, TransformerDriver

USUAL = TransformerDriver()
DRY = SkinLoad(r_s=33.4e3, r_p=186e3, c_p=0.12e-9)


def changed(**factors):
    return dataclasses.replace(USUAL, **{k: getattr(USUAL, k) * v for k, v in factors.items()})


def study(driver=USUAL, seed=0, **options):
    trials = (Trial("loaded/0", DRY),)
    known = (Trial("calibration/0", ResistorLoad(98.8e3)),)
    options = dict[str, Any](trigger_jitter_rms=50e-9, offset_rms=0.01) | options
    return Scene(trials, known, driver=driver, **options).simulate(seed)


def spectrum(recording):
    return Harmonics.of(Inspected.of(recording)).fields


def is_other(calibration, spectrum):
    """Whether the unloaded voltage of a recording shows another driver."""
    of_y = spectrum.y[None], spectrum.variance_y[None], spectrum.selected[None]
    return differs(calibration, Records(spectrum.frequency, spectrum.x, spectrum.variance_x, *of_y))


@functools.cache
def calibrated(snr_db):
    return shape(spectrum(study(snr_db=snr_db)["calibration/0"]))


def is_changed(driver, seed=1, snr_db=60.0, **options):
    later = spectrum(study(driver, seed, snr_db=snr_db, **options)["loaded/0"])
    return bool(is_other(calibrated(snr_db), later))


PARTS = {
    "protection": {"r_protection": 1.03},
    "winding": {"r_secondary": 1.2},
    "leakage": {"l_primary": 1.05, "l_secondary": 1.05},
    "magnetising": {"l_magnetising": 1.05},
    "source": {"r_source": 1.05},
    "capacitance": {"c_secondary": 1.1},
    "cable": {"c_cable": 1.1},
}


@pytest.mark.parametrize("part", PARTS)
def test_a_part_that_has_changed_is_seen(part):
    assert is_changed(changed(**PARTS[part]))


@pytest.mark.parametrize(
    ("snr_db", "seed"),
    [(80.0, 1), (80.0, 2), (60.0, 3), (40.0, 4), (30.0, 1), (20.0, 2), (20.0, 3)],
)
def test_the_same_driver_is_the_same(snr_db, seed):
    assert not is_changed(USUAL, seed, snr_db, start=seed * 3.7e-4)


@pytest.mark.parametrize(
    ("name", "driver"),
    {
        "louder": changed(amplitude=1.02),
        "upside down": changed(amplitude=-1.0),
        "longer": changed(width=1.01),
        "longer by a half": changed(width=1.5),
        "twice as long": changed(width=2.0),
        "slower edge": changed(edge=1.2),
    }.items(),
)
def test_another_pulse_of_the_same_driver_is_no_change(name, driver):
    assert not is_changed(driver), name


@pytest.mark.parametrize("part", [{"c_cable": 1.3}, {"l_primary": 1.2, "l_secondary": 1.2}])
def test_a_pulse_of_a_tenth_shows_what_has_changed_as_well(part):
    """The noise of the calibration is that of a tenth of it."""
    calibration = shape(spectrum(study(snr_db=40.0)["calibration/0"]))
    for amplitude in (1.0, 0.1):
        later = study(changed(amplitude=amplitude, **part), 1, snr_db=60.0)["loaded/0"]
        assert bool(is_other(calibration, spectrum(later)))


@pytest.fixture(scope="module")
def driver():
    return etid.identify_driver(study()["calibration/0"])


def test_the_limit_is_exceeded_as_rarely_as_a_study_can_bear():
    directions = shape(spectrum(study()["calibration/0"])).directions.shape[0]
    np.testing.assert_allclose(scipy.stats.chi2.sf(SEEN, directions), FALSE_ALARMS, rtol=1e-2)


def test_a_skin_behind_a_changed_driver_is_inconsistent(driver):
    """R_p was 63 of its standard errors off, at chi2 1."""
    fit = etid.identify_skin(study(seed=1)["loaded/0"], driver)
    assert fit.verdict == "successful"
    later = study(changed(r_protection=1.05), seed=1)["loaded/0"]
    with pytest.raises(etid.IdentificationError, match="inconsistent"):
        etid.identify_skin(later, driver)


@pytest.mark.slow
def test_recordings_behind_a_changed_driver_take_no_part_in_a_joint_fit():
    """R_p was 40 standard errors off in these two, and all of it was successful."""
    later = changed(r_protection=1.05)
    sources = {"before/0": USUAL, "before/1": USUAL, "after/0": later, "after/1": later}
    loaded = [
        study(source, seed)["loaded/0"].replace(path=path)
        for seed, (path, source) in enumerate(sources.items(), 1)
    ]
    calibration = study()["calibration/0"]
    both = etid.identify_jointly(Study.from_recordings([calibration, *loaded]))
    assert dict(zip(both.fits.labels["path"], both.fits.verdicts, strict=True)) == {
        path: "successful" if path.startswith("before") else "inconsistent" for path in sources
    }
    (driver,) = both.drivers.values()
    assert driver.verdict == "successful"
    alone = etid.identify_jointly(Study.from_recordings([calibration, *loaded[:2]]))
    before = np.char.startswith(both.fits.labels["path"], "before")
    found, expected = (np.asarray(of.fits.circuit.values()).T for of in (both, alone))
    # As near as the solver goes to the minimum: those of another driver take no part.
    error = np.asarray(alone.fits.stderr.values()).T
    assert (np.abs(found[:, before] - expected) < 0.05 * error).all()


def test_a_driver_that_is_known_to_drift_may():
    calibration = spectrum(study()["calibration/0"])
    later = spectrum(study(changed(l_magnetising=1.01), seed=1)["loaded/0"])
    assert bool(is_other(shape(calibration), later))
    assert not bool(is_other(shape(calibration, np.asarray(0.01)), later))
