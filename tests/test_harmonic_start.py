"""Steiglitz-McBride on harmonics, the start of a skin: near the truth, whatever noise and delay."""

import numpy as np
import pytest

from etid.circuits.circuit import SkinRC
from etid.likelihood import starts
from etid.likelihood.gains import Gains
from etid.likelihood.load import Load
from etid.likelihood.profile import Records
from etid.likelihood.source import Source
from etid.signals.transfer import delayed
from tests.test_driver import SOURCE

SKINS = {"dry": SkinRC(33.4e3, 186e3, 0.12e-9), "damp": SkinRC(6.1e3, 17.4e3, 0.66e-9)}
SETTLED = 20  # iterations
SUMS = 1e-2  # straight lines between the knots; one step of a fit corrects a hundredth
FREQUENCY = 60.0 * np.arange(1.0, 1667.0)
Z_TH = np.asarray(SOURCE.response(FREQUENCY))
RATE = 200e3
DRAWS = 64


def start(z, delay=0.0, sigma=0.0, draws=1):
    """The skin and the delay of the likeliest start, for each draw.

    A pulse of 4 % duty whose spectrum falls as 1/f, behind `SOURCE`, with noise on both records.
    """
    k = np.arange(1.0, FREQUENCY.size + 1)
    x = 50 * np.sin(0.04 * np.pi * k) / (np.pi * k) + 0.01j / k
    y = delayed(x * z / (z + Z_TH), FREQUENCY, delay, RATE)
    parts = np.random.default_rng(5).standard_normal((4, draws, k.size)) * sigma / np.sqrt(2)
    x, y = x + parts[0] + 1j * parts[1], y + parts[2] + 1j * parts[3]
    variance, used = np.full(x.shape, sigma**2), np.ones((draws, 1, k.size), bool)
    frequency, none = np.tile(FREQUENCY, (draws, 1)), np.zeros(0)
    numbers = np.zeros((0, k.size), complex), np.asarray(0.0), none, np.diag(none), np.asarray(0.5)
    source = Source(FREQUENCY, Z_TH, np.zeros(k.size, complex), *numbers)
    records = Records(frequency, x, variance, y[:, None], variance[:, None], used)
    load = Load(Gains(source, SkinRC(), frequency, RATE), records, np.zeros(4), np.full(4, np.inf))
    likeliest = starts.starts(load)[0]
    return np.exp(likeliest[:, :3]), likeliest[:, 3]


def errors(found, name):
    return np.log(found / SKINS[name].values())


@pytest.mark.parametrize("name", SKINS)
@pytest.mark.parametrize("delay", [0.0, 0.08, -0.3])
def test_exact_harmonics_give_the_skin_and_the_delay(name, delay, monkeypatch):
    monkeypatch.setattr(starts, "STEPS", SETTLED)
    skin, found = start(SKINS[name].response(FREQUENCY), delay)
    assert np.abs(errors(skin, name)).max() < SUMS
    assert found == pytest.approx(delay, abs=SUMS)


@pytest.mark.parametrize("name", SKINS)
def test_noise_leaves_no_bias(name):
    """Errors of 64 draws; without the compensation they are all one way, by tens of per cent."""
    # A hundredth of a volt in each coefficient: 40 dB and three periods have half of that.
    skins, _ = start(SKINS[name].response(FREQUENCY), 0.0, 2e-3, DRAWS)
    error = errors(skins, name)
    mean, scatter = error.mean(0), error.std(0, ddof=1)
    # Of second order in the noise some is left, as of every non-linear estimate.
    assert (np.abs(mean) < 5 * scatter / np.sqrt(DRAWS) + scatter**2 + SUMS).all()
