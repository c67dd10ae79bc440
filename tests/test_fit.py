"""Intervals, correlation, table and file of one fit."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import etid
from etid.results.fit import complex_rrse
from etid.results.instrument import Effects
from etid.results.verdicts import verdict

VALUES = np.array([33.4e3, 186e3, 0.12e-9])
ERRORS = np.array([100.0, 1e3, 1e-12])
CORRELATION = np.array([[1.0, 0.5, -0.25], [0.5, 1.0, 0.0], [-0.25, 0.0, 1.0]])


def fit(name="successful"):
    one = np.asarray(1.5)
    return etid.Fit(
        circuit=etid.SkinRC(*VALUES),
        cov=CORRELATION * np.outer(ERRORS, ERRORS),
        shared_cov=np.zeros((3, 3)),
        rrse=one,
        chi2=one,
        result=verdict(name),
        steps=np.asarray(7),
        method="maximum_likelihood",
    )


@pytest.mark.parametrize("level", [0.5, 0.95, 0.99])
def test_an_interval_holds_this_part_of_a_normal_distribution(level):
    found = fit().intervals(level)
    assert list(found) == ["r_s", "r_p", "c_p"]
    low, high = np.transpose(list(found.values()))
    expected = stats.norm.interval(level, VALUES, ERRORS)
    np.testing.assert_allclose([low, high], expected, rtol=1e-12)
    assert all(type(end) is float for ends in found.values() for end in ends)


def test_the_table_of_a_fit_is_its_row_in_the_table_of_fits(tmp_path):
    table = fit("misfit").table()
    assert (table["r_s"], table["verdict"], table["steps"]) == (33.4e3, "misfit", 7)
    np.testing.assert_allclose(table["c_p_stderr"], 1e-12)
    fit("misfit").write(tmp_path / "fit.h5")
    fits = etid.Fits.read(tmp_path / "fit.h5")
    assert len(fits) == 1
    assert "misses the recording" in fits.notes[0]
    np.testing.assert_array_equal(fits[0].cov, fit().cov)
    whole = fits.table()
    for name, value in table.items():
        np.testing.assert_array_equal(whole[name][0], value)


def test_the_error_of_complex_values_counts_those_that_are_used():
    measured = jnp.array([3.0 + 4.0j, 1.0j, 2.0 + 0j])
    predicted = jnp.array([3.0 + 3.0j, 9.0j, 4.0 + 0j])
    used = jnp.array([True, False, True])
    assert complex_rrse(predicted, measured, used) == pytest.approx(np.sqrt(5.0 / 29.0))
    assert complex_rrse(predicted, measured) == pytest.approx(np.sqrt(69.0 / 30.0))


LEFT = "The circuit leaves 0.4 % of the signal; ± contain it."


def inexact(name, discrepancy=0.0):
    """χ² of 101 at an RRSE of 0.402 %: noise is a hundredth of the squares."""
    of = Effects.unknown(3)
    of = dataclasses.replace(of, discrepancy=np.full(3, discrepancy))
    size = {"chi2": np.asarray(101.0), "rrse": np.asarray(4.02e-3)}
    return dataclasses.replace(fit(name), by_tolerance=of, **size)


def test_what_a_circuit_leaves_is_told_where_the_errors_contain_it():
    for name, discrepancy in (("approximate", 0.01), ("successful", 0.01), ("approximate", 0.0)):
        one = inexact(name, discrepancy)
        assert one.usable
        assert one.inexact
        assert one.leaves == LEFT
        assert str(one).count(LEFT) == 1
        assert one.note.endswith(LEFT)
    for name, discrepancy in (("misfit", 0.01), ("successful", 0.0)):
        assert inexact(name, discrepancy).leaves == ""
        assert "leaves" not in str(inexact(name, discrepancy))
    hidden = dataclasses.replace(inexact("successful", 0.01), chi2=np.asarray(0.99))
    assert hidden.leaves == "The circuit leaves less than the noise; ± contain it."


def test_an_approximate_fit_is_usable_in_a_table_and_in_a_file(tmp_path):
    inexact("approximate", 0.01).write(tmp_path / "fit.h5")
    fits = etid.Fits.read(tmp_path / "fit.h5")
    assert fits.counts() == {"approximate": 1}
    assert len(fits.usable()) == 1
    assert fits.notes[0].endswith(LEFT)
    assert fits[0].leaves == LEFT
    (group,) = fits.summary()
    assert (group["usable"], group["r_p"]) == (1, 186e3)
    said = str(fits)
    assert "1 approximate" in said
    assert "1/1" in said
    assert "The circuit leaves up to 0.4 % of the signal in 1 fit; ± contain it." in said
