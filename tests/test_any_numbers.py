"""A fit that failed may hold any number: what etid writes it reads, shows and exports."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal

import etid
from benchmarks.specimens import study_fits
from etid import cli
from etid.commands import fit as fit_command
from etid.results.study_fits import StudyFits
from etid.results.verdicts import RESULTS, USABLE, verdict, verdicts_of
from etid.simulation.scenes import Scene, Trial
from etid.simulation.transformer import ResistorLoad, SkinLoad

LARGE, SMALL = 1.7e308, 5e-324  # near the ends of double precision
# 2.5e300 is a covariance of a fit of SkinRC to a recording of two relaxations.
EXTREMES = [0.0, -0.0, np.nan, np.inf, -np.inf, SMALL, -SMALL, 2.5e300, LARGE, -LARGE, 1e147, 1.0]
VERDICTS = sorted(RESULTS._name_to_item)


def drawn(seed):
    """Fits of all verdicts, and a driver, with extreme numbers in any of their fields."""
    rng = np.random.default_rng(seed)
    base = study_fits()

    def replaced(leaf):
        leaf = np.asarray(leaf)
        if leaf.dtype.kind != "f":
            return leaf
        chosen = rng.random(leaf.shape) < rng.choice([0.1, 0.5, 1.0])
        return np.where(chosen, rng.choice(EXTREMES, leaf.shape), leaf)

    names = rng.choice(VERDICTS, 6)
    fit = jax.tree.map(replaced, base.fits.fit)
    good = np.isin(names, USABLE)  # for which elements are positive
    circuit = jax.tree.map(lambda v: np.where(good & ~(v > 0), LARGE, v), fit.circuit)
    change = [replaced(np.ones((6, 4))) for _ in range(2)]
    fit = dataclasses.replace(
        fit, circuit=circuit, result=verdicts_of(names), change=change[0], change_stderr=change[1]
    )
    drivers = {  # their rate is that of a recording, which is finite
        paths: dataclasses.replace(
            jax.tree.map(lambda leaf: jnp.asarray(replaced(leaf)), driver),
            sample_rate=driver.sample_rate,
            result=verdict(str(rng.choice(VERDICTS))),
        )
        for paths, driver in base.drivers.items()
    }
    return dataclasses.replace(base, fits=dataclasses.replace(base.fits, fit=fit), drivers=drivers)


def assert_equal(written, read):
    """Fits are equal in all columns of their file."""
    (mine, *_), (theirs, *_) = written.as_table(), read.as_table()
    assert set(mine) == set(theirs)
    for name, column in mine.items():
        np.testing.assert_array_equal(column, theirs[name], err_msg=name)


# Method of the driver, and how many fits. Nonsense takes all steps that a fit may:
# 45 ms on the harmonics, where a skin takes one, and half a second in time.
METHODS = {
    "maximum_likelihood": ("maximum_likelihood", 80),
    "steiglitz_mcbride": ("steiglitz_mcbride", 100),
    "output_error": ("output_error", 10),
}


def nonsense(v_th, rng):
    """A terminal voltage that has to do with V_th, and with no circuit."""
    v_out: Any = v_th * 10 ** rng.uniform(-3, 1)
    for _ in range(rng.integers(3)):
        pole = rng.choice([-1, 1]) * rng.uniform(0.5, 0.9999)
        v_out = scipy.signal.lfilter([1 - pole, rng.normal()], [1, -pole], v_out)
    if rng.random() < 0.3:
        v_out = np.ptp(v_out) * np.tanh(v_out / np.ptp(v_out) * 10 ** rng.uniform(-1, 1))
    if rng.random() < 0.3:
        v_out = v_out * np.linspace(1, rng.normal(), v_out.size)
    v_out = np.roll(v_out, rng.integers(-3, 4)) * rng.choice([1, 1, 1, -1])
    return v_out + np.ptp(v_out) * 10 ** rng.uniform(-6, 0) * rng.normal(size=v_th.size)


@pytest.fixture(scope="module")
def calibrations():
    skin = Trial("s01/dry/0", SkinLoad(r_s=33.4e3, r_p=186e3, c_p=0.12e-9))
    resistors = tuple(Trial(f"calibration/{r:g}", ResistorLoad(r)) for r in (98.8e3, 21.62e3))
    scenes = {
        samples: Scene((skin,), resistors, samples=samples, snr_db=60.0).simulate(seed=1)
        for samples in (10_000, 3334)
    }
    return {samples: list(study.calibrations.values()) for samples, study in scenes.items()}


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_fits_of_nonsense_are_read(calibrations, method, tmp_path):
    of_driver, count = METHODS[method]
    records = calibrations[3334 if method == "output_error" else 10_000]
    driver = etid.identify_driver(records, method=of_driver, throw=False)
    rng = np.random.default_rng(count)
    v_th = records[0].samples["v_th"].values
    recordings = [
        etid.Recording(v_th, nonsense(v_th, rng), sample_rate=2e5, pulse_rate=60.0)
        for _ in range(count)
    ]
    fits = etid.identify_skins(recordings, driver, method=method)
    assert len(fits.counts()) >= 3  # nonsense fails in many ways
    fits.write(tmp_path / "fits.h5")
    assert_equal(fits, etid.Fits.read(tmp_path / "fits.h5"))


@pytest.mark.parametrize("seed", range(10))
def test_whatever_is_written_is_read_shown_and_exported_without_a_warning(tmp_path, seed):
    outcome = drawn(seed)
    outcome.write(tmp_path / "fits.h5")
    again = StudyFits.read(tmp_path / "fits.h5")
    assert_equal(outcome.fits, again.fits)
    for paths, driver in outcome.drivers.items():
        both = map(jax.tree.leaves, (driver, again.drivers[paths]))
        for mine, read in zip(*both, strict=True):
            np.testing.assert_array_equal(mine, read)
    # `str` would show the fields of an object whose overview fails.
    assert max(map(len, again._overview().text().splitlines())) < 700
    for row in range(6):
        fit = again.fits[row]
        assert max(map(len, fit._overview().text().splitlines())) < 700  # a verdict is a sentence
        assert len(fit.elements) == len(fit.circuit.names())
    assert set(again.fits.summary()[0]) > set(again.fits.circuit.names())
    cli._plain(fit_command._data(again))
    etid.export_fits(tmp_path / "fits.h5", tmp_path / "fits.csv")
    assert len((tmp_path / "fits.csv").read_text("utf-8").splitlines()) == 7
    if seed < 2:
        etid.write_report(again, tmp_path / "page.html")
