"""Behind drivers that resonate above half the rate, no record is taken at a wrong minimum."""

import numpy as np
import pytest

import etid
from etid.estimators import refined_driver
from etid.identify import fitting
from etid.simulation.scenes import Scene, Trial
from etid.simulation.transformer import OpenLoad, ResistorLoad, SkinLoad, loading
from tests.skins import DAMP, off

RATE = 100e3
DRIVERS = 8
SIGMAS = 4.5  # one in 150 000 for a normal error


def study(seed, snr_db=60.0, resistors=(98.8e3,)):
    """Damp skin behind a ladder of discrete parts, drawn with 10 %; it resonates at 95 kHz."""
    draws = np.random.default_rng(seed)
    r1, l1, c1, r2, l2, c2 = np.array([3e3, 20e-3, 60e-12, 2e3, 25e-3, 40e-12]) * (
        1 + 0.1 * draws.standard_normal(6)
    )

    def voltage(trial, f):
        s = 2j * np.pi * f
        across = 1 / 200e3 + 1 / (5 * s) + c1 * s  # core loss, magnetising inductance, winding
        first = 1 / (1 + (r1 + l1 * s) * across)
        behind = (r1 + l1 * s) * first + r2 + l2 * s
        second = 1 / (1 + behind * c2 * s)
        begin, end = 1e-3, 1.667e-3
        pulse = 50 * f[0] * (np.exp(-s * begin) - np.exp(-s * end)) / s
        v_th = pulse * first * second
        if isinstance(trial.load, OpenLoad):
            return v_th
        return v_th * loading(trial.load(f), behind * second)

    known = tuple(Trial(f"known/{r:g}", ResistorLoad(r)) for r in resistors)
    scene = Scene(
        (Trial("damp", SkinLoad(r_s=6.1e3, r_p=17.4e3, c_p=0.66e-9)),),
        known,
        sample_rate=RATE,
        samples=5_000,
        antialias=0.4,
        snr_db=snr_db,
        bits=None,
        trigger_jitter_rms=50e-9,
    )
    return scene.record(seed, voltage)


@pytest.fixture(scope="module")
def fits():
    """A fit behind each driver, and the same without a second search."""
    found = []
    for seed in range(DRIVERS):
        of = study(seed)
        driver = etid.identify_driver(of["known/98800"], order=5)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(fitting, "OPEN", np.inf)
            first = etid.identify_skin(of["damp"], driver, throw=False)
        found.append((etid.identify_skin(of["damp"], driver, throw=False), first))
    return found


def test_no_fit_is_successful_at_the_wrong_minimum(fits):
    """A single search ends there behind several drivers, 10 and more errors away."""
    wrong = [first for _, first in fits if np.abs(off(first, DAMP)).max() > SIGMAS]
    assert len(wrong) >= 2
    successful = [fit for fit, _ in fits if fit.verdict == "successful"]
    assert all(np.abs(off(fit, DAMP)).max() < SIGMAS for fit in successful)
    assert len(successful) >= DRIVERS / 2
    assert {fit.verdict for fit, _ in fits} <= {"successful", "driver_unclear"}


def test_a_batch_finds_what_single_fits_find(fits):
    """Behind one driver, with several searches in one call."""
    of = study(0)
    driver = etid.identify_driver(of["known/98800"], order=5)
    both = etid.identify_skins([of["damp"], study(0, snr_db=50.0)["damp"]], driver)
    assert both.verdicts[0] == fits[0][0].verdict
    np.testing.assert_allclose(
        np.asarray(both.circuit.values())[0], np.asarray(fits[0][0].circuit.values()), rtol=1e-6
    )


@pytest.mark.parametrize("seed", range(3))
def test_a_second_resistor_or_a_stated_delay_leaves_no_other_minimum(seed, monkeypatch):
    points, minimum = [], refined_driver.driver.minimum

    def counted(*of):
        least = minimum(*of)
        points.append(least.points.max())
        return least

    monkeypatch.setattr(refined_driver.driver, "minimum", counted)
    of = study(seed, resistors=(98.8e3, 21.62e3))
    known, delay = [of["known/98800"], of["known/21620"]], etid.Instrument(delay=50e-9)
    drivers = (
        etid.identify_driver(known, order=5),
        etid.identify_driver(known[0], order=5, instrument=delay),
    )
    for driver in drivers:
        assert np.abs(off(etid.identify_skin(of["damp"], driver), DAMP)).max() < SIGMAS
    assert max(points) <= 10  # of 500 steps each; a start that creeps far above the others took 90
