"""The map of failures: what counts as one, how sure the rates are, and that the scenes are so."""

import csv
import itertools
from typing import Any

import numpy as np
import pytest
import scipy.stats

from benchmarks import failure_axes, failure_map
from benchmarks.failure_axes import Cell, Clipped, Cole, Coloured, TwoLayers, cells, scene
from benchmarks.failure_counts import clopper_pearson, rate, rates, silent
from benchmarks.failure_draws import Answer, Effort, answers, bounds, seeds
from benchmarks.ladder import LOADS

NOTHING = np.full(3, np.nan)


def answer(error: Any = 0.0, stderr: Any = 0.01, bound: Any = 0.01, **more: Any) -> Answer:
    of = (np.broadcast_to(np.asarray(x, float), 3) for x in (error, stderr, bound))
    place = {"method": "default", "seed": 0, "path": "dry/00", "verdict": "successful"}
    return Answer(**{**place, **dict(zip(("error", "stderr", "bound"), of, strict=True)), **more})


@pytest.mark.parametrize(("events", "trials"), [(0, 7), (1, 40), (20, 40), (7, 7)])
def test_intervals_are_those_of_scipy(events, trials):
    known = scipy.stats.binomtest(events, trials).proportion_ci(method="exact")
    np.testing.assert_allclose(clopper_pearson(events, trials), (known.low, known.high), rtol=1e-9)


def test_trials_with_drivers_of_their_own_are_independent():
    """But for m − 1 in the place of m, of which V is not aware."""
    events = [True] * 10 + [False] * 90
    assert rate(events, range(100)) == pytest.approx((0.1, *clopper_pearson(9.9, 99)))


def test_trials_that_fail_together_count_as_one():
    events, drivers = [True] * 50 + [False] * 50, np.repeat(np.arange(10), 10)
    assert rate(events, drivers) == pytest.approx((0.5, *clopper_pearson(4.5, 9)))


def test_without_a_failure_the_drivers_count():
    assert rate([False] * 80, np.repeat(np.arange(8), 10)) == (0.0, *clopper_pearson(0, 8))
    assert np.isnan(rate([], [])).all()


@pytest.mark.parametrize(
    ("of", "wrong", "quiet", "missed"),
    [
        (answer(), False, False, False),
        (answer((0.04, 0, 0)), False, False, False),
        (answer((0.06, 0, 0)), True, True, True),
        (answer((0.06, 0, 0), stderr=0.02), True, False, False),
        (answer((0.06, 0, 0), stderr=np.nan), True, True, True),
        (answer((0.06, 0, 0), verdict="misfit"), True, False, False),
        (answer((0, -0.25, 0), bound=0.3, stderr=0.2), True, False, False),
        (answer((0, -0.25, 0), bound=0.3), True, True, False),  # nothing is asked of it
        (answer((0, -0.25, 0), bound=np.nan), True, True, False),
        (answer((0, 0.25, np.nan), bound=(0.05, 0.2, np.nan)), True, True, False),
        (answer((0.15, 0, 0), exact=False), False, False, False),
        (answer((0.25, 0, 0), exact=False), True, True, True),
        (answer((-1.5, 0, 0), stderr=np.nan, verdict="nonphysical"), True, False, False),
        (answer(NOTHING, verdict="driver_failed"), False, False, False),
    ],
)
def test_wrong_is_silent_where_neither_verdict_nor_standard_error_tells(of, wrong, quiet, missed):
    assert (of.wrong, of.silent, of.missed) == (wrong, quiet, missed)


def test_no_answer_is_refused_and_not_wrong():
    assert answer(NOTHING).refused
    assert not answer((0.0, 0.0, np.nan)).refused


def test_rates_count_what_they_say():
    every = [
        answer(seed=0),
        answer((0.06, 0, 0), seed=0),
        answer((0.5, 0, 0), seed=1, bound=0.3),
        answer(NOTHING, seed=1, verdict="unstable", unstable=True, unsettled=True),
    ]
    found = rates(every)
    assert (found["drivers"], found["trials"], found["determined"]) == (2, 4, 3)
    names = ("wrong", "refused", "silent", "unstable", "not_converged")
    assert [found[name] for name in names] == [0.5, 0.25, 0.5, 0.25, 0.25]
    assert found["missed"] == pytest.approx(1 / 3)


def test_every_silent_failure_is_listed_with_its_seed():
    cell = Cell("map", "row", "column", scene())
    [row] = silent([cell], [[answer(seed=5), answer((0.06, 0, 0), seed=7)]])
    assert (row["map"], row["seed"], row["path"], row["r_s_error"]) == ("map", 7, "dry/00", 0.06)


def test_all_cells_have_places_and_seeds_of_their_own():
    every = list(cells())
    places = {(cell.chart, cell.row, cell.column) for cell in every}
    assert len(places) == len(every)
    assert len({cell.chart for cell in every}) == 9
    assert failure_map.FEW < places
    most = failure_map.DRIVERS
    used = list(itertools.chain.from_iterable(seeds(cell, most) for cell in every))
    assert len(set(used)) == len(used)


def test_each_cell_is_done_once_and_with_others_of_its_shape():
    every = list(cells())
    tasks = failure_map.tasks(every)
    assert sorted(itertools.chain.from_iterable(tasks)) == list(range(len(every)))
    assert all(len({every[i].shape for i in of}) == 1 for of in tasks)


@pytest.mark.parametrize("order", failure_axes.LOST)
def test_the_simplified_transformer_has_as_many_poles_as_it_says(order):
    """The rank of a Loewner matrix, (z_i − z_j) / (s_i − s_j), is the order of z(s)."""
    f = np.geomspace(1.0, 3e6, 40)
    s = np.concatenate([2j * np.pi * f, -2j * np.pi * f])
    z = failure_axes.transformer(order).z_th(np.abs(f))
    z = np.concatenate([z, np.conj(z)])
    left, right = slice(0, None, 2), slice(1, None, 2)
    loewner = (z[left, None] - z[None, right]) / (s[left, None] - s[None, right])
    scale = np.sqrt(np.abs(s))
    values = np.linalg.svd(scale[left, None] * loewner * scale[None, right], compute_uv=False)
    assert np.sum(values > 1e-12 * values[0]) == order


@pytest.mark.parametrize("kind", [lambda of: TwoLayers(of, 0.3), lambda of: Cole(of, 0.9)])
def test_elements_of_skin_that_is_not_one_rc_are_the_limits_of_its_impedance(kind):
    load = kind(LOADS["dry"])
    low, high = 1e-9, 1e13  # [Hz]; a constant phase arrives slowly
    z = load(np.array([low, high]))
    np.testing.assert_allclose(z[1].real, load.elements.r_s, rtol=1e-4)
    np.testing.assert_allclose(z[0].real, load.elements.r_s + load.elements.r_p, rtol=1e-4)
    if not np.isnan(load.elements.c_p):
        reactance = np.abs(load(np.array([1e8])) - load.elements.r_s)
        np.testing.assert_allclose(2 * np.pi * 1e8 * reactance * load.elements.c_p, 1, rtol=1e-4)


def test_a_constant_phase_of_one_is_a_capacitor():
    f, skin = np.geomspace(1, 1e6, 20), LOADS["damp"]
    np.testing.assert_allclose(Cole(skin, 1.0)(f), skin(f), rtol=1e-12)
    np.testing.assert_allclose(TwoLayers(skin, 0.0)(f), skin(f), rtol=1e-12)


def test_what_does_not_exist_has_no_bound():
    found = bounds(scene(lambda skin: Cole(skin, 0.9)))
    np.testing.assert_array_equal(np.isnan(found["dry/00"]), [False, False, True])


@pytest.fixture(scope="module")
def recording():
    return scene().simulate(3)["dry/00"]


def test_clipping_cuts_as_many_samples_as_it_says(recording):
    rng = np.random.default_rng(1)
    cut = Clipped(0.02, known=True)(recording, rng)
    limit = np.abs(cut.v_th).max()
    assert (np.abs(recording.v_th) > limit).mean() == pytest.approx(0.02, rel=0.05)
    assert cut.adc_range == pytest.approx((-limit, limit), rel=1e-3)
    loose = Clipped(0.02, sigma=0.01)(recording, rng)
    assert loose.adc_range is None
    at_limit = np.abs(recording.v_th) > limit
    # A converter step besides, of 6 mV.
    assert np.std(np.abs(loose.v_th[at_limit])) == pytest.approx(0.01, rel=0.25)


@pytest.mark.parametrize("band", failure_axes.COLOURS.values())
def test_coloured_noise_has_its_size_and_its_band(recording, band):
    changed = Coloured(band, 0.5)(recording, np.random.default_rng(2))
    added = changed.v_out - recording.v_out
    assert np.std(added) == pytest.approx(0.5, rel=0.02)
    f = np.fft.rfftfreq(added.size, 1 / recording.sample_rate)
    power = np.abs(np.fft.rfft(added)) ** 2
    inside = (f >= band[0] - 65) & (f <= band[1] + 65)  # a tone between two bins leaks
    assert power[inside].sum() > 0.9 * power.sum()
    other = changed.v_th - recording.v_th
    assert np.std(other - added) > 0.1  # to each record its own


def test_more_samples_get_fewer_drivers():
    usual = {"default": Effort(6, 10), "output_error": Effort(1, 3)}
    few = failure_map.effort(Cell("", "", "", scene(sample_rate=1e6, samples=50_000)), usual)
    assert (few["default"].drivers, few["output_error"].drivers) == (1, 1)
    assert failure_map.effort(Cell("", "", "", scene()), usual) == usual


@pytest.mark.slow
def test_a_resistor_fitted_to_skin_is_refused_at_20_db():
    """It was called successful in 158 of 160 fits."""
    place = ("SNR and circuit fitted to skin", "20 dB", "resistor")
    [cell] = [cell for cell in cells() if (cell.chart, cell.row, cell.column) == place]
    found = answers(cell, {"default": Effort(2, 10), "steiglitz_mcbride": Effort(2, 10)})
    assert len(found) == 20  # the other method knows skin only
    assert sum(of.successful for of in found) <= 1  # one of 80 was
    assert not any(of.exact for of in found)


def test_one_map_anew_keeps_the_others(tmp_path):
    """With the commit of the run that drew them."""
    old, new = cells_of("SNR and periods"), cells_of("SNR and sample rate")
    nothing = {failure_map.RATES: [], failure_map.SILENT: []}
    far = answer((0.06, 0, 0), seed=7)
    failure_map.write(old[:2], {0: [far], 1: [far]}, tmp_path, nothing)
    paths = {name: tmp_path / name for name in nothing}
    for path in paths.values():
        with path.open(newline="") as file:
            commit = next(csv.DictReader(file))["commit"]
        path.write_text(path.read_text().replace(commit, "earlier"))
    kept = {
        name: failure_map.earlier(path, {"SNR and sample rate"}) for name, path in paths.items()
    }
    failure_map.write(new[:1], {0: [far]}, tmp_path, kept)
    for path in paths.values():
        with path.open(newline="") as file:
            rows = list(csv.DictReader(file))
        assert [row["map"] for row in rows] == [new[0].chart, *[old[0].chart] * 2]
        assert rows[0]["commit"] != "earlier"
        assert rows[1]["commit"] == rows[2]["commit"] == "earlier"


def cells_of(chart):
    return [cell for cell in cells() if cell.chart == chart]
