"""`order="auto"`: an order whose standard errors contain what its choice leaves open."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import binom, chi2

import etid
from benchmarks import driver_order as benchmark
from benchmarks.coverage import scene, with_driver
from benchmarks.ladder import CALIBRATION, LOADS, rung
from benchmarks.rates import NORMAL_95
from etid.estimators import refined_driver
from etid.estimators.starts import source_starts
from etid.results.driver import AUTO, LARGEST, ContinuousDriver, HarmonicDriver, Order
from etid.selection.driver_order import FIRST, TriedOrder, best, evidence, next_order
from etid.simulation.transformer import TransformerDriver

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
    gains = searched([candidate(7, 3000.0, asks), candidate(8, 3000.0 - POLE - 1)])
    assert [one.order for one in gains] == [7, 8]
    assert best(gains).order == 8
    lost = searched([candidate(7, 3000.0, asks), candidate(8, 3000.0 - POLE + 1)])
    assert [one.order for one in lost] == [7, 8]
    assert best(lost).order == 7


def test_without_an_adequate_order_the_search_ends_and_the_least_bic_is_returned():
    """A wrong resistor, for example, is misfitted at every order."""
    tried = searched([candidate(order, 9000.0, 900.0, False) for order in (7, 8)])
    assert [one.order for one in tried] == [7, LARGEST]
    assert best(tried).order == 7
    falling = [candidate(order, 9000.0 - 500 * order, 900.0, False) for order in (7, 8)]
    assert best(searched(falling)).order == LARGEST


def test_a_fit_without_numbers_is_not_chosen():
    tried = [candidate(7, np.nan, np.nan, False), candidate(8, 3000.0)]
    assert next_order(tried[:1]) == 8
    assert best(tried).order == 8
    assert evidence(tried).orders == [7, 8]
    assert evidence(tried).adequate.tolist() == [False, False, False, False, True]  # from 4 on
    words = "orders tried and their BIC above the least: 7 "
    assert str(evidence([candidate(7, 9e3, 9e2, False), candidate(8, 3e3)])).startswith(words)


@dataclasses.dataclass(frozen=True)
class Resonant(TransformerDriver):
    """A transformer with a second, weak resonance, a bump of 300 ohm in 13 kohm."""

    def _thevenin(self, f):
        gain, z = super()._thevenin(f)
        x = 1j * f / 15e3
        return gain, z + 300.0 / (1 + 0.4 * x + x**2)


def nine_periods(seed, parts=0.03):
    """One calibration, a dry and a damp fingertip at 50 dB behind a driver that is drawn."""
    return with_driver(scene(50.0, 30_000), seed, parts)


def errors_of(of, seed, order: Order = AUTO):
    """The driver of a scene, and the errors of the elements in standard errors."""
    study = of.simulate(seed)
    driver = etid.identify_driver(study["calibration/0"], order=order, throw=False)
    assert isinstance(driver, HarmonicDriver)
    found = []
    for path in LOADS:
        fit = etid.identify_skin(study[path], driver, throw=False)
        error = np.array(fit.circuit.values()) - list(of.truth()[path].values())
        found.append(error / np.array(fit.stderr.values()))
    return driver, np.array(found)


@pytest.fixture(scope="module")
def hidden():
    """A driver whose fifth pole no test of the calibration sees, and the errors behind it."""
    return errors_of(nine_periods(28), 28)


@pytest.mark.parametrize("order", [4, "auto"])
def test_the_errors_contain_poles_that_no_test_of_the_calibration_sees(hidden, order):
    """Four poles fix the delay of the calibration by the shape of Z_th: C_p is 4.6 errors off."""
    driver, z = hidden if order == "auto" else errors_of(nine_periods(28), 28, order)
    assert driver.verdict == "successful"
    assert driver.missing_pole < 2 * np.log(3000)  # no test asks for more poles
    assert (np.abs(z).max() < 3) == (order == "auto")


@pytest.mark.parametrize("order", [5, "auto"])
def test_the_errors_contain_a_resonance_that_no_test_of_the_calibration_sees(order):
    of = nine_periods(1)
    of = dataclasses.replace(of, driver=Resonant(**dataclasses.asdict(of.driver)))
    driver, z = errors_of(of, 1, order)
    assert driver.verdict == "successful"
    assert (np.abs(z).max() < 3.5) == (order == "auto")


def test_a_driver_tells_the_orders_that_were_tried(hidden):
    driver, _ = hidden
    assert (driver.order, driver.tried.orders) == (7, [7])
    assert "orders tried and their BIC above the least: 7 +0" in str(driver)


def test_drivers_share_compiled_functions_however_many_orders_were_tried():
    """A field that is None for a fixed order would compile the fit of a skin twice."""
    calibration = rung("dry", snr_db=80.0).simulate(seed=3)[CALIBRATION]

    def shapes(driver):
        leaves, structure = jax.tree.flatten(driver)
        return [np.shape(leaf) for leaf in leaves], structure

    chosen = etid.identify_driver(calibration, order="auto")
    fixed = etid.identify_driver(calibration, order=chosen.order)
    assert isinstance(fixed, ContinuousDriver)
    assert fixed.tried.orders == []
    assert "tried" not in str(fixed)
    assert shapes(fixed) == shapes(chosen)


def test_other_methods_say_what_to_do():
    calibration = rung("dry").simulate(seed=3)[CALIBRATION]
    with pytest.raises(ValueError, match="give a number of poles, such as 5"):
        etid.identify_driver(calibration, order="auto", method="steiglitz_mcbride")


def test_spice_drivers_need_no_further_pole(reference_data):
    found = benchmark.spice_orders(reference_data(benchmark.FOLDER), ("lab_dry", "clean_dry"))
    assert set(found.values()) == {FIRST}


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
    turned = etid.identify_driver(calibration, order=3, method=method, throw=False)
    assert isinstance(told, ContinuousDriver)
    assert isinstance(turned, ContinuousDriver)
    assert turned.start == counts[0] - 1 - told.start
    assert float(turned.chi2) == pytest.approx(float(told.chi2), rel=1e-6)  # the same minimum


@pytest.mark.slow
def test_intervals_behind_an_automatic_order_contain_the_truth():
    """100 drivers that are drawn, one resistor, nine periods at 50 dB."""
    z = np.stack([errors_of(nine_periods(seed), seed)[1] for seed in range(100)])
    covered = np.abs(z) < NORMAL_95
    # The six elements behind one driver share its error: they are counted once, and C_p of dry
    # skin for itself. 99.9 % of binomial numbers are within these limits.
    low, high = binom.ppf((5e-4, 0.9995), 100, 0.95) / 100
    assert low <= covered.mean() <= high
    assert low <= covered[:, 0, 2].mean() <= high
    # The root mean square of 100 standard normal numbers is below this in 99.9 % (order 4: 1.27).
    assert np.sqrt(np.mean(z[:, 0, 2] ** 2)) < np.sqrt(chi2.ppf(0.999, 100) / 100)
