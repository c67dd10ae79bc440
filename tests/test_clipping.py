"""Clipping without a known range: found where a pulse is cut, and nowhere else."""

import numpy as np
import pytest

from benchmarks.laboratory import Output, noise
from benchmarks.ladder import LOADS
from benchmarks.perturbed_study import drawn_driver
from etid.recordings.preflight import Inspected, preflight
from etid.recordings.recording import Recording
from etid.signals.clipping import is_clipped
from etid.simulation.transformer import TransformerDriver
from tests.conftest import REFERENCE_DATA

RATE, SAMPLES, FULL_SCALE = 200e3, 10_000, 10.0
NOISE_DB = (40.0, 60.0, 80.0, np.inf)


@pytest.fixture(scope="module")
def waves():
    """Voltages at the converter behind drivers whose parts differ by 10 %, and noise at 0 dB."""
    found = []
    for number in range(8):
        driver = drawn_driver(number, 0.1, TransformerDriver())
        outputs = [Output(driver), *(Output(driver, (load,)) for load in LOADS.values())]
        rng = np.random.default_rng(number)
        volts = np.stack([one.volts(RATE, SAMPLES, rng) for one in outputs])
        found.append((volts, noise(driver, RATE, 0.0)))
    return found


def converted(volts, bits, sigma, seed, rails=(-np.inf, np.inf)):
    """Volts, rounded as the converter does, which do not say its step."""
    noisy = volts + sigma * np.random.default_rng(seed).standard_normal(volts.shape)
    step = 2 * FULL_SCALE / 2**bits
    return np.rint(np.clip(noisy, *rails) / step) * step


@pytest.mark.parametrize("snr_db", NOISE_DB)
@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
def test_rounded_volts_are_not_clipped(waves, bits, snr_db):
    """Of damp skin, 12 bits and 60 dB, 21 of 24 were saturated."""
    for number, (volts, at_0_db) in enumerate(waves):
        for v in converted(volts, bits, at_0_db * 10 ** (-snr_db / 20), number):
            assert not is_clipped(v, 0.0)


@pytest.mark.parametrize("snr_db", NOISE_DB)
@pytest.mark.parametrize("bits", [12, 14, 16])
def test_a_pulse_whose_top_is_cut_by_5_percent_is_clipped(waves, bits, snr_db):
    for number, (volts, at_0_db) in enumerate(waves):
        sigma = at_0_db * 10 ** (-snr_db / 20)
        for v in volts:
            top = v[np.argmax(np.diff(v)) + 12]  # after the overshoot
            assert is_clipped(converted(v, bits, sigma, number, (-np.inf, 0.95 * top)), 0.0)
            assert is_clipped(-converted(v, bits, sigma, number, (-np.inf, 0.95 * top)), 0.0)


@pytest.mark.parametrize("width", [1, 9])
def test_commands_of_a_generator_are_not_clipped(width):
    phase = np.arange(SAMPLES) * 60.0 / RATE % 1
    first, second = phase < 0.04, (phase >= 0.04) & (phase < 0.08)
    window = np.hanning(width + 2) / np.hanning(width + 2).sum()
    for command in (first * 4.2, first * 4.2 - second * 4.2, first * (4.2 - 10 * phase)):
        v = np.convolve(command, window, "same")
        for sign in (1.0, -1.0):
            assert not is_clipped(sign * v, 0.0)
            assert not is_clipped(converted(sign * v, 14, 0.0, 0), 0.0)


def test_drawn_drivers_pass_with_converters_of_all_bits():
    data = REFERENCE_DATA / "drawn_drivers"
    if not data.is_dir():
        pytest.skip("../shared/data/drawn_drivers is absent")
    held = np.load(data / "records.npz")
    for codes in held["codes"].astype(float):
        for bits in (10, 12, 14, 16):
            step = float(held["lsb"]) * 2 ** (16 - bits)
            th, out = np.rint(codes * held["lsb"] / step) * step / held["scale"]
            one = Recording(th, out, sample_rate=float(held["fs"]), pulse_rate=float(held["f0"]))
            assert preflight(Inspected(one)) is None
