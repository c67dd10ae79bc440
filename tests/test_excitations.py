"""Currents of any waveform: the noise is found beside them, and standard errors are true."""

import numpy as np
import pytest
import scipy.signal

import etid
from benchmarks.excitations import fitted
from benchmarks.real import held as staircase
from etid.recordings.preflight import Inspected

RATE = 200e3
TRUTH = np.array([33e3, 186e3, 0.12e-9])
SKIN = etid.SkinRC(*TRUTH)
SNR = 1e-3  # noise of both records, relative to their standard deviations
LATE = 0.5  # [samples] standard deviation of the delay of v_out; a fit expects as much
# Multisines have 25 lines, evenly spaced in the logarithm of the frequency.
WAVES = ("flat 6", "flat 36", "flat 72", "flat 90", "1/f 36", "chirp 36", "chirp 80", "pulses")


def coefficients(kind, harmonics, rate):
    """Fourier coefficients of a current [A]; the number is the highest frequency [kHz]."""
    f, found = rate * harmonics, np.zeros(harmonics.size, complex)
    name, _, top = kind.partition(" ")
    if name == "pulses":
        first, second, end = (np.exp(-2j * np.pi * f * (1e-3 + k * 2e-4)) for k in range(3))
        pulse = 1e-3 * rate * (first - 2 * second + end) / (2j * np.pi * f)
        return pulse / (1 + (f / 60e3) ** 8)
    if name == "chirp":
        inside = f <= 1e3 * float(top)
        return np.where(inside, 1e-5 * np.exp(-1j * np.pi * harmonics**2 / inside.sum()), 0)
    lines = np.unique(np.round(np.geomspace(1, 1e3 * float(top) / rate, 25)).astype(int))
    turned = np.exp(2j * np.pi * np.random.default_rng(3).uniform(size=lines.size))
    found[lines - 1] = 1e-5 * turned * (10 / lines if name == "1/f" else 1)
    return found


def recorded(kind, periods, seed, rate):
    """Current and voltage of whole periods; a period of 60 Hz is no whole number of samples."""
    whole = round(3 * RATE / rate)  # three periods are
    harmonics = np.arange(1, int(0.49 * RATE / rate))
    i = coefficients(kind, harmonics, rate)
    rng = np.random.default_rng(seed)
    delay = np.exp(-2j * np.pi * rate * harmonics * LATE * rng.standard_normal() / RATE)
    spectra = np.zeros((2, whole // 2 + 1), complex)
    spectra[:, 3 * harmonics] = i, i * SKIN.response(rate * harmonics) * delay
    count = int(periods * RATE / rate + 0.5)
    clean = [np.resize(wave, count) for wave in np.fft.irfft(spectra, whole, norm="forward")]
    sigma = [SNR * wave.std() for wave in clean]
    current, v_out = (
        wave + noise * rng.standard_normal(count) for wave, noise in zip(clean, sigma, strict=True)
    )
    one = etid.Recording(v_out=v_out, current=current, sample_rate=RATE, pulse_rate=rate)
    return one, np.array(sigma)


@pytest.mark.parametrize("periods", [1, 2, 4])
@pytest.mark.parametrize("rate", [50.0, 60.0])
@pytest.mark.parametrize("kind", WAVES)
def test_the_noise_is_found_beside_any_waveform(kind, rate, periods):
    """Differences saw the signal as noise: 15 times too much for a multisine to 36 kHz.

    By the median of 400 bins of a single period, σ has a standard error of 3.6 %; the limits are
    four of these. Two periods of 60 Hz end between two samples, so that a chirp leaks between its
    harmonics. The highest bins of one period of a chirp to 80 kHz hold the signal.
    """
    one, sigma = recorded(kind, periods, 0, rate)
    ratio = Inspected.of(one).sigma / sigma
    assert (ratio > 0.85).all()
    if (kind, periods) != ("chirp 80", 1):
        assert (ratio < (1.15 if (kind, periods, rate) != ("chirp 80", 2, 60.0) else 1.2)).all()


@pytest.mark.parametrize("rate", [50.0, 60.0])
def test_a_flat_multisine_is_fitted_to_its_noise(rate):
    """χ² was 0.03, and the standard errors were eight times too large."""
    one, _ = recorded("flat 36", 4, 1, rate)
    fit = etid.identify_skin(one)
    assert 0.7 < fit.chi2 < 1.3
    errors = np.array([float(getattr(fit.stderr, name)) for name in fit.circuit.names()])
    assert (errors / TRUTH < 1e-3).all()
    assert np.abs((fit.circuit.values() - TRUTH) / errors).max() < 4


@pytest.mark.parametrize(("kind", "rate"), [*zip(WAVES, [50.0, 60.0] * 4, strict=True)])
def test_one_period_of_any_waveform_is_fitted(kind, rate):
    """Two crests of a chirp or of a 1/f multisine were pulses of another rate: `rate_mismatch`."""
    fit = etid.identify_skin(recorded(kind, 1, 2, rate)[0])
    errors = np.array([float(getattr(fit.stderr, name)) for name in fit.circuit.names()])
    assert np.abs((fit.circuit.values() - TRUTH) / errors).max() < 4


@pytest.mark.parametrize("kind", ["flat 6", "flat 36", "1/f 36", "chirp 36"])
def test_a_spectrum_that_has_ended_has_no_aliases(kind):
    """By chance, noise above it looked like aliases in one of thirty records: `biased`."""
    for periods, seed in ((1, 3), (1, 6), (4, 6)):
        seen = Inspected.of(recorded(kind, periods, seed, 50.0)[0])
        assert seen.has_no_aliases
        assert not seen.is_aliased


@pytest.mark.parametrize("kind", ["flat 72", "flat 90", "pulses"])
def test_a_spectrum_that_goes_on_may_have_aliases(kind):
    assert not Inspected.of(recorded(kind, 1, 0, 50.0)[0]).has_no_aliases


def test_a_record_that_does_not_close_has_not_ended():
    """One period that begins with the current: the voltage at the skin is not yet periodic."""
    one, sigma = recorded("flat 36", 1, 0, 50.0)
    charged = 100 * sigma[1] * np.exp(-np.arange(one.v_out.size) / (RATE * 186e3 * 0.12e-9))
    assert Inspected.of(one).has_no_aliases
    assert not Inspected.of(one.replace(v_out=one.v_out + charged)).has_no_aliases


@pytest.mark.slow
@pytest.mark.parametrize(("rate", "periods"), [(50.0, 1), (60.0, 4)])
@pytest.mark.parametrize("kind", WAVES)
def test_estimates_scatter_as_much_as_their_standard_errors_say(kind, rate, periods):
    """The root mean square of 60 errors has a standard error of 9 %."""
    if (kind, rate) == ("flat 6", 60.0):
        pytest.skip("output error: one or two of sixty are a misfit (docs/limits.md)")
    errors = []
    for seed in range(60):
        fit = etid.identify_skin(recorded(kind, periods, seed, rate)[0], throw=False)
        assert fit.verdict == "successful"
        stderr = [float(getattr(fit.stderr, name)) for name in fit.circuit.names()]
        errors.append((fit.circuit.values() - TRUTH) / np.array(stderr))
    scatter = np.sqrt(np.mean(np.square(errors), axis=0))
    assert (scatter > 0.7).all()
    assert (scatter < 1.4).all()


def anywhere(kind, seed):
    """A part of a long record, which begins and ends anywhere; exact between the samples."""
    rng, whole, size = np.random.default_rng(seed), 12_288, 3000
    f, time = np.arange(1, whole // 2) * (RATE / whole), np.arange(whole)
    if kind == "noise":
        x = rng.standard_normal(f.size) + 1j * rng.standard_normal(f.size)
    elif kind == "multisine":
        x = np.zeros(f.size, complex)
        lines = np.unique(np.geomspace(7, 2000, 25).astype(int))
        x[lines] = np.exp(2j * np.pi * rng.uniform(size=lines.size))
    else:
        bits = np.repeat(rng.choice([-1.0, 1.0], whole // 12), 12)
        step = 1.0 * ((time > 1500) & (time < 9000))
        x = np.fft.rfft({"bits": bits, "step": step}[kind])[1:-1]
    x = x / (1 + (f / 50e3) ** 8)
    waves = np.fft.irfft(np.pad([x, x * np.asarray(SKIN.response(f))], ((0, 0), (1, 1))), whole)[
        :, 500:
    ]
    noise = rng.standard_normal((2, size))
    current, v_out = (w[:size] + SNR * w.std() * n for w, n in zip(waves, noise, strict=True))
    return etid.Recording(
        v_out=v_out, current=1e-3 * current / current.std(), sample_rate=RATE, pulse_rate=60.0
    ).replace(v_out=1e-3 * v_out / current.std())


@pytest.mark.parametrize("kind", ["bits", "noise", "multisine", "step"])
def test_records_without_period_and_rest_have_true_standard_errors(kind):
    """Random signals were taken for noise: χ² was 0.2. 16 independent errors: 1 ± 0.18."""
    errors, chi2 = [], []
    for seed in range(8):
        fit = etid.identify_skin(anywhere(kind, seed))
        stderr = [float(getattr(fit.stderr, name)) for name in fit.circuit.names()]
        errors.append((fit.circuit.values() - TRUTH) / np.array(stderr))
        chi2.append(float(fit.chi2))
    assert 0.7 < np.mean(chi2) < 1.3
    assert 0.5 < np.sqrt(np.mean(np.square(errors))) < 1.5


@pytest.mark.parametrize("kind", ["bits", "noise"])
def test_a_random_command_that_a_converter_holds_is_a_signal(kind):
    """White noise was `flat`, ± of random bits 1.4 times too large; 18 numbers have 1 ± 0.2."""
    every = [fitted(kind, "current, held", 60.0, number) for number in range(6)]
    verdicts, z, _ = zip(*every, strict=True)
    assert set(verdicts) == {"successful"}
    assert 0.5 < np.sqrt(np.mean(np.square(z))) < 1.5


def test_two_records_of_noise_are_flat():
    both = np.random.default_rng(0).standard_normal((2, 3000))
    one = etid.Recording(v_out=both[0], current=1e-4 * both[1], sample_rate=RATE, pulse_rate=60.0)
    assert etid.identify_skin(one, throw=False).verdict == "flat"


def test_bends_of_the_gain_are_no_noise_of_a_short_record():
    """In 243 samples G and T bend within 32 bins: electrodes in tissue were `successful` at 7 %."""
    rng, at = np.random.default_rng(0), np.arange(243)
    command = 1e-3 * ((at >= 60) & (at < 90)) - 1e-3 * ((at >= 90) & (at < 120))
    decay = np.exp(-1 / (24e3 * 8e-3))
    of_layer = scipy.signal.lfilter([0, 20e3 * (1 - decay)], [1, -decay], command)
    v_out = 1e3 * command + of_layer + 1e-4 * rng.standard_normal(at.size)
    current = staircase(command)
    one = etid.Recording(v_out=v_out, current=current, sample_rate=24e3, pulse_rate=24e3 / 243)
    variance = Inspected.of(one).bins.fields[4]
    assert np.max(variance) < 30 * 1e-8 / at.size  # it was 10 000 times this
    assert etid.identify_skin(one, throw=False).verdict != "successful"
