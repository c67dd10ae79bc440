"""A gain or an amplitude that is not the stated one, and another circuit, pulse by pulse."""

import dataclasses
import functools

import jax.numpy as jnp
import numpy as np
import pytest

import etid
from benchmarks.failure_axes import Cole, TwoLayers
from benchmarks.online_alarms import LOADS, Fingertip
from etid.online.tracker import Tracker
from etid.results.verdicts import verdict_names
from etid.simulation.scenes import Trial
from tests.test_online import LOADS as SKINS
from tests.test_online import (
    NOISE,
    TEN,
    after_amplitude,
    calibrated,
    followed,
    loaded,
    quiet,
    scene,
    ten,
    tracker_of,
    with_noise,
)

SOON = 2  # pulses after which 1 % must be refused at 60 dB


def verdicts_of_pulses(tracker, pulses, amplitude=1.0):
    """Verdicts after each pulse (pulse, electrode), and the last state."""
    state, found = after_amplitude(tracker.start(), amplitude), []
    for v_out in pulses:
        state = tracker.update(state, v_out, amplitude)
        found.append(verdict_names(state.electrodes.result))
    return np.array(found), state


@pytest.mark.parametrize("factor", [0.98, 0.99, 1.01, 1.02])
@pytest.mark.parametrize(
    ("told", "change"), [(False, 0.0), (True, 0.0), pytest.param(False, 1e-3, id="skin may vary")]
)
def test_one_per_cent_of_gain_or_amplitude_is_refused_within_two_pulses(factor, told, change):
    """R_p of dry skin would be 20 % wrong, at a χ² that noise alone can have."""
    _, _, clean = ten()
    tracker = tracker_of(TEN, change)
    amplitude = 1 / factor if told else 1.0
    pulses = with_noise((1.0 if told else factor) * clean, seed=3)
    found, _ = verdicts_of_pulses(tracker, pulses, amplitude)
    assert (found[SOON - 1 :] != "successful").all()


@pytest.fixture(scope="module")
def at_40_db():
    """A tracker of ten electrodes whose calibration has 40 dB, and 24 pulses without noise."""
    study = scene(12, snr_db=40.0, trigger_jitter_rms=50e-9).simulate(seed=0)
    driver = etid.identify_driver(list(study.calibrations.recordings()))
    tracker = Tracker.of(driver, study["cal/0"], electrodes=TEN)
    clean = np.tile(tracker.pulses(loaded(quiet())), (1, TEN // 2, 1))
    return tracker, np.concatenate([clean] * 2)


@pytest.mark.parametrize(
    ("factor", "skin", "half"), [(0.99, "dry", 3), (0.995, "dry", 20), (0.98, "damp", 7)]
)
def test_gains_at_40_db_are_refused_by_half_of_the_electrodes_about_as_soon_as_said(
    at_40_db, factor, skin, half
):
    """The guide has the medians of three drivers; that of five electrodes scatters by a third."""
    tracker, pulses = at_40_db
    noise = 10 * NOISE * np.random.default_rng(3).standard_normal(pulses.shape)
    found, _ = verdicts_of_pulses(tracker, factor * pulses + noise)
    refused = found[half - 1 :, ("dry", "damp").index(skin) :: 2] != "successful"
    assert refused.all(axis=0).mean() > 0.5


@pytest.mark.parametrize("factor", [0.99, 1.01])
def test_a_gain_that_changes_under_way_is_refused_and_the_old_one_is_good_again(factor):
    """At some electrodes: at all of them it would be the driver."""
    tracker, state, clean = ten()
    some = np.where(np.arange(TEN) < 3, factor, 1.0)[:, None]
    pulses = with_noise(clean[: 2 * SOON + 1], seed=4)
    for v_out in some * pulses[:SOON]:
        state = tracker.update(state, v_out)
    for v_out in some * pulses[SOON : 2 * SOON]:
        state = tracker.update(state, v_out)
        wrong = verdict_names(state.electrodes.result) != "successful"
        np.testing.assert_array_equal(wrong, np.arange(TEN) < 3)
        confirmed = np.asarray(state.electrodes.confirmed) > 0
        np.testing.assert_array_equal(confirmed, ~wrong)
    state = tracker.update(state, pulses[2 * SOON])
    assert set(verdict_names(state.electrodes.result)) == {"successful"}


def test_a_gain_that_does_not_matter_is_never_refused():
    """0.09 % moves R_p of dry skin by 1.8 %; many pulses show it, and the limit is 2 %."""
    tracker, _, clean = ten()
    pulses = with_noise(0.9991 * np.concatenate([clean] * 4), seed=5)
    found, state = verdicts_of_pulses(tracker, pulses)
    score, information, common = np.asarray(state.electrodes.scores)[:, 0].T
    assert (score**2 > 25 * (information + common**2)).any()
    assert set(found.ravel()) == {"successful"}


def of_gain(tracker, pulses):
    """Sums of the test after some pulses: s, I and c of each electrode."""
    return np.asarray(followed(tracker, pulses).electrodes.scores)[:, 0].T


def test_the_score_is_that_of_the_gain_and_its_error_that_of_the_driver():
    """Against other pulses and another Z_th, in small steps."""
    (tracker, _, clean), step = ten(), 1e-4
    pulses = with_noise(clean[:4], seed=4)
    score, information, common = of_gain(tracker, pulses)
    more, less = (of_gain(tracker, factor * pulses)[0] for factor in (1 + step, 1 - step))
    np.testing.assert_allclose((more - less) / (2 * step), information, rtol=0.02)

    def with_model(**fields):
        return dataclasses.replace(tracker, model=dataclasses.replace(tracker.model, **fields))

    def shifted(error):
        source = tracker.model.source
        sides = (of_gain(with_model(source=source * (1 + by)), pulses)[0] for by in (error, -error))
        return np.subtract(*sides) / (2 * step)

    by_source = np.stack([shifted(step * error) for error in tracker.model.source_error])
    expected = np.sqrt((by_source**2).sum(axis=0))
    without = dataclasses.replace(tracker.model.bands, variance_x=jnp.zeros(()))
    of_source = of_gain(with_model(bands=without), pulses)[2]
    np.testing.assert_allclose(of_source, expected, rtol=0.05)
    assert (common > of_source).all()  # by the noise of the unloaded record
    assert (score**2 < 16 * (information + common**2)).all()


@pytest.mark.parametrize(
    "make", [functools.partial(Cole, alpha=0.98), functools.partial(TwoLayers, share=0.05)]
)
def test_skin_that_is_not_one_rc_is_refused_within_two_pulses(make):
    """Cole skin was `successful` with R_s 5 (dry) and 10 % (damp) off, 35 and 54 of its errors."""
    tracker, *_ = ten()
    trials = tuple(Trial(name, make(skin)) for name, skin in SKINS.items())
    quiet = dataclasses.replace(scene(6, snr_db=None, bits=None), trials=trials, start=0.3e-6)
    clean = np.tile(tracker.pulses(loaded(quiet.simulate(seed=0))), (1, TEN // 2, 1))
    found, _ = verdicts_of_pulses(tracker, with_noise(clean, seed=3))
    assert (found[SOON - 1 :] == "misfit").all()


def test_a_circuit_without_time_constants_has_no_spread():
    driver, study = calibrated()
    tracker = Tracker.of(driver, study["cal/0"], electrodes=1, circuit=etid.Resistor())
    pulses = tracker.pulses(study["cal/1"].v_out[None])
    found, state = verdicts_of_pulses(tracker, pulses)
    assert set(found.ravel()) == {"successful"}
    gain, spread = np.asarray(state.electrodes.scores)[0]
    assert (gain[1:] > 0).all()
    np.testing.assert_array_equal(spread, 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("snr_db", [60.0, 40.0])
def test_undisturbed_electrodes_are_never_refused_at_a_hundred_thousand_pulses(snr_db):
    """The limit is one in ten million for each."""
    electrodes, squares = 96, []
    display = Fingertip(electrodes, snr_db)
    state = display.tracker.start()
    for v_out in display.pulses(np.arange(electrodes) % len(LOADS), 1050):
        state = display.tracker.update(state, v_out)
        assert set(verdict_names(state.electrodes.result)) == {"successful"}
        score, information, common = np.asarray(state.electrodes.scores).T
        squares.append(score**2 / (information + common**2))
    # All have the error of one calibration, so that their z are nearly one number.
    assert (np.mean(squares, axis=(0, 2)) < 3**2).all()
