"""A pulse period of a whole number of samples: aliases fall on the harmonics."""

import functools

import numpy as np
import pytest

import etid
import etid.display
from benchmarks.ladder import CALIBRATION, recorded
from benchmarks.perturbed_study import drawn_driver
from etid.signals.harmonics import ALIASED, aliases
from etid.simulation.transformer import TransformerDriver
from tests.skins import DAMP, DRY, off

SKINS = {"dry": DRY, "damp": DAMP}
SIGMAS = 4.0  # one of 16 000 for a normal error; 600 elements are compared below


def scene(number, *, rate=204e3, pulses=60.0, periods=3, filtered=True, snr_db=60.0):
    """Both skins behind a drawn driver; the pulses begin anywhere between two samples.

    The usual rate gives as many harmonics as those of other tests, after padding, so that nothing
    is compiled for them.
    """
    return recorded(
        SKINS,
        driver=drawn_driver(number, 0.05, TransformerDriver()),
        sample_rate=rate,
        pulse_rate=pulses,
        samples=round(periods * rate / pulses),
        start=0.37 / rate,
        antialias=0.4 if filtered else 5.0,  # far above what edges of 250 ns have
        trigger_jitter_rms=0.1 / rate,
        snr_db=snr_db,
    )


@functools.cache
def study(filtered):
    return scene(1, filtered=filtered).simulate(1)


def each(fits):
    """The fits of the skins with their names."""
    return [(fits[number], name) for number, name in enumerate(SKINS)]


@pytest.mark.parametrize(
    "identify", [etid.identify_study, pytest.param(etid.identify_jointly, marks=pytest.mark.slow)]
)
def test_a_fit_is_by_maximum_likelihood_and_right(identify):
    for fit, name in each(identify(study(True)).fits):
        assert fit.verdict == "successful"
        assert fit.method in ("maximum_likelihood", "joint")
        assert np.abs(off(fit, SKINS[name])).max() < SIGMAS


def test_without_a_filter_the_records_are_biased():
    """Maximum likelihood would be up to fifty of its standard errors off."""
    with pytest.raises(etid.IdentificationError, match=r"biased.*anti-alias filter"):
        etid.identify_driver(study(False)[CALIBRATION])
    driver = etid.identify_driver(study(True)[CALIBRATION])
    for name in SKINS:
        fit = etid.identify_skin(study(False)[name], driver, throw=False)
        assert fit.verdict == "biased"
    joint = etid.identify_jointly(study(False))
    assert set(joint.fits.verdicts) == {"driver_failed"}
    assert all("biased" in note for note in joint.fits.notes)
    with pytest.raises(etid.IdentificationError, match="biased"):
        etid.display.Tracker.of(driver, study(False)[CALIBRATION], electrodes=1)


@pytest.mark.parametrize(("rate", "pulses"), [(200e3, 50.0), (240e3, 60.0), (500e3, 50.0)])
@pytest.mark.parametrize("load", ["open", *SKINS])
def test_aliases_behind_a_filter_are_not_larger_than_estimated(rate, pulses, load):
    """Nor are they more than 20 times smaller where they matter most, at the highest harmonics."""
    size = round(rate / pulses)
    half = (size - 1) // 2
    for number in range(4):
        of = scene(number, rate=rate, pulses=pulses).waveform()
        x, k = of.v_th, np.round(of.f / pulses).astype(int)
        if load != "open":
            z = np.asarray(SKINS[load].response(of.f))
            x = x * z / (z + of.z_th)
        x = x * np.exp(2j * np.pi * k / size * np.random.default_rng(number).uniform())
        found = np.zeros(size, complex)  # folded by hand
        np.add.at(found, k % size, x)
        np.add.at(found, -k % size, x.conj())
        found, true = found[1 : half + 1], x[:half]
        quiet = np.full(found.shape, 1e-12 * np.abs(found[-1]) ** 2)
        estimated = aliases(found, quiet, 3, 3 * size)
        for part in (0.1, 0.2, 0.3, ALIASED):
            # 25 harmonics hold a whole lobe of the spectrum of a pulse.
            around = slice(round(part * size) - 25, round(part * size) + 25)
            ratio = np.mean(estimated.power[around]) / np.mean(np.abs(found - true)[around] ** 2)
            assert ratio > 1
        assert ratio < 20


def test_a_spectrum_that_ends_in_the_noise_has_no_aliases():
    rng = np.random.default_rng(4)
    parts = rng.standard_normal((2, 2000))
    noise = np.full(2000, 2.0)
    pulse = 1e6 * np.exp(-np.arange(2000) / 50)
    of = aliases(pulse + parts[0] + 1j * parts[1], noise, 5, 20_000)
    assert not of.power.any()
    assert not of.are_unknown(noise)


def test_a_spectrum_that_falls_with_a_power_has_the_aliases_of_this_power():
    size = 4000
    u = np.arange(1, 2000) / size
    of = aliases(u**-7.0 + 0j, np.full(u.size, 1e-9), 5, 5 * size)
    # A spectrum as steep as this changes by a factor of five over a band, whose mean lies higher.
    np.testing.assert_allclose(of.fall, 14.0, rtol=0.03)
    np.testing.assert_allclose(of.power[:1400], (1 - u[:1400]) ** -14.0, rtol=0.15)


def drawn(**settings):
    """Errors of skins behind drawn drivers in standard errors; skins that are not fitted."""
    errors, others = [], []
    for draw in range(18):
        of = scene(100 + draw, snr_db=(40.0, 60.0, 80.0)[draw % 3], **settings).simulate(draw)
        try:
            driver = etid.identify_driver(of[CALIBRATION])
        except etid.IdentificationError as error:
            others += [str(error).split(": ")[1].split(".")[0].split(",")[0]] * len(SKINS)
            continue
        fits = etid.identify_skins([of[name] for name in SKINS], driver)
        for fit, name in each(fits):
            if fit.verdict == "successful":
                errors.append(off(fit, SKINS[name]))
            else:
                others.append(fit.verdict)
    return np.array(errors), others


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rate", "pulses", "periods"), [(200e3, 50.0, 10), (240e3, 60.0, 3)], ids=["50 Hz", "60 Hz"]
)
def test_behind_a_filter_the_elements_are_within_their_errors(rate, pulses, periods):
    errors, others = drawn(rate=rate, pulses=pulses, periods=periods)
    assert len(others) <= 2
    assert np.abs(errors).max() < SIGMAS
    assert np.sqrt(np.mean(errors**2, axis=0)).max() < 1.3  # 1 ± 0.09 without any aliases


@pytest.mark.slow
@pytest.mark.parametrize(("rate", "pulses"), [(200e3, 50.0), (240e3, 60.0)], ids=["50 Hz", "60 Hz"])
def test_without_a_filter_no_fit_is_silently_wrong(rate, pulses):
    errors, others = drawn(rate=rate, pulses=pulses, filtered=False)
    assert others.count("biased") >= 0.75 * 36
    assert not errors.size or np.abs(errors).max() < SIGMAS
