"""What one would use instead of etid: other packages on the same recordings.

Each rival is a module beside this one, written as a user of its package would write it, and run by
`worker` in an environment of its own, of which as many are made as pins clash. A rival that cannot
be installed or run is a row that says why.

    python -m benchmarks rivals              installs all, and runs each where it should work
    python -m benchmarks rivals scipy_harmonics jaxopt_lm

Nothing but the standard library and NumPy is imported here: those environments have no etid.
"""

import argparse
import dataclasses
import json
import math
import os
import pathlib
import shutil
import signal
import subprocess
import sys
import tempfile
import venv
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from benchmarks.rivals.roster import RIVALS

ROOT = pathlib.Path(__file__).parents[2]
ENVIRONMENTS = ROOT / ".rivals"
REQUIREMENTS = pathlib.Path(__file__).parent
ONE_THREAD = {
    name: "1"
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
}


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What a rival found, one row per draw, or why it found nothing.

    Attributes:
        elements: R_s [ohm], R_p [ohm], C_p [F]; NaN where a draw failed.
        ok: What the package says of its success.
        seconds: Of the skin's fit from its records, warm.
        driver_seconds: Of the driver's fit.
        first_seconds: Of the first fit of a skin, with what it compiles.
        versions: By package.
        errors: Message of each draw, mostly empty.
        missing: One line that says why there is nothing; empty if there is.
    """

    elements: np.ndarray = dataclasses.field(default_factory=lambda: np.empty((0, 3)))
    ok: np.ndarray = dataclasses.field(default_factory=lambda: np.empty(0, bool))
    seconds: np.ndarray = dataclasses.field(default_factory=lambda: np.empty(0))
    driver_seconds: np.ndarray = dataclasses.field(default_factory=lambda: np.empty(0))
    first_seconds: float = np.nan
    versions: Mapping[str, str] = dataclasses.field(default_factory=dict)
    errors: tuple[str, ...] = ()
    missing: str = ""


def python_of(environment: str) -> pathlib.Path:
    """The interpreter of an environment, made or not."""
    return ENVIRONMENTS / environment / "bin" / "python"


def installed(environment: str) -> bool:
    """Whether an environment was made from the requirements as they are now."""
    wanted, made = _requirements(environment)
    return made.exists() and made.read_text() == wanted.read_text()


def _requirements(environment: str) -> tuple[pathlib.Path, pathlib.Path]:
    """What an environment is made from, and the copy it gets once it is."""
    name = f"{environment}.txt"
    return REQUIREMENTS / name, ENVIRONMENTS / environment / name


def install(names: Iterable[str]) -> dict[str, str]:
    """Make the environments of some rivals.

    An environment whose requirements have not changed since is left as it is.

    Args:
        names: Modules of `RIVALS`.

    Returns:
        By environment why it could not be made; empty where it could.
    """
    made = {name: make(name) for name in dict.fromkeys(RIVALS[one].environment for one in names)}
    return {environment: why for environment, why in made.items() if why}


def make(environment: str) -> str:
    """Make an environment; why it could not be made, or nothing."""
    if installed(environment):
        return ""
    wanted, made = _requirements(environment)
    venv.create(ENVIRONMENTS / environment, clear=True, with_pip=True)
    command = [python_of(environment), "-m", "pip", "install", "--quiet", "-r", wanted]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        return f"failed to install: {_last_error(done.stderr)}"
    shutil.copy(wanted, made)
    return ""


def run(
    name: str,
    problem: Mapping[str, Any],
    repeats: int,
    timeout: float,
    budget: float = math.inf,
    python: pathlib.Path | None = None,
) -> Outcome:
    """Run a rival on a problem, on one core, in a process of its own.

    Args:
        name: Module of `RIVALS`.
        problem: The arrays that `worker` reads.
        repeats: Fits of each skin, of which the median time counts.
        timeout: Longest time for all of it [s].
        budget: Time after which no further draw is begun [s].
        python: The interpreter; that of the rival's environment if not given.
    """
    rival = RIVALS[name]
    if python is None and not installed(rival.environment):
        return Outcome(missing=f"not installed: python -m benchmarks rivals {name}")
    for program, packages in rival.program.items():
        if shutil.which(program) is None:
            return Outcome(missing=f"{program} not found: apt-get install {packages}")
    with tempfile.TemporaryDirectory() as folder:
        given, found = pathlib.Path(folder, "problem.npz"), pathlib.Path(folder, "result.npz")
        np.savez(given, **problem)
        worker = [python or python_of(rival.environment), "-m", "benchmarks.rivals.worker"]
        process = subprocess.Popen(
            [*worker, name, given, found, str(repeats), str(budget)],
            cwd=ROOT,
            env={**os.environ, **ONE_THREAD},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        try:
            _, complaint = process.communicate(timeout=timeout)
        except subprocess.TimeoutExpired:
            return Outcome(missing=f"not done after {timeout:g} s")
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)  # with the Octave that it may have started
                process.communicate()
        if process.returncode != 0:
            return Outcome(missing=f"failed: {_last_error(complaint)}")
        with np.load(found) as file:
            result = {key: file[key] for key in file.files}
    return Outcome(
        **{key: result[key] for key in ("elements", "ok", "seconds", "driver_seconds")},
        first_seconds=float(result["first_seconds"]),
        versions=json.loads(str(result["versions"])),
        errors=tuple(json.loads(str(result["errors"]))),
    )


def _last_error(text: str) -> str:
    """The line that tells most: pip's first complaint, or the end of a traceback."""
    lines = [line for line in text.splitlines() if line.strip()]
    complaints = [line for line in lines if line.startswith("ERROR:")]
    return (complaints[:1] or lines[-1:] or ["no message"])[0]


def problem(pairs: Sequence[tuple[Any, Any]], start: Any) -> dict[str, Any]:
    """Recordings of one rate, for `run`.

    Args:
        pairs: Each trial and its calibration, as `etid.Recording`.
        start: Elements to start from, in SI.
    """
    trials, calibrations = zip(*pairs, strict=True)
    return {
        "v_th": np.stack([one.v_th for one in trials]),
        "v_out": np.stack([one.v_out for one in trials]),
        "ref_th": np.stack([one.v_th for one in calibrations]),
        "ref_out": np.stack([one.v_out for one in calibrations]),
        "r_ref": np.array([one.r_load for one in calibrations]),
        "start": np.asarray(start),
        "fs": trials[0].sample_rate,
        "f0": trials[0].pulse_rate,
    }


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Which rivals, and how long they may take."""
    parser.add_argument("rivals", nargs="*", metavar="RIVAL", help=f"of {', '.join(RIVALS)}")
    parser.add_argument("--draws", type=int, default=3)
    parser.add_argument("--repeats", type=int, default=5, help="fits of each draw")
    parser.add_argument("--timeout", type=float, default=600.0, help="for each rival [s]")


def main(arguments: argparse.Namespace) -> bool:
    """Install, run each rival where it should work, print; whether none is missing or wrong."""
    from benchmarks.rivals import table  # imports etid

    names = arguments.rivals or list(RIVALS)
    unknown = sorted({*names} - {*RIVALS})
    if unknown:
        sys.exit(f"no rivals {', '.join(unknown)}; there are {', '.join(RIVALS)}")
    return table.show(names, install(names), arguments)
