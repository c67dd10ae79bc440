"""The command line: what it prints, what it writes, how it ends."""

import json
import os
import pathlib
import re
import subprocess
import sys

import h5py
import jax
import numpy as np
import pytest
import shtab

import etid
from benchmarks.specimens import study_fits
from etid import cli
from etid.commands import calibrate, fit, simulate
from etid.simulation import displays
from etid.simulation.calibration import CheckedCalibration

DONE, WRONG_DATA, WRONG_USAGE = 0, 1, 2


@pytest.fixture
def run(capsys):
    """Run a command; its status, and its lines on stdout and stderr."""

    def run(*arguments):
        try:
            status = cli.main([str(argument) for argument in arguments])
        except SystemExit as stop:
            status = stop.code
        captured = capsys.readouterr()
        return status, captured.out.splitlines(), captured.err.splitlines()

    return run


@pytest.fixture
def study_file(tmp_path):
    """A calibration, three good dry trials, and one with NaN."""
    scene = etid.scenes.paper_dry(bits=None)
    recordings = list(scene.simulate(seed=5).recordings())[:5]
    v_out = recordings[2].v_out.copy()
    v_out[100] = np.nan
    recordings[2] = recordings[2].replace(v_out=v_out)
    path = tmp_path / "study.h5"
    etid.Study.from_recordings(recordings).write(path)
    return path


@pytest.fixture(scope="session")
def without_driver(tmp_path_factory):
    """A file of 23 recordings whose calibration is flat."""
    recordings = [
        one.replace(v_out=np.zeros_like(one.v_out)) if one.r_load else one
        for one in etid.scenes.paper_built(bits=None).simulate(seed=0).recordings()
    ]
    path = tmp_path_factory.mktemp("without_driver") / "study.h5"
    etid.Study.from_recordings(recordings).write(path)
    return path


def as_json(printed):
    """The one object that stands on stdout; NaN and Infinity are no JSON."""

    def refuse(constant):
        raise AssertionError(f"{constant} is no JSON")

    (line,) = printed
    return json.loads(line, parse_constant=refuse)


def test_simulate_writes_a_study_and_its_truth_and_the_seed_decides(run, tmp_path):
    files = [tmp_path / name for name in ("a.h5", "b.h5", "c.h5")]
    for file, seed in zip(files, (1, 1, 2), strict=True):
        options = ("--snr-db", 50, "--jitter", 1e-7, "--seed", seed, "--force")
        options = (*options, "--truth", tmp_path / "t.json")
        assert run("simulate", "paper_dry", "-o", file, *options) == (
            DONE, [f"{file}: 11 recordings"], [],
        )  # fmt: skip
    records = []
    for file in files:
        with etid.read(file) as study:
            assert len(study) == 11
            records.append(study["typical/dry/03"].v_out)
    assert np.array_equal(records[0], records[1])
    assert not np.array_equal(records[0], records[2])
    truth = json.loads((tmp_path / "t.json").read_text())
    assert truth["typical/dry/03"] == {"r_s": 33.4e3, "r_p": 186e3, "c_p": 0.12e-9}


@pytest.mark.parametrize("preset", ["paper_built", "paper_dry", "paper_damp", "paper_subjects"])
def test_no_recording_of_the_default_seed_is_refused(preset):
    """As one good recording in some thousand is by chance: no first sight of etid."""
    study = etid.scenes.PRESETS[preset]().simulate(simulate.SEED)
    assert set(etid.identify_study(study).fits.verdicts) == {"successful"}


def test_check_names_every_wrong_field(run, study_file):
    with h5py.File(study_file, "a") as file:
        file["calibration/98k8/v_th"].attrs["unit"] = "millivolt"
        file["typical/dry/01"].attrs["sample_rate"] = 0.0
        del file["typical/dry/03/v_out"]
    status, printed, _ = run("check", study_file)
    assert status == WRONG_DATA
    assert printed == [str(problem) for problem in etid.check(study_file)]
    assert len(printed) == 4
    assert any("'typical/dry/02', v_out: 1 of 10000" in line for line in printed)  # the NaN


def test_check_names_a_constant_current_and_remarks_on_an_implausible_one(run, tmp_path):
    """A unit cannot be told for sure, so it is a remark, with the sizes found."""
    i = 1e-3 * np.sin(2 * np.pi * 60 * np.arange(10_000) / 200e3)
    milli = etid.Recording(
        v_out=5e4 * i, current=1e3 * i, sample_rate=200e3, pulse_rate=60.0, path="milli"
    )
    constant = milli.replace(current=0 * i + 1e-3, path="constant")
    for name, recordings in (("remark.h5", [milli]), ("fault.h5", [milli, constant])):
        etid.Study.from_recordings(recordings).write(tmp_path / name)
    status, [_, line], _ = run("check", tmp_path / "remark.h5")
    assert status == DONE
    assert line.startswith("milli: v_out spans 100 V and current 2 A, 50 ohm. ")
    status, [line], _ = run("check", tmp_path / "fault.h5")
    assert status == WRONG_DATA
    assert "'constant', current: is constant, 0.001 A. Record the current" in line


def test_import_turns_a_table_into_a_file_that_check_accepts(run, tmp_path):
    table = tmp_path / "table.csv"
    values = np.random.default_rng(0).normal(size=(500, 2))
    np.savetxt(table, values, delimiter=",", header="open,skin", comments="")
    target = tmp_path / "study.h5"
    arguments = ("--v-th", "open", "--v-out", "skin", "--sample-rate", 2e5, "--pulse-rate", 60)
    more = ("--scale", 0.0535, "--subject", "s01", "--condition", "dry")
    assert run("import", table, "-o", target, *arguments, *more) == (
        DONE,
        [
            "loaded/0: 500 samples at 200000 Hz (command), pulses at 60 Hz",
            "  v_th    'open' in V (command), divided by 0.0535",
            "  v_out   'skin' in V (command), divided by 0.0535",
        ],
        [],
    )
    assert run("check", target)[0] == DONE
    with etid.read(target) as study:
        recording = study["loaded/0"]
    assert (recording.subject, recording.condition) == ("s01", "dry")
    np.testing.assert_allclose(recording.v_out, values[:, 1] / 0.0535, rtol=1e-12)


def test_fit_writes_all_fits_and_one_bad_recording_costs_itself(run, study_file, tmp_path):
    with h5py.File(study_file, "a") as file:
        file.create_group("typical/dry/99").attrs.update(kind="loaded")  # cannot be read
    target = tmp_path / "fits.h5"
    status, printed, complaints = run("fit", study_file, "-o", target)
    assert (status, complaints) == (DONE, [])
    assert printed[0] == "5 fits of SkinRC: 3 successful, 1 nonfinite_samples, 1 unreadable"
    (row,) = (line.split() for line in printed if line.startswith("  typical dry"))
    assert row[2] == "3/4"
    r_s, error = float(row[3]), float(row[5])
    assert abs(r_s - 33.4) < 5 * error < r_s  # five standard errors: 1 in 10⁶ by chance
    assert any(line.split()[:3] == ["calibration/98k8", "5", "successful"] for line in printed)
    assert any(line.startswith("  typical/dry/99: unreadable. ") for line in printed)
    assert any(line.startswith("  typical/dry/02: nonfinite_samples. ") for line in printed)
    fits = etid.Fits.read(target)
    assert fits.labels["path"].tolist() == [f"typical/dry/{i:02d}" for i in (1, 2, 3, 4, 99)]
    assert "typical/dry/99" in fits.notes[-1]

    _, printed, _ = run("fit", study_file, "-o", target, "--json", "--force")
    data = as_json(printed)
    files = {"source": str(study_file), "target": str(target)}
    assert data.items() >= {"command": "fit", "status": DONE, "recordings": 5, **files}.items()
    assert data["method"] == "maximum_likelihood"
    assert data["units"] == {"r_s": "ohm", "r_p": "ohm", "c_p": "farad"}
    expected = {"successful": 3, "nonfinite_samples": 1, "unreadable": 1}
    assert data["verdicts"] == fits.counts() == expected
    (driver,) = data["drivers"]
    assert driver["calibrations"] == ["calibration/98k8"]
    assert (driver["verdict"], driver["order"]) == ("successful", 5)
    assert 0 < driver["rrse"] < 0.01
    groups = data["groups"], fits.summary("subject", "condition")
    told, kept = ([group for group in of if group["subject"]] for of in groups)
    assert told == kept
    failed, _ = data["unusable"]
    assert (failed["path"], failed["verdict"]) == ("typical/dry/02", "nonfinite_samples")
    assert failed["note"]


def test_fit_joint_fits_all_recordings_together(run, study_file, tmp_path, monkeypatch):
    asked = {}

    def jointly(_, **options):
        asked.update(options)
        return study_fits()

    monkeypatch.setattr(fit, "identify_jointly", jointly)
    status, printed, _ = run("fit", study_file, "-o", tmp_path / "f.h5", "--joint", "--order", 4)
    assert asked["order"] == 4
    assert len(printed) > 1
    assert status == DONE


def test_fit_without_any_success_says_so_and_lists_twenty_at_most(run, without_driver, tmp_path):
    target = tmp_path / "fits.h5"
    status, printed, _ = run("fit", without_driver, "-o", target)
    assert status == WRONG_DATA
    assert printed[0] == "23 fits of SkinRC: 23 driver_failed"
    (driver,) = (line for line in printed if line.startswith("  calibration/98k8: "))
    assert "calibration 'calibration/98k8': flat." in driver
    (explained,) = (line for line in printed if "driver_failed. " in line)  # not one for each
    assert explained.count("built/") == 20
    assert "'calibration/98k8': flat." in explained
    assert "  … and 3 more unusable; their notes say why" in printed
    assert len(etid.Fits.read(target)) == 23


LONG = f"{'a' * 300}.h5"
OPEN = "--v-th open --v-out open --scale 1 --pulse-rate 60 --sample-rate 2e5"
TWICE = "--calibration c.csv 1 --calibration c.csv 2"


@pytest.mark.parametrize(
    ("command", "words"),
    [
        ("fit absent.h5 -o fits.h5", "absent.h5: there is no such file"),
        ("fit garbage.h5 -o fits.h5", "garbage.h5: is not an HDF5 file"),
        ("fit calibration.h5 -o f.h5", "calibration.h5: there is no loaded recording. Import one"),
        ("import absent.csv -o out.h5", "absent.csv: there is no such file"),
        ("import table.csv -o out.h5", "v_th, v_out, pulse_rate, scale: are not given"),
        (f"import table.csv -o s.h5 {OPEN}", "v_out: is channel 'open', and so is v_th"),
        (f"import a.csv -o s.h5 {TWICE}", "c.csv, calibrations: is given with two resistors"),
        ("fit study.h5 -o absent/f.h5", "absent/f.h5: the folder of this file does not exist"),
        ("simulate paper_dry -o absent/s.h5", "absent/s.h5: the folder of this file"),
        ("simulate paper_dry -o s.h5 --truth absent/t.json", "absent/t.json: the folder"),
        ("import table.csv -o absent/s.h5", "absent/s.h5: the folder of this file"),
        ("report fits.h5 -o absent/page.html", "absent/page.html: the folder of"),
        ("export fits.h5 -o absent/t.csv", "absent/t.csv: the folder of this file"),
        ("fit study.h5 -o .", ".: this is a folder"),
        (f"fit {LONG} -o f.h5", f"{LONG}: cannot be opened (File name too long). Check its name"),
        (f"fit study.h5 -o {LONG}", f"{LONG}: cannot be written (File name too long"),
        ("check caf\udce9.h5", r"'caf\udce9.h5': this name is not UTF-8; rename the file"),
        ("fit study.h5 -o table.csv", "table.csv: the file is not written as .csv; "),
        ("report fits.h5 -o page.pdf", "page.pdf: the file is not written as .pdf; "),
        ("fit study.h5 -o calibration.h5", "this file exists; add --force to replace"),
        ("fit study.h5 -o f.h5 --joint --method output_error", "--joint uses maximum_likelihood"),
        ("fit study.h5 -o f.h5 --joint --tolerance drift=0.1", "no drift between them"),
        ("fit study.h5 -o f.h5 --joint --driver d.h5", "remove --driver, or --joint"),
        ("fit study.h5 -o f.h5 --joint --resume", "--joint is one fit per driver"),
        ("report study.h5", "run etid fit first"),
        ("simulate paper_dry -o s.h5 --jitter 5", "below half a pulse period"),
        ("simulate paper_dry -o s.h5 --jitter -1", "must not be negative"),
        ("simulate paper_calibration -o s.h5 --stream p.h5", "no skin for a stream; choose"),
        ("simulate paper_dry -o s.h5 --seed -1", "seed is -1; it must not be negative"),
    ],
)
def test_an_error_is_one_line_without_a_traceback(
    run, study_file, tmp_path, monkeypatch, command, words
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "garbage.h5").write_bytes(b"no HDF5")
    (tmp_path / "table.csv").write_text("open,skin\n1,2\n")
    etid.scenes.paper_calibration().simulate(seed=0).write(tmp_path / "calibration.h5")
    status, printed, [complaint] = run(*command.split())
    assert (status, printed) == (WRONG_DATA, [])
    assert complaint.startswith("etid: error: ")
    assert words in complaint
    status, printed, again = run(*command.split(), "--json")
    error = {"command": command.split()[0], "status": status, "error": complaint[13:]}
    assert (again, as_json(printed)) == ([complaint], error)


@pytest.mark.parametrize(
    "command",
    [
        "fit FILE -o FILE",
        "import FILE -o FILE",
        "import table.csv --mapping FILE -o FILE",
        "fit other.h5 --driver FILE -o FILE",
        "calibrate other.h5 --former FILE -o FILE",
        "report FILE --recordings PAGE",
        "simulate paper_dry -o new --truth new",
    ],
)
def test_no_file_of_a_command_is_replaced_by_another(run, study_file, monkeypatch, command):
    monkeypatch.chdir(study_file.parent)
    before = study_file.read_bytes()
    named = {"FILE": study_file, "PAGE": study_file.with_suffix(".html")}
    status, _, complaints = run(*(named.get(word, word) for word in command.split()), "--force")
    assert status == WRONG_USAGE
    assert "is already a file of this command; name another to write" in complaints[-1]
    assert study_file.read_bytes() == before


def test_keys_of_json_are_those_of_the_guide_and_options_are_passed_on(
    run, study_file, tmp_path, monkeypatch
):
    def calibrated(records, order, former):
        driver = etid.identify_driver(records, method="steiglitz_mcbride", throw=False)
        return CheckedCalibration(driver, [1e-3], {})

    monkeypatch.setattr(calibrate, "calibrate", calibrated)
    monkeypatch.setattr(displays, "REPEATS", 1)
    page = (pathlib.Path(__file__).parents[1] / "docs" / "command_line.md").read_text("utf-8")
    rows = dict(re.findall(r"^\| `(\w+)` \| (.*) \|$", page, flags=re.MULTILINE))
    assert rows.keys() == cli.COMMANDS.keys()
    table = tmp_path / "t.csv"
    np.savetxt(table, np.ones((500, 2)), delimiter=",", header="open,skin", comments="")
    names = ("--v-th", "open", "--v-out", "skin", "--scale", 1)
    rates = ("--sample-rate", 2e5, "--pulse-rate", 60)
    calls = {
        "simulate": ("paper_dry", "-o", tmp_path / "made.h5", "--stream", tmp_path / "s.h5"),
        "merge": (study_file, "-o", tmp_path / "merged.h5"),
        "check": (study_file,),
        "calibrate": (study_file, "-o", tmp_path / "driver.h5"),
        "import": (table, "-o", tmp_path / "i.h5", *names, *rates),
        "fit": (study_file, "-o", tmp_path / "f.h5", "--method", "steiglitz_mcbride", "--order", 3),
        "report": (tmp_path / "f.h5",),
        "export": (tmp_path / "f.h5", "-o", tmp_path / "f.csv"),
    }
    assert calls.keys() == cli.COMMANDS.keys() - {"live"}  # of which `test_displays` reads the keys
    for command, arguments in calls.items():
        _, printed, _ = run(command, *arguments, "--json")
        told = set(re.findall(r"`(\w+)`", rows[command]))
        found = as_json(printed)
        assert set(found) - {"command", "status"} <= told, command
        if command == "fit":
            assert (found["method"], found["drivers"][0]["order"]) == ("steiglitz_mcbride", 3)
        written = {"check": "file", "report": "page"}.get(command, "target")
        assert set(found) >= {"command", "status", written}
        inner = [item for value in found.values() if isinstance(value, list) for item in value]
        groups = [item for item in inner if isinstance(item, dict) and "subject" not in item]
        assert {key for item in groups for key in item} <= told, command


def test_verbose_says_on_stderr_what_is_done(run, study_file, tmp_path):
    status, printed, said = run("--verbose", "fit", study_file, "-o", tmp_path / "fits.h5")
    assert status == DONE
    assert any(re.match(r"calibration/98k8: Driver.*start \d won", line) for line in said)
    assert sum("SkinRC: successful" in line for line in said) == 3
    command = ("fit", study_file, "-o", tmp_path / "fits.h5", "--force", "--workers", 2)
    _, _, also = run("--verbose", *command)
    assert sorted(also) == sorted(said)  # what worker processes log is shown, too
    again = run("fit", study_file, "-o", tmp_path / "fits.h5", "--force")
    assert again == (DONE, printed, [])


def test_help_lists_every_command(run):
    status, listed, complaints = run("--help")
    assert (status, complaints) == (DONE, [])
    for command in cli.COMMANDS:
        assert any(re.match(rf" +{command} +[a-z]", line) for line in listed)
        status, printed, complaints = run(command, "--help")
        assert (status, complaints) == (DONE, [])
        assert any("--json" in line for line in printed)


def test_what_needs_no_command_is_answered_without_jax():
    code = f"""
import sys
from etid.__main__ import main
for word, status in ("--help", {DONE}), ("--version", {DONE}), ("nonsense", {WRONG_USAGE}):
    sys.argv[1:] = [word]
    try:
        main()
    except SystemExit as end:
        assert end.code == status
assert "etid.cli" in sys.modules
assert not {{"jax", "equinox", "h5py"}} & set(sys.modules)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    "arguments",
    ["", "nonsense", "fit study.h5", "simulate nonsense -o x.h5", "--completion sh", "fit --json"]
    + [f"fit a.h5 -o b.h5 {option}" for option in (
        "--method guessing", "--workers 0", "--workers -1", "--order 50", "--order 1",
        "--order many", "--plausible 300")],
)  # fmt: skip
def test_wrong_usage_ends_with_2(run, arguments):
    status, printed, complaints = run(*arguments.split())
    assert (status, printed) == (WRONG_USAGE, [])
    assert complaints


def test_the_program_starts_in_float64_and_knows_its_version(without_driver, tmp_path):
    """In a process of its own: this one has float64 switched on already."""
    command = [sys.executable, "-m", "etid"]
    version = subprocess.run([*command, "--version"], capture_output=True, text=True, check=True)
    told = f"etid {etid.__version__}, JAX {jax.__version__}, NumPy {np.__version__}, Python 3."
    assert version.stdout.startswith(told)
    arguments = [*command, "fit", without_driver, "-o", tmp_path / "fits.h5"]
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path / "cache")}
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)
    ended = subprocess.run(arguments, capture_output=True, text=True, check=False, env=environment)
    assert (tmp_path / "cache" / "etid").is_dir()  # for what a large batch compiles
    assert ended.returncode == WRONG_DATA
    assert "float64" not in ended.stdout + ended.stderr
    assert ended.stderr == ""  # no progress bar where there is no terminal


def test_a_closed_stderr_and_another_encoding_stop_nothing(without_driver, tmp_path):
    command = 'exec "$0" -m etid fit "$1" -o "$2" --json 2>&-'
    arguments = ["sh", "-c", command, sys.executable, without_driver, tmp_path / "Ω.h5"]
    environment = {**os.environ, "PYTHONIOENCODING": "latin-1"}
    done = subprocess.run(arguments, stdout=subprocess.PIPE, check=False, env=environment)
    assert json.loads(done.stdout)["target"] == str(tmp_path / "Ω.h5")


@pytest.mark.parametrize("arguments", ["check study.h5", "--completion bash"])
def test_a_reader_that_has_gone_is_no_error(tmp_path, arguments):
    read, write = os.pipe()
    os.close(read)
    etid.scenes.paper_calibration().simulate(seed=0).write(tmp_path / "study.h5")
    command = [sys.executable, "-m", "etid", *arguments.split()]
    path = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(
        command, stdout=write, stderr=subprocess.PIPE, check=False, cwd=tmp_path, env=path
    )
    os.close(write)
    assert (done.returncode, done.stderr) == (DONE, b"")


def test_completion_is_offered_for_every_shell_there_is_one_for(run):
    assert set(cli.SHELLS) == set(shtab.SUPPORTED_SHELLS)
    for shell in cli.SHELLS:
        status, printed, complaints = run("--completion", shell)
        assert (status, complaints) == (DONE, [])
        assert any("snr-db" in line for line in printed)


def test_completion_without_its_package_names_what_to_install(run, monkeypatch):
    monkeypatch.setitem(sys.modules, "shtab", None)
    status, printed, complaints = run("--completion", "bash")
    assert (status, printed) == (WRONG_USAGE, [])
    assert "--completion needs shtab: pip install 'etid[completion]'" in complaints[-1]
