"""Aliases of edges do not reach the averages, whatever the clock of the pulses."""

import dataclasses

import numpy as np
import pytest
from scipy.signal import czt

import etid
from etid.recordings.preflight import Inspected
from etid.signals.averaging import (
    PLACES,
    Aliases,
    aliases_of,
    left,
    longer,
    weighted,
    weights,
)
from etid.signals.harmonics import harmonics
from etid.signals.periods import Periods
from etid.simulation.scenes import Electronics
from tests.skins import off

RATE, PULSES = 200e3, 60.0


def periods_of(v, spacing, periods):
    return Periods.of(v[None], spacing * np.arange(periods)[None], RATE / PULSES)


def beyond(power, fall):
    return Aliases(np.array(power), np.array(fall), np.array(fall))


def sampled(spacing, samples, highest):
    """Pulses with edges, and the same behind a filter of first order at 10 kHz; its gain.

    Their harmonics go up to `highest` times the sample rate.
    """
    number = np.arange(1, int(highest * spacing))
    size = np.sin(np.pi * 0.0413 * number) / (np.pi * number) * np.exp(-2j * np.pi * 0.3 * number)
    size *= np.exp(-np.square(number / (0.6 * spacing)))  # edges of a sample, which do not ring
    gain = 1 / (1 + 1j * number * PULSES / 10e3)
    turn = np.exp(2j * np.pi / spacing)
    return [2 * czt(np.append(0, of), samples, turn).real for of in (size, size * gain)], gain


@pytest.mark.parametrize("ppm", [15.0, -15.0, 20.0])
@pytest.mark.parametrize(("periods", "highest"), [(3, 1.0), (5, 1.4), (6, 1.4)])
def test_the_weighted_mean_has_no_aliases(periods, highest, ppm):
    spacing = RATE / PULSES * (1 + 1e-6 * ppm)
    samples = round(periods * RATE / PULSES)
    both, gain = sampled(spacing, samples, highest)
    noise = np.full(samples // (2 * periods), 1e-14)
    of = periods_of(both[0], spacing, periods)
    aliases = aliases_of(of, np.array([spacing]), noise[None]).take(0)
    assert aliases.power > 0
    by = weights(spacing, periods, noise[: PLACES.size], aliases)
    errors = []
    for x, y in (
        harmonics(np.stack(both), periods, samples),
        weighted(np.stack(both), spacing, by),
    ):
        loud = np.abs(x) > 0.3 * np.median(np.abs(x))
        ratio = np.abs(y / x / gain[: x.size] - 1)
        errors.append(np.median(ratio[100:600][loud[100:600]]))  # 6 to 36 kHz
    # The rest is that of harmonics which are not exactly at the bins.
    assert errors[1] < max(errors[0] / 4, 1e-4)


@pytest.mark.parametrize("ppm", [0.0, 15.0, 50.0])
def test_the_clock_is_known_to_a_hundredth_of_a_sample(ppm):
    """Without a filter: aliases of the edges are a tenth of the spectrum at a tenth of the rate."""
    scene = etid.scenes.paper_dry(antialias=3.5, snr_db=60.0, samples=20_000, pulse_rate_ppm=ppm)
    scene = dataclasses.replace(scene, trials=scene.trials[:1])
    one = scene.simulate(seed=0)[scene.trials[0].path]
    of = periods_of(np.asarray(one.v_th), RATE / PULSES, 6)
    [found], [error] = longer(of, np.array([RATE / PULSES]))
    assert error < 0.001
    assert found == pytest.approx(-RATE / PULSES * 1e-6 * ppm, abs=0.002)


def test_weights_are_equal_where_the_clock_needs_no_others():
    noise = np.ones(PLACES.size)
    np.testing.assert_allclose(weights(3333 + 1 / 3, 6, noise, beyond(1.0, 8.0)), 1 / 6)
    # Aliases that cannot be told from the signal, or do not exceed the noise.
    np.testing.assert_allclose(weights(3333.0, 4, noise, beyond(1.0, 8.0)), 1 / 4)
    np.testing.assert_allclose(weights(3333.1, 4, noise, beyond(1e-14, 8.0)), 1 / 4)


def test_noise_is_not_enlarged_for_aliases_below_it():
    """To remove those of twice the sample rate, too, would cost 26 times the power of the noise."""
    aliases = beyond(0.02, 9.0)
    by = weights(3333.466, 6, np.ones(PLACES.size), aliases)
    assert (6 * np.square(by).sum(-1) + left(by, 3333.466, aliases)).max() < 1.2


@pytest.mark.parametrize("kind", ["dry", "damp"])
def test_a_converter_without_a_filter_and_a_clock_of_its_own(kind):
    """Aliases leaked into the harmonics: damp skin was `inconsistent`, three of four."""
    scene = getattr(etid.scenes, f"paper_{kind}")(
        antialias=3.5,
        snr_db=60.0,
        samples=20_000,
        pulse_rate_ppm=15.0,
        trigger_jitter_rms=50e-9,
    )
    scene = dataclasses.replace(scene, trials=scene.trials[:3])
    study = scene.simulate(seed=0)
    driver = etid.identify_driver(study["calibration/98k8"])
    fits = etid.identify_skins(study.loaded.recordings(), driver)
    assert fits.counts() == {"successful": 3}
    truth = scene.truth()[scene.trials[0].path]
    for fit in fits:
        assert (np.abs(off(fit, np.array(list(truth.values())))) < 4.0).all()
        assert fit.chi2 < 1.15  # five standard deviations


@pytest.mark.parametrize(("snr_db", "ppm"), [(40.0, -40.0), (70.0, 45.0)])
def test_without_a_filter_nothing_is_lost_with_much_noise_nor_refused_with_little(snr_db, ppm):
    """Standard errors were 7 times the bound at 40 dB; at 70 dB the skin was `changed`."""
    scene = etid.scenes.paper_damp(
        antialias=3.5,
        snr_db=snr_db,
        samples=20_100,
        pulse_rate_ppm=ppm,
        trigger_jitter_rms=50e-9,
    )
    scene = dataclasses.replace(scene, trials=scene.trials[:3])
    study = scene.simulate(seed=1)
    driver = etid.identify_driver(study["calibration/98k8"])
    fits = etid.identify_skins(study.loaded.recordings(), driver)
    assert fits.counts() == {"successful": 3}
    path = scene.trials[0].path
    for fit in fits:
        assert (np.abs(off(fit, np.array(list(scene.truth()[path].values())))) < 4.0).all()
        # The bound knows no aliases, but leaves the driver free at each frequency. Alone, the mean
        # over six periods has up to 1.1 times the variance.
        stderr = np.array(list(fit.stderr.values()))
        assert (stderr < 1.25 * np.array(list(etid.bound(scene)[path].stderr.values()))).all()


def test_a_steep_filter_leaves_no_aliases_where_the_clocks_agree():
    """The noise hides how fast the spectrum falls behind the filter, not that it falls."""
    scene = etid.scenes.paper_dry(
        electronics=Electronics(filter_order=7), antialias=0.37, snr_db=50.0, samples=20_100
    )
    scene = dataclasses.replace(scene, trials=scene.trials[:3])
    for one in scene.simulate(seed=0).loaded.recordings():
        assert Inspected.of(one).aliases is None
