"""A gain or an amplitude that is not the stated one, and another circuit, pulse by pulse."""

import dataclasses
import functools

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

import etid
from benchmarks.display.online_alarms import LOADS, Fingertip
from benchmarks.failure_axes import Cole, TwoLayers
from etid.display import Tracker
from etid.display.alarms import SEEN_IN_PULSES, SPREAD
from etid.display.pulse_fit import GainModel
from etid.likelihood.noise import MISFIT_CHI2
from etid.results.verdicts import verdict_names
from etid.simulation.scenes import Trial
from tests.display.test_online import LOADS as SKINS
from tests.display.test_online import (
    NOISE,
    TEN,
    TRUTH,
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
from tests.skins import off

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
    # Of its other errors R_p would be 50 off.
    values = np.asarray(tracker.read(state).circuit.values())
    truth = np.tile([dataclasses.astuple(skin) for skin in SKINS.values()], (TEN // 2, 1))
    assert (np.abs(values - truth) < 5 * np.asarray(tracker.read(state).stderr.values())).all()


GAIN, A_SPREAD = range(2)  # rows of the scores


def of_row(row, tracker, pulses):
    """Sums of one test after some pulses: s, I and c of each electrode."""
    return np.asarray(followed(tracker, pulses).electrodes.scores)[:, row].T


of_gain = functools.partial(of_row, GAIN)


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
    bands = tracker.model.bands
    without = dataclasses.replace(bands, variance_x=0 * bands.variance_x)
    of_source = of_gain(with_model(bands=without), pulses)[2]
    np.testing.assert_allclose(of_source, expected, rtol=0.05)
    assert (common > of_source).all()  # by the noise of the unloaded record
    assert (score**2 < 16 * (information + common**2)).all()


def pulses_of(make):
    """Six pulses of other skins at ten electrodes, dry and damp in turn, without noise."""
    trials = tuple(Trial(name, make(skin)) for name, skin in SKINS.items())
    late = dataclasses.replace(scene(6, snr_db=None, bits=None), trials=trials, start=0.3e-6)
    return np.tile(ten()[0].pulses(loaded(late.simulate(seed=0))), (1, TEN // 2, 1))


@pytest.mark.parametrize(
    "make", [functools.partial(Cole, alpha=0.98), functools.partial(TwoLayers, share=0.05)]
)
def test_skin_that_is_not_one_rc_is_refused_within_two_pulses(make):
    """Cole skin was `successful` with R_s 5 (dry) and 10 % (damp) off, 35 and 54 of its errors."""
    tracker, *_ = ten()
    found, _ = verdicts_of_pulses(tracker, with_noise(pulses_of(make), seed=3))
    assert (found[SOON - 1 :] == "misfit").all()


turned = eqx.filter_jit(GainModel.turned)


@pytest.mark.parametrize("delay", [-1.23, 0.0, 0.049, 0.4321, 1.5])
def test_a_delay_turns_each_band_by_its_own_phase(delay):
    """To the first neglected term of the series, for up to 0.05 samples from the table."""
    model = ten()[0].model
    angle = np.asarray(model.turn)
    limit = (0.05 * np.abs(angle).max()) ** 8 / 40_320 + 5e-14  # rounding
    found = turned(model, jnp.asarray(delay))
    np.testing.assert_allclose(found, np.exp(1j * angle * delay), rtol=0, atol=limit)


outputs = eqx.filter_jit(GainModel.expected)


@pytest.mark.parametrize("skin", SKINS)
def test_the_spread_of_a_gain_is_that_of_the_exponent_of_j_omega(skin):
    """Against central differences of the gain with (jω)^(1 + ε) in the time constant."""
    tracker, *_ = ten()
    model, step, of = tracker.model, 1e-5, SKINS[skin]
    log_s = np.log(2j * np.pi * np.asarray(model.bands.frequency))
    source = np.asarray(model.source)

    def gain(epsilon):
        z = of.r_s + of.r_p / (1 + np.exp((1 + epsilon) * log_s) * of.r_p * of.c_p)
        return z / (z + source)

    expected = outputs(model, etid.SkinRC(of.r_s, of.r_p, of.c_p).log_values())
    np.testing.assert_allclose(expected.gain, gain(0.0), rtol=1e-9)
    slope = (gain(step) - gain(-step)) / (2 * step)
    # Curvature makes errors of step², and rounding of ε/step; G is at most 1.
    np.testing.assert_allclose(expected.spread, slope, rtol=1e-6, atol=1e-9)


def test_the_score_is_that_of_a_spread():
    """Against other skin, in small steps: it has the information by which a test divides it."""
    (tracker, *_), step = ten(), 1e-3
    more, less = (
        of_row(A_SPREAD, tracker, with_noise(pulses_of(functools.partial(Cole, alpha=alpha)), 4))
        for alpha in (1 + step, 1 - step)
    )
    # 2 % as of the gain: the elements follow, by half a per cent of R_s.
    np.testing.assert_allclose((more[0] - less[0]) / (2 * step), more[1], rtol=0.02)


def test_a_spread_alone_makes_a_misfit():
    """At 46 dB, where neither χ² of a pulse nor the test of the gain shows Cole's α = 0.98."""
    tracker, *_ = ten()
    clean = pulses_of(functools.partial(Cole, alpha=0.98))
    noise = 5 * NOISE * np.random.default_rng(6).standard_normal(clean.shape)
    state, refused = tracker.start(), 0
    for v_out in clean + noise:
        state = tracker.update(state, v_out)
        score, information, common = np.moveaxis(np.asarray(state.electrodes.scores), -1, 0)
        scatter = np.sqrt(information + common**2)
        beyond = np.abs(score) - SEEN_IN_PULSES * scatter
        blind = (np.asarray(state.electrodes.chi2) < MISFIT_CHI2) & (beyond[:, GAIN] < 0)
        spread = beyond[:, A_SPREAD] > SPREAD * information[:, A_SPREAD]
        said = verdict_names(state.electrodes.result)
        np.testing.assert_array_equal(said[blind & spread], "misfit")
        np.testing.assert_array_equal(said[blind & ~spread], "successful")
        refused += int((blind & spread).sum())
    assert refused > TEN


@pytest.mark.parametrize(("skin", "amplitude"), [("dry", 0.1), ("damp", 0.3)])
def test_weak_pulses_at_40_db_have_the_errors_that_they_state(skin, amplitude):
    """Twenty pulses; the noise is that of 40 dB for pulses of the whole amplitude."""
    draws, lane, z = 8, list(SKINS).index(skin), []
    tracker, *_ = ten()
    clean = amplitude * tracker.pulses(loaded(quiet()))[:, lane : lane + 1]
    for seed in range(draws):
        rng = np.random.default_rng(seed)
        noise = 10 * NOISE * rng.standard_normal((20, TEN, clean.shape[-1]))
        pulses = clean[np.arange(20) % len(clean)] + noise
        _, state = verdicts_of_pulses(tracker, pulses, amplitude)
        z += list(off(tracker.read(state).usable(), TRUTH[lane]))
    assert len(z) > 0.98 * draws * TEN
    assert np.abs(z).max() < 5  # one of 240 normal numbers in 7 000 such tests
    # The calibration has 60 dB, so that the electrodes err independently. 0.1 % beyond each limit.
    low, high = scipy.stats.chi2.ppf([0.0005, 0.9995], len(z))
    squares = np.sum(np.square(z), axis=0)
    assert ((low < squares) & (squares < high)).all(), np.sqrt(squares / len(z))


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
