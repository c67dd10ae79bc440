"""The state of one electrode after a pulse, against the same rules written for one electrode."""

import itertools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from etid.estimators.judgement import MAX_STEPS_REACHED, SUCCESSFUL
from etid.online import alarms
from etid.online.alarms import GainScore
from etid.online.state import DRIFT, JUMP, NONE, ElectrodeState
from etid.online.tick import PATIENCE, Attempt, Measured, Suspicion, after_pulse
from etid.results.verdicts import RESULTS, verdict_names

NUMBER, LIMIT = 77, 10.0
POWERS = np.array([1.0, -1.0])  # of a resistor and of a capacitor
OLD, FOUND, FRESH = np.array([1.0, 2.0, 0.1]), np.array([1.1, 2.1, 0.2]), np.array([7.0, 2.2, 0.3])
BEFORE = np.array([[50.0, 5.0], [5.0, 40.0]])
TOLD, ALONE = np.array([[30.0, 2.0], [2.0, 20.0]]), np.array([[60.0, 3.0], [3.0, 70.0]])
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


CASES = [
    Case(*one)
    for one in itertools.product(
        (True, False),
        (True, False),
        (True, False),
        (True, False),
        ("good", "bad", "late"),
        (True, False),
        (0, PATIENCE - 1),
        (True, False),
        (True, False),
        (True, False),
    )
    if one[0] or not (one[1] or one[2])  # an electrode that does not run is not suspected
]
# NumPy's arrays stand in the place of JAX's.
MEASURED: Any = Measured
ATTEMPT: Any = Attempt
GAIN_SCORE: Any = GainScore
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
        shown=np.array([5.0, 6.0]),
        gain=np.array([30.0, 100.0, 1.0]),
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
        weight=np.zeros(1),
        level=1.3,
        amplitude=0.0 if of.silent else 2.0,
        offset=1.25,
        steady=True,
        shown=4.0,
        bad=RESULTS.unconnected if of.off else SUCCESSFUL,
    )
    score = GAIN_SCORE(np.array([-150.0 if of.gain else 1.0, 90.0, 2.0]), np.array([0.5, -8.0]))
    found = ATTEMPT(FOUND, TOLD, np.linalg.inv(TOLD), 1.9, 1.01, GOOD if of.found else BAD, score)
    own = np.array([*(OLD[:2] + 1e-3), 0.3]) if of.near else FRESH
    fresh = ATTEMPT(own, ALONE, np.linalg.inv(ALONE), 2.9, 2.01, RESULT[of.fresh], score)
    z = np.array([0.1, 0.2])
    suspected = SUSPICION(of.jump, of.drift, np.array([0.7, 0.8]), 0.02 * BEFORE, 0, z)
    return state, measured, BEFORE, found, fresh, suspected, LIMIT, NUMBER, POWERS


def expected(of: Case) -> dict[str, Any]:
    """The rules, one electrode at a time."""
    state, measured, before, found, fresh, suspected, limit, number, powers = electrode(of)
    again = not of.running or of.jump or of.drift
    used = fresh if again else found
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
        grown = np.diag(np.exp(powers * factor))
        summed = grown @ (used.information + before) @ grown
        information = used.information if again else summed
        pulses = 1 if again else state["pulses"] + 1
    mean, mean_cov = state["mean"], state["mean_cov"]
    if good and not again:
        mean, mean_cov = suspected.mean, suspected.mean_cov
    elif good or lost:
        mean, mean_cov = 0 * mean, 0 * mean_cov
    begun = not of.running and of.fresh == "late"
    gain = state["gain"]
    if good:
        gain = used.gain.sums + (0 if again else gain)
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
        "shown": [4.0, 5.0],
        "confirmed": confirmed,
        "gain": gain,
        "mean": mean,
        "mean_cov": mean_cov,
        "event": JUMP if jumped else DRIFT if drifted else NONE,
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


# --- changes --------------------------------------------------------------------------------------


LANES = 20
SURE = alarms.DRIVER * 1.709 / np.sqrt(LANES) - 1.282  # nine tenths of z beyond it: the driver


@pytest.mark.parametrize(
    ("z", "jumps", "counted", "expected"),
    [
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
    ],
)
@pytest.mark.parametrize("test", [0, 1])
def test_the_driver_has_changed_if_most_electrodes_move_one_way(z, jumps, counted, expected, test):
    """Those that do not count may move or be anything; one in ten may move the other way."""
    values = np.zeros((2, LANES))
    values[test] = z
    values[test, :1] = -z
    values[:, counted:] = -99.0
    values[test, counted + 1 :] = np.nan
    jumped, counts = np.arange(LANES) < jumps, np.arange(LANES) < counted
    jumped[counted:] = True
    running = np.arange(LANES) < 2 * counted - 1  # those that count are more than half of them
    found = alarms.driver_change(*map(jnp.asarray, (jumped, values, counts, running)))
    assert bool(found) == expected


# --- what a pulse shows ---------------------------------------------------------------------------
