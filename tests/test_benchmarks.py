"""The benchmarks themselves: what they measure on, and that each runs and says what it should."""

import argparse
import csv
import dataclasses
import os
import subprocess
import sys

import h5py
import jax
import numpy as np
import pytest
import scipy.signal

import etid
from benchmarks import amplitudes, curves, online, peers, scale, spectra, timing
from benchmarks.large_file import LAYOUTS, SAMPLES, large_file
from benchmarks.online_alarms import Alarms
from benchmarks.problem import START, ByNumPy, problem
from benchmarks.provenance import write_csv
from benchmarks.rivals import installed, python_of

FEW = 12  # recordings


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_large_file_follows_the_schema_and_is_made_once(layout, tmp_path):
    path = large_file(tmp_path, FEW, layout)
    assert etid.check(path) == []
    with etid.read(path) as study:
        assert len(study.loaded) == FEW
        assert len(study.calibrations) == 1
        first, second = (study[f"s0000/skin/{row}"] for row in (0, 1))
    assert first.v_out.size == SAMPLES
    assert round(first.periods, 6) == 3
    assert (first.v_out != second.v_out).any()
    before = path.stat().st_mtime_ns
    assert large_file(tmp_path, FEW, layout).stat().st_mtime_ns == before


def test_the_layouts_hold_the_same_samples(tmp_path):
    stacks = []
    for layout in LAYOUTS:
        with h5py.File(large_file(tmp_path, FEW, layout)) as file:
            stacks.append(np.asarray(file["s0000/skin/v_out"]))
    np.testing.assert_array_equal(stacks[0], stacks[1])
    np.testing.assert_array_equal(stacks[0], stacks[2])


def test_files_are_compared_bit_by_bit(tmp_path):
    one, other = tmp_path / "one.h5", tmp_path / "other.h5"
    for path, last in (one, 2.0), (other, np.nextafter(2.0, 3.0)):
        with h5py.File(path, "w") as file:
            file["x"] = [np.nan, last]
            file["note"] = ["a text", "another"]
    assert scale._same(one, one)
    assert not scale._same(one, other)


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


@pytest.mark.slow
def test_scale_measures_everything_and_a_killed_run_loses_nothing(tmp_path):
    plan = scale.Plan(tmp_path, 60, 6, ("equation_error",), "equation_error")
    rows = list(scale.rows(plan))
    assert len(rows) == 3 * 3 + 4  # three ways to read three layouts, fitted by 1, 2, 1, 1 process
    assert all(row["seconds"] > 0 and row["memory_mb"] > 0 for row in rows)
    resumed = scale.resume(plan)
    assert resumed.passed
    assert resumed.parts == 10
    assert resumed.killed_at == sorted(resumed.killed_at)


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
def test_scipy_and_we_do_the_same_before_the_fit(short_problem):
    """Filter, normal equations, Steiglitz-McBride: rounding of a condition of 1e4 apart."""
    every = np.arange(2)
    for stage in (peers._equations(short_problem), peers._steiglitz_mcbride(short_problem)):
        ours, theirs = (np.stack(stage.by[name](every)) for name in ("ours", "scipy"))
        np.testing.assert_allclose(ours, theirs, rtol=1e-8)


@pytest.mark.slow
def test_numpy_writes_the_same_terms(short_problem):
    load = short_problem.load(jax.tree.map(lambda leaf: leaf[0], short_problem.lanes))
    by, q = ByNumPy(load), START + 0.01
    used = np.concatenate([np.tile(np.asarray(load.records.selected), 2), [False] * 3, [True]])
    np.testing.assert_allclose(
        by.terms(q), np.asarray(load(jax.numpy.asarray(q)))[used], rtol=1e-6, atol=1e-9
    )
    slope = np.asarray(jax.jacfwd(load)(jax.numpy.asarray(q)))[used]
    np.testing.assert_allclose(by.jacobian(q), slope, rtol=1e-6, atol=1e-6 * np.abs(slope).max())


@pytest.mark.slow
def test_all_solvers_find_the_same_minimum(short_problem):
    by, every = peers.solvers(short_problem), np.arange(2)
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):  # jaxopt's
        found = {name: np.stack(run(every)) for name, run in by.items()}
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
    assert [row["jaxopt"] is not None for row in table] == [False] * 8 + [True] * 4 + [False] * 2
    monkeypatch.setattr(peers, "stages", lambda p: [peers._filter(p)])
    once, never = peers.rows(2, (1, 3), 1, 0.0)
    assert once["ours"] > 0
    assert never["ours"] is None


def test_slopes_are_those_between_neighbours_of_a_curve():
    times = {"line": (1.0, 10.0, 100.0), "bend": (1.0, 1.0, 10.0)}
    rows = [
        {"against": "samples", "what": what, "number": 10**power, "seconds": seconds[power]}
        for power in range(3)
        for what, seconds in times.items()
    ]
    found = list(curves.with_slopes(rows))
    slopes = {what: [row["slope"] for row in found if row["what"] == what] for what in times}
    np.testing.assert_allclose(slopes["line"], [np.nan, 1.0, 1.0])
    np.testing.assert_allclose(slopes["bend"], [np.nan, 0.0, 1.0], atol=1e-12)
    assert [row["what"] for row in found if row["bent"]] == ["bend"]


@pytest.mark.slow
def test_curves_are_measured_and_drawn(tmp_path, monkeypatch):
    monkeypatch.setattr(curves, "LANES", (1, 2))
    monkeypatch.setattr(curves, "SAMPLES", (1_000,))
    monkeypatch.setattr(curves, "pin", lambda: None)  # it would be for all tests to come
    # Processes are measured above.
    monkeypatch.setattr(scale, "measured", lambda *_: {"seconds": 1.0})
    curves.run(quick=True, folder=tmp_path)
    with (tmp_path / "curves.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["against"] for row in rows} == {"samples", "lanes", "workers"}
    assert all(float(row["seconds"]) > 0 for row in rows)
    assert (tmp_path / "curves.svg").read_text().startswith("<?xml")


def test_no_false_alarm_in_three_hours_is_at_most_one_per_hour():
    """The rule of three: exp(−rate · hours) = 0.05."""
    found = Alarms(hours=-np.log(0.05), false=0, driver=0, changes=8, found=6)
    np.testing.assert_allclose(found.hourly(), 1.0)
    assert found.soon() == 0.75
    assert dataclasses.replace(found, false=1).hourly() > 1


def test_a_number_that_could_not_be_had_misses_its_target():
    assert not online.Line("rival", np.nan, least=10.0).met()
    assert not online.Line("tick", 0.2, most=0.1).met()
    assert online.Line("tick", 0.05, most=0.1).met()
    assert online.Line("hours", np.nan).met()


CASES = [one.name for one in amplitudes.cases(8)]
EXACT = 1e-8  # of the peak; DOP853 has tolerances of 1e-9


@pytest.mark.parametrize("number", range(2), ids=CASES)
def test_the_reference_of_a_linear_skin_is_its_closed_form(number):
    case = amplitudes.cases(834)[number]
    case = case._replace(skin=etid.SkinCurrent(**{**named(case), "i_0": 1e6}))
    linear = {name: of for name, of in named(case).items() if name != "i_0"}
    points = 16 * case.samples  # so that nothing of the current pulses aliases
    t = np.arange(points) / points / amplitudes.PULSE_RATE
    s = 2j * np.pi * amplitudes.PULSE_RATE * np.arange(points // 2 + 1)
    z = linear["r_s"] + linear["r_p"] / (1 + s * linear["r_p"] * linear["c_p"])
    if case.v_th is None:
        voltage = np.fft.rfft(amplitudes.pulses(t)) * z
    else:
        z_th = amplitudes.RESISTANCE + amplitudes.INDUCTANCE * s
        voltage = np.fft.rfft(case.fine(16)) * z / (z + z_th)
    expected = np.fft.irfft(voltage)[::16]
    found = amplitudes.reference(case)
    np.testing.assert_allclose(found, expected, atol=EXACT * np.abs(expected).max())


def named(case: amplitudes.Case) -> dict[str, float]:
    """The elements of its skin."""
    return dict(zip(case.skin.names(), case.skin.values().tolist(), strict=True))


@pytest.mark.slow
@pytest.mark.parametrize("number", range(2), ids=CASES)
def test_harmonic_balance_and_diffrax_find_the_same_response(number):
    case = amplitudes.cases()[number]
    truth = amplitudes.reference(case)
    lines = [amplitudes.by_balance(case, truth, 4)]
    if installed(amplitudes.ENVIRONMENT):
        python = python_of(amplitudes.ENVIRONMENT)
        lines += amplitudes.by_diffrax(case, truth, python, (("Dopri8", 1e-5),))
    assert all(line.error < 1e-4 for line in lines), lines  # a record at 80 dB tells no more


def test_a_rival_that_is_not_installed_is_said(monkeypatch, capsys):
    monkeypatch.setattr(amplitudes, "make", lambda _: "failed to install")
    monkeypatch.setattr(amplitudes, "pin", lambda: None)
    monkeypatch.setattr(jax.config, "update", lambda *_: None)
    monkeypatch.setattr(amplitudes, "by_balance", lambda *_: amplitudes.Line("ours", 0, 1, 2, 3))
    monkeypatch.setattr(amplitudes, "reference", lambda _: np.ones(8))
    assert not amplitudes.main(argparse.Namespace(samples=8))
    assert "diffrax: failed to install" in capsys.readouterr().out


@pytest.mark.slow
def test_a_spectrum_with_a_fault_is_never_called_successful_and_wrong(capsys):
    assert spectra.main(argparse.Namespace(spectra=15, good=15, seed=1))
    printed = capsys.readouterr().out
    assert printed.count("silent: 0") == len(spectra.FAULTS)
    assert printed.count("misfit") >= len(spectra.FAULTS)


def test_an_answer_that_is_wrong_beyond_its_errors_is_silent():
    right = spectra.good(np.random.default_rng(0))
    name = next(iter(right.truth))
    low = right.truth[name][0]
    moved = dataclasses.replace(right, truth={**right.truth, name: (1.5 * low, 1.5 * low)})
    assert not spectra.answer(right).silent
    assert spectra.answer(moved).silent
    assert spectra.answer(dataclasses.replace(right, truth={})).silent
