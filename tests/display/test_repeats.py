"""Old windows: noise that comes back is no measurement, and equal codes alone prove nothing."""

import numpy as np
import pytest

from etid.display import Controller, repeats
from etid.display.repeats import SAMPLES, SHIFT, Windows
from tests.display.test_online import TEN, ten, with_noise

STEP = 5.7e-3  # [V] of a converter
LONG = 40 * 16  # samples of a window


def windows_of(electrodes):
    return Windows.of(((0, 2), (32, 38)), 16, electrodes)


def drawn(rng, electrodes=3):
    return STEP * np.rint(2 * rng.standard_normal((electrodes, LONG)))


def test_a_window_that_comes_back_is_old_at_any_distance():
    """Each electrode has its own windows, and a state does not see those of later pulses."""
    rng, windows = np.random.default_rng(0), windows_of(3)
    stream = [drawn(rng) for _ in range(3000)]
    for number, v in enumerate(stream, 1):
        assert not windows.repeated(v, number).any()
    for ago in (1, 2, 9, 20, 50, 1000, 2990):
        back = stream[-ago].copy()
        assert windows.repeated(back, 3001).all()
        back[1] = drawn(rng)[1]
        assert windows.repeated(back, 3002).tolist() == [True, False, True]
        of_others = stream[-ago][[1, 0, 2]]
        assert windows.repeated(of_others, 3003).tolist() == [False, False, True]
    assert not windows.repeated(stream[100], 101).any()  # the same pulse once more
    assert not windows.repeated(stream[100], 50).any()
    assert windows.repeated(stream[100], 102).all()


@pytest.mark.parametrize("shift", range(-SHIFT - 1, SHIFT + 2))
def test_a_window_that_comes_back_beside_its_place_is_old(shift):
    """A ring of other than whole periods; shifts beyond `SHIFT` are misfits."""
    rng, windows = np.random.default_rng(1), windows_of(3)
    longer = np.concatenate([drawn(rng), drawn(rng)], axis=1)
    assert not windows.repeated(longer[:, 10 : 10 + LONG], 1).any()
    assert not windows.repeated(drawn(rng), 2).any()
    begin = 10 + shift
    found = windows.repeated(longer[:, begin : begin + LONG], 3)
    assert found.all() == (abs(shift) <= SHIFT)


@pytest.mark.parametrize("noise", [0.05, 0.15, 0.3, 1.0])
def test_codes_that_are_equal_by_chance_are_not_old_and_noise_of_a_sixth_of_a_code_is_enough(noise):
    """Levels and slopes of all kinds [codes], as in the quiet of a pulse, with noise [codes]."""
    rng, number = np.random.default_rng(2), np.arange(LONG)
    level = [0 * number, 0 * number + 0.25, 0 * number + 0.5, 0.02 * number, 0.2 * number + 0.1]
    windows, equal, before = windows_of(len(level)), 0, set()
    v = np.zeros((len(level), LONG))
    for pulse in range(1, 401):
        v = STEP * np.rint(np.array(level) + noise * rng.standard_normal((len(level), LONG)))
        assert not windows.repeated(v, pulse).any()
        rows = {row.tobytes() for row in v}
        equal, before = equal + len(rows & before), before | rows
    assert (equal > 300) == (noise == 0.05)  # so often windows are equal by chance
    found = windows.repeated(v, 401)
    assert found[2]  # on the edge of a code
    assert found[3] == (noise >= 0.15)
    assert found.all() == (noise >= 0.3)


def test_windows_of_two_codes_have_different_fingerprints():
    """200 million pairs of windows; 40 bits differ in all but one of 5000 such draws."""
    rng = np.random.default_rng(3)
    part = np.concatenate(
        [np.where(rng.random((10_000, SAMPLES + 1 + 2 * SHIFT)) < p, 1, 2) for p in (0.5, 0.05)]
    )
    prints = repeats._fingerprints(STEP * part)[:, SHIFT]
    assert np.unique(prints).size == prints.size


def test_samples_that_are_no_numbers_and_silence_are_not_old():
    windows, nothing = windows_of(3), np.zeros((3, LONG))
    nothing[1], nothing[2] = np.nan, np.inf
    for number in range(1, 4):
        assert not windows.repeated(nothing, number).any()


def test_a_ring_of_old_windows_ends_with_amplitude_0_and_an_alarm():
    """All electrodes at once, when the skin may have become wet; until the noise is new."""
    tracker, state, clean = ten()
    controller = Controller.of(tracker, charge_cap=120e-9)
    names = tracker.model.circuit.names()
    assert len(names) == 3
    pulses = with_noise(np.resize(clean, (32, *clean.shape[1:])), seed=7)
    for v_out in pulses[8:28]:
        state = tracker.update(state, v_out)
    assert set(controller.command(state, charge=80e-9).reason) == {"wanted"}
    ring, alarms = np.roll(pulses[8:28], 1, axis=-1), []
    amplitude = np.ones(TEN)
    for v_out in [*ring, *ring]:
        state = tracker.update(state, v_out, amplitude)
        command = controller.command(state, charge=80e-9)
        assert set(command.reason) == {"repeated"}
        assert (command.amplitude == 0).all()
        assert np.isnan(command.charge).all()
        alarms += tracker.changes(state)
        amplitude = command.amplitude
    [alarm] = alarms
    assert (alarm.pulse, alarm.electrode, alarm.kind) == (29, None, "repeated")
    fits = tracker.read(state)
    assert set(fits.verdicts) == {"repeated"}
    assert "Check the acquisition" in str(fits[0])
    # Noise is new at half of the electrodes, whose pulses begin again far below a short circuit.
    v_out = ring[0].copy()
    v_out[::2] = with_noise(0 * v_out, seed=9)[::2]
    state = tracker.update(state, v_out, 0.0)
    command = controller.command(state, charge=80e-9)
    assert command.reason.tolist() == ["fallback", "repeated"] * (TEN // 2)
    np.testing.assert_allclose(command.amplitude[::2], float(controller.limits.fallback))
    assert (command.amplitude[1::2] == 0).all()
    assert tracker.changes(state) == []
    # What was identified is forgotten, the windows are not.
    for after, old in ((state, True), (None, False)):
        new = tracker.start(after=after)
        assert not np.asarray(new.electrodes.pulses).any()
        new = tracker.update(new, ring[1])
        assert set(np.asarray(new.electrodes.repeated)) == {old}


def test_a_state_does_not_change_when_others_follow_it():
    """Two streams from one state, and one of them again from its own."""
    tracker, state, clean = ten()
    one, other = with_noise(clean[:2], seed=11), with_noise(clean[:2], seed=12)
    for pulses in (one, other, one):
        after = state
        for v_out in pulses:
            after = tracker.update(after, v_out)
            assert not np.asarray(after.electrodes.repeated).any()
    assert np.asarray(tracker.update(after, one[0]).electrodes.repeated).all()
