"""Each benchmark runs on a small case, says what it should, and writes its tables and pictures."""

import csv
import os
import subprocess
import sys

import h5py
import jax
import numpy as np
import pytest
import scipy.signal

import etid
from benchmarks import amplitudes, curves, peers, scale, timing, which
from benchmarks.__main__ import NAMES, asked
from benchmarks.problem import START, ByNumPy, problem
from benchmarks.provenance import write_csv
from benchmarks.rivals import installed
from benchmarks.rivals.roster import RIVALS
from benchmarks.spectra import FAULTS

# What is run of each benchmark, whether it meets its targets on so few draws (None: it may not),
# and what it writes into the folder {}. Those without a line have tests of their own below, or in
# `test_report.py` (paper) and `test_mutation.py`.
CASES = {
    "amplitude_errors": (["--draws", "2"], None, []),
    "control": (
        ["--electrodes", "4", "--pulses", "4", "--snr", "60", "--hazard-electrodes", "12",
         "--hazard-pulses", "30", "--output", "{}/control.svg"], None,
        ["control.svg", "control.csv"]),
    "coverage": (["--repetitions", "3", "--parts", "0.03"], True, []),
    "delays": (["--studies", "2", "--scatter", "0", "--snr-db", "60"], True, []),
    "design": ([], True, []),
    "driver_order": (
        ["--drivers", "1", "--snr-db", "60", "--orders", "4", "5", "--data", "{}"], True, []),
    "failure_map": (
        ["--quick", "--workers", "1", "--folder", "{}"], True, ["failures.csv", "failures_4.svg"]),
    "fuzz": (["--files", "3", "--kind", "csv", "--output", "{}/f.json"], True, ["f.json"]),
    "noise": (["--drivers", "2", "--snr-db", "60", "--only", "white"], True, []),
    "online": (
        ["--electrodes", "4", "--ticks", "3", "--hours", "0.01", "--output", "{}/online.csv"],
        None, ["online.csv"]),
    "perturbations": (
        ["--quick", "--snr-db", "60", "--folder", "{}"], True,
        ["perturbations.csv", "perturbations.svg"]),
    "selection": (
        ["--quick", "--drivers", "1", "--workers", "1", "--folder", "{}"], None,
        ["selection.csv", "selection_map.csv", "selection.svg"]),
    "spectra": (["--spectra", "15", "--good", "15", "--seed", "1"], True, []),
    "speed_accuracy": (
        ["--quick", "--scene", "dry, 60 dB", "--folder", "{}"], True,
        ["speed_accuracy.csv", "speed_accuracy.svg", "speed_accuracy_all.svg"]),
    "timing": (["--lanes", "2"], True, []),
    "which": (["--readme", "{}/README.md"], True, ["README.md"]),
}  # fmt: skip
QUICK = ("design", "fuzz", "which")


@pytest.fixture(autouse=True)
def _no_environments(monkeypatch):
    """No test installs a rival, pins the process to a core, or turns off its cache."""
    for name in ("amplitudes", "online_rival", "referee"):
        monkeypatch.setattr(f"benchmarks.{name}.make", lambda _: "not installed")
    monkeypatch.setattr("benchmarks.selection_rival.missing", lambda: "not installed")
    monkeypatch.setattr("benchmarks.rivals.table.install", lambda _: {"common": "not installed"})
    monkeypatch.setattr(curves, "pin", lambda: None)


def run(name: str, *options: str) -> bool:
    """Whether a benchmark meets its targets."""
    arguments = asked([name, *options])
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):  # jaxopt's
        return arguments.module.main(arguments)


@pytest.mark.parametrize(
    "name", [n if n in QUICK else pytest.param(n, marks=pytest.mark.slow) for n in CASES]
)
def test_each_benchmark_runs_on_a_small_case_and_writes_what_it_should(name, tmp_path, capsys):
    options, met, files = CASES[name]
    (tmp_path / "README.md").write_text(which.README.read_text())
    found = run(name, *(option.format(tmp_path) for option in options))
    assert isinstance(found, bool)
    assert met is None or found == met, capsys.readouterr().out
    for file in files:
        text = (tmp_path / file).read_text()
        assert text.startswith("<?xml") or not file.endswith(".svg")
        if file.endswith(".csv"):
            assert next(csv.DictReader(text.splitlines()))["etid"] == etid.__version__


def test_every_benchmark_has_options_and_a_case_or_a_test_of_its_own():
    own = {"amplitudes", "curves", "mutation", "paper", "referee", "rivals", "scale", "speed"}
    assert {*NAMES} == CASES.keys() | own | {"spice"}
    for name in NAMES:
        assert asked([name]).module.OPTIONS is not None


@pytest.mark.parametrize("name", ["referee", "rivals", "amplitudes"])
def test_a_rival_that_is_not_installed_is_said_and_misses_the_target(name, capsys, monkeypatch):
    monkeypatch.setattr(jax.config, "update", lambda *_: None)
    monkeypatch.setattr(amplitudes, "cases", lambda _: ())
    assert not run(name, *(["scipy_harmonics", "--draws", "1"] if name == "rivals" else []))
    assert "not installed" in capsys.readouterr().out
    assert "scipy_harmonics" in RIVALS


@pytest.mark.slow
def test_spice_scenes_are_fitted(reference_data, tmp_path, capsys):
    folder = reference_data("spice_recordings")
    options = ["--scene", "lab_dry", "--method", "maximum_likelihood"]
    assert run("spice", *options, "--data", str(folder.parent), "-o", str(tmp_path / "s.csv"))
    assert capsys.readouterr().out.count("silent 0") == 3


@pytest.mark.slow
def test_no_fault_of_a_spectrum_is_without_a_misfit(capsys):
    assert run("spectra", "--spectra", "15", "--good", "15", "--seed", "1")
    assert capsys.readouterr().out.count("misfit") >= len(FAULTS)


# --- tables, processes, files ---------------------------------------------------------------------


def test_a_table_says_where_it_comes_from(tmp_path):
    write_csv(tmp_path / "deep" / "table.csv", [{"what": "a, b", "seconds": 1.5}])
    with (tmp_path / "deep" / "table.csv").open() as file:
        (row,) = csv.DictReader(file)
    assert (row["what"], row["seconds"], row["etid"]) == ("a, b", "1.5", etid.__version__)
    assert row["commit"]
    assert row["machine"]


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="needs Linux")
def test_processes_begin_on_as_many_cores_as_they_have_workers():
    own = os.sched_getaffinity(0)
    with timing.cores(1):
        count = [sys.executable, "-c", "import os; print(len(os.sched_getaffinity(0)))"]
        assert int(subprocess.run(count, capture_output=True, check=True).stdout) == 1
    assert os.sched_getaffinity(0) == own


def test_files_are_compared_bit_by_bit(tmp_path):
    one, other = tmp_path / "one.h5", tmp_path / "other.h5"
    for path, last in (one, 2.0), (other, np.nextafter(2.0, 3.0)):
        with h5py.File(path, "w") as file:
            file["x"] = [np.nan, last]
            file["note"] = ["a text", "another"]
    assert scale._same(one, one)
    assert not scale._same(one, other)


@pytest.mark.slow
def test_scale_measures_everything_and_a_killed_run_loses_nothing(tmp_path):
    plan = scale.Plan(tmp_path, 60, 6, ("equation_error",), "equation_error")
    rows = list(scale.rows(plan))
    assert len(rows) == 3 * 3 + 4  # three ways to read three layouts, fitted by 1, 2, 1, 1 process
    assert all(row["seconds"] > 0 and row["memory_mb"] > 0 for row in rows)
    resumed = scale.resume(plan)
    assert resumed.passed
    assert resumed.parts == 10


# --- speed ----------------------------------------------------------------------------------------


def test_steiglitz_mcbride_in_numpy_recovers_a_filter_without_noise():
    """Z = N/D between the voltages of a divider with a source of 2 ohm."""
    num, den = np.array([3.0, -1.0]), np.array([1.0, -0.7])
    v_out = np.random.default_rng(5).normal(size=500)
    current = scipy.signal.lfilter(den, num, v_out)
    found = peers.numpy_steiglitz_mcbride(
        v_out + 2 * current, v_out, np.array([2.0]), np.array([1.0]), 3
    )
    # X = 2 i and W = 2 v_out, so that N/D = Z; the recursion starts at rest, as lfilter does.
    np.testing.assert_allclose(found[0], num, rtol=1e-10)
    np.testing.assert_allclose(found[1], den, rtol=1e-10)


@pytest.fixture(scope="module")
def short_problem():
    return problem(2000, 2, sample_rate=40e3)


@pytest.mark.slow
def test_all_peers_solve_the_same_problem(short_problem):
    every = np.arange(2)
    for stage in list(peers._on_samples(short_problem))[1:]:
        ours, theirs = (np.stack(stage.by[name](every)) for name in ("ours", "scipy"))
        np.testing.assert_allclose(ours, theirs, rtol=1e-8)  # rounding of a condition of 1e4
    load = short_problem.load(jax.tree.map(lambda leaf: leaf[0], short_problem.lanes))
    by, q = ByNumPy(load), START + 0.01
    used = np.concatenate([np.tile(np.asarray(load.records.selected), 2), [False] * 3, [True]])
    slope = np.asarray(jax.jacfwd(load)(jax.numpy.asarray(q)))[used]
    terms = np.asarray(load(jax.numpy.asarray(q)))[used]
    np.testing.assert_allclose(by.terms(q), terms, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(by.jacobian(q), slope, rtol=1e-6, atol=1e-6 * np.abs(slope).max())
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):  # jaxopt's
        found = {name: np.stack(run(every)) for name, run in peers.solvers(short_problem).items()}
    for name in peers.NAMES[1:]:
        # A fraction of a standard error of the logarithms, which are above 1e-3.
        np.testing.assert_allclose(found[name], found["ours"], atol=1e-4, err_msg=name)


@pytest.mark.slow
def test_every_stage_is_timed_and_what_takes_too_long_is_left_out(short_problem, monkeypatch):
    monkeypatch.setattr(peers, "problem", lambda samples, lanes: short_problem)
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):  # jaxopt's
        table = peers.show(peers.rows(2, (1, 3), 1, np.inf))
    assert len(table) == 2 * 7
    assert all(row["ours"] > 0 for row in table)
    monkeypatch.setattr(peers, "stages", lambda p: list(peers._on_samples(p))[:1])
    once, never = peers.rows(2, (1, 3), 1, 0.0)
    assert once["ours"] > 0
    assert never["ours"] is None


@pytest.mark.slow
def test_curves_are_measured_and_drawn(tmp_path, monkeypatch):
    monkeypatch.setattr(curves, "LANES", (1, 2))
    monkeypatch.setattr(curves, "SAMPLES", (1_000,))
    # Processes are measured above.
    monkeypatch.setattr(scale, "measured", lambda *_: {"seconds": 1.0})
    assert run("curves", "--quick", "--folder", str(tmp_path))
    with (tmp_path / "curves.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["against"] for row in rows} == {"samples", "lanes", "workers"}
    assert (tmp_path / "curves.svg").read_text().startswith("<?xml")


@pytest.mark.slow
@pytest.mark.parametrize("number", range(2))
def test_harmonic_balance_and_diffrax_find_the_same_response(number):
    case = amplitudes.cases()[number]
    truth = amplitudes.reference(case)
    lines = [amplitudes.by_balance(case, truth, 4)]
    if installed(amplitudes.ENVIRONMENT):
        lines += amplitudes.by_diffrax(case, truth, (("Dopri8", 1e-5),))
    assert all(line.error < 1e-4 for line in lines), lines  # a record at 80 dB tells no more
