"""Output error piece by piece: what is in doubt of a calibration, its derivative, the errors."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import etid
from benchmarks.ladder import CALIBRATION, LOADS, TRIAL, rung
from etid.circuits.elements import resistor
from etid.estimators.estimate import SOLVER
from etid.estimators.lanes import PaddedSamples
from etid.estimators.output_error.estimator import _has_aliases, _leaves_out
from etid.estimators.output_error.fit import fit_source
from etid.estimators.output_error.information import (
    Slopes,
    curvature,
)
from etid.estimators.output_error.prediction import (
    IMPULSE,
    impulse,
    late_calibration,
    loaded_filter,
    measured_impulse,
    prepare,
)
from etid.estimators.registry import OUTPUT_ERROR
from etid.identify.fitting import skin
from etid.likelihood.source_prior import DELAY_WIDTH, KNOWN_DELAY, delay_std
from etid.recordings.preflight import Inspected
from etid.results.driver import ContinuousDriver, SourceImpedance
from etid.signals.filtering import simulate
from etid.signals.noise import Measurement
from etid.simulation.scenes import Scene, Trial
from etid.simulation.transformer import ResistorLoad, SkinLoad
from tests import kept_numbers

RATE = 200e3
prepared = eqx.filter_jit(prepare)  # operation by operation, it takes seconds


@pytest.mark.parametrize(
    ("resistors", "expected"),
    [
        ((98.8e3,), DELAY_WIDTH),
        ((98.8e3, 98.8e3), DELAY_WIDTH),
        ((98.8e3, 98.9e3), DELAY_WIDTH),
        ((98.8e3, 21.62e3), KNOWN_DELAY),
        ((98.8e3, 98.8e3, 55.2e3), KNOWN_DELAY),
    ],
)
def test_only_different_resistors_know_the_delay_of_their_records(resistors, expected):
    assert float(delay_std(jnp.array(resistors))) == expected


def measurement(v_th, v_out=None):
    zero = jnp.asarray(1e-3)
    return Measurement(v_th, v_th if v_out is None else v_out, zero, zero, jnp.asarray(RATE))


def plain(resistance):
    """A source that is a resistor; its pole has no effect."""
    none = jnp.zeros(0)
    log = jnp.log(jnp.asarray(resistance))
    return SourceImpedance(log, none, none, none, none, jnp.log(jnp.array([1e4])), jnp.zeros(1))


@pytest.mark.parametrize("z_load", [pytest.param(20e3, marks=pytest.mark.slow), 300e3])
def test_a_late_calibration_is_an_excess_impedance_and_a_delay(z_load):
    """−G sτ ((R_L − Z_L) / (Z_L + R) + 1) of V_th, a sine, all of them resistors."""
    r_load, r, omega = 98.8e3, 15e3, 0.2
    records = prepared(measurement(jnp.sin(omega * jnp.arange(400.0))))
    load = resistor(jnp.asarray(z_load)).rational()
    late = eqx.filter_jit(late_calibration)(
        records, plain(r), load, jnp.asarray(r_load), jnp.zeros(1)
    )
    v_th = np.asarray(records.hold[:, 0])  # where the interpolation has it
    slope = omega * np.sqrt(1 - v_th**2) * np.sign(np.gradient(v_th))
    expected = -z_load / (z_load + r) * ((r_load - z_load) / (z_load + r) + 1) * slope
    # A sine's root cannot be trusted where it is flat; it is interpolated to a thousandth.
    steep = np.abs(v_th) < 0.9
    np.testing.assert_allclose(np.asarray(late.v_out)[steep], expected[steep], rtol=0.02)


def test_a_late_calibration_is_the_same_where_a_record_begins_in_a_pulse():
    """As in a record of the whole pulse, but for what the free state at the start can do."""
    records = prepared(measurement(jnp.exp(-(((jnp.arange(400.0) - 250) / 60) ** 2))))
    whole, end = (  # of equal length, so that one compilation serves both
        jax.tree.map(lambda leaf, part=part: leaf[part] if leaf.ndim else leaf, records)
        for part in (slice(250), slice(100, 350))
    )
    source, load = plain(15e3), etid.SkinRC(30e3, 180e3, 1e-9).impedance().rational()
    system, run = loaded_filter(source, load, records.sample_rate), eqx.filter_jit(simulate)
    rest, late = jnp.zeros(system.C.size), eqx.filter_jit(late_calibration)
    x0 = run(system, records.hold[:100], rest)[1]
    expected = late(whole, source, load, jnp.asarray(98.8e3), rest).v_out[100:]
    off = late(end, source, load, jnp.asarray(98.8e3), x0).v_out[:150] - expected
    decays = [run(system, 0 * end.hold, state)[0][:150] for state in jnp.eye(rest.size)]
    free = np.stack(decays, axis=1)
    left = off - free @ np.linalg.lstsq(free, off)[0]
    np.testing.assert_allclose(left, 0.0, atol=1e-4 * np.abs(expected).max())


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
def test_a_step_has_aliases_in_any_unit_and_what_a_filter_leaves_has_none(unit):
    rng, place = np.random.default_rng(0), np.arange(3000)
    steps = np.where((place > 1000) & (place < 1200), 1.0, 0.0)
    passed = np.exp(-((np.fft.rfftfreq(place.size) / 0.15) ** 2))
    smooth = np.fft.irfft(np.fft.rfft(steps) * passed, place.size)
    for waveform, expected in ((steps, True), (smooth, False), (0 * steps, False)):
        v = jnp.asarray(unit * (waveform + 1e-3 * rng.standard_normal(place.size)))
        sigma = jnp.asarray(1e-3 * unit)
        m = Measurement(v, v, sigma, sigma, jnp.asarray(RATE))
        assert bool(_has_aliases(m, jnp.asarray(place.size))) == expected


def test_the_noise_of_a_record_is_no_information():
    """H = JᵀJ − N (what noise alone puts into it), by sums as they are written down."""
    records = prepared(measurement(jnp.zeros(600)))
    records = eqx.tree_at(
        lambda r: (r.sigma_th, r.sigma_out), records, (jnp.asarray(0.3), jnp.asarray(0.7))
    )
    rows = records.hold.shape[0]
    rng = np.random.default_rng(3)
    slope, h0 = rng.normal(size=(rows, 3)), rng.normal(size=IMPULSE + 1)
    of_h = rng.normal(size=(IMPULSE + 1, 3))
    of_h[:, -1] = 0.0  # a delay does not change the response
    precision = np.array([0.0, 2.0, 5.0])
    at = Slopes(jnp.zeros(rows), *map(jnp.asarray, (slope, h0, of_h)))
    found = curvature(records, at, jnp.asarray(precision))
    k = np.asarray(impulse())[:, 0]
    s = 0.7**2 * np.sum(k**2) + 0.3**2 * np.sum(h0**2)
    of_s = 2 * 0.3**2 * h0 @ of_h
    noise = 0.3**2 * of_h.T @ of_h / s - np.outer(of_s, of_s) / (4 * s**2)
    noise[-1, -1] += 0.7**2 * np.sum(np.asarray(measured_impulse())[:, 1] ** 2) / s
    expected = slope.T @ slope - rows * noise + np.diag(precision)
    np.testing.assert_allclose(found.expected, expected, rtol=1e-10, atol=1e-8)
    # The score: residuals that are noise filtered by k and by h.
    score = np.zeros((3, 3))
    for sigma, of in ((0.7, k), (0.3, h0)):
        moved = np.stack([np.correlate(np.pad(c, of.size), of, "valid") for c in slope.T])
        score += sigma**2 * moved @ moved.T / s
    score += np.diag(precision)  # what is drawn from its prior
    np.testing.assert_allclose(found.score, score, rtol=1e-9, atol=1e-9 * np.abs(score).max())


@pytest.fixture(scope="module")
def fitted():
    """A driver from one pulse, and the fit of a skin as a function of the noise it is told."""
    study = Scene(
        (Trial("a", SkinLoad(33.4e3, 186e3, 0.12e-9)),),
        (Trial("c", ResistorLoad(98.8e3)),),
        samples=3334,
    ).simulate(seed=11)
    driver = etid.identify_driver(study["c"])
    assert isinstance(driver, ContinuousDriver)
    kept_numbers.check("driver_in_time", kept_numbers.of_driver(driver))

    def of(scale, late=driver.calibration.delay_std_samples, **other):
        lane = PaddedSamples.of(Inspected.of(study["a"]))
        told = jax.tree.map(jnp.asarray, lane)
        lane = dataclasses.replace(
            told, sigma_th=scale * told.sigma_th, sigma_out=scale * told.sigma_out
        )
        known = eqx.tree_at(lambda of: of.calibration.delay_std_samples, driver, jnp.asarray(late))
        known = dataclasses.replace(known, **other)
        return skin(lane, known, None, etid.SkinRC(), OUTPUT_ERROR)

    return driver, of


def test_if_the_noise_is_larger_than_it_is_said_to_be_the_errors_are_as_large(fitted):
    """χ² grows as the noise that is assumed falls, and the errors by it remain."""
    _, fit_of = fitted
    third, tenth = fit_of(1 / 3), fit_of(1 / 10)
    kept_numbers.check("in_time_too_noisy", kept_numbers.of_fit(third))
    assert float(third.chi2) > 5
    np.testing.assert_allclose(tenth.chi2 / third.chi2, 100 / 9, rtol=1e-3)
    own = [np.asarray(fit.cov - fit.shared_cov) for fit in (third, tenth)]
    # The minimum is found to a thousandth of a standard error, of the smaller noise. A covariance
    # that nearly cancels is compared in standard errors of both elements.
    for one, other in ((own[1], own[0]), (tenth.shared_cov, third.shared_cov)):
        errors = np.sqrt(np.diagonal(other))
        off = (np.asarray(one) - np.asarray(other)) / np.outer(errors, errors)
        assert np.abs(off).max() < 1e-2


def test_if_the_noise_is_smaller_the_errors_are_what_it_is_said_to_be(fitted):
    _, fit_of = fitted
    once, twice = fit_of(1.2), fit_of(2.4)
    kept_numbers.check("in_time", kept_numbers.of_fit(once))
    assert float(once.chi2) < 1
    own = [np.asarray(fit.cov - fit.shared_cov) for fit in (once, twice)]
    np.testing.assert_allclose(np.diagonal(own[1]), 4 * np.diagonal(own[0]), rtol=0.1)
    np.testing.assert_allclose(twice.chi2 / once.chi2, 1 / 4, rtol=1e-2)


def test_the_delay_of_the_calibration_is_known_as_well_as_its_standard_deviation_says(fitted):
    """One parameter with information c and prior 1/s²: cov = A + b bᵀ / (1/s² + c)."""
    _, fit_of = fitted
    known, *others = (
        np.diagonal(np.asarray((fit := fit_of(1.2, late)).cov - fit.shared_cov))
        for late in (1e-6, 0.005, 0.01, 1e3)
    )
    first, second, free = (cov - known for cov in others)
    # Where a delay of the calibration matters most. The fits end at minima that differ, too: by a
    # tenth of these small differences, and by more of those of less certain delays.
    element = np.argmax(free / known)
    ratio = (free[element] / first[element] - 1) / (free[element] / second[element] - 1)
    assert ratio == pytest.approx(4, rel=0.1)


def test_a_driver_that_drifts_is_one_that_is_known_less(fitted):
    driver, fit_of = fitted
    drift = etid.Instrument(drift=0.01).as_arrays()
    later = dataclasses.replace(driver, instrument=drift).later_cov()
    drifts, less = fit_of(1.5, instrument=drift), fit_of(1.5, cov=later)
    np.testing.assert_allclose(drifts.shared_cov, less.shared_cov, rtol=1e-6)
    assert (np.diagonal(drifts.shared_cov) > 2 * np.diagonal(fit_of(1.5).shared_cov)).any()


def test_errors_of_a_driver_that_misses_its_calibration_are_as_large_as_it_does():
    """One real pole for a transformer: χ² is large; whatever noise is assumed, cov stays."""
    study = Scene((), (Trial("c", ResistorLoad(98.8e3)),), samples=1200).simulate(seed=11)
    v_th, v_out = jnp.asarray(study["c"].v_th), jnp.asarray(study["c"].v_out)
    start = dataclasses.replace(plain(5e3), gain_real=jnp.array([-2e3]))

    @jax.jit
    def fit(sigma):
        m = Measurement(v_th[None], v_out[None], sigma[None], sigma[None], jnp.array([RATE]))
        records = jax.vmap(prepare)(m)
        _, estimate, _ = fit_source(records, jnp.array([98.8e3]), start, jnp.asarray(SOLVER.ftol))
        return estimate.chi2, estimate.cov

    (chi2, cov), (larger, same) = fit(jnp.asarray(0.01)), fit(jnp.asarray(0.005))
    assert float(chi2) > 5
    np.testing.assert_allclose(larger / chi2, 4, rtol=1e-2)
    np.testing.assert_allclose(np.diagonal(same), np.diagonal(cov), rtol=0.05)


@pytest.mark.parametrize("v_out_per_v_th", [1.0, 0.01])
def test_what_the_interpolation_leaves_out_is_hidden_by_noise_as_stated(v_out_per_v_th):
    """A sinusoid of 1 % at 0.48 of the rate: its RMS is 1 %, a thirtieth of which is left out."""
    count = 4000
    time = np.arange(count)
    low = np.sin(2 * np.pi * 0.01 * time)
    v_th, v_out = low + 0.01 * np.sin(2 * np.pi * 0.48 * time), v_out_per_v_th * low
    # 15 σ / RMS(V_out) / √N is as large where σ of V_out is this.
    limit = 0.01 / 30 / 15 * np.sqrt(count / 2) * v_out_per_v_th
    for part in (0.9, 1.1):
        of = map(jnp.asarray, (v_th, v_out, 1e-9, part * limit, 200e3))
        assert bool(_leaves_out(Measurement(*of), jnp.asarray(count))) == (part < 1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sample_rate", "snr_db", "verdict"),
    [(100e3, 80.0, "biased"), (100e3, 60.0, "biased"), (150e3, 80.0, "biased"),
     (200e3, 80.0, "successful"), (150e3, 50.0, "successful")],
)  # fmt: skip
def test_a_sample_rate_that_is_too_low_for_the_interpolation_is_told(sample_rate, snr_db, verdict):
    """χ² does not show it."""
    samples = round(0.05 * sample_rate) + 1
    of = rung("dry", snr_db=snr_db, sample_rate=sample_rate, samples=samples).simulate(1)
    driver = etid.identify_driver(of[CALIBRATION], method="output_error")
    fit = etid.identify_skin(of[TRIAL], driver, method="output_error", throw=False)
    truth = np.array(dataclasses.astuple(LOADS["dry"]))
    off = np.abs(np.array(fit.circuit.values()) - truth) / np.array(fit.stderr.values())
    assert off.max() > 3.5 if verdict == "biased" else off.max() < 4
    assert fit.verdict == verdict
