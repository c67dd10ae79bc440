"""The state of one electrode after a pulse, against the same rules written for one electrode."""

import dataclasses
import itertools
import types
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from etid.display import alarms, tick
from etid.display import state as states
from etid.display.alarms import MOVED, SEEN_IN_PULSES, SPREAD, PulseScores
from etid.display.gain_bands import Bands
from etid.display.noise import Noise
from etid.display.projection import BandSums
from etid.display.pulse_fit import Expected, GainModel
from etid.display.repeats import Windows
from etid.display.state import DRIFT, JUMP, NONE, REPEATED, ElectrodeState, TrackerState
from etid.display.tick import (
    PATIENCE,
    Attempt,
    Measured,
    Suspicion,
    after_pulse,
    anew,
    attempt,
    suspicion,
)
from etid.estimators.judgement import MAX_STEPS_REACHED, SUCCESSFUL
from etid.estimators.unknowns import LoadUnknowns
from etid.results.verdicts import RESULTS, verdict_names, verdicts_of

NUMBER, LIMIT = 77, 10.0
OLD, FOUND, FRESH = np.array([1.0, 2.0, 0.1]), np.array([1.1, 2.1, 0.2]), np.array([7.0, 2.2, 0.3])
BEFORE = np.array([[50.0, 5.0], [5.0, 40.0]])
TOLD, ALONE = np.array([[30.0, 2.0], [2.0, 20.0]]), np.array([[60.0, 3.0], [3.0, 70.0]])
SHAPE = np.array([[3.0, 1.0], [1.0, 2.0]])
GOOD, BAD, LATE = SUCCESSFUL, RESULTS.misfit, MAX_STEPS_REACHED


class Case(NamedTuple):
    """What may be so or otherwise."""

    running: bool
    jump: bool
    drift: bool
    found: bool
    fresh: str
    silent: bool
    missed: int
    off: bool
    near: bool
    gain: bool
    old: str


USUAL = Case(True, False, False, True, "good", False, 0, False, False, False, "no")
EITHER = (True, False)
KINDS: list[tuple[Any, ...]] = [
    *(EITHER, EITHER, EITHER, EITHER, ("good", "bad", "late"), EITHER, (0, PATIENCE - 1)),
    *(EITHER, EITHER, EITHER, ("no", "first", "again")),
]
CASES = [
    Case(*one)
    for one in itertools.product(*KINDS)
    if one[0] or not (one[1] or one[2])  # an electrode that does not run is not suspected
]
# NumPy's arrays stand in the place of JAX's.
MEASURED: Any = Measured
ATTEMPT: Any = Attempt
SCORES: Any = PulseScores
SUSPICION: Any = Suspicion
RESULT = {"good": GOOD, "bad": BAD, "late": LATE}


def electrode(of: Case) -> tuple[Any, ...]:
    """The arguments of `after_pulse`."""
    state = dict(
        own=OLD,
        information=9 * BEFORE,
        pulses=12 if of.running else 0,
        missed=of.missed,
        amplitude=0.5,
        offset=0.25,
        repeated=of.old == "again",
        scores=np.array([[30.0, 100.0, 1.0], [0.0, 1.0, 1.0]]),
        shape=SHAPE,
        confirmed=0.7,
        level=0.3,
        variance=0.4,
        chi2=0.9,
        rrse=0.01,
        result=RESULTS.insensitive,
        mean=np.array([0.2, 0.3]),
        mean_cov=0.01 * BEFORE,
        event=DRIFT,
        factor=np.array([0.5, 0.6]),
        element=1,
        drifted=5,
    )
    measured = MEASURED(
        gain=np.zeros(1, complex),
        variance=1.4,
        weight=np.array([1.5, 0.5]),
        line=np.zeros(0),
        level=1.3,
        amplitude=0.0 if of.silent else 2.0,
        offset=1.25,
        steady=True,
        repeated=of.old != "no",
        bad=RESULTS.unconnected if of.off else SUCCESSFUL,
    )
    sums = [[-150.0 if of.gain else 1.0, 90.0, 2.0], [1.0, 1.0, 0.0]]
    scores = SCORES(np.array(sums), np.array([0.5, -8.0]))
    result = GOOD if of.found else BAD
    noise = np.zeros(4), np.zeros((0, 4)), np.zeros(4)
    found = ATTEMPT(FOUND, TOLD, np.linalg.inv(TOLD), 1.9, 1.01, result, scores, *noise)
    own = np.array([*(OLD[:2] + 1e-3), 0.3]) if of.near else FRESH
    result = RESULT[of.fresh]
    fresh = ATTEMPT(own, ALONE, np.linalg.inv(ALONE), 2.9, 2.01, result, scores, *noise)
    z = np.array([0.1, 0.2])
    again = not of.running or of.jump or of.drift
    suspected = SUSPICION(of.jump, of.drift, again, np.array([0.7, 0.8]), 0.02 * BEFORE, 0, z)
    return state, measured, BEFORE, fresh if again else found, suspected, LIMIT, NUMBER


def expected(of: Case) -> dict[str, Any]:
    """The rules, one electrode at a time."""
    state, measured, before, used, suspected, limit, number = electrode(of)
    again = suspected.again
    good = of.fresh == "good" if again else of.found
    factor = (used.own - state["own"])[:2]
    # T = δᵀ (Λ⁻¹ + spread)⁻¹ δ, and the element that explains most of it alone.
    cov = np.linalg.inv(before) + used.spread
    inverse = np.linalg.inv(cov)
    statistic = factor @ inverse @ factor
    jumped = of.running and of.jump and good and bool(statistic > limit)
    drifted = of.running and of.drift and good and not jumped
    missed = 0 if good else of.missed + (0 if of.silent else 1)
    lost = of.running and (missed >= PATIENCE or of.off)
    information, pulses = before, state["pulses"]
    if good:
        new, old = map(np.linalg.cholesky, (used.information / 2, state["shape"]))
        turn = new @ np.linalg.inv(old)
        summed = turn @ before @ turn.T + used.information
        information = used.information if again else summed
        pulses = 1 if again else state["pulses"] + 1
    mean, mean_cov = state["mean"], state["mean_cov"]
    if good and not again:
        mean, mean_cov = suspected.mean, suspected.mean_cov
    elif good or lost:
        mean, mean_cov = 0 * mean, 0 * mean_cov
    begun = not of.running and of.fresh == "late"
    sums = state["scores"]
    if good:
        sums = used.scores.sums + (0 if again else sums)
    wrong_gain = good and of.gain  # by far, and by chance never
    confirmed = state["confirmed"] if of.silent else 0.0
    if of.running and good and not of.jump and not wrong_gain:
        confirmed = max(state["confirmed"], measured.amplitude)
    which = int(np.argmax((inverse @ factor) ** 2 / np.diagonal(inverse)))
    shown = {
        name: state[name] if of.silent else getattr(source, name)
        for name, source in (
            ("level", measured),
            ("variance", measured),
            ("chi2", used),
            ("rrse", used),
        )
    }
    return shown | {
        "own": used.own if good or begun else state["own"],
        "information": 0 * before if lost else information,
        "pulses": 0 if lost else pulses,
        "missed": missed,
        "amplitude": measured.amplitude,
        "offset": measured.offset,
        "repeated": measured.repeated,
        "confirmed": confirmed,
        "scores": sums,
        "shape": used.information / 2 if good else state["shape"],  # 2 is the weight
        "mean": mean,
        "mean_cov": mean_cov,
        "event": JUMP if jumped else DRIFT if drifted else REPEATED if of.old == "first" else NONE,
        "factor": factor if jumped or drifted else state["factor"],
        "element": which if jumped else 0 if drifted else state["element"],
        "drifted": number if drifted else state["drifted"],
        "result": state["result"] if of.silent else BAD if wrong_gain else used.result,
    }


def test_the_state_after_a_pulse_follows_its_rules_in_every_case():
    lanes = jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *map(electrode, CASES))
    after = jax.jit(jax.vmap(after_pulse))(ElectrodeState(**lanes[0]), *lanes[1:])
    found = {name: np.asarray(getattr(after, name)) for name in vars(after) if name != "result"}
    found["result"] = verdict_names(after.result)
    wrong = []
    for lane, of in enumerate(CASES):
        for name, value in expected(of).items():
            one = found[name][lane]
            if name == "result":
                same = one == verdict_names(value)
            else:
                same = np.allclose(one, value, rtol=1e-12, atol=1e-12)
            if not same:
                wrong.append((of, name, one, value))
    assert not wrong, (len(wrong), wrong[:3])


suspected_of = jax.jit(suspicion)


def test_a_pulse_is_suspected_by_the_distance_from_its_prediction():
    """T = δᵀ (Λ⁻¹ + cov)⁻¹ δ of the fit of the pulse alone, δ = δ₊ + cov Λ δ₊."""
    state, _, before, found, *_ = electrode(USUAL)
    off = (found.own - state["own"])[:2]
    alone = off + found.spread @ before @ off
    statistic = alone @ np.linalg.inv(np.linalg.inv(before) + found.spread) @ alone
    for running, good, part, jump, drift in (
        (True, True, 0.5, True, None),
        (True, True, 2.0, False, None),
        (True, False, 0.5, True, False),
        (True, False, 2.0, True, False),
        (False, True, 0.5, False, None),
        (False, False, 0.5, False, False),
    ):
        of = ElectrodeState(**jax.tree.map(jnp.asarray, state | {"pulses": 12 if running else 0}))
        fit = jax.tree.map(jnp.asarray, found._replace(result=GOOD if good else BAD))
        common, limit = jnp.array([0.6, 0.8]), jnp.asarray(part * statistic)
        seen = suspected_of(of, fit, jnp.asarray(before), common, limit)
        assert bool(seen.jump) == jump, (running, good, part)
        assert drift is None or bool(seen.drift) == drift, (running, good, part)
        assert bool(seen.again) == (not running or jump or bool(seen.drift))


class Minimum(NamedTuple):
    """What is found at the minimum of a pulse."""

    squares: Any
    curvature: Any = jnp.array([[50.0, 4.0, 3.0], [4.0, 40.0, -2.0], [3.0, -2.0, 9.0]])
    matrix: Any = jnp.eye(3)


def test_the_worst_that_a_pulse_shows_is_its_verdict(monkeypatch):
    """Bad samples, then no number, then no minimum, then a misfit or a delay out of its range."""
    rows = [  # verdict on the samples, delay, decrement, squares, verdict
        ("successful", 0.1, 0.1, 3.0, "successful"),
        ("saturated", 0.1, 0.1, 3.0, "saturated"),
        ("saturated", np.nan, 5.0, 9e9, "saturated"),
        ("successful", np.nan, 5.0, 9e9, "nonphysical"),
        ("successful", 0.1, 5.0, 9e9, "max_steps_reached"),
        ("successful", 0.1, np.nan, 3.0, "max_steps_reached"),
        ("successful", 0.1, 0.1, 9e9, "misfit"),
        ("successful", 1.7, 0.1, 3.0, "misfit"),
        ("successful", -1.7, 0.1, 3.0, "misfit"),
        ("successful", 1.4, 0.1, 3.0, "successful"),
    ]
    bad, delay, decrement, squares, verdict = map(np.array, zip(*rows, strict=True))
    weight, gain = np.array([3.0, 2.0, 0.0]), np.array([1 + 1j, 2j, 5.0])
    nothing, zero = PulseScores(jnp.zeros((2, 3)), jnp.zeros(2)), jnp.asarray(0.0)
    model = object.__new__(GainModel)  # only these two fields are read
    object.__setattr__(model, "bands", types.SimpleNamespace(weight=jnp.asarray(weight)))
    object.__setattr__(model, "noise_freedom", jnp.asarray(1000.0))
    monkeypatch.setattr(PulseScores, "of", lambda *_: (nothing, jnp.zeros(6)))
    monkeypatch.setattr(GainModel, "departure", lambda *_: jnp.zeros(3, complex))
    monkeypatch.setattr(GainModel, "patterns", lambda *_: jnp.zeros((0, 6)))
    pulse = types.SimpleNamespace(jacobian=lambda *_: jnp.zeros((3, 6)))
    monkeypatch.setattr("etid.display.tick.Pulse", lambda *_: pulse)

    @jax.jit
    @jax.vmap
    def attempted(bad, delay, decrement, squares):
        logs = jnp.concatenate([jnp.array([1.0, 2.0]), delay[None]])
        found = logs, Minimum(squares), decrement, jnp.zeros(6)
        monkeypatch.setattr("etid.display.tick.minimum", lambda *_: found)
        variance, level, one = jnp.asarray(0.01), jnp.asarray(0.5), jnp.asarray(1.0)
        measured = Measured(
            jnp.asarray(gain),
            variance,
            jnp.asarray(weight / 0.01),
            jnp.zeros(0),
            level,
            one,
            zero,
            one > 0,
            one,
            bad,
        )
        none = jnp.zeros(3, complex)
        expected = Expected(none, jnp.zeros((2, 3), complex), none, none)
        start = LoadUnknowns.of(logs)
        return attempt(model, measured, start, expected, jnp.zeros(2), jnp.zeros((2, 2)))

    numbers = map(jnp.asarray, (delay, decrement, squares))
    found = attempted(jax.tree.map(jnp.asarray, verdicts_of(bad)), *numbers)
    assert verdict_names(found.result).tolist() == verdict.tolist()
    # Two bands have two numbers each, and three are fitted.
    np.testing.assert_allclose(found.chi2, squares / (2 * 2 - 3))
    power = (weight * abs(gain) ** 2).sum()
    np.testing.assert_allclose(found.rrse, np.sqrt(squares * 0.01 / power))
    spread = np.linalg.inv(Minimum(0.0).curvature)[:2, :2]  # the delay is free
    every = (len(rows), 1, 1)
    np.testing.assert_allclose(found.spread, np.tile(spread, every))
    np.testing.assert_allclose(found.information, np.tile(np.linalg.inv(spread), every))


def test_a_gain_or_a_spread_is_wrong_if_all_noise_and_one_that_does_not_matter_are_less():
    """The variance is 16 by the pulses and 3² by the calibrations: a standard deviation of 5."""
    limit = MOVED / (SEEN_IN_PULSES * 5) * 16
    for score, moved, wrong in (
        (SEEN_IN_PULSES * 5.01, [0.0, 9.0], True),
        (-SEEN_IN_PULSES * 5.01, [-9.0, 0.0], True),
        (SEEN_IN_PULSES * 4.99, [0.0, 9.0], False),
        (SEEN_IN_PULSES * 10, [0.0, 1.01 * limit], True),
        (SEEN_IN_PULSES * 10, [0.0, 0.99 * limit], False),
        (np.nan, [0.0, 9.0], False),
    ):
        found = PulseScores(jnp.array([[score, 16.0, 3.0], [0.0, 1.0, 0.0]]), jnp.array(moved))
        assert bool(found.wrong()) == wrong
    information = 1e6
    for score, wrong in ((1.01, True), (-1.01, True), (0.99, False)):
        score *= SEEN_IN_PULSES * np.sqrt(information) + SPREAD * information
        sums = jnp.array([[0.0, 1.0, 0.0], [score, information, 0.0]])
        assert bool(PulseScores(sums, jnp.zeros(2)).wrong()) == wrong


# --- changes --------------------------------------------------------------------------------------


def test_an_innovation_and_its_moving_mean_are_those_of_their_formulas():
    d, direction = np.array([0.3, -0.2]), np.array([1.0, -2.0])
    spread = np.linalg.inv(TOLD)
    new = alarms.Innovation.of(*map(jnp.asarray, (d, spread, BEFORE)))
    cov = spread + np.linalg.inv(BEFORE)
    weight = np.linalg.inv(cov)
    np.testing.assert_allclose(new.cov, cov)
    np.testing.assert_allclose(new.statistic(), d @ weight @ d)
    along = direction @ weight @ d / np.sqrt(direction @ weight @ direction)
    np.testing.assert_allclose(new.along(jnp.asarray(direction)), along)
    mean = np.array([0.1, 0.4])
    moving = alarms.averaged(jnp.asarray(mean), jnp.asarray(BEFORE / 1e4), new)
    np.testing.assert_allclose(moving.d, 0.9 * mean + 0.1 * d)
    np.testing.assert_allclose(moving.cov, 0.81 * BEFORE / 1e4 + 0.01 * cov)
    np.testing.assert_allclose(moving.weight, np.linalg.inv(moving.cov))
    # An element that changes alone is named however well the others are known: (W e_i)_j² / W_jj is
    # largest for j = i, by Cauchy and Schwarz.
    root = np.random.default_rng(0).normal(size=(3, 3)) * [[1.0], [30.0], [0.1]]
    cov = jnp.asarray(root @ root.T)
    for number, d in enumerate(jnp.eye(3)):
        assert int(alarms.Innovation(d, jnp.linalg.inv(cov), cov).element()) == number


LANES = 20
SURE = alarms.DRIVER * 1.709 / np.sqrt(LANES) - 1.282  # nine tenths of z beyond it: the driver


driver_changed = jax.jit(alarms.driver_change)


@pytest.mark.parametrize("test", [0, 1])
def test_the_driver_has_changed_if_most_electrodes_move_one_way(test):
    """Those that do not count may move or be anything; one in ten may move the other way."""
    for z, jumps, counted, expected in (
        (0.0, 0, LANES, False),
        (SURE + 0.01, 0, LANES, True),
        (SURE - 0.01, 0, LANES, False),
        (-SURE - 0.01, 0, LANES, True),
        (-SURE + 0.01, 0, LANES, False),
        (0.0, LANES // 2, LANES, False),
        (0.0, LANES // 2 + 1, LANES, True),
        (0.0, 4, alarms.COMMON, False),
        (0.0, 5, alarms.COMMON, True),
        (0.0, 7, alarms.COMMON - 1, False),
        (99.0, 0, alarms.COMMON, True),
        (99.0, 0, alarms.COMMON - 1, False),
        (99.0, 0, 0, False),
    ):
        values = np.zeros((2, LANES))
        values[test] = z
        values[test, :1] = -z
        values[:, counted:] = -99.0
        values[test, counted + 1 :] = np.nan
        jumped, counts = np.arange(LANES) < jumps, np.arange(LANES) < counted
        jumped[counted:] = True
        running = np.arange(LANES) < 2 * counted - 1  # those that count are more than half of them
        found = driver_changed(*map(jnp.asarray, (jumped, values, counts, running)))
        assert bool(found) == expected, (z, jumps, counted)
    # A few electrodes in trouble are not the driver while the others change their amplitude.
    counts, running = np.arange(LANES) < alarms.COMMON, np.arange(LANES) < 2 * alarms.COMMON
    values = np.where(counts, 99.0, 0.0) * np.ones((2, 1))
    for jumped in (counts, ~counts):
        assert not bool(driver_changed(*map(jnp.asarray, (jumped, values, counts, running))))


@pytest.mark.parametrize("opposite", range(5))
def test_nine_tenths_of_the_electrodes_are_the_driver(opposite):
    values = np.full((2, LANES), SURE + 0.01)
    values[:, :opposite] *= -1
    counts, none = np.ones(LANES, bool), np.zeros(LANES, bool)
    found = driver_changed(*map(jnp.asarray, (none, values, counts, counts)))
    assert bool(found) == (LANES - opposite >= 0.9 * LANES)


def state_of(**fields: Any) -> TrackerState:
    """A state after pulse 100 of as many electrodes as a field has."""
    count = max(len(value) for value in fields.values())
    one = electrode(USUAL)[0]
    lanes: dict[str, Any] = {
        name: jnp.asarray(np.stack([value] * count))
        for name, value in one.items()
        if name != "result"
    }
    verdicts = fields.pop("verdicts", ["successful"] * count)
    lanes["result"] = jax.tree.map(jnp.asarray, verdicts_of(np.array(verdicts)))
    lanes |= {name: jnp.asarray(value) for name, value in fields.items()}
    no = jnp.asarray(False)
    empty = Windows(slice(0), np.zeros((0, 1), np.uint64), np.zeros((0, 1), np.uint32))
    noise = Noise.of(jnp.ones(2), 0, 1.0, count)
    return TrackerState(ElectrodeState(**lanes), noise, jnp.asarray(100), no, no, empty)


def test_what_a_pulse_has_shown_is_listed():
    factor = np.log([[2.0, 3.0], [4.0, 5.0], [6.0, 7.0]])
    state = state_of(
        event=np.array([NONE, JUMP, DRIFT]), element=np.array([0, 1, 0]), factor=factor
    )
    jump, drift = states.changes(state, ("r_s", "r_p"))
    assert (jump.pulse, jump.electrode, jump.kind, jump.element) == (100, 1, "jump", "r_p")
    assert (drift.electrode, drift.kind, drift.element) == (2, "drift", "r_s")
    np.testing.assert_allclose([jump.factor, drift.factor], [5.0, 6.0])
    assert jump.words("E2") == "jump of r_p, to 5 times its value, at E2"
    driver = dataclasses.replace(state, driver_event=jnp.asarray(True))
    [found] = states.changes(driver, ("r_s", "r_p"))
    assert (found.pulse, found.electrode, found.kind, found.element) == (100, None, "driver", "")
    assert np.isnan(found.factor)
    assert found.words("") == "the driver has changed; calibrate again"


@pytest.mark.parametrize(
    ("events", "listed", "where"),
    [
        ([REPEATED, JUMP, NONE, NONE], [(1, "jump"), (0, "repeated")], "at E1"),
        ([REPEATED, REPEATED, NONE, NONE], [(0, "repeated"), (1, "repeated")], "at E2"),
        ([REPEATED, REPEATED, REPEATED, JUMP], [(3, "jump"), (None, "repeated")], "at most elect"),
        ([REPEATED], [(0, "repeated")], "at E1"),
    ],
)
def test_windows_that_repeat_are_an_alarm_and_one_alarm_if_most_electrodes_do(
    events, listed, where
):
    count = len(events)
    state = state_of(
        event=np.array(events), element=np.zeros(count, int), factor=np.zeros((count, 2))
    )
    found = states.changes(state, ("r_s", "r_p"))
    assert [(one.electrode, one.kind) for one in found] == listed
    at = found[-1].electrode
    text = found[-1].words("" if at is None else f"E{at + 1}")
    assert text.startswith(f"old windows return {where}")
    assert "buffer is not filled" in text
    assert "Check the acquisition" in text
    assert len(f"Pulse 1234567: {text}") < 200  # bytes of an alarm of the live page


def test_an_electrode_that_cannot_be_used_has_the_first_reason_that_applies():
    last = 100 - states.RECENT
    cases = [  # level, impedance, pulses, drifted, verdict, reason
        (0.5, 1e3, 9, -1, "successful", None),
        (0.5, 1e3, 9, -1, "unconnected", "open"),
        (0.0199, 1e3, 9, -1, "unconnected", "open"),
        (0.0199, 1e3, 0, -1, "flat", "shorted"),
        (0.0201, 1e3, 0, -1, "flat", None),
        (0.5, 701e3, 1, -1, "misfit", "dry"),
        (0.5, 699e3, 1, -1, "misfit", None),
        (0.5, 701e3, 0, -1, "misfit", None),
        (0.5, 1e3, 9, last, "successful", None),
        (0.5, 1e3, 9, last + 1, "successful", "drifting"),
        (0.5, 701e3, 9, 100, "successful", "dry"),
    ]
    level, impedance, pulses, drifted, verdicts, reasons = map(list, zip(*cases, strict=True))
    state = state_of(
        level=np.array(level), pulses=np.array(pulses), drifted=np.array(drifted), verdicts=verdicts
    )
    found = states.bad_electrodes(state, np.array(impedance))
    assert found == {number: why for number, why in enumerate(reasons) if why}
    early = dataclasses.replace(state, number=jnp.asarray(5))  # none has drifted yet
    early = states.bad_electrodes(
        dataclasses.replace(
            early,
            electrodes=state_of(drifted=np.array([-1, 0]), pulses=np.array([1, 1])).electrodes,
        ),
        np.array([1e3, 1e3]),
    )
    assert early == {1: "drifting"}


# --- what a pulse shows ---------------------------------------------------------------------------


def test_the_size_of_a_pulse_and_its_samples_are_judged_by_the_rules(monkeypatch):
    """Level, offset and amplitude, and the first verdict that applies, from the measured gains."""
    weight = np.array([3.0, 2.0, 0.0])
    rows = [  # amplitude, amplitude before, mean, gain, variance, clipped, offset before, verdict
        (1.0, 1.0, 0.1, 0.5, 1e-3, False, 0.2, "successful"),
        (2.0, 1.0, 0.1, 0.5, 1e-3, False, 0.2, "successful"),
        (2.0, np.nan, 0.1, 0.5, 1e-3, False, 0.2, "successful"),
        (1.0, 0.905, 0.1, 0.5, 1e-3, False, 0.2, "successful"),
        (1.0, 0.895, 0.1, 0.5, 1e-3, False, 0.2, "successful"),
        (1.0, 1.0, 0.1, 0.5, np.nan, True, 0.2, "nonfinite_samples"),
        (1.0, 1.0, np.nan, 0.5, 1e-3, True, 0.2, "nonfinite_samples"),
        (1.0, 2.0, 0.1, 0.5, 1e-3, True, np.nan, "saturated"),
        (1.0, 2.0, 0.1, 1e-3, 1e-1, False, np.nan, "too_short"),
        (1.0, 1.0, 0.1, 1e-3, 1e-1, False, 0.2, "flat"),
        (0.0, 1.0, 0.1, 0.995, 1e-3, False, 0.2, "flat"),
        (1.0, 1.0, 0.1, 0.5, 1e-3, False, 0.2, "repeated"),
        (1.0, 1.0, 0.1, 0.9902, 1e-6, False, 0.2, "unconnected"),
        (1.0, 1.0, 0.1, 0.9898, 1e-6, False, 0.2, "successful"),
        (1.0, 1.0, 0.1, 1.0098, 1e-6, False, 0.2, "unconnected"),
        (1.0, 1.0, 0.1, 1.0102, 1e-6, False, 0.2, "successful"),
        (4.0, 4.0, 0.1, 4 * 0.9902, 1e-6, False, 0.2, "unconnected"),
        (1.0, 1.0, 0.1, np.sqrt(3.99e-2 * 4 / 5), 1e-2, False, 0.2, "flat"),
        (1.0, 1.0, 0.1, np.sqrt(4.01e-2 * 4 / 5), 1e-2, False, 0.2, "successful"),
    ]
    columns = [np.array(column) for column in zip(*rows, strict=True)]
    amplitude, before, mean, gain, variance, clipped, offset, verdict = columns
    used = []

    def measure(self, seen, noise, lacking, offset):
        used.append((np.asarray(lacking), np.asarray(offset)))
        wide = jnp.asarray(gain[:, None] * np.exp(1j * np.arange(3))[None, :])
        return wide, jnp.ones((len(rows), 3))

    monkeypatch.setattr(Bands, "measure", measure)
    bands = object.__new__(Bands)  # only its weights are read
    object.__setattr__(bands, "weight", jnp.asarray(weight))
    zero = np.zeros(len(rows))
    sums = np.stack([*np.zeros((6, len(rows))), mean, zero, zero], axis=1)
    seen = BandSums(sums, variance, clipped, (verdict == "repeated") | (verdict == "flat"))
    state = state_of(amplitude=before, offset=offset).electrodes
    noise = Noise.of(jnp.ones(3), 0, 1.0, len(rows))
    found = tick.measured_pulse(bands, seen, jnp.asarray(amplitude), state, noise)
    relative = np.where(amplitude > 0, amplitude, 1.0)
    lacking = np.where(np.isnan(before), 0.0, (relative - before) / relative)
    steady = abs(lacking) < tick.STEADY
    known = np.where(np.isfinite(mean) & np.isfinite(variance) & steady, mean, offset)
    np.testing.assert_allclose(used[0][0], lacking)
    np.testing.assert_allclose(used[0][1], np.where(np.isnan(known), 0.0, known))
    np.testing.assert_array_equal(found.steady, steady)
    np.testing.assert_array_equal(found.offset, known)
    np.testing.assert_array_equal(found.amplitude, amplitude)
    np.testing.assert_allclose(found.variance, variance / relative**2)
    np.testing.assert_allclose(found.weight, np.repeat(relative[:, None] ** 2, 3, axis=1))
    np.testing.assert_allclose(abs(np.asarray(found.gain))[:, 0], gain / relative)
    # Two bands tell something, each by two numbers.
    power = np.maximum(gain**2 * weight.sum() - 4 * variance, 0.0) / weight.sum()
    np.testing.assert_allclose(found.level, np.sqrt(power) / relative)
    assert verdict_names(found.bad).tolist() == verdict.tolist()


def test_a_pulse_alone_tells_elements_or_says_that_it_does_not(monkeypatch):
    zero, two, wave = jnp.zeros(()), jnp.zeros(2), jnp.zeros(3, complex)
    monkeypatch.setattr(tick, "nearest_delay", lambda *_: (zero, zero))
    monkeypatch.setattr(tick, "searched", lambda *_: jnp.zeros(3))
    for name in ("departure", "undelayed", "expected"):
        monkeypatch.setattr(GainModel, name, lambda *_: wave)
    monkeypatch.setattr(GainModel, "patterns", lambda *_: jnp.zeros((0, 6)))
    parts = jnp.ones(3), jnp.zeros(0)
    measured, model = MEASURED(wave, zero, *parts, *[zero] * 6), object.__new__(GainModel)
    scores = PulseScores(jnp.zeros((2, 3)), two)

    @jax.jit
    @jax.vmap
    def alone(spread, result):
        rest = zero, zero, result, scores, zero, zero, zero
        fit = ATTEMPT(jnp.zeros(3), two, jnp.diag(spread), *rest)
        monkeypatch.setattr(tick, "attempt", lambda *_: fit)
        return anew(model, measured, jnp.zeros((1, 2)), jnp.asarray(True), two).result

    spread = jnp.array([[0.5, 0.9], [0.5, 1.1], [1.1, 0.5], [np.nan, 0.5], [1.1, 0.5]])
    results = verdicts_of(np.array(["successful"] * 4 + ["misfit"]))
    found = verdict_names(alone(spread, jax.tree.map(jnp.asarray, results)))
    assert found.tolist() == ["successful", *["insensitive"] * 3, "misfit"]
