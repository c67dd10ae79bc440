"""Z_th as one number for each harmonic: no order, no bias that is not told."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import etid
from benchmarks.coverage import scene
from benchmarks.ladder import LOADS
from etid.estimators.non_parametric import fit as non_parametric
from etid.results.driver import HarmonicDriver
from etid.results.verdicts import verdict
from etid.signals.harmonics import Spectrum
from tests import kept_numbers

pytestmark = pytest.mark.usefixtures("run_as_for_users")

RESISTORS = (98.8e3, 21.62e3)
SIGMAS = 5.0  # one in 2 million for a normal error


def z(fit, name):
    truth = np.array([getattr(LOADS[name], e) for e in ("r_s", "r_p", "c_p")])
    return (np.asarray(fit.circuit.values()) - truth) / np.asarray(fit.stderr.values())


def coarse_driver(study):
    """A driver whose Z_th is a third too large, and known to be wrong: only harmonics are used."""
    driver = etid.identify_driver(list(study.calibrations.recordings()), throw=False)
    assert isinstance(driver, HarmonicDriver)
    wrong = jax.tree.map(lambda leaf: 1.3 * leaf, (driver.source.gain, driver.source.slope))
    source = dataclasses.replace(driver.source, gain=wrong[0], slope=wrong[1])
    return dataclasses.replace(driver, source=source, result=verdict("misfit"))


@pytest.fixture(scope="module")
def study():
    return scene(60.0, 10_000, resistors=RESISTORS).simulate(seed=8)


@pytest.fixture(scope="module")
def coarse(study):
    return coarse_driver(study)


@pytest.mark.slow
def test_a_load_is_right_whatever_the_model_of_its_driver(study, coarse):
    assert coarse.verdict == "misfit"
    for name in LOADS:
        fit = etid.identify_skin(study[name], coarse, method="non_parametric")
        assert fit.method == "non_parametric"
        assert (np.abs(z(fit, name)) < SIGMAS).all()


def test_its_errors_are_the_bound(study, coarse):
    """Nothing is assumed of Z_th on either side; what is left is the choice of harmonics."""
    bounds = etid.bound(scene(60.0, 10_000, resistors=RESISTORS))
    for name in LOADS:
        fit = etid.identify_skin(study[name], coarse, method="non_parametric")
        relative = np.asarray(fit.stderr.values()) / np.asarray(fit.circuit.values())
        np.testing.assert_allclose(relative, list(bounds[name].relative.values()), rtol=0.1)
        assert (np.diagonal(fit.shared_cov) < np.diagonal(fit.cov)).all()
        kept_numbers.check(f"non_parametric_{name}", kept_numbers.of_fit(fit))


def test_noise_that_shifts_it_too_far_is_told():
    noisy = scene(40.0, 10_000, resistors=RESISTORS).simulate(seed=2)
    driver = coarse_driver(noisy)
    for name in LOADS:
        fit = etid.identify_skin(noisy[name], driver, method="non_parametric", throw=False)
        assert fit.verdict == "biased"
        kept_numbers.check(f"non_parametric_noisy_{name}", kept_numbers.of_fit(fit))


def test_other_pulse_rates_than_the_calibration_s_have_no_z_th(study, coarse):
    record = study["dry"]
    faster = record.replace(pulse_rate=2 * record.pulse_rate)
    with pytest.raises(ValueError, match="harmonics of 60"):
        etid.identify_skin(faster, coarse, method="non_parametric")


def noisy_spectrum(count):
    """X = 3, Y = −2j."""
    one = jnp.ones(count)
    x, y = jax.lax.complex(3 * one, 0 * one), jax.lax.complex(0 * one, -2 * one)
    return Spectrum(one, x, y, 0.01 * one, 0.04 * one, one > 0)


def test_bias_is_what_noise_adds_on_average():
    """|X + n|² is E|n|² larger on average; a sum of terms that are linear is not."""
    count = 500
    spectrum = noisy_spectrum(count)

    def change(records):
        x, y = records[-1].x, records[-1].y
        return jnp.stack(
            [jnp.sum(jnp.abs(x) ** 2 - 9), jnp.sum(jnp.abs(y) ** 2 - 4), jnp.sum(x.real + y.imag)]
        )

    of_x, of_y, linear = non_parametric._bias(change, [spectrum])
    # 4 draws of 500 harmonics: 2000 of exponential distribution, whose sum scatters by √2000.
    scatter = SIGMAS / np.sqrt(count * non_parametric.PAIRS)
    np.testing.assert_allclose(of_x, 0.01 * count, rtol=scatter)
    np.testing.assert_allclose(of_y, 0.04 * count, rtol=scatter)
    np.testing.assert_allclose(linear, 3 * count - 2 * count, rtol=1e-12)
