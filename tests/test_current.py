"""Loads identified from a measured current: accuracy, delays, batches, and wrong input."""

import csv
import re
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import etid
from etid import cli
from etid.recordings.causes import why_misaligned
from etid.recordings.preflight import Inspected, preflight
from tests import kept_numbers
from tests.skins import off

RATE, PULSES = 200e3, 60.0
SKIN = etid.SkinRC(33e3, 186e3, 0.12e-9)
COLE = etid.SkinCole(2e3, 27e3, 1e-3, 0.85)
WIDTH, STRENGTH = 200e-6, 1e-3  # [s], [A] of each phase of a biphasic pulse
# Estimates are within this many standard errors of the truth; by chance one of 3000 is not.
WITHIN = 4.0


def recorded(circuit, *, periods=3.0, snr_db=60.0, seed=0, delay=0.0, **fields):
    """Biphasic current pulses and their voltage at a circuit, exact between the samples."""
    n, whole = round(periods * RATE / PULSES), round(3 * RATE / PULSES)  # samples, of 3 periods
    harmonics = np.arange(1, int(0.499 * RATE / PULSES))
    f = harmonics * PULSES
    first, second, end = (np.exp(-2j * np.pi * f * (1e-3 + k * WIDTH)) for k in range(3))
    x = STRENGTH * PULSES * (first - 2 * second + end) / (2j * np.pi * f)
    x = x / (1 + (f / (0.3 * RATE)) ** 8)  # anti-alias filter of both channels
    y = x * np.asarray(circuit.response(f)) * np.exp(-2j * np.pi * f * delay)
    spectra = np.zeros((2, whole // 2 + 1), complex)
    spectra[:, 3 * harmonics] = x, y
    waves = np.fft.irfft(spectra, whole, norm="forward")
    rng = np.random.default_rng(seed)
    current, v_out = (
        v + np.std(v) * 10 ** (-snr_db / 20) * rng.standard_normal(n)
        for v in (np.resize(wave, n) for wave in waves)
    )
    records = {"current": current, "v_out": v_out, "sample_rate": RATE, "pulse_rate": PULSES}
    return etid.Recording(**records | fields)


@pytest.fixture(scope="module")
def skin():
    return recorded(SKIN, delay=1e-6)


def test_a_load_is_identified_from_whole_periods_of_current_and_voltage(skin):
    fit = etid.identify_skin(skin)
    assert fit.method == "maximum_likelihood"
    assert np.abs(off(fit, SKIN)).max() < WITHIN
    assert fit.stderr.r_p < 1e-3 * fit.circuit.r_p
    kept_numbers.check("current", kept_numbers.of_fit(fit))


@pytest.mark.slow
@pytest.mark.parametrize("periods", [3.0, 1.1])
def test_a_fixed_element_keeps_its_value_and_helps_the_others(skin, periods):
    recording = skin if periods == 3.0 else recorded(SKIN, periods=periods)
    free = etid.identify_skin(recording)
    fixed = etid.identify_skin(recording, fixed={"r_s": 33e3})
    assert fixed.circuit.r_s == 33e3
    assert fixed.stderr.r_s < 1e-8 * 33e3
    assert fixed.stderr.r_p < 0.9 * free.stderr.r_p
    assert np.abs(off(fixed, SKIN)[1:]).max() < WITHIN


@pytest.mark.slow
def test_a_fixed_element_keeps_its_value_at_several_amplitudes(skin):
    fit = etid.identify_amplitudes([skin], circuit=etid.SkinRC(), fixed={"r_s": 33e3})
    assert fit.circuit.r_s == 33e3


def test_a_prior_is_one_more_measurement(skin):
    free = etid.identify_skin(skin)
    r_s, error = float(free.circuit.r_s), float(free.stderr.r_s)
    # As exact as the record, and two standard errors off: the estimate is half way.
    told = etid.identify_skin(skin, prior={"r_s": (r_s + 2 * error, error)})
    assert abs(told.circuit.r_s - (r_s + error)) < 0.05 * error  # linear to 2 % of an error
    np.testing.assert_allclose(told.stderr.r_s, error / np.sqrt(2), rtol=0.02)
    # One standard error from the record, and one from the prior.
    assert told.support is not None
    assert free.support is not None
    assert told.support.deviance - free.support.deviance == pytest.approx(2.0, abs=0.1)
    kept_numbers.check("current_with_prior", kept_numbers.of_fit(told))


def test_a_single_pulse_is_identified_in_time():
    fit = etid.identify_skin(recorded(SKIN, periods=1.1, delay=5e-7))
    assert fit.method == "maximum_likelihood"
    assert np.abs(off(fit, SKIN)).max() < WITHIN
    kept_numbers.check("current_in_time", kept_numbers.of_fit(fit))


@pytest.mark.parametrize(
    ("circuit", "samples", "digits"),
    [
        *((etid.SkinCole(2e3, 27e3, 1e-3, alpha), 300, 1e-4) for alpha in (0.4, 0.99)),
        (etid.SkinCole(2e3, 27e3, 1e-3, 0.85), 30_000, 1e-4),
        # From a few samples to the length of the record.
        *((etid.SkinWarburg(2e3, 27e3, 3 / RATE), n, 1e-4) for n in (300, 30_000)),
        *((etid.SkinWarburg(2e3, 27e3, n / RATE), n, 1e-4) for n in (300, 30_000)),
        (SKIN, 1000, 1e-12),
    ],
    ids=repr,
)
def test_the_states_of_a_load_have_its_impedance(circuit, samples, digits):
    """Of the ladder of a constant phase, the relaxations of a diffusion, capacitors."""
    system = circuit.impedance().state_space(RATE, samples)
    f = np.geomspace(1 / samples, 0.5, 100) * RATE
    a, b, c = np.asarray(system.A), np.asarray(system.B)[:, 0], np.asarray(system.C)
    z = [c @ np.linalg.solve(2j * np.pi * one * np.eye(b.size) - a, b) for one in f]
    expected = np.asarray(circuit.response(jnp.asarray(f)))
    np.testing.assert_allclose(np.array(z) + np.asarray(system.D)[0], expected, rtol=digits)


@pytest.mark.parametrize(
    ("cause", "effect", "element", "error"),
    [("v_out", "current", 1, -0.012), ("current", "v_out", 0, 0.045)],
)
def test_crosstalk_between_the_channels_passes_with_the_error_of_the_guide(
    skin, cause, effect, element, error
):
    """One per cent of the peak: a resistor in parallel, or in series with the load."""
    peak = {name: np.abs(getattr(skin, name)).max() for name in ("v_out", "current")}
    other = 0.01 * peak[effect] / peak[cause] * getattr(skin, cause)
    fit = etid.identify_skin(skin.replace(**{effect: getattr(skin, effect) + other}))
    assert fit.verdict == "successful"
    values = np.asarray(fit.circuit.values()) / np.asarray(SKIN.values())
    np.testing.assert_allclose(values[element] - 1, error, rtol=0.1)  # two digits are printed


def test_a_prediction_from_the_current_misses_by_the_noise(skin):
    rest = etid.predict(skin, circuit=etid.identify_skin(skin).circuit) - skin.v_out
    # The noise of both channels is 1e-3 of each; that of the current passes the skin.
    assert np.nanstd(rest) < 2e-3 * np.std(skin.v_out)
    cole = recorded(COLE, periods=1.1)
    assert np.nanstd(etid.predict(cole, circuit=COLE) - cole.v_out) < 2e-3 * np.std(cole.v_out)


def test_a_study_of_currents_needs_no_calibration_and_its_report_speaks_of_no_driver(
    skin, tmp_path
):
    study = etid.Study.from_recordings([skin.replace(path="s01/0"), skin.replace(path="s01/1")])
    study.write(tmp_path / "study.h5")
    with etid.read(tmp_path / "study.h5") as again:
        np.testing.assert_array_equal(again["s01/1"].current, skin.current)
    found = etid.fit_file(tmp_path / "study.h5", tmp_path / "fits.h5")
    assert found.drivers == {}
    assert (found.fits.verdicts == "successful").all()
    etid.write_report(tmp_path / "fits.h5", tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text("utf-8")
    assert "measured currents, which needs no driver" in page
    assert "V_out = Z_L I" in page
    for wrong in ("Z_th is a rational function", "do not say with which driver", "No prediction"):
        assert wrong not in page


KNOWN: dict[str, Any] = {"fixed": {"r_s": 33e3}, "prior": {"c_p": (0.12e-9, 1e-13)}}


@pytest.mark.slow
def test_draws_of_a_fit_with_known_elements_keep_to_them(skin):
    fit = etid.identify_skin(skin, **KNOWN)
    draws = fit.posterior()
    assert draws.effective > 800  # of 1000: the likelihood is normal at 60 dB
    np.testing.assert_allclose(draws.draws.r_s, 33e3, rtol=1e-7)
    free = etid.identify_skin(skin)
    for name in ("r_p", "c_p"):
        error = float(getattr(fit.stderr, name))
        assert error < 0.95 * float(getattr(free.stderr, name))
        expected = float(getattr(fit.circuit, name)) + np.array([-1.96, 1.96]) * error
        for interval in (draws.intervals()[name], fit.profile(name).interval()):
            # 1000 draws give an end of the interval to a tenth of a standard error.
            np.testing.assert_allclose(interval, expected, rtol=0, atol=0.3 * error)
    with pytest.raises(ValueError, match="r_s is fixed, so it has no profile"):
        fit.profile("r_s")


def test_known_elements_of_batches_and_on_the_command_line(skin, tmp_path, capsys):
    study = tmp_path / "study.h5"
    etid.Study.from_recordings([skin.replace(path="s01/0")]).write(study)
    command = ["fit", str(study), "-o", str(tmp_path / "fits.h5"), "--force"]
    assert cli.main([*command, "--fix", "r_s=33e3", "--prior", "c_p=120e-12,1e-13"]) == 0
    fits = etid.identify_skins([skin], **KNOWN)
    assert np.abs(off(fits[0], SKIN))[1:].max() < WITHIN
    assert "known_elements" in fits.fit.method
    for fit in (fits[0], etid.Fits.read(tmp_path / "fits.h5")[0]):
        assert fit.verdict == "successful"
        assert fit.circuit.r_s == 33e3  # which is not exp(ln 33e3)
        assert fit.stderr.c_p < 1e-13
    assert cli.main(["export", str(tmp_path / "fits.h5"), "-o", str(tmp_path / "fits.csv")]) == 0
    (row,) = csv.DictReader((tmp_path / "fits.csv").read_text("utf-8").splitlines())
    assert row["r_s [ohm]"] == "33000.0"
    etid.write_report(tmp_path / "fits.h5", tmp_path / "page.html")
    assert "r_s = 33000 (fixed)" in (tmp_path / "page.html").read_text("utf-8")
    for options, words in (
        (["--fix", "r_s=1", "--fix", "r_s=2"], "names an element twice: r_s, r_s"),
        (["--fix", "r_x=1"], "'r_x' is no element of SkinRC"),
        (["--joint", "--fix", "r_x=1"], "'r_x' is no element of SkinRC"),
    ):
        capsys.readouterr()
        assert cli.main([*command, *options]) == 1
        assert words in capsys.readouterr().err
    for option, told, right in (("--prior", "r_s=much", "500,50"), ("--fix", "r_s=1,2", "500")):
        with pytest.raises(SystemExit):
            cli.main([*command, option, told])
        assert f"write {option} r_s={right}" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("change", "verdict", "words"),
    [
        (lambda one: {"current": 1e3 * one.current}, "wrong_unit", "in ampere and not in mA"),
        (lambda one: {"current": one.v_out, "v_out": one.current}, "wrong_unit", "exchanged"),
        (lambda one: {"v_out": 1e3 * one.v_out}, "wrong_unit", "v_out in volt"),
        (lambda one: {"current": 0 * one.current}, "flat", "is in current"),
        (lambda one: {"v_out": 0 * one.v_out}, "flat", "is in v_out"),
        (lambda one: {"current": -one.current}, "misaligned", "change the sign"),
        (
            lambda one: {"current": np.where(np.arange(one.v_out.size) == 5, np.nan, one.current)},
            "nonfinite_samples",
            "is in current",
        ),
    ],
)
def test_a_wrong_current_gets_one_clear_verdict(skin, change, verdict, words):
    with pytest.raises(etid.IdentificationError, match=words) as error:
        etid.identify_skin(skin.replace(**change(skin)))
    assert str(error.value).startswith(f"recording '': {verdict}.")


@pytest.mark.parametrize("snr_db", [60.0, 20.0])
@pytest.mark.parametrize("load", [SKIN, COLE, etid.SkinRC(1e3, 1e5, 1e-6)], ids=repr)
def test_the_cause_of_a_misaligned_current_is_named(load, snr_db):
    """A phase of the pulse has 40 samples: v_out that late falls where the current rises."""
    right = recorded(load, snr_db=snr_db)
    v, n = right.v_out, right.v_out.size
    sign = "v_out falls where the current rises; change the sign of one of them."
    other = recorded(load, snr_db=snr_db, seed=1, periods=4.0).v_out[1600 : 1600 + n]
    for v_out, words in (
        (-v, f"^{sign}$"),
        (np.roll(v, 40), r"^v_out is late by 4[01] samples \(0\.0002\d* s\); shift .*records\.$"),
        (-np.roll(v, -300), rf"^v_out is early by (299|300) samples .*records\. {sign}$"),
        (other, "^The cause is not clear"),  # half a period away
    ):
        assert re.search(words, why_misaligned(Inspected.of(right.replace(v_out=v_out))))


@pytest.mark.parametrize("late", [1, 5, 40])
def test_a_late_capacitor_is_not_mistaken_for_a_wrong_sign(late):
    """Its voltage then falls with the current at every frequency, as with the wrong sign."""
    right = recorded(etid.SkinRC(10.0, 1e6, 1e-7))
    seen = Inspected.of(right.replace(v_out=np.roll(right.v_out, late)))
    assert preflight(seen) == "misaligned"
    assert why_misaligned(seen).startswith("The cause is not clear")


def test_a_current_that_its_converter_clips_is_refused(skin):
    clipped = skin.replace(current=np.minimum(skin.current, 0.8 * skin.current.max()))
    for record, verdict in ((skin, None), (clipped, "saturated")):
        assert preflight(Inspected.of(record)) == verdict
        ranged = record.replace(adc_range=(-1e4, 1e4))  # that of the voltages
        assert preflight(Inspected.of(ranged)) == verdict
    with pytest.raises(etid.IdentificationError, match="may rest at its value: state `hold`"):
        etid.identify_skin(clipped)
