"""On-line identification of loads that are no circuit."""

import dataclasses
import functools

import jax.numpy as jnp
import numpy as np
import pytest

import etid
from benchmarks import perturbed_study as lab
from benchmarks.inexact import inexact
from etid.display import Controller, Tracker
from etid.display.current import CurrentModel
from etid.display.discrepancy import Smooth

SIZE = 2e-3  # of δ
EACH = 8  # electrodes on dry, and as many on damp skin
PULSES = 6


@functools.cache
def display():
    """Skins behind one driver, each with a δ of its own."""
    study = lab.undisturbed(7100, 60.0)
    calibrations = tuple(dataclasses.replace(of, samples=40_000) for of in study.calibrations)
    trials = tuple(
        dataclasses.replace(of, path=f"{of.path}/{number}", samples=20_000)
        for of in study.trials
        for number in range(EACH)
    )
    truths = {of.path: study.truths[of.path.rpartition("/")[0]] for of in trials}
    study = dataclasses.replace(study, calibrations=calibrations, trials=trials, truths=truths)
    return inexact(study, SIZE, 1.0)


@functools.cache
def recorded():
    records = display().recordings()
    return list(records.calibrations.recordings()), list(records.loaded.recordings())


@functools.cache
def driver():
    return etid.identify_driver(recorded()[0])


@functools.cache
def followed():
    """Tracker, and its states after each pulse."""
    calibrations, records = recorded()
    of = {"electrodes": len(records), "discrepancy": SIZE}
    tracker = Tracker.of(driver(), calibrations[0], **of)
    states = [tracker.start()]
    for v_out in tracker.pulses(np.stack([record.v_out for record in records])):
        states.append(tracker.update(states[-1], v_out))
    assert len(states) == PULSES + 1
    return tracker, states


def errors(fits):
    """Errors and ± of logarithms (electrode, element)."""
    low = np.array([display().truths[str(record.path)].low for record in recorded()[1]])
    values = np.stack([np.asarray(one.circuit.values()) for one in fits])
    stderr = np.stack([np.asarray(one.stderr.values()) for one in fits])
    return np.log(values / low), stderr / values


def test_what_the_circuit_leaves_is_in_the_verdict_in_the_errors_and_in_the_weights():
    tracker, states = followed()
    fits = tracker.read(states[-1])
    assert {one.verdict for one in fits} == {"approximate"}
    assert len(fits.usable()) == len(fits)
    error, stderr = errors(fits)
    # 16 draws of a function that is not the usual one; 2.0 exceeds what χ² of 16 does once in 10⁶.
    rms = np.sqrt(np.mean((error / stderr) ** 2, 0))
    assert (rms < 2.0).all()
    assert (rms > 0.25).all()
    # Weights of the noise err by 3 to 4 % of R_s and C_p (`python -m benchmarks inexact`).
    assert (np.sqrt(np.mean(error**2, 0))[[0, 2]] < 0.015).all()
    first = errors(tracker.read(states[1]))[1]
    assert (stderr < first).all()
    assert (stderr > 0.4 * first).all(), "pulses do not lessen what the circuit leaves"
    # What is the same in each pulse is no noise.
    bands = np.asarray(states[-1].noise.bands)
    assert 0.8 < np.median(bands) < 1.25


def test_the_charge_of_a_pulse_has_it_in_its_error():
    tracker, states = followed()
    controller = Controller.of(tracker)
    command = controller.command(states[-1], charge=50e-9)
    assert (command.reason != "fallback").all()
    sums, f = np.asarray(controller.model.sums[0]), np.asarray(controller.model.frequency)
    loads = [of.out.loads[0] for of in display().trials]
    true = [
        np.sum(sums / (load(f) + of.out.driver.z_th(f))).real
        for load, of in zip(loads, display().trials, strict=True)
    ]
    z = (command.amplitude * true - command.charge) / command.charge_stderr
    rms = np.sqrt(np.mean(z.reshape(2, EACH) ** 2, 1))
    assert (rms < 2.2).all(), "eight draws; χ² of 8 exceeds it once in 10⁵"
    without = CurrentModel.of(dataclasses.replace(tracker.model, discrepancy=None))
    exact = dataclasses.replace(controller, model=without).command(states[-1], charge=50e-9)
    assert (exact.charge_stderr < 0.5 * command.charge_stderr)[:EACH].all()


def test_parts_of_variance_1_are_made_of_noise_and_error():
    rng = np.random.default_rng(0)
    functions = rng.standard_normal((3, 5))
    gain = rng.standard_normal(5) + 1j * rng.standard_normal(5)
    weight = np.array([1.0, 10.0, 0.0, 3.0, 1e4])
    smooth = Smooth.of(jnp.asarray(functions), jnp.asarray(gain), jnp.asarray(weight))
    draws = rng.standard_normal((200_000, 2, 3)) @ functions
    delta = draws[:, 0] + 1j * draws[:, 1]
    noise = rng.standard_normal((200_000, 2, 5))
    residual = np.sqrt(weight) * gain * delta + noise[:, 0] + 1j * noise[:, 1]
    parts = np.asarray(smooth(jnp.asarray(residual)))
    unit = parts.conj().T @ parts / len(parts) / 2
    np.testing.assert_allclose(unit, np.eye(5), atol=0.02)  # five standard errors
    np.testing.assert_allclose(
        np.asarray(smooth.undone(jnp.asarray(parts[:3]))), residual[:3] * np.asarray(smooth.phase)
    )
    other = rng.standard_normal((2, 5)) + 1j * rng.standard_normal((2, 5))
    one, two = smooth(jnp.asarray(residual[:2])), smooth.transposed(jnp.asarray(other))
    products = [np.real(np.sum(np.conj(a) * b, -1)) for a, b in ((one, other), (residual[:2], two))]
    np.testing.assert_allclose(*products)


@pytest.mark.parametrize("given", [-0.1, 1.0, np.nan])
def test_a_discrepancy_that_is_no_part_of_a_signal_is_refused(given):
    with pytest.raises(ValueError, match="discrepancy is"):
        Tracker.of(driver(), recorded()[0][0], electrodes=1, discrepancy=given)
