"""Each benchmark runs in short, writes its tables and pictures, and says what it was asked."""

import csv
import importlib
import shlex
import shutil
import types

import jax
import numpy as np
import pytest

import etid
import etid.display
from benchmarks import __main__ as entry
from benchmarks import (
    amplitude_errors,
    amplitudes,
    curves,
    excitations,
    peers,
    scale,
    selection,
    selection_draws,
    spectra,
    which,
)  # fmt: skip
from benchmarks.__main__ import NAMES, asked
from benchmarks.display import (
    control_loop,
    online,
    online_alarms,
    online_faults,
    online_instruments,
)
from benchmarks.display.control_hazards import Hazards
from benchmarks.failure_draws import Effort
from benchmarks.peers import START, ByNumPy, problem
from benchmarks.rivals import RivalError
from etid.display.stimulator import PAUSE, Output, Stimulator

# What is run of each benchmark, what it writes into the folder {}, and what its output must say.
# So few draws scatter too much for most targets.
HAZARDS = "--hazard-electrodes 19 --hazard-pulses 30 --loop-draws 1"
CASES = {
    "amplitude_errors": ("--draws 2", "", "scene 0: covered"),
    "amplitudes": ("", "", "error of harmonic balance"),
    "control": (
        f"--electrodes 4 --pulses 4 --snr 60 {HAZARDS} --output {{}}/control.csv",
        "control.svg control.csv control_loop.csv",
        "above the cap but the first after an unseen change  0",
    ),
    "coverage": ("--repetitions 3 --parts 0.03", "", "dry, default: covered"),
    "curves": ("--quick --folder {}", "curves.csv curves.svg", "LM fit, optimistix"),
    "delays": ("--scatter 3e-9 --snr-db 60", "", "3 ns: 64, 64, 82, dropped"),
    "design": ("", "", "times better than 60 Hz"),
    "directions": (
        "--drivers 2 --snr-db 60 --parts 0.03 --workers 1", "", "gain: deviation",
    ),
    "driver_order": ("--drivers 1 --snr-db 60 --orders 5 7 --data {}", "", "100 % right"),
    "excitations": (
        "--draws 2 --workers 1 --folder {}", "excitations.csv", "record current, held  fits 2",
    ),
    "fuzz": ("--files 3 --kind csv", "", "wrong error: 0.00 %"),
    "inexact": (
        "--drivers 1 --snr-db 60 --sizes 0.002 --driver-sizes 0.005 --lengths 1 --workers 1", "",
        "δ of Z_th 0.50%, length 1, damp: within 1.96 ±",
    ),
    "instruments": (
        "--quick --folder {0} --data {0}", "instruments.csv instruments.svg",
        "oscilloscope_12_bit: rms error / bound",
    ),
    "live": (
        "--electrodes 4 --minutes 0.02 --output {}/live.csv", "live.csv",
        "growth of the page's memory [MB]",
    ),
    "noise": ("--drivers 2 --snr-db 60 --only white", "", "60 dB, white, dry: covered"),
    "real": ("--data {}/none", "", "skipped: no recordings"),
    "online": (
        "--electrodes 4 --ticks 3 --hours 0.01 --output {}/online.csv", "online.csv",
        "wet skin that is found within 2 pulses",
    ),
    "paper": (
        "--quick --folder {}", "table_1.csv table_4.csv table_4.svg",
        "element r_s  paper_error 15.5  paper_scatter 43.2  error -2",
    ),
    "perturbations": (
        "--quick --snr-db 60 --folder {}", "perturbations.csv perturbations.svg",
        "undisturbed recordings refused    ",
    ),
    "referee": ("", "", "not installed"),
    "rivals": ("scipy_harmonics --draws 1", "", "not installed"),
    "selection": (
        "--quick --workers 1 --folder {}",
        "selection.csv selection_map.csv selection.svg", "spurious element, from 20 dB",
    ),
    "spectra": ("--spectra 4 --good 6 --drawn 1 --seed 1", "", "wrong sign"),
    "spectrum_peers": ("--draws 1", "", "not installed"),
    "tolerances": (
        "--draws 2 --snr-db 60 --only gain --workers 1", "", "60 dB, gain, joint, damp: covered",
    ),
    "which": ("--readme {}/README.md", "README.md", "| dry, 60 dB | **0.8"),
}  # fmt: skip
QUICK = ("rivals", "referee", "which")
# Run by `make ranking`, or with tests of their own; `speed` asserts that its peers agree.
OWN = {"failure_map", "mutation", "scale", "speed", "speed_accuracy", "spice"}

# Constants that make a benchmark smaller than its options do.
SMALLER = {
    amplitude_errors: {"SCENES": amplitude_errors.SCENES[:1], "POINTS": 2**9},
    amplitudes: {"FINER": (4,), "REPEATS": 1},
    excitations: {"KINDS": ("bits",)},
    curves: {"LANES": (1, 2), "SAMPLES": (1_000,)},
    online_instruments: {"PULSES": 4},
    online_faults: {"LANES": 4, "DRIVERS": 1, "SNR": (60.0,)},
    online: {"WARM": 3, "NOISES": ((60.0, "before_the_filter"),), "KINDS": 3},
    online_alarms: {"TIMES": 1},
    selection: {
        "FEW": Effort(1, 1), "FEW_PAIRS": 1, "FEW_DRIVERS": 1, "FEW_SNR": (60,), "STEP": 60,
        "BATCH": 2, "SINGLES": 1,
    },
    spectra: {"GOOD_POINTS": (20,)},
}  # fmt: skip

# Each program runs a few times, so that compilation would be most of the time.


@pytest.fixture(autouse=True, scope="module")
def _compiled_at_once():
    """What NumPy does not run is compiled in half the time."""
    usual = jax.config.read("jax_disable_most_optimizations")
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", usual)


@pytest.fixture(autouse=True)
def _small(monkeypatch):
    """Few draws; no rival is installed; nothing turns off the cache of this process."""
    for module in ("rivals", "rivals.table"):
        monkeypatch.setattr(f"benchmarks.{module}.make", lambda _: "not installed")
    monkeypatch.setattr(amplitudes, "PINNED", False)
    for module, constants in SMALLER.items():
        for name, value in constants.items():
            monkeypatch.setattr(module, name, value)
    for name in [name for name in selection_draws.TRUTHS if "damp" in name]:
        monkeypatch.delitem(selection_draws.TRUTHS, name)


def run(name: str, options: str) -> bool:
    """Whether a benchmark meets its targets."""
    arguments = asked([name, *shlex.split(options)])
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):  # jaxopt's
        try:
            return arguments.module.main(arguments)
        except RivalError as error:
            print(error)
            return False


@pytest.mark.parametrize(
    "name", [n if n in QUICK else pytest.param(n, marks=pytest.mark.slow) for n in CASES]
)
def test_each_benchmark_runs_in_short_and_says_what_it_was_asked(
    name, tmp_path, capsys, monkeypatch
):
    if name == "control" and shutil.which("ngspice") is None:
        pytest.skip("ngspice is not installed; Debian package ngspice")
    if name == "amplitudes":
        monkeypatch.setattr(jax.config, "update", lambda *_: None)
    options, files, says = CASES[name]
    (tmp_path / "README.md").write_text(which.README.read_text())
    met = run(name, options.format(tmp_path))
    text = capsys.readouterr().out
    assert says in text
    assert met == ("missed" not in text and "not installed" not in text) or name == "spectra"
    assert name != "amplitudes" or "missed" not in text
    for file in files.split():
        text = (tmp_path / file).read_text()
        assert text.startswith("<?xml") or not file.endswith(".svg")
        if file.endswith(".csv"):
            assert next(csv.DictReader(text.splitlines()))["etid"] == etid.__version__


def test_every_benchmark_has_options_and_a_case_or_a_test_of_its_own():
    assert {*NAMES} == CASES.keys() | OWN
    for name in NAMES:
        assert asked([name]).module.OPTIONS is not None


def at_once(stimulator):
    stimulator.resting = False
    return True


def only_at_rest(stimulator, output, usual=Stimulator._give_zero):
    if output == Output.REST:
        usual(stimulator, output)


def as_before(tracker, *, at_rest=False, after=None, usual=etid.display.Tracker.start):
    return usual(tracker, at_rest=at_rest) if after is None else after


@pytest.mark.slow
def test_hazards_of_the_loop_end_with_0_and_faults_of_the_loop_are_counted(monkeypatch):
    """No limit of the time to the 0, which is longer beside other tests."""
    hazards = Hazards(60.0, 0)
    controller = hazards.controller(control_loop.LANES)
    monkeypatch.setattr(Hazards, "controller", lambda *_: controller)
    monkeypatch.setattr(control_loop, "LONGEST", 300)

    def counted(cells, draws=1):
        rows = list(control_loop.rows(hazards, draws, cells))
        return np.array([[row[name] for name in control_loop.COLUMNS] for row in rows]).T

    def with_fault(of, name, fault, cell, draws=1):
        with monkeypatch.context() as faulty:
            faulty.setattr(of, name, fault)
            return counted([cell], draws)[:, 0]

    numbers = counted(control_loop.CELLS)
    assert not numbers[:3].any()
    assert np.isfinite(numbers[3]).all()
    assert with_fault(Stimulator, "rested", at_once, "backlog")[1] > 0
    assert with_fault(Stimulator, "_give_zero", only_at_rest, "STOP")[0] == 1
    never = with_fault(Stimulator, "_watch", lambda _: None, "silence")
    assert never[3] > 2 * PAUSE * control_loop.PERIOD
    # In half of the runs the skin becomes wet; not each of them gives a pulse then.
    # Beside other tests fewer do: none of eight once.
    assert with_fault(etid.display.Tracker, "start", as_before, "counter from 0", draws=20)[2] > 0


@pytest.mark.slow
def test_spice_scenes_are_fitted(reference_data, tmp_path, capsys):
    folder = reference_data("spice_recordings").parent
    of = f"--scene lab_dry --method maximum_likelihood --data {folder} -o {tmp_path}/s.csv"
    assert run("spice", of)
    assert capsys.readouterr().out.count("silent 0") == 3


@pytest.mark.slow
def test_scale_measures_everything_and_a_killed_run_loses_nothing(tmp_path, monkeypatch, capsys):
    """One layout and one kill: `test_benchmark_counts` reads the others, `test_streaming` kills."""
    monkeypatch.setattr(scale, "LAYOUTS", ("contiguous",))
    monkeypatch.setattr(scale, "KILLS", 1)
    plan = scale.Plan(tmp_path, 60, 6, scale.METHODS[1:])
    rows = list(scale.rows(plan))
    assert len(rows) == 3 + 2  # three ways to read, fitted by 1 and 2 processes
    assert all(row["seconds"] > 0 and row["memory_mb"] > 0 for row in rows)
    assert scale.resume(plan)
    assert "of 10 parts done" in capsys.readouterr().out


@pytest.mark.slow
def test_all_peers_solve_the_same_problem():
    of, every = problem(2000, 2, sample_rate=40e3), np.arange(2)
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):  # jaxopt's
        found = {name: np.stack(run(every)) for name, run in peers.solvers(of).items()}
    for name, elements in found.items():
        # A fraction of a standard error of the logarithms, which are above 1e-3.
        np.testing.assert_allclose(elements, found["ours"], atol=1e-4, err_msg=name)
    load = of.load(jax.tree.map(lambda leaf: leaf[0], of.lanes))
    by, q = ByNumPy(load), START + 0.01
    used = np.concatenate([np.tile(load.records.used[0], 2), [False] * 3, [True]])
    slope = np.asarray(jax.jacfwd(peers.terms)(jax.numpy.asarray(q), load))[used]
    terms = peers.terms(q, load)[used]
    np.testing.assert_allclose(by.terms(q), terms, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(by.jacobian(q), slope, rtol=1e-6, atol=1e-6 * np.abs(slope).max())


def test_a_benchmark_without_its_package_names_what_to_install(monkeypatch, capsys):
    """As after `pip install .`, which brings no extra."""
    usual = importlib.import_module

    def without(name):
        if name == "benchmarks.which":
            raise ModuleNotFoundError("No module named 'adjustText'", name="adjustText")
        return usual(name)

    monkeypatch.setattr(entry, "importlib", types.SimpleNamespace(import_module=without))
    says = "needs the package adjustText: pip install 'etid[bench]' (in a clone: '.[bench]')"
    with pytest.raises(SystemExit) as caught:
        asked(["which", "--output", "a.csv"])
    assert caught.value.code == f"python -m benchmarks which {says}"
    with pytest.raises(SystemExit) as caught:
        asked(["--help"])
    assert caught.value.code == 0
    assert says in " ".join(capsys.readouterr().out.split())
    assert asked(["noise"]).module is usual("benchmarks.noise")
