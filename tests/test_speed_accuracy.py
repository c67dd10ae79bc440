"""Error against time: what counts as wrong, what is on the front, what is complained of."""

import numpy as np
import pytest

from benchmarks import speed_accuracy, speed_accuracy_chart, which
from benchmarks.estimators import Draws, Result, score
from benchmarks.ladder import CALIBRATION, SOURCES, TRIAL, ladder
from benchmarks.provenance import RESULTS
from benchmarks.speed_accuracy import dominators, front, ranked

BOUND = np.array([0.01, 0.01, 0.08])
TRUTH = np.array([30e3, 200e3, 1e-10])


def draws(count):
    return Draws("a scene", [None] * count, TRUTH, BOUND)  # type: ignore[arg-type]


def result(errors, *, stderr=np.nan, successful=True, seconds=1.0, name="x", mode="batched"):
    errors = np.atleast_2d(errors)
    return Result(
        name,
        mode,
        TRUTH * (1 + errors),
        np.full(len(errors), successful),
        TRUTH * np.broadcast_to(stderr, errors.shape),
        seconds,
        1.0,
        1.0,
    )


def test_an_error_is_counted_in_bounds():
    found = score(draws(2), result([[0.01, 0.01, 0.08], [0.03, 0.03, 0.24]]))
    np.testing.assert_allclose(found.each, [1.0, 3.0])
    np.testing.assert_allclose(found.error, 2.0)
    np.testing.assert_allclose(found.error_of, 2.0)


@pytest.mark.parametrize(
    ("error", "wrong"),
    [
        ([0.049, 0.0, 0.0], False),
        ([0.051, 0.0, 0.0], True),  # five bounds
        ([0.0, 0.0, 0.19], False),
        ([0.0, 0.0, -0.21], True),  # 20 %, two and a half bounds
    ],
)
def test_wrong_is_far_from_the_truth_by_the_bound_or_in_per_cent(error, wrong):
    assert score(draws(1), result(error)).wrong == wrong


@pytest.mark.parametrize(
    ("stderr", "successful", "silent"),
    [(np.nan, True, True), (0.01, True, True), (0.02, True, False), (0.01, False, False)],
)
def test_silent_is_wrong_successful_and_not_covered(stderr, successful, silent):
    found = score(draws(1), result([0.06, 0.0, 0.0], stderr=stderr, successful=successful))
    assert found.wrong == 1
    assert found.silent == silent
    assert found.said == (not successful)


def test_no_answer_is_infinitely_far_but_not_wrong():
    found = score(draws(3), result([[np.nan] * 3, [np.nan] * 3, [0.0] * 3]))
    assert np.isinf(found.error)
    assert found.none == pytest.approx(2 / 3)
    assert found.wrong == found.silent == 0


def test_the_front_is_what_nothing_beats_in_both():
    assert front([1, 2, 3, 2, np.nan], [9, 5, 1, 6, 0]) == [True, True, True, False, False]
    assert front([1, 2], [np.inf, 1]) == [False, True]


def test_what_beats_the_default_is_faster_and_better_beyond_chance():
    random = np.random.default_rng(2)
    errors = 0.01 * random.normal(size=(20, 3))
    several = [
        result(errors, name="default", seconds=2.0),
        result(0.5 * errors, name="better", seconds=1.0),
        result(0.5 * errors, name="better, but slow", seconds=3.0),
        result(errors[::-1], name="as good", seconds=1.0),
        result(2 * errors, name="worse", seconds=1.0),
        result(np.full((20, 3), np.nan), name="nothing", seconds=1.0),
    ]
    assert dominators(several, [score(draws(20), of) for of in several]) == ["better"]
    assert dominators([], []) != []


def row(name, **of):
    defaults = {"scene": "s", "mode": "batched", "beaten_by": "", "silent": 0.0, "error": 1.0}
    more = {"ms": 1.0, "said": 0.0, "on_front": False, "estimator": name, "missing": ""}
    return {**defaults, **more, **of}


def test_what_does_not_hold_is_said():
    worse = [row("steiglitz_mcbride", error=9.0), row("equation_error", error=np.inf)]
    assert ranked([row("default"), *worse]) == []
    assert len(ranked([row("default", silent=0.1, error=3.0, beaten_by="x"), *worse])) == 3
    assert len(ranked([row("default", error=1.5), worse[0], row("equation_error")])) == 1


def test_a_chart_shows_every_scene_and_who_has_no_answer(tmp_path):
    rows = [
        row("default", on_front=True),
        row("default", mode="alone", ms=3.0),
        row("SciPy", mode="rival", ms=30.0, error=5e3),
        row("equation_error", error=np.inf),
        row("steiglitz_mcbride", scene="t", said=1.0),
    ]
    path = tmp_path / "deep" / "chart.svg"
    speed_accuracy_chart.chart(rows, path)
    assert "etid" in path.read_text()


def test_the_ladder_differs_from_its_middle_in_one_thing_each():
    scenes = ladder()
    assert len(scenes) == 18
    for scene in scenes.values():
        assert [trial.path for trial in scene.trials] == [TRIAL]
        assert [trial.path for trial in scene.calibration] == [CALIBRATION]
    study = SOURCES["simulated"](scenes["dry, 1 period"], 3)
    np.testing.assert_array_equal(
        study[TRIAL].v_out, scenes["dry, 1 period"].simulate(seed=3)[TRIAL].v_out
    )


def test_the_first_that_is_good_is_to_be_used_or_what_is_as_good_in_half_its_time():
    rows = [
        row("maximum_likelihood", ms=3.0, none=0.0),
        row("non_parametric", ms=1.4, error=1.2, none=0.0),
        row("output_error", ms=1.0, error=1.3, none=0.0),
        row("steiglitz_mcbride", ms=0.5, error=0.9, said=0.6, none=0.0),
        row("equation_error", ms=0.5, error=0.9, silent=0.1, none=0.0),
    ]
    assert which.best(rows) == "non_parametric"
    assert which.best([rows[0], {**rows[1], "ms": 2.0}]) == "maximum_likelihood"
    assert which.best(rows[3:]) is None
    made = which.table(rows)
    assert "| s | 1 | **1.2** | 1.3 | (0.9) | 0.9 silent | non parametric |" in made
    page = f"before\n{which.BEGIN}old\n{which.END}after\n"
    assert which.inserted(page, made) == f"before\n{which.BEGIN}{made}{which.END}after\n"
    with pytest.raises(ValueError, match="no '<!--"):
        which.inserted("before\n", made)


def test_the_readme_has_the_table_of_the_last_results():
    made = which.table(which.read(RESULTS / speed_accuracy.FILE))
    page = which.README.read_text()
    assert which.inserted(page, made) == page, "run python -m benchmarks which"
