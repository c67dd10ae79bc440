"""A stimulator whose quartz is not that of the converter."""

import functools

import numpy as np
import pytest

from etid.display import Tracker
from etid.display.clock import Clock
from etid.display.stream import Pulses
from etid.recordings.preflight import Inspected
from etid.results.verdicts import verdict_names
from etid.simulation.transformer import loading
from tests.display.test_online import (
    LOADS,
    NOISE,
    PERIOD,
    PULSES,
    RATE,
    TEN,
    TRUTH,
    calibrated,
    scene,
    ten,
    tiled,
)
from tests.skins import off

MANY = 60


@functools.cache
def exact():
    """A sampler, and V_out of dry and damp skin in the steady state."""
    sampler, v_th, z_th, _ = scene(3)._exact()
    return sampler, [v_th * loading(load(sampler.f), z_th) for load in LOADS.values()], v_th


def drifting(spectra, ppm, pulses=MANY):
    """A record of pulses that come later and later (electrode, time), without noise [V]."""
    sampler, ends = exact()[0], [round(n * PERIOD * (1 + 1e-6 * ppm)) for n in range(pulses + 1)]
    rows = []
    for v in spectra:
        starts = [at / RATE - n * (1 + 1e-6 * ppm) / PULSES for n, at in enumerate(ends)]
        parts = [
            sampler.sample(v, after - at, start)
            for at, after, start in zip(ends[:-1], ends[1:], starts, strict=False)
        ]
        rows.append(np.concatenate(parts))
    return np.stack(rows)


def noisy(v, seed):
    return v + NOISE * np.random.default_rng(seed).standard_normal(v.shape)


@pytest.mark.parametrize("ppm", [-50.0, 5.0, 50.0, 100.0])
def test_pulses_of_another_quartz_are_tracked_to_the_end(ppm):
    """At 50 ppm they are ten samples late after a second; a delay of 1.5 samples is a misfit."""
    tracker, *_ = ten()
    record = noisy(tiled(drifting(exact()[1], ppm)), seed=1)
    state, found = tracker.start(), []
    pulses = tracker.pulses(record)
    assert len(pulses) >= MANY - 1
    for v_out in pulses:
        state = tracker.update(state, v_out)
        found.append(verdict_names(state.electrodes.result))
        assert not bool(state.driver_changed)
    assert set(np.ravel(found)) == {"successful"}
    assert (np.abs(off(tracker.read(state), tiled(TRUTH))) < 4).all()


def test_an_unloaded_record_of_another_quartz_has_its_own_period():
    """12 windows of a period that is wrong by 5 ppm smear the pulse by a fifth of a sample."""
    driver, study = calibrated()
    ppm = 5.0
    v = noisy(drifting([exact()[2], *exact()[1]], ppm, 12), seed=2)
    record = study["cal/0"].replace(v_th=v[0], v_out=v[1])
    tracker = Tracker.of(driver, record, electrodes=TEN)
    assert tracker.period == pytest.approx(PERIOD * (1 + 1e-6 * ppm), abs=1e-6 * PERIOD)
    assert Inspected.of(study["cal/0"]).exact_spacing == PERIOD


def blocks(v, size=500):
    for first in range(0, v.shape[1], size):
        yield first, v[:, first : first + size]


def test_a_clock_finds_pulses_again_after_lost_samples_and_goes_on_through_a_rest():
    tracker, ppm = ten()[0], 40.0
    late = 1e-6 * ppm * PERIOD  # from pulse to pulse
    v = noisy(drifting(exact()[1], ppm, 150), seed=3)
    rest = slice(round(50 * PERIOD), round(90 * PERIOD))
    v[:, rest] = 0.01 * v[:, rest]  # no pulses, but noise
    gone = round(110 * PERIOD) + 1500
    v = np.concatenate([v[:, :gone], v[:, gone + 100 :]], axis=1)  # 100 samples are lost
    pulses = Pulses(tracker.clock(), len(v))
    wrong = []
    for number, _ in pulses.cut(blocks(v)):
        true = number * (PERIOD + late) - (100 if number > 110 else 0)
        wrong.append(abs(pulses.clock.begin - true) > 1.1)  # half a sample, and what a load delays
    # Two pulses that agree move the clock.
    np.testing.assert_array_equal(np.flatnonzero(wrong), [111, 112])
    assert pulses.missing == 0


def test_noise_alone_moves_no_clock():
    rng, pulse = np.random.default_rng(0), ten()[0].model.bands.waveform()
    clock = Clock(PERIOD, pulse)
    for number in range(200):
        assert clock.begin == round(number * PERIOD)
        clock.follow(rng.standard_normal((2, pulse.size)))
    clock.follow(np.full((2, pulse.size), np.nan))


@pytest.mark.parametrize("size", [100, 3333, 3334])
def test_a_window_that_begins_before_the_end_of_the_last_one_has_all_its_samples(size):
    """Pulses that come earlier and earlier: a block may have ended with the last window."""
    tracker = ten()[0]
    v = noisy(drifting(exact()[1], -100.0), seed=4)
    pulses = Pulses(tracker.clock(), len(v))
    for _, window in pulses.cut(blocks(v, size)):
        begin = pulses.clock.begin
        np.testing.assert_array_equal(window, v[:, begin : begin + window.shape[1]])
    assert pulses.clock.number >= MANY - 1
    assert (pulses.late, pulses.missing) == (0, 0)
