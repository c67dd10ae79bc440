"""What one would use instead of etid: other packages on the same recordings.

Each rival is a module beside this one, run by `worker` in an environment of its own, of which as
many are made as pins clash. One that cannot be installed or run is a row that says why.

Nothing but the standard library and NumPy is imported here: those environments have no etid.
"""

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
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from benchmarks.rivals.roster import RIVALS

ROOT = pathlib.Path(__file__).parents[2]
ENVIRONMENTS = ROOT / ".rivals"
REQUIREMENTS = pathlib.Path(__file__).parent
# One thread; and compilation counts, so that no cache may serve it.
SETTINGS = {
    **{f"{of}_NUM_THREADS": "1" for of in ("OMP", "OPENBLAS", "MKL", "NUMBA")},
    "JAX_ENABLE_COMPILATION_CACHE": "0",
}
NONE = np.empty(0)


class RivalError(RuntimeError):
    """A rival could not be run; says why in a line."""


@dataclass(frozen=True)
class Outcome:
    """What a rival found, one row per draw, or why it found nothing."""

    elements: np.ndarray = field(default_factory=NONE.copy)  # [ohm, ohm, F]; NaN without an answer
    ok: np.ndarray = field(default_factory=NONE.copy)  # what the package says of its success
    seconds: np.ndarray = field(default_factory=NONE.copy)  # of the skin's fit, warm
    driver_seconds: np.ndarray = field(default_factory=NONE.copy)  # of the driver's fit
    first_seconds: float = np.nan  # of the first fit of a skin, with what it compiles
    versions: Mapping[str, str] = field(default_factory=dict)  # by package
    errors: Sequence[str] = ()  # message of each draw, mostly empty
    missing: str = ""  # one line that says why there is nothing; empty if there is


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


def make(environment: str) -> str:
    """Make an environment unless it is there; why it could not be made, or nothing."""
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


def exchange(
    environment: str,
    module: str,
    python: pathlib.Path | None = None,
    timeout: float | None = None,
    **problem: Any,
) -> dict[str, np.ndarray]:
    """What a module beside this, which calls `serve`, makes of arrays in a process of its own.

    A `RivalError` says why it does not, or not within the timeout [s].
    """
    missing = "" if python else make(environment)
    if missing:
        raise RivalError(missing)
    with tempfile.TemporaryDirectory() as folder:
        given, found = pathlib.Path(folder, "problem.npz"), pathlib.Path(folder, "result.npz")
        np.savez(given, **problem)
        process = subprocess.Popen(
            [python or python_of(environment), "-m", f"{__name__}.{module}", given, found],
            cwd=ROOT,
            env={**os.environ, **SETTINGS},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        try:
            _, complaint = process.communicate(timeout=timeout)
        except subprocess.TimeoutExpired:
            raise RivalError(f"not done after {timeout:g} s") from None
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)  # with the Octave that it may have started
                process.communicate()
        if process.returncode != 0:
            raise RivalError(f"failed: {_last_error(complaint)}")
        with np.load(found) as file:
            return dict(file)


def serve(solve: Callable[[dict[str, np.ndarray]], Mapping[Any, Any]]) -> None:
    """The other end of `exchange`: solve the problem of this process."""
    given, found = sys.argv[1:]
    with np.load(given) as file:
        problem = dict(file)
    np.savez(found, **solve(problem))


def run(
    name: str,
    problem: Mapping[str, Any],
    repeats: int,
    timeout: float | None,
    budget: float = math.inf,
    python: pathlib.Path | None = None,
) -> Outcome:
    """Run a rival on a problem, on one core, in a process of its own.

    After the `budget` [s] no further draw is begun; the `timeout` [s] is that of all, if any.
    """
    rival = RIVALS[name]
    if python is None and not installed(rival.environment):
        return Outcome(missing=f"not installed: python -m benchmarks rivals {name}")
    for program, packages in rival.program.items():
        if shutil.which(program) is None:
            return Outcome(missing=f"{program} not found: apt-get install {packages}")
    asked = {"name": name, "repeats": repeats, "budget": budget, **problem}
    try:
        found = exchange(rival.environment, "worker", python, timeout, **asked)
    except RivalError as error:
        return Outcome(missing=str(error))
    said = {key: json.loads(str(found.pop(key))) for key in ("versions", "errors")}
    return Outcome(**found, **said)  # pyright: ignore[reportArgumentType]  # `worker` names them


def _last_error(text: str) -> str:
    """The line that tells most: pip's first complaint, or the end of a traceback."""
    lines = [line for line in text.splitlines() if line.strip()]
    complaints = [line for line in lines if line.startswith("ERROR:")]
    return (complaints[:1] or lines[-1:] or ["no message"])[0]


def problem(pairs: Sequence[tuple[Any, Any]], start: Any) -> dict[str, Any]:
    """Trials with their calibrations, and elements to start from, for `run`."""
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
