"""The order of a driver: a pole that is missing shows where chi2 does not, and none is invented."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import etid
from benchmarks.failure_axes import transformer
from benchmarks.ladder import CALIBRATION, rung
from etid.likelihood import of_calibrations
from etid.likelihood.calibrations import Calibrations
from etid.results.driver import SourceImpedance


def source(gain, slope, omega, zeta):
    one = jnp.ones(1)
    of = (jnp.log(500.0), jnp.log(omega * one), jnp.log(zeta * one), gain * one, slope * one)
    return SourceImpedance(*of, jnp.log(2e3 * one), -4e3 * one)


def test_sections_are_what_a_source_would_have_more():
    f = jnp.geomspace(60.0, 1e5, 40)
    found = of_calibrations.sections(f, f[-1])
    assert found.shape == (of_calibrations.GRID * len(of_calibrations.DAMPINGS), 2, f.size)
    without = source(0.0, 0.0, 1.0, 1.0).response(f)
    omegas = 2 * np.pi * np.geomspace(20.0, 3e5, of_calibrations.GRID)
    for number in (0, 40, 107):
        zeta, omega = divmod(number, of_calibrations.GRID)
        of = omegas[omega], of_calibrations.DAMPINGS[zeta]
        for which, gains in enumerate([(1.0, 0.0), (0.0, 1.0)]):
            expected = source(*gains, *of).response(f) - without
            # Rounding of 4 kohm against 1 ohm.
            np.testing.assert_allclose(found[number, which], expected, rtol=1e-9, atol=1e-11)


@pytest.fixture(scope="module")
def identified():
    """Calibrations of a transformer of so many poles, and their driver of a given order."""

    def identified(true, given, seed):
        calibration = rung("dry", driver=transformer(true)).simulate(seed)[CALIBRATION]
        return calibration, etid.identify_driver(calibration, order=given, throw=False)

    return identified


def test_a_driver_of_too_low_an_order_says_so(identified):
    """Skins behind it were off by ten standard errors and called successful."""
    calibration, driver = identified(6, 3, seed=1)
    assert float(driver.chi2) < 1.2  # which shows nothing
    assert driver.verdict == "order_too_low"
    with pytest.raises(etid.IdentificationError, match="Raise `order`"):
        etid.identify_driver(calibration, order=3)


def test_an_order_that_is_high_enough_shows_noise_only(identified):
    """Squares of two degrees of freedom."""

    @jax.jit
    def squares_of(calibrations):
        near = calibrations.near(calibrations.start())
        return of_calibrations.missing_pole(calibrations, near, calibrations.linear(near))

    squares = []
    for seed in range(8):
        _, driver = identified(3, 3, seed)
        assert driver.verdict == "successful"
        squares.append(np.asarray(squares_of(Calibrations.of(driver))))
    assert np.nanmax(squares) < of_calibrations.MISSING_POLE
    assert abs(np.nanmean(squares) - 2) < 5 * 0.22
