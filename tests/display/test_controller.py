"""The controller: the wanted charge, limits that hold, and no command without its reason."""

import dataclasses
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

import etid
from etid.display import Controller, Tracker
from etid.display.controller import RAISE
from etid.results.verdicts import verdict
from etid.simulation.transformer import SkinLoad, TransformerDriver
from tests.display.test_live import alone
from tests.display.test_online import (
    DAMP,
    DRY,
    PULSES,
    TEN,
    TRUTH,
    calibrated,
    ten,
    tiled,
    with_noise,
)
from tests.skins import off

HARMONICS = 60.0 * np.arange(1, 30_001)  # to 1.8 MHz
POINTS = 1 << 16


def true_current(load):
    """One period of the current in the steady state, from the circuit of the transformer [A]."""
    driver = TransformerDriver()
    i = driver.v_th_spectrum(HARMONICS) * PULSES / (load(HARMONICS) + driver.z_th(HARMONICS))
    return np.fft.irfft(np.concatenate([[0], i, np.zeros(POINTS // 2 - i.size)]), POINTS) * POINTS


def controlled(**limits):
    """A controller for ten electrodes, dry and damp in turn, and the state after eight pulses."""
    tracker, state, _ = ten()
    return Controller.of(tracker, **limits), state


def with_lanes(state, **fields):
    """The state with these fields at each of its electrodes."""
    given = {
        name: jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (TEN, *leaf.shape)), of)
        if name == "result"
        else jnp.asarray(tiled(of))
        for name, of in fields.items()
    }
    return dataclasses.replace(state, electrodes=dataclasses.replace(state.electrodes, **given))


def true_charge(load):
    """Charge in the phase of the unloaded voltage [C]."""
    driver = TransformerDriver()
    v = driver.v_th_spectrum(HARMONICS) * PULSES
    v = np.fft.irfft(np.concatenate([[0], v, np.zeros(POINTS // 2 - v.size)]), POINTS)
    below = np.flatnonzero(v <= 0)
    top = int(np.argmax(v))
    inside = slice(below[below < top].max(), below[below > top].min())
    return true_current(load)[inside].sum() / POINTS / PULSES


def test_the_charge_of_the_commanded_pulse_is_the_wanted_one():
    controller, state = controlled()
    command = controller.command(state, charge=80e-9)
    assert set(command.reason) == {"wanted"}
    delivered = command.amplitude * tiled([true_charge(DRY), true_charge(DAMP)])
    # The driver has one error for both; two standard errors, and 0.1 % by the finite bandwidth.
    assert (np.abs(delivered - 80e-9) < 2 * command.charge_stderr + 0.08e-9).all()
    np.testing.assert_allclose(command.charge, 80e-9, rtol=1e-12)
    by_current = controller.command(state, current=80e-9 / controller.model.phase)
    np.testing.assert_allclose(by_current.amplitude, command.amplitude, rtol=1e-12)


def test_the_standard_error_of_the_charge_is_what_other_calibrations_and_noise_make_of_it():
    """Noise: the derivative. Calibration: Z_th along z, with the gain of the pulses fixed."""
    controller, _ = controlled()
    model, circuit = controller.model, etid.SkinRC(*dataclasses.astuple(DRY))
    logs, step = jnp.asarray(circuit.log_values()), 1e-5
    nothing = jnp.zeros((3, 3))
    alone = dataclasses.replace(model, source_error=0 * model.source_error)
    current = eqx.filter_jit(alone.current)
    for i in range(3):
        low, high = (
            float(current(circuit, logs.at[i].add(s), nothing).charge) for s in (-step, step)
        )
        one = current(circuit, logs, nothing.at[i, i].set(1.0))
        # A central difference of a smooth function: error of the order of step².
        np.testing.assert_allclose(one.charge_stderr, abs(high - low) / 2 / step, rtol=1e-6)
    first = dataclasses.replace(model, source_error=model.source_error[:1])
    one = first.current(circuit, logs, nothing)
    # I = X (1 - G) / Z_th with G fixed: the admittance changes by -δ log Z_th.
    admittance = 1 / (circuit.response(model.frequency) + model.source)
    parts = admittance * model.source_error[0]
    shift = (model.sums[0] @ parts).real
    np.testing.assert_allclose(one.charge_stderr, jnp.abs(shift), rtol=1e-9)


@pytest.mark.parametrize("cap", [20e-9, 120e-9])
def test_the_fallback_is_what_a_short_circuit_may_carry_or_is_refused(cap):
    """The charge through a short circuit is that of the circuit of the transformer itself."""
    controller, state = controlled(charge_cap=cap)
    new = controller.command(controller.tracker.start(), charge=80e-9)
    delivered = new.amplitude * true_charge(SkinLoad(1e-3, 1e-3, 1e-12))
    # RAISE for the first pulse that is raised, 4.2 % for a pulse from rest, 1 % of calibration.
    assert (delivered < cap / RAISE).all()
    assert (delivered > 0.94 * cap / RAISE).all()
    np.testing.assert_allclose(new.worst, new.amplitude * controller.short)
    Controller.of(controller.tracker, charge_cap=cap, fallback=0.99 * new.amplitude[0])
    with pytest.raises(ValueError, match=r"charge_cap allows .* Give at most"):
        Controller.of(controller.tracker, charge_cap=cap, fallback=1.01 * new.amplitude[0])
    assert (controller.command(state, charge=80e-9).worst >= cap).all()


@pytest.mark.parametrize(
    ("confirmed", "before", "allowed"),
    [
        (1.0, 0.2, math.inf),  # a smaller amplitude since then does not count
        (0.1, 0.1, 0.1 * RAISE),
        (0.0, 0.1, 0.0),  # the last pulse was a jump, or the first one
        (1.0, 0.0, 0.0),  # there was no pulse: nothing was seen
    ],
)
def test_the_amplitude_rises_from_what_a_pulse_has_confirmed(confirmed, before, allowed):
    controller, state = controlled(charge_cap=120e-9)
    state = with_lanes(state, confirmed=[confirmed] * 2, amplitude=[before] * 2)
    command = controller.command(state, charge=110e-9)
    most = max(allowed, float(controller.limits.short))
    free = 110e-9 / tiled([true_charge(DRY), true_charge(DAMP)])
    # 1 % by the calibration; the second electrode is damp and may need less than it is allowed.
    np.testing.assert_allclose(command.amplitude, np.minimum(free, most), rtol=0.01)
    assert set(command.reason) <= {"wanted", "confirmed"}
    without, _ = controlled()
    command = without.command(state, charge=110e-9)
    assert set(command.reason) == {"wanted"}  # there is no cap that could be exceeded


@pytest.mark.parametrize(
    ("limits", "reason"),
    [
        ({"current_cap": 1e-3}, "guard"),
        ({"charge_cap": 50e-9}, "charge"),
        ({"voltage_cap": 10.0}, "voltage"),
    ],
)
def test_limits_hold_and_are_named(limits, reason):
    controller, state = controlled(**limits)
    command = controller.command(state, charge=400e-9)
    assert command.reason[0] == reason
    peaks = tiled([np.abs(true_current(load)).max() for load in (DRY, DAMP)])
    assert (command.amplitude * peaks <= limits.get("current_cap", np.inf)).all()
    # The caps on what is delivered hold with a margin of k standard errors.
    assert (command.charge < limits.get("charge_cap", np.inf)).all()
    if reason == "guard":  # it holds for pulses of either sign
        driver, study = calibrated(0)
        of = study["cal/0"]
        turned = of.replace(v_th=-of.v_th, v_out=-of.v_out)
        other = Controller.of(Tracker.of(driver, turned, electrodes=TEN), **limits)
        guards = [float(one.limits.guard) for one in (controller, other)]
        assert guards[1] == pytest.approx(guards[0], rel=1e-6)


@pytest.mark.parametrize("probability", [0.9, 1 - 1e-9])
def test_the_caps_leave_room_for_the_stated_probability(probability):
    """k from the tables of the normal distribution; σ as in the equations of the controller."""
    k = {0.9: 1.2815515655, 1 - 1e-9: 5.9978070150}[probability]
    caps = {"charge_cap": 50e-9, "probability": probability}
    (controller, state), model = controlled(**caps), ten()[0].model
    state = with_lanes(state, information=[0.01 * np.asarray(state.electrodes.information[0])] * 2)
    command = controller.command(state, charge=200e-9)
    assert set(command.reason) == {"charge"}
    spent = controller.model.rest * (command.charge + k * command.charge_stderr)
    np.testing.assert_allclose(spent, 50e-9, rtol=1e-9)
    assert (command.charge_stderr > 5e-4 * command.charge).all()  # k matters
    # Without the guard, which is smaller, the cap on the current acts.
    controller, _ = controlled(current_cap=0.4e-3, probability=probability)
    free = controller.limits._replace(guard=jnp.asarray(jnp.inf))
    command = dataclasses.replace(controller, limits=free).command(state, charge=200e-9)
    assert set(command.reason) == {"peak"}
    own, information = state.electrodes.own[0, :-1], state.electrodes.information[0]
    now = eqx.filter_jit(controller.model.current)(model.circuit, own, jnp.linalg.inv(information))
    spent = command.amplitude[0] * (now.peak + k * now.peak_stderr)
    np.testing.assert_allclose(spent, 0.4e-3, rtol=1e-6)
    assert now.peak_stderr > 5e-4 * now.peak
    # The fallback, too, has k errors of the calibrations.
    short = [float(controller.model.short_charge(jnp.asarray(of))) for of in (0.0, k)]
    assert controller.short == pytest.approx(short[1], rel=1e-9)
    assert short[1] > short[0] * (1 + 1e-5)


def test_an_electrode_that_is_not_good_gets_the_fallback_and_says_so():
    (controller, state), (tracker, _, clean) = controlled(fallback=0.2), ten()
    first = controller.command(tracker.start(), charge=80e-9)
    assert set(first.reason) == {"fallback"}
    assert (first.amplitude == 0.2).all()
    assert np.isnan(first.charge).all()
    pulse = with_noise(clean[8], seed=1)
    pulse[0] = np.nan
    command = controller.command(tracker.update(state, pulse), charge=80e-9)
    assert list(command.reason) == ["fallback", *["wanted"] * (TEN - 1)]
    assert "1 fallback" in str(command)
    changed = dataclasses.replace(state, driver_changed=jnp.asarray(True))
    assert set(controller.command(changed, charge=80e-9).reason) == {"fallback"}
    # Three times what damp skin needs: one bad pulse does not raise the amplitude of wet skin.
    controller, state = controlled(fallback=0.3)
    bad = with_lanes(state, amplitude=[0.1, 0.6], result=verdict("misfit"))
    found = controller.command(bad, charge=80e-9).amplitude
    np.testing.assert_allclose(found, tiled([0.1, 0.3]))
    lost = with_lanes(bad, pulses=[0, 0])  # a new electrode gets it
    np.testing.assert_allclose(controller.command(lost, charge=80e-9).amplitude, 0.3)


def test_the_fallback_obeys_the_limits_and_nothing_wanted_is_nothing_given():
    controller, state = controlled(fallback=0.5, slew=0.01)
    first = controller.command(controller.tracker.start(), charge=tiled([80e-9, 0.0]))
    np.testing.assert_allclose(first.amplitude, tiled([0.01, 0.0]))
    command = controller.command(with_lanes(state, amplitude=[0.1, 0.1]), charge=400e-9)
    np.testing.assert_allclose(command.amplitude, 0.11)
    assert set(command.reason) == {"slew"}


ANY = st.floats(allow_nan=True, allow_infinity=True)
NEGATIVE = [-59.5, -69.3, -16.2, -69.3, -10.3, -42.1, -16.2, -42.1, -14.9]  # variances


@settings(max_examples=20)
@given(
    own=st.lists(ANY | st.floats(-40, 40), min_size=8, max_size=8),
    information=st.lists(ANY | st.floats(-1e8, 1e8), min_size=18, max_size=18),
    before=st.lists(st.floats(0, 1e3) | st.just(math.nan), min_size=2, max_size=2),
    result=st.sampled_from(["successful", "misfit", "unstable", "unconnected"]),
    wanted=st.floats(0, 3e-6),  # what the cap of 5 mA carries in a phase
    confirmed=st.sampled_from([0.0, 1e3]),
    step=st.sampled_from([0.0, 1 / 255]),
)
@example(
    own=[10.42, 12.13, -22.85, -0.06] * 2,
    information=NEGATIVE * 2,
    before=[1.0, 1.0],
    result="successful",
    wanted=80e-9,
    confirmed=1e3,
    step=0.0,
)
def test_limits_hold_whatever_the_estimate_says(
    own, information, before, result, wanted, confirmed, step
):
    """A not-a-number in a limit was the amplitude."""
    caps = {"voltage_cap": 30.0, "slew": 0.5, "charge_cap": 120e-9}
    controller, state = controlled(amplitude_step=step, **caps)
    hostile = with_lanes(
        state,
        own=np.reshape(own, (2, 4)),
        information=np.reshape(information, (2, 3, 3)),
        amplitude=before,
        confirmed=[confirmed] * 2,
        result=verdict(result),
    )
    command = controller.command(hostile, charge=wanted)
    most = min(float(controller.limits.guard), float(controller.limits.ceiling))
    assert (command.amplitude >= 0).all()
    if step > 0:
        np.testing.assert_allclose(command.amplitude / step % 1, 0.0, atol=1e-9)
    assert (command.amplitude <= np.minimum(most, tiled(np.nan_to_num(before)) + 0.5)).all()
    if confirmed == 0 or result != "successful":
        assert (command.amplitude * true_charge(SkinLoad(1e-3, 1e-3, 1e-12)) <= 120e-9).all()


def in_steps(tracker, step):
    """Pulses of a stimulator that rounds to its steps: what is found, what it gives next."""
    pulses = alone()
    controller = Controller.of(tracker, charge_cap=120e-9, amplitude_step=step)
    state, before = tracker.start(at_rest=True), np.zeros(TEN)
    command = controller.command(state, charge=80e-9)
    for number in range(25):
        given = command.amplitude
        if step:
            given = step * np.rint(given / step)
            np.testing.assert_allclose(given, command.amplitude, rtol=1e-12)
        shapes = tiled([pulses[name][number % 3] for name in ("dry", "damp")])
        v = given[:, None] * shapes[:, 0] + before[:, None] * shapes[:, 1]
        state, before = tracker.update(state, with_noise(v, number), command.amplitude), given
        command = controller.command(state, charge=80e-9)
        yield tracker.read(state), command


@pytest.mark.parametrize("bits", [8, 10, 12])
def test_a_stimulator_of_a_few_bits_gives_what_it_is_told(bits):
    """Told another amplitude than was given, R_p is wrong by 20 times the error, silently."""
    (tracker, *_), step, seen, found = ten(), 1 / (2**bits - 1), 0, []
    for fits, command in in_steps(tracker, step):
        good = fits.verdicts == "successful"
        seen += int(good.sum())
        assert (np.abs(off(fits, tiled(TRUTH)))[good] < 5).all()
        found.append((fits, command))
    last, command = found[-1]
    assert set(command.reason) == {"wanted"}
    assert seen > 22 * TEN
    # With any amplitude and the same noise, the errors are the same in standard errors. The
    # amplitudes of damp skin differ by up to 2 % with 8 bits, and the noise relative to them.
    *_, (free, _) = in_steps(tracker, 0.0)
    truth = tiled(TRUTH)
    np.testing.assert_allclose(off(last, truth), off(free, truth), atol=0.25)
    np.testing.assert_allclose(last.stderr.values(), free.stderr.values(), rtol=0.04)
    delivered = command.amplitude * tiled([true_charge(DRY), true_charge(DAMP)])
    # Half a step, 0.5 % by the calibration, and the tail of the pulse before.
    half = 0.5 * step / command.amplitude
    assert (np.abs(delivered / 80e-9 - 1) < half + 0.005).all()
    if bits >= 10:
        assert (np.abs(command.charge / 80e-9 - 1) < 0.02).all()


def test_steps_that_are_too_coarse_to_rise_are_refused():
    tracker, *_ = ten()
    with pytest.raises(ValueError, match=r"too coarse: .* rises from there by a quarter"):
        Controller.of(tracker, charge_cap=20e-9, amplitude_step=1 / 255)
    with pytest.raises(ValueError, match=r"amplitude_step is -0\.1; give a step"):
        Controller.of(tracker, amplitude_step=-0.1)
