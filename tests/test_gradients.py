"""Derivatives through a fit: implicit, against differences of fits and against what must be."""

import contextlib

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import etid
from benchmarks.perturbed_study import drawn_driver
from etid.estimators import lanes
from etid.estimators.lanes import Harmonics
from etid.estimators.maximum_likelihood.estimator import MaximumLikelihood
from etid.identify import samples
from etid.likelihood import search
from etid.recordings.preflight import Inspected
from etid.results.driver import ContinuousDriver, HarmonicDriver
from etid.signals.noise import noise, noise_of
from etid.simulation.scenes import Scene, Trial
from etid.simulation.transformer import ResistorLoad, SkinLoad, TransformerDriver

STEP = 1e-3  # of a disturbance that is small itself: the curvature costs its square
# Differences of minima along the flat direction of the driver repeat to some 1e-9 of an element.
REPEATED = 1e-8


@pytest.fixture
def exact(monkeypatch):
    """Minima to a millionth of a standard error: a difference of two of them is to be compared."""
    monkeypatch.setattr(search, "BEFORE", 1e-6)
    monkeypatch.setattr(search, "ROUNDING", 0.0)
    jax.clear_caches()  # of programs with the other numbers
    yield
    jax.clear_caches()


@pytest.mark.slow
@pytest.mark.usefixtures("exact")
def test_a_resistor_follows_the_data_and_the_known_resistor_one_to_one():
    known = (Trial("c", ResistorLoad(98.8e3)),)
    scene = Scene((Trial("a", ResistorLoad(55.2e3)),), known, sample_rate=40e3, samples=2000)
    study = scene.simulate(seed=1)
    driver = etid.identify_driver(study["c"], order=3, throw=False)
    assert isinstance(driver, ContinuousDriver)
    v_th, v_out = jnp.asarray(study["a"].v_th), jnp.asarray(study["a"].v_out)
    r_load = driver.calibration.r_load

    @jax.jit
    def derivative(v_out, r_load, of_v_out, of_r_load):
        """The logarithm of the resistor, and its derivative in one direction."""

        def log_resistor(v_out, r_load):
            changed = eqx.tree_at(lambda d: d.calibration.r_load, driver, r_load)
            fit = etid.identify_samples(
                v_th, v_out, changed, sample_rate=40e3, pulse_rate=60.0, circuit=etid.Resistor()
            )
            return fit.circuit.log_values()[0]

        return jax.jvp(log_resistor, (v_out, r_load), (of_v_out, of_r_load))

    change = 1e-2 * (jnp.sin(jnp.arange(2000.0) * 0.13) + 0.3) * v_out
    still = jnp.zeros_like(r_load)
    up, by_data = derivative(v_out + STEP * change, r_load, change, still)
    down, also = derivative(v_out - STEP * change, r_load, change, still)
    numeric = (up - down) / (2 * STEP)
    assert abs(float(numeric)) > 1e-4
    # The mean of two derivatives and the difference are both of second order.
    np.testing.assert_allclose((by_data + also) / 2, numeric, rtol=1e-4, atol=REPEATED / STEP)
    _, by_resistor = derivative(v_out, r_load, 0 * v_out, r_load)
    np.testing.assert_allclose(by_resistor, 1.0, atol=1e-4)  # the weak prior of Z_th is in ohm


@pytest.mark.slow
@pytest.mark.usefixtures("exact")
def test_derivatives_by_both_records_are_differences_of_fits(monkeypatch):
    """In directions of white noise, whose effect is a standard error, with the noise held.

    A derivative of the estimate of the noise would count: it is that of a median, and so far off.
    """
    held = []

    def known(v, step):
        """The noise of the unmoved record, with the derivative of the estimate."""
        found = noise(v, step)
        return found + jax.lax.stop_gradient(held.pop(0) - found)

    monkeypatch.setattr(samples, "floor", known)
    # Then the noise at each harmonic is that of white noise of this size, held too.
    monkeypatch.setattr(lanes, "noise_of", lambda v, *of: noise_of(0 * v, *of))

    @jax.jit
    def derivative(records, sigma, driver, direction):
        """The logarithms of the elements, their derivatives and standard errors."""

        def log_elements(v_th, v_out):
            held[:] = sigma
            fit = etid.identify_samples(v_th, v_out, driver, sample_rate=200e3, pulse_rate=60.0)
            values = fit.circuit.values()
            return jnp.log(values), jnp.sqrt(jnp.diagonal(fit.cov)) / values

        return jax.jvp(log_elements, tuple(records), tuple(direction), has_aux=True)

    skin = SkinLoad(r_s=33.4e3, r_p=186e3, c_p=0.12e-9)
    for number, snr_db in enumerate((40.0, 60.0, 40.0)):
        of = drawn_driver(number, 0.1, TransformerDriver())
        trials = (Trial("a", skin),), (Trial("c", ResistorLoad(98.8e3)),)
        study = Scene(*trials, driver=of, snr_db=snr_db).simulate(seed=number)
        driver = etid.identify_driver(study["c"], order=5, throw=False)
        driver = jax.tree.map(jnp.asarray, driver)  # one program for all
        records = np.stack([study["a"].v_th, study["a"].v_out])
        sigma = [float(noise(record, np.zeros(()))) for record in records]
        for which in range(2):
            white = np.random.default_rng([number, which]).standard_normal(10_000)
            direction = np.zeros_like(records)
            direction[which] = sigma[which] * white
            (up, by_up, errors), (down, by_down, _) = (
                derivative(records + step * direction, jnp.array(sigma), driver, direction)
                for step in (0.05, -0.05)
            )
            difference = np.asarray((up - down) / 0.1 / errors)
            assert np.abs(difference).max() > 0.1  # the direction matters
            # The mean of both derivatives; what is left are 6e-3, of the curvature of a step.
            found = np.asarray((by_up + by_down) / 2 / errors)
            np.testing.assert_allclose(found, difference, rtol=0.0, atol=0.01)


def three_periods():
    """Of 334 samples: aliases fall on the harmonics."""
    pulses = 100.0 * (np.arange(1002) % 334 < 14)
    return pulses + np.random.default_rng(0).standard_normal((2, 1002))


@pytest.fixture
def unfitted(monkeypatch):
    """The lane that would be fitted to the arrays of a recording."""
    lanes = []

    def seen(_, lane, *of):
        del of
        lanes.append(lane)
        raise InterruptedError  # its fit is not needed

    monkeypatch.setattr(MaximumLikelihood, "fit_load", seen)
    driver = object.__new__(HarmonicDriver)  # whose numbers nobody reads
    monkeypatch.setattr(samples, "_may_share", lambda *_: False)
    for name in ("known", "check_driver"):
        monkeypatch.setattr(MaximumLikelihood, name, lambda *_: None)

    def lane(v_th, v_out):
        with contextlib.suppress(InterruptedError):
            etid.identify_samples(v_th, v_out, driver, sample_rate=334.0, pulse_rate=1.0)
        return lanes.pop()

    return lane


def test_arrays_have_the_weights_of_a_recording(unfitted):
    """White noise was a floor besides: where the noise scatters above it, it was kept."""
    records = three_periods()
    one = etid.Recording(*records, sample_rate=334.0, pulse_rate=1.0)
    found, of = unfitted(*records), Harmonics.of(Inspected.of(one))
    for one, other in ((found.variance_x, of.variance_x), (found.variance_y, of.variance_y)):
        np.testing.assert_allclose(one, other, rtol=1e-9)  # rounding, of 1 002 samples


def test_what_is_estimated_before_a_fit_is_held(unfitted):
    """Noise, and what aliases add to it; the records themselves are not held."""

    def arrays(v_th, v_out):
        one = unfitted(v_th, v_out)
        return one.variance_x, one.variance_y, one.x, one.y

    records = tuple(jnp.asarray(three_periods()))
    _, slopes = jax.jvp(arrays, records, records)
    of_x, of_y, x, y = slopes
    assert not np.any(of_x)
    assert not np.any(of_y)
    assert np.any(x)
    assert np.any(y)
