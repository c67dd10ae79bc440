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
from benchmarks.rivals.table import pairs

FS, F0 = 100e3, 60.0
PERIODS, SAMPLES = 3, 5_000  # three periods of 60 Hz at 100 kHz
R_S, R_P, C_P = TRUTH = np.array([33.4e3, 186e3, 0.12e-9])
ROUNDING = 1e-9  # of transforms of some thousand samples, 1e-16 times their condition
HERE = pathlib.Path(sys.executable)
TUSTIN = 0.01  # 0.35 % of C_p at 1 MHz, of which a delay that is fitted too makes R_s


def load(f):
    return R_S + R_P / (1 + 2j * np.pi * f * R_P * C_P)


def source(f):
    return 5e3 + 8e3 / (1 + 1j * f / 20e3)


def pulses(f):
    """Coefficients of pulses of 4 % of a period, 50 V high."""
    return 50 * 0.04 * np.sinc(f * 0.04 / F0) * np.exp(-1j * np.pi * f * 0.04 / F0)


def samples_of(coefficients, delay=0.0):
    """Three periods of these harmonics, from the first on."""
    spectrum = np.zeros(SAMPLES // 2 + 1, complex)
    number = np.arange(1, coefficients.size + 1)
    turn = np.exp(-2j * np.pi * number * F0 * delay)
    spectrum[PERIODS * number] = SAMPLES * coefficients * turn
    return np.fft.irfft(spectrum, SAMPLES)


@pytest.fixture
def f():
    return F0 * np.arange(1, 800)  # below half the sample rate


@pytest.fixture
def spectra(f):
    """Coefficients of V_th, and of V_out at the skin and at 98.8 kΩ."""
    x = pulses(f)
    return x, x * load(f) / (load(f) + source(f)), x * 98.8e3 / (98.8e3 + source(f))


def test_harmonics_are_those_that_a_record_was_made_of(f, spectra):
    x, y, _ = spectra
    of = records.harmonics(samples_of(x), samples_of(y), FS, F0)
    np.testing.assert_allclose(of.f[: f.size], f)
    np.testing.assert_allclose(of.x[: f.size], x, atol=ROUNDING)
    np.testing.assert_allclose(of.y[: f.size], y, atol=ROUNDING)


def test_residuals_vanish_at_the_truth_and_count_standard_errors(f, spectra):
    x, y, _ = spectra
    late = y * np.exp(-2j * np.pi * f * 0.3e-6)
    q = np.append(np.log(TRUTH), 0.3)
    misfit = harmonic_fit.skin_misfit(q, f, x, late, 1e-3, source(f))
    np.testing.assert_allclose(misfit, 0, atol=ROUNDING / 1e-3)
    rng = np.random.default_rng(3)
    noise = 1e-3 / np.sqrt(2) * (rng.normal(size=(4, f.size)))
    noisy = x + noise[0] + 1j * noise[1], late + noise[2] + 1j * noise[3]
    squares = harmonic_fit.skin_misfit(q, f, *noisy, 1e-3, source(f)) ** 2
    assert 2 * squares.mean() == pytest.approx(1, rel=5 / np.sqrt(f.size))


Q = np.array(
    [np.log(0.05), 13.0, -0.5, 0.1, 0.1, 11.0, 0.3, 0.05, -0.02, 6.0, 0.02]
)  # of Z_th / R_L


@pytest.mark.parametrize("name", ["scipy_harmonics", "optimistix_lm", "jaxopt_lm"])
@pytest.mark.filterwarnings("ignore:JAXopt is no longer maintained:DeprecationWarning")
def test_a_package_recovers_a_skin_behind_a_known_driver(name, f):
    rival = importlib.import_module(f"benchmarks.rivals.{name}")
    z_th, x = 98.8e3 * harmonic_fit.source_impedance(Q, f), pulses(f)
    y = x * load(f) / (load(f) + z_th)
    noise = np.random.default_rng(4).normal(0, 1e-6, (2, SAMPLES))  # [V], which shows in 1e-6 of Z
    records_of = samples_of(x) + noise[0], samples_of(y, 0.3e-6) + noise[1]
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):  # jaxopt's
        found, ok = rival.skin(*records_of, (Q, 98.8e3), np.array(START), FS, F0)
    assert ok
    np.testing.assert_allclose(found, TRUTH, rtol=1e-5)


@pytest.fixture(scope="module")
def easy():
    """Two draws without noise and delays."""
    return problem(pairs(rung("dry", snr_db=None, bits=None, trigger_jitter_rms=0.0), 2), START)


def test_a_rival_recovers_a_skin_and_a_draw_that_fails_costs_itself_alone(easy):
    broken = {**easy, "v_out": easy["v_out"].copy()}
    broken["v_out"][0, 5] = np.nan
    outcome = rivals.run("scipy_lfilter", broken, 1, 120.0, python=HERE)
    assert outcome.missing == ""
    assert outcome.errors[0]
    assert np.isnan(outcome.elements[0]).all()
    assert outcome.errors[1] == ""
    assert outcome.ok.tolist() == [False, True]
    np.testing.assert_allclose(outcome.elements[1], TRUTH, rtol=TUSTIN)
    assert outcome.seconds[1] > 0
    assert (outcome.driver_seconds > 0).all()
    assert outcome.first_seconds > 0
    assert outcome.versions["scipy"] == scipy.__version__


def test_a_rival_that_cannot_run_says_why(easy, tmp_path, monkeypatch):
    assert (
        "not done after 0.01 s" in rivals.run("scipy_lfilter", easy, 1, 0.01, python=HERE).missing
    )
    monkeypatch.setattr(rivals, "ENVIRONMENTS", tmp_path)
    assert "not installed: python -m" in rivals.run("jax_sysid_linear", easy, 1, 1.0).missing
    monkeypatch.setenv("PATH", str(tmp_path))
    outcome = rivals.run("octave_arx", easy, 1, 1.0, python=HERE)
    assert outcome.missing == "octave-cli not found: apt-get install octave octave-control"
    nothing = {key: value for key, value in easy.items() if key != "r_ref"}
    assert "r_ref" in rivals.run("scipy_lfilter", nothing, 1, 60.0, python=HERE).missing


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


def test_every_rival_has_a_module_an_environment_and_a_scene():
    folder = pathlib.Path(rivals.__file__).parent
    for name, rival in RIVALS.items():
        assert (folder / f"{name}.py").exists()
        assert (folder / f"{rival.environment}.txt").exists()
        assert rival.works in SCENES


@pytest.mark.slow
@pytest.mark.parametrize("name", RIVALS)
def test_every_rival_works_somewhere(name):
    if not rivals.installed(RIVALS[name].environment):
        pytest.skip(f"its environment is not made: python -m benchmarks rivals {name}")
    outcome = rivals.run(
        name, problem(pairs(rung("dry", **SCENES[RIVALS[name].works]), 2), START), 1, 600.0
    )
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
