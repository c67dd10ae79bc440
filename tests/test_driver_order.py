"""`order="auto"`: the least order of a driver that its calibrations support."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import etid
from benchmarks import driver_order as benchmark
from benchmarks.ladder import CALIBRATION, rung
from etid.estimators import refined_driver
from etid.estimators.starts import source_starts
from etid.identify import driver as identify
from etid.numpy_tier.tiers import program
from etid.results.driver import LARGEST, LEAST, ContinuousDriver
from etid.selection.driver_order import TriedOrder, best, evidence, next_order

TERMS = 3000
POLE = 2 * np.log(TERMS)  # what one more pole costs in BIC


def candidate(order, squares, missing_pole=4.0, adequate=True):
    return TriedOrder(order, squares, 2 * order + 2, TERMS, missing_pole, adequate)


def searched(candidates):
    """The candidates that the search asks for, one after the other."""
    by_order = {one.order: one for one in candidates}
    tried = []
    while (order := next_order(tried)) is not None:
        tried.append(by_order[order])
    return tried


def test_a_pole_that_pays_is_taken_and_one_that_does_not_is_tried_only():
    asks = POLE + 1
    gains = searched([candidate(4, 3000.0, asks), candidate(5, 3000.0 - POLE - 1)])
    assert [one.order for one in gains] == [4, 5]
    assert best(gains).order == 5
    lost = searched([candidate(4, 3000.0, asks), candidate(5, 3000.0 - POLE + 1)])
    assert [one.order for one in lost] == [4, 5]
    assert best(lost).order == 4


def test_a_section_is_found_though_its_first_pole_brings_nothing():
    tried = searched(
        [
            candidate(4, 9000.0, 900.0, adequate=False),
            candidate(5, 8999.0, 900.0, adequate=False),
            candidate(6, 3000.0),
        ]
    )
    assert best(tried).order == 6


def test_without_an_adequate_order_the_search_ends_and_the_least_bic_is_returned():
    """A wrong resistor, for example, is misfitted at every order."""
    many = [candidate(order, 9000.0, 900.0, False) for order in range(LEAST, LARGEST + 1)]
    tried = searched(many)
    assert [one.order for one in tried] == [4, 5, 6]  # two more poles without a gain
    assert best(tried).order == 4
    falling = [
        candidate(order, 9000.0 - 500 * order, 900.0, False) for order in range(LEAST, LARGEST + 1)
    ]
    assert best(searched(falling)).order == LARGEST


def test_a_fit_without_numbers_is_not_chosen():
    tried = [candidate(4, np.nan, np.nan, False), candidate(5, 3000.0)]
    assert next_order(tried[:1]) == 5
    assert best(tried).order == 5
    assert evidence(tried).orders == [4, 5]


@pytest.fixture(scope="module")
def drivers():
    """Drivers of one transformer of six poles, by the SNR of their calibration [dB]."""
    found = {}
    for snr_db, seed in ((60.0, 3), (80.0, 4)):
        calibration = rung("dry", snr_db=snr_db).simulate(seed)[CALIBRATION]
        found[snr_db] = etid.identify_driver(calibration, order="auto")
    return found


def test_four_poles_are_taken_at_60_db_and_the_fifth_at_80_db(drivers):
    assert (drivers[60.0].order, drivers[60.0].tried.orders) == (4, [4])
    assert (drivers[80.0].order, drivers[80.0].tried.orders) == (5, [4, 5])
    assert drivers[80.0].tried.adequate.tolist() == [False, True, False, False, False]
    text = str(drivers[80.0])
    assert "orders tried and their BIC above the least: 4 +" in text
    assert "(not adequate), 5 +0" in text


def test_drivers_share_compiled_functions_however_many_orders_were_tried(drivers):
    """A field that is None for a fixed order would compile the fit of a skin twice."""
    calibration = rung("dry", snr_db=80.0).simulate(seed=3)[CALIBRATION]
    fixed = etid.identify_driver(calibration, order=5)
    assert isinstance(fixed, ContinuousDriver)
    assert fixed.tried.orders == []
    assert "tried" not in str(fixed)

    def shapes(driver):
        leaves, structure = jax.tree.flatten(driver)
        return [np.shape(leaf) for leaf in leaves], structure

    assert shapes(fixed) == shapes(drivers[80.0])


def test_other_methods_say_what_to_do():
    calibration = rung("dry").simulate(seed=3)[CALIBRATION]
    with pytest.raises(ValueError, match="give a number of poles, as in order=5"):
        etid.identify_driver(calibration, order="auto", method="output_error")


def test_spice_drivers_have_the_order_that_is_visible(reference_data):
    found = benchmark.spice_orders(reference_data(benchmark.FOLDER), ("lab_dry", "clean_dry"))
    for name, order in found.items():
        low, high = benchmark.VISIBLE[name]
        assert low <= order <= high, name


def test_a_driver_of_two_poles_has_starts():
    """Order 2 has no section beside its real poles; the fit stopped with an error of numpy."""
    number = jnp.asarray
    starts = source_starts(number([1.0, -1.5, 0.6]), 2, number(200e3), number(98.8e3))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(starts))


@pytest.mark.parametrize("method", ["maximum_likelihood", "output_error"])
def test_a_driver_tells_the_start_that_led_to_it(monkeypatch, method):
    """With the starts in reverse order, the same one has its number from the other end."""
    samples = 3_300 if method == "output_error" else 10_000
    calibration = rung("dry", snr_db=60.0, samples=samples).simulate(seed=5)[CALIBRATION]
    counts = []

    def reversed_starts(*of):
        starts = source_starts(*of)
        counts.append(starts.log_resistance.size)
        return jax.tree.map(lambda leaf: leaf[::-1], starts)

    told = etid.identify_driver(calibration, order=3, method=method, throw=False)
    monkeypatch.setattr(refined_driver, "source_starts", reversed_starts)
    monkeypatch.setattr(identify, "_identified", program(inspect.unwrap(identify._identified)))
    turned = etid.identify_driver(calibration, order=3, method=method, throw=False)
    assert isinstance(told, ContinuousDriver)
    assert isinstance(turned, ContinuousDriver)
    assert turned.start == counts[0] - 1 - told.start
    assert float(turned.chi2) == pytest.approx(float(told.chi2), rel=1e-6)  # the same minimum
