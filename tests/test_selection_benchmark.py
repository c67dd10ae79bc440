"""The benchmark of the choice of circuits: what it counts, on made-up fits."""

import jax.numpy as jnp
import numpy as np
import pytest

import etid
from benchmarks import selection, selection_counts, selection_rival
from benchmarks.failure_draws import AUTO, judged, limits
from benchmarks.selection_counts import CRITERIA, cell, choose, covered
from benchmarks.selection_draws import TRUTHS, Drawn, quantities
from etid.results.fit import CHANGES, Fit, Support
from etid.results.verdicts import verdict
from etid.selection.evidence import best
from etid.selection.search import usual_circuits
from etid.selection.selection import Selection

CANDIDATES = usual_circuits()

TERMS = 1000.0
SKIN, COLE = 0, 3  # numbers of candidates
TRUTH = "one RC, dry"
KINDS = [type(one) for one in CANDIDATES]


def made(circuit, deviance, error=0.01):
    size = len(circuit.names())
    unchanged = np.zeros(CHANGES), np.zeros(()), np.zeros(size)
    return Fit(
        circuit=circuit,
        cov=np.diag((error * np.asarray(circuit.values())) ** 2),
        shared_cov=np.zeros((size, size)),
        rrse=np.asarray(0.01),
        chi2=np.asarray(deviance / TERMS),
        result=verdict("successful"),
        steps=np.asarray(3),
        method="maximum_likelihood",
        support=Support(np.asarray(deviance), np.asarray(TERMS), *unchanged),
    )


def drawn(deviances, driver=0, off=1.0, truth=TRUTH):
    """A recording of a truth; the fit of the true circuit has elements off by a factor."""
    circuits = dict(enumerate(CANDIDATES))
    number = KINDS.index(type(TRUTHS[truth]))
    true = TRUTHS[truth]
    circuits[number] = true.with_log_values(true.log_values() + np.log(off))
    fits = {i: made(circuits[i], of) for i, of in enumerate(deviances)}
    return Drawn(truth, 40.0, driver, Selection.of(fits, best(fits), CANDIDATES), fits)


def test_two_circuits_have_the_same_resistance_corner_and_limits():
    skin, cole, layers = (
        quantities(TRUTHS[name]) for name in (TRUTH, "Cole 0.9, dry", "layers 0.3, 10, dry")
    )
    for name in ("R_s", "Z(0)", "corner"):
        assert skin[name].value == pytest.approx(cole[name].value)
    assert layers["Z(0)"].value == pytest.approx(skin["Z(0)"].value)
    assert "corner" not in layers
    np.testing.assert_allclose(skin["Z(0)"].slope, [1, 1, 0])
    values = np.asarray(TRUTHS[TRUTH].values())
    np.testing.assert_allclose(skin["corner"].slope, [0, -1 / values[1], -1 / values[2]])
    found, stderr = limits(made(TRUTHS["R, dry"], 1000.0))
    np.testing.assert_allclose(found, [216.6e3, 0, np.nan])
    np.testing.assert_allclose(stderr, [2166, 0, 0])


def test_bic_of_the_benchmark_chooses_as_etid_does():
    for gain in (0.0, 8.0, 10.0, 40.0):
        fits = drawn([1000.0, 3000.0, 5000.0, 1000.0 - gain, 1000.0 - gain]).fits
        assert choose(fits, CRITERIA["BIC"]) == best(fits)
    # AICc asks for less: a gain of 6 pays for one element.
    fits = drawn([1000.0, 3000.0, 5000.0, 994.0, 994.0]).fits
    assert [choose(fits, CRITERIA[name]) for name in ("BIC", "AICc")] == [SKIN, COLE]


def test_a_row_counts_choices_and_intervals(tmp_path):
    unlikely = [1000.0, 3000.0, 5000.0, 1010.0, 1010.0]
    good, wide = drawn(unlikely, driver=0, off=1.001), drawn(unlikely, driver=1, off=1.05)
    rich = drawn([1000.0, 3000.0, 5000.0, 900.0, 900.0], driver=2)
    row = cell([good, wide, rich])
    assert (row["chose_SkinRC"], row["chose_SkinCole"], row["richer"]) == (2, 1, 1)
    assert row["decisive"]
    inside, drivers = covered([good, wide], "R_s")
    assert (inside, drivers) == ([True, False], [0, 1])
    right = next(selection.chosen([row], [good, wide, rich]))
    assert right.value == pytest.approx(2 / 3)
    assert not right.met
    selection.draw([row], tmp_path / "chart.svg")
    assert "one RC, dry" in (tmp_path / "chart.svg").read_text()


def test_a_circuit_without_a_series_resistor_claims_that_it_is_zero():
    [cell_of] = [
        one
        for one in selection_counts.chosen_cells()
        if (one.chart, one.row, one.column) == (selection_counts.OTHER_SKIN, "60 dB", "Cole, 0.9")
    ]
    path, bound = cell_of.scene.trials[0].path, np.array([0.01, 0.01, np.nan])
    fit = made(etid.ParallelRC(186e3, 0.12e-9), 1000.0)
    said = judged(cell_of, AUTO, 0, path, fit, bound)
    assert said.error[0] == -1
    assert said.missed
    cole = made(etid.SkinCole(33.4e3, 186e3, 22e-6, 0.9), 1000.0)
    assert selection_counts.is_right(judged(cell_of, AUTO, 0, path, cole, bound))


def test_the_noise_of_exact_spectra_is_what_the_rival_is_told_and_choices_are_counted_by_truth():
    f, z, sigma, used = selection_rival.exact(40.0, selection.FIRST)
    assert used.all()
    for row, circuit in enumerate(TRUTHS.values()):
        error = z[row] - np.asarray(circuit.response(jnp.asarray(f)))
        square = np.mean(np.abs(error / sigma[row]) ** 2)
        # |noise|² / σ² is exponential, with deviation 1; four deviations of the mean.
        assert square == pytest.approx(1.0, abs=4 / np.sqrt(f.size))
    names = np.array([type(circuit).__name__ for circuit in TRUTHS.values()])
    wrong = np.where(np.arange(names.size) == 0, "SkinLayers", names)
    found = selection_rival.by_truth(np.concatenate([names, wrong]), np.zeros(2 * names.size))
    assert found.right.shape == (names.size, 2)
    assert found.right.sum(0).tolist() == [names.size, names.size - 1]
