"""The rivals of the benchmarks: what they do with a record, and that each runs or says why not."""

import dataclasses
import importlib
import pathlib
import sys

import jax
import numpy as np
import pytest
import scipy.signal

from benchmarks import referee, rivals
from benchmarks.ladder import START, rung
from benchmarks.rivals import harmonic_fit, problem, records, table
from benchmarks.rivals.roster import RIVALS, SCENES

FS, F0 = 100e3, 60.0
PERIODS, SAMPLES = 3, 5_000  # three periods of 60 Hz at 100 kHz
R_S, R_P, C_P = TRUTH = np.array([33.4e3, 186e3, 0.12e-9])
ROUNDING = 1e-9  # of transforms of some thousand samples, 1e-16 times their condition
HERE = pathlib.Path(sys.executable)
TUSTIN = 0.01  # 0.35 % of C_p at 1 MHz, of which a delay that is fitted too makes R_s
Q = np.array([np.log(0.05), 13.0, -0.5, 0.1, 0.1, 11.0, 0.3, 0.05, -0.02, 6.0, 0.02])  # Z_th / R_L
F = F0 * np.arange(1, 800)  # below half the sample rate
Z_TH = 98.8e3 * harmonic_fit.source_impedance(Q, F)
Z = R_S + R_P / (1 + 2j * np.pi * F * R_P * C_P)
# Pulses of 4 % of a period, 50 V high, and the voltage at the skin.
X = 50 * 0.04 * np.sinc(F * 0.04 / F0) * np.exp(-1j * np.pi * F * 0.04 / F0)
Y = X * Z / (Z + Z_TH)


def samples_of(coefficients, delay=0.0):
    """Three periods of these harmonics, from the first on."""
    spectrum = np.zeros(SAMPLES // 2 + 1, complex)
    number = np.arange(1, coefficients.size + 1)
    turn = np.exp(-2j * np.pi * number * F0 * delay)
    spectrum[PERIODS * number] = SAMPLES * coefficients * turn
    return np.fft.irfft(spectrum, SAMPLES)


def test_harmonics_are_those_that_a_record_was_made_of_and_give_its_impedance():
    of = records.harmonics(samples_of(X), samples_of(Y), FS, F0)
    np.testing.assert_allclose([of.x[: F.size], of.y[: F.size]], [X, Y], atol=ROUNDING)
    known = records.Harmonics(F, X, Y, 1e-12)
    at, z, _ = records.load_impedance(known, Z_TH)
    np.testing.assert_allclose(z, Z[np.isin(F, at)], rtol=1e-6)  # x − y loses digits
    period = records.current_and_voltage(known, Z_TH)
    current, voltage = (np.fft.rfft(v)[1:21] for v in (period.current, period.voltage))
    np.testing.assert_allclose(period.unit * voltage / current, Z[:20], rtol=1e-6)


def test_elements_are_those_that_tustin_made_discrete():
    of = records.Period(np.ones(2), np.ones(2), 1e4, 1e6)
    b, a = scipy.signal.bilinear([R_S * R_P * C_P, R_S + R_P], [R_P * C_P, 1.0], of.fs)
    b_0, b_1, a_1 = (float(z) for z in (b[0] / of.unit, b[1] / of.unit, a[1]))
    np.testing.assert_allclose(records.elements(b_0, b_1, a_1, of), TRUTH, rtol=ROUNDING)


def test_residuals_vanish_at_the_truth_and_count_standard_errors():
    late = Y * np.exp(-2j * np.pi * F * 0.3e-6)
    q = np.append(np.log(TRUTH), 0.3)
    misfit = harmonic_fit.skin_misfit(q, F, X, late, 1e-3, Z_TH)
    np.testing.assert_allclose(misfit, 0, atol=ROUNDING / 1e-3)
    noise = 1e-3 / np.sqrt(2) * np.random.default_rng(3).normal(size=(4, F.size))
    noisy = X + noise[0] + 1j * noise[1], late + noise[2] + 1j * noise[3]
    squares = harmonic_fit.skin_misfit(q, F, *noisy, 1e-3, Z_TH) ** 2
    assert 2 * squares.mean() == pytest.approx(1, rel=5 / np.sqrt(F.size))


@pytest.mark.parametrize("name", ["scipy_harmonics", "optimistix_lm", "jaxopt_lm"])
@pytest.mark.filterwarnings("ignore:JAXopt is no longer maintained:DeprecationWarning")
def test_a_package_recovers_a_skin_behind_a_known_driver(name):
    rival = importlib.import_module(f"benchmarks.rivals.{name}")
    noise = np.random.default_rng(4).normal(0, 1e-6, (2, SAMPLES))  # [V], which shows in 1e-6 of Z
    records_of = samples_of(X) + noise[0], samples_of(Y, 0.3e-6) + noise[1]
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):  # jaxopt's
        found, ok = harmonic_fit.skin(rival.fit, *records_of, (Q, 98.8e3), np.array(START), FS, F0)
    assert ok
    np.testing.assert_allclose(found, TRUTH, rtol=1e-5)


@pytest.fixture(scope="module")
def easy():
    """Two draws without noise and delays."""
    scene = rung("dry", snr_db=None, bits=None, trigger_jitter_rms=0.0)
    return problem(table.pairs(scene, 2), START)


def test_a_rival_recovers_a_skin_and_a_draw_that_fails_costs_itself_alone(easy):
    broken = {**easy, "v_out": easy["v_out"].copy()}
    broken["v_out"][0, 5] = np.nan
    outcome = rivals.run("scipy_lfilter", broken, 1, 120.0, python=HERE)
    assert outcome.missing == ""
    assert [bool(error) for error in outcome.errors] == [True, False]
    assert np.isnan(outcome.elements[0]).all()
    assert outcome.ok.tolist() == [False, True]
    np.testing.assert_allclose(outcome.elements[1], TRUTH, rtol=TUSTIN)
    assert min(outcome.seconds[1], outcome.first_seconds, *outcome.driver_seconds) > 0
    assert outcome.versions["scipy"] == scipy.__version__


def test_a_rival_that_cannot_run_says_why(easy, tmp_path, monkeypatch):
    def missing(name, of=easy, timeout=60.0, python: pathlib.Path | None = HERE):
        return rivals.run(name, of, 1, timeout, python=python).missing

    assert "not done after 0.01 s" in missing("scipy_lfilter", timeout=0.01)
    monkeypatch.setattr(rivals, "ENVIRONMENTS", tmp_path)
    assert "not installed: python -m" in missing("jax_sysid_linear", python=None)
    monkeypatch.setenv("PATH", str(tmp_path))
    octave = "octave-cli not found: apt-get install octave octave-control"
    assert missing("octave_arx") == octave
    nothing = {key: value for key, value in easy.items() if key != "r_ref"}
    assert "r_ref" in missing("scipy_lfilter", nothing)


def test_the_table_shows_what_is_missing_and_what_does_not_work():
    line, works = table.line("sippy_oe", rivals.Outcome(missing="not installed"), TRUTH)
    assert not works
    assert "not installed" in line
    one, yes = np.array([1e-3]), np.array([True])
    right = rivals.Outcome(np.array([TRUTH * 1.01]), yes, one, one, 0.5)
    line, works = table.line("sippy_oe", right, TRUTH)
    assert works
    assert "1.000   1.000   1.000" in line
    for wrong in {"elements": right.elements * 1.2}, {"ok": ~yes}:
        assert not table.line("sippy_oe", dataclasses.replace(right, **wrong), TRUTH)[1]


@pytest.mark.parametrize("name", RIVALS)
def test_every_rival_has_a_module_an_environment_and_a_scene(name):
    folder, rival = pathlib.Path(rivals.__file__).parent, RIVALS[name]
    assert (folder / f"{name.removesuffix(f'_{rival.estimator}')}.py").exists()
    assert (folder / f"{rival.environment}.txt").exists()
    assert rival.works in SCENES


@pytest.mark.slow
@pytest.mark.parametrize("name", RIVALS)
def test_every_rival_works_somewhere(name):
    if not rivals.installed(RIVALS[name].environment):
        pytest.skip(f"its environment is not made: python -m benchmarks rivals {name}")
    scene = rung("dry", **SCENES[RIVALS[name].works])
    outcome = rivals.run(name, problem(table.pairs(scene, 2), START), 1, 600.0)
    line, works = table.line(name, outcome, TRUTH)
    assert works, line


@pytest.mark.slow
def test_the_referee_agrees_with_the_posterior_of_a_fit():
    if not rivals.installed(referee.ENVIRONMENT):
        pytest.skip("its environment is not made: python -m benchmarks referee")
    found = referee.compared(40.0, 1)
    assert found["worth"].min() > referee.ENDED
    # 2000 effective draws of each know a mean to 0.03 standard deviations, a deviation to 2 %.
    assert np.abs(found["shift"]).max() < 0.15
    assert np.abs(found["ratio"] - 1).max() < 0.1
