"""Noise before the filter, and what an instrument adds: against closed forms of linear systems."""

import dataclasses
from typing import Any

import numpy as np
import pytest
import scipy.linalg
import scipy.signal

import etid
from etid.simulation.electronics import INSTRUMENTS, Electronics
from etid.simulation.scenes import Scene, Trial
from etid.simulation.transformer import OpenLoad, ResistorLoad, SkinLoad

RATE = 200e3  # [Hz]
DRY = SkinLoad(33.4e3, 186e3, 0.12e-9)
FIVE_SIGMA = 5.0  # one in 2e6; with fixed seeds a test passes always or never


def spectrum(order, corner, f):
    """Power of sampled noise behind a Butterworth filter, relative to that of its samples.

    The covariance of the filter's state driven by white noise solves a Lyapunov equation; that of
    the output after a time is C exp(A t) P Cᵀ. The sum over all multiples of the sampling time has
    every alias in it.
    """
    a, b, c, _ = scipy.signal.zpk2ss(*scipy.signal.buttap(order))
    p = scipy.linalg.solve_continuous_lyapunov(a, -b @ b.T)
    step = scipy.linalg.expm(a * 2 * np.pi * corner / RATE)
    lags = np.empty(400)
    for n in range(lags.size):
        lags[n] = (c @ p @ c.T).item()
        p = step @ p
    turns = np.outer(f / RATE, np.arange(1, lags.size))
    return 1 + 2 * np.cos(2 * np.pi * turns) @ (lags[1:] / lags[0])


@pytest.mark.parametrize(
    ("order", "corner", "rtol"),
    # A filter of first order passes 0.4 % of the noise above the last frequency that is folded.
    [(1, 30e3, 1e-2), (2, 45e3, 1e-4), (4, 80e3, 1e-6), (8, 90e3, 1e-6)],
)
def test_noise_before_the_filter_has_the_folded_power_of_the_filter(order, corner, rtol):
    f = np.linspace(100.0, RATE / 2, 50)
    found = Electronics(filter_order=order).noise_power(f, corner, RATE)
    np.testing.assert_allclose(found, spectrum(order, corner, f), rtol=rtol)
    above = Electronics(filter_order=order).noise_power(RATE - f, corner, RATE)
    np.testing.assert_allclose(above, found, rtol=1e-9)  # the same noise, folded


def test_a_filter_of_each_type_has_its_corner_and_passes_slow_signals():
    of = {kind: Electronics(filter_type=kind) for kind in ("butterworth", "average", "delta_sigma")}
    for kind, gain in {"butterworth": 0.5**0.5, "average": 0.5**0.5, "delta_sigma": 0.5}.items():
        found = np.abs(of[kind].response(np.array([0.0, 0.45e5, 1e5]), 1e5))
        assert found[[0, 2]] == pytest.approx([1.0, gain], rel=1e-5)
    zeros, poles, gain = scipy.signal.buttap(3)
    f = np.geomspace(1e2, 1e7, 30)
    _, expected = scipy.signal.freqs_zpk(zeros, poles, gain, f / 1e5)  # pyright: ignore
    found = Electronics(filter_order=3).response(f, 1e5)
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    passes = of["delta_sigma"].response(np.array([0.4535, 0.5465, 3.0]) * RATE, 0.5 * RATE)
    np.testing.assert_allclose(passes, [1.0, 0.0, 0.0], atol=1e-12)
    # Means over the whole time between two samples share no noise, so they are white. Half a per
    # cent of their noise comes from above the last frequency that is folded.
    white = of["average"].noise_power(np.linspace(0, RATE / 2, 9), 0.442946 * RATE, RATE)
    np.testing.assert_allclose(white, 1.0, rtol=1e-2)


def test_records_have_this_noise_and_no_period():
    of, corner, count = Electronics(noise_corner=2e3), 0.3 * RATE, 400
    noise = of.noise(np.random.default_rng(0), 2.0, (count, 1000), corner, RATE)
    white = Electronics().noise(np.random.default_rng(0), 2.0, (count, 1000), corner, RATE)
    # Neighbours are correlated: a record has 0.6 as many independent samples as it has samples.
    relative = FIVE_SIGMA / np.sqrt(2 * 0.6 * white.size)
    assert white.std() == pytest.approx(2.0, rel=relative)
    window = np.hanning(1000)
    power = np.mean(np.abs(np.fft.rfft(noise * window)) ** 2, axis=0) / np.sum(window**2) / 4.0
    f = np.fft.rfftfreq(1000, 1 / RATE)
    expected = of.noise_power(f, corner, RATE)
    inside = slice(5, -3)  # the window mixes the first bins, where 1/f noise is steep
    error = power[inside] / expected[inside] - 1
    assert np.abs(error).max() < FIVE_SIGMA / np.sqrt(count)
    assert abs(error.mean()) < FIVE_SIGMA / np.sqrt(count * error.size / 2)
    # The ends of a record are as far apart as they look.
    ends = np.corrcoef(white[:, :5].T, white[:, -5:].T)[:5, 5:]
    assert np.abs(ends).max() < FIVE_SIGMA / np.sqrt(count)


def exact(scene):
    """The scene with nothing but its filter."""
    of = scene.electronics
    filtering = Electronics(of.filter_type, of.filter_order)
    return dataclasses.replace(scene, snr_db=None, electronics=filtering)


def records(scene, seed=0):
    """Loaded records [V at the converter] with and without noise."""
    noisy, clean = scene.simulate(seed), exact(scene).simulate(seed)
    return [
        scene.scale * np.array([study[trial.path].v_out for trial in scene.trials])
        for study in (noisy, clean)
    ]


def of(electronics, count=1, load: Any = DRY, **settings: Any):
    trials = tuple(Trial(f"x/{i}", load) for i in range(count))
    usual: dict[str, Any] = {"snr_db": None, "bits": None}
    return Scene(trials, electronics=electronics, **{**usual, **settings})


def test_snr_is_that_of_the_noise_behind_the_filter():
    scene = of(Electronics(), 20, load=OpenLoad(), snr_db=40.0)
    noisy, clean = records(scene)
    relative = FIVE_SIGMA / np.sqrt(2 * 0.6 * noisy.size)
    assert (noisy - clean).std() == pytest.approx(clean[0].std() / 100, rel=relative)
    assert scene.waveform().sigma * scene.scale == pytest.approx(clean[0].std() / 100, rel=1e-6)


def test_a_stream_gets_the_noise_of_the_records_without_their_rounding():
    electronics = Electronics(filter_order=2, converter_noise=1e-3)
    scene = of(electronics, load=OpenLoad(), snr_db=50.0)
    noise = scene.noise(np.random.default_rng(0), (40, 1000))
    relative = FIVE_SIGMA / np.sqrt(2 * 0.6 * noise.size)
    assert noise.std() == pytest.approx(scene.waveform().sigma, rel=relative)
    power = np.mean(np.abs(np.fft.rfft(noise)) ** 2, axis=0) / 1000
    expected = np.interp(np.fft.rfftfreq(1000, 1 / RATE), *scene_noise(scene)) ** 2
    bands = (power / expected)[:500].reshape(10, 50).mean(axis=1)
    np.testing.assert_allclose(bands, 1.0, atol=FIVE_SIGMA / np.sqrt(40 * 50))


def scene_noise(scene):
    """Frequencies, and the noise of a scene there."""
    waveform = scene.waveform()
    inside = waveform.f < RATE / 2
    return waveform.f[inside], waveform.noise[inside]


def test_each_part_of_the_electronics_adds_what_it_says():
    noisy, clean = records(of(Electronics(converter_noise=1e-3), 20))
    relative = FIVE_SIGMA / np.sqrt(2 * noisy.size)
    assert (noisy - clean).std() == pytest.approx(1e-3, rel=relative)

    noisy, clean = records(of(Electronics(gain_drift=0.01), 100, samples=500))
    gains = np.sum(noisy * clean, axis=1) / np.sum(clean**2, axis=1)
    np.testing.assert_allclose(noisy, gains[:, None] * clean, atol=1e-12)
    assert gains.std() == pytest.approx(0.01, rel=FIVE_SIGMA / np.sqrt(200))

    noisy, clean = records(of(Electronics(hum=0.02, hum_rate=60.0), 4))
    turns = np.exp(-2j * np.pi * 60.0 / RATE * np.arange(10_000))  # three whole periods
    hum = 2 * np.mean((noisy - clean) * turns, axis=1)
    np.testing.assert_allclose(np.abs(hum), 0.02, rtol=1e-9)
    assert np.ptp(np.angle(hum)) > 0.1  # each record has its own phase

    noisy, clean = records(of(Electronics(nonlinearity=0.01), full_scale=4.0))
    expected = 0.04 * np.sin(np.pi * clean / 4.0)
    np.testing.assert_allclose(noisy - clean, expected, atol=1e-12)


def test_a_seed_and_a_path_give_one_record_whatever_the_other_trials_are():
    three = of(Electronics(converter_noise=1e-3, hum=0.01), 3, snr_db=50.0)
    alone = dataclasses.replace(three, trials=three.trials[2:])
    first, again, other = (
        study["x/2"].v_out for study in (three.simulate(3), alone.simulate(3), three.simulate(4))
    )
    np.testing.assert_array_equal(first, again)
    assert np.any(first != other)
    # Delays and offsets are those of the scene without electronics.
    late: dict[str, Any] = {"trigger_jitter_rms": 1e-6, "offset_rms": 0.1}
    with_none, ideal = (of(one, **late).simulate(3)["x/0"].v_out for one in (None, Electronics()))
    np.testing.assert_allclose(ideal, with_none, atol=1e-9)


@pytest.mark.parametrize("name", INSTRUMENTS)
def test_every_instrument_records_and_has_a_bound(name):
    calibration = (Trial("calibration/0", ResistorLoad(98.8e3)),)
    scene = Scene((Trial("a", DRY),), calibration, snr_db=50.0, samples=7000, **INSTRUMENTS[name])
    noisy, clean = records(scene)
    sigma = scene.waveform().sigma * scene.scale
    # Beside noise and rounding, nonlinearity, gain, offset: together at most one step of 8 bits.
    assert 0.9 * sigma < (noisy - clean).std() < sigma + scene.full_scale / 128
    assert "noise at 50 dB before the filter" in str(scene)
    assert 0 < etid.bound(scene)["a"].relative["r_p"] < 0.1


def test_a_filter_that_takes_signal_and_noise_alike_takes_no_information():
    """Only the noise that it folds costs some: 3 % here."""
    known = (Trial("calibration/0", ResistorLoad(98.8e3)),)

    def relative(order, corner):
        usual = {"bits": None, "antialias": corner / RATE}
        scene = Scene(
            (Trial("a", DRY),), known, electronics=Electronics(filter_order=order), **usual
        )
        # As much noise at low frequencies before every filter.
        low = 20 * np.log10(scene.waveform().noise[0])
        scene = dataclasses.replace(scene, snr_db=60.0 + low + 40.0)
        return np.array(list(etid.bound(scene)["a"].relative.values()))

    np.testing.assert_allclose(relative(8, 70e3), relative(8, 90e3), rtol=0.03)
    np.testing.assert_allclose(relative(6, 70e3), relative(8, 90e3), rtol=0.03)


def test_the_bound_of_a_resistor_from_its_current_has_a_closed_form():
    """Y = R I, both with noise: the information on ln R is 2 Σ |R I|² / (σ_Y² + R² σ_I²)."""
    r = 55.2e3
    electronics = Electronics(filter_order=2, noise_corner=500.0, converter_noise=2e-4)
    scene = Scene(
        (Trial("a", ResistorLoad(r)),), current_snr_db=50.0, bits=None, electronics=electronics
    )
    [found] = etid.bound(scene, delays=False).values()
    waveform = scene.waveform()
    current = waveform.v_th / (r + waveform.z_th)
    shape = electronics.noise_power(waveform.f, 0.4 * RATE, RATE)
    sigma = 1e-3 * np.sqrt(2 * np.sum(np.abs(waveform.v_th) ** 2))
    noise = sigma**2 * shape + (2e-4 / scene.scale) ** 2
    noise += (r * scene.current_noise(current)) ** 2 * shape
    inside = waveform.f < RATE / 2
    information = 2 * scene.samples * np.sum(np.abs(r * current[inside]) ** 2 / noise[inside])
    assert found.relative["r"] == pytest.approx(information**-0.5, rel=1e-6)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"filter_type": "elliptic"}, "use one of butterworth"),
        ({"filter_order": 0}, "use 1 to 12"),
        ({"converter_noise": -1.0}, "converter_noise is -1.0"),
        ({"hum": np.inf}, "hum is inf"),
    ],
)
def test_electronics_that_cannot_be_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        Electronics(**settings)


@pytest.mark.slow
def test_what_a_card_that_becomes_warmer_does_to_skin_is_as_large_as_the_guide_says():
    """0.11 % and seven standard errors of R_p at 70 dB; a tenth of this drift costs nothing."""

    def fits(gain_drift, seeds=6):
        electronics = Electronics(gain_drift=gain_drift)
        settings: dict[str, Any] = {"snr_db": 70.0, "samples": 20_000, "antialias": 5.0}
        known = (Trial("calibration/0", ResistorLoad(98.8e3)),)
        scene = Scene((Trial("a", DRY),), known, electronics=electronics, **settings)
        for seed in range(seeds):
            study = scene.simulate(seed)
            yield etid.identify_skin(
                study["a"], etid.identify_driver(study["calibration/0"]), throw=False
            )

    error, z = {}, {}
    for drift in (25e-6, 2.5e-6):
        found = list(fits(drift))
        off = np.array([float(fit.circuit.r_p) / DRY.r_p - 1 for fit in found])
        own = np.array([float(fit.stderr.r_p) / DRY.r_p for fit in found])
        error[drift], z[drift] = (np.sqrt(np.mean(of**2)) for of in (off, off / own))
    # A root mean square of six draws scatters by 30 %.
    assert 0.6e-3 < error[25e-6] < 1.7e-3
    assert z[25e-6] > 4
    assert z[2.5e-6] < 1.6
