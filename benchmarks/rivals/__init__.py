"""What one would use instead of etid: other packages on the same recordings.

Each rival is a module beside this one, written as a user of its package would write it, and run by
`worker` in an environment of its own, of which as many are made as pins clash. A rival that cannot
be installed or run is a row that says why (`benchmarks.rivals.table`).

Nothing but the standard library and NumPy is imported here: those environments have no etid.
"""

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
from collections.abc import Callable, Iterable, Mapping, Sequence
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


class RivalError(RuntimeError):
    """A rival could not be run; says why in a line."""


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What a rival found, one row per draw, or why it found nothing."""

    # R_s [ohm], R_p [ohm], C_p [F]; NaN where a draw failed
    elements: np.ndarray = dataclasses.field(default_factory=lambda: np.empty((0, 3)))
    # what the package says of its success
    ok: np.ndarray = dataclasses.field(default_factory=lambda: np.empty(0, bool))
    # of the skin's fit from its records, warm
    seconds: np.ndarray = dataclasses.field(default_factory=lambda: np.empty(0))
    # of the driver's fit
    driver_seconds: np.ndarray = dataclasses.field(default_factory=lambda: np.empty(0))
    first_seconds: float = np.nan  # of the first fit of a skin, with what it compiles
    versions: Mapping[str, str] = dataclasses.field(default_factory=dict)  # by package
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


def install(names: Iterable[str]) -> dict[str, str]:
    """Make the environments of some rivals of `RIVALS`; by environment why one could not be made.

    An environment whose requirements have not changed since is left as it is.
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


def exchange(
    environment: str,
    module: str,
    python: pathlib.Path | None = None,
    timeout: float | None = None,
    **problem: Any,
) -> dict[str, np.ndarray]:
    """What a module that calls `serve` makes of a problem, in a process of its own.

    Args:
        environment: In which it runs.
        module: Its full name.
        python: The interpreter; that of the environment if not given.
        timeout: Longest time [s].
        problem: Arrays.

    Raises:
        RivalError: It failed, or took too long.
    """
    with tempfile.TemporaryDirectory() as folder:
        given, found = pathlib.Path(folder, "problem.npz"), pathlib.Path(folder, "result.npz")
        np.savez(given, **problem)
        process = subprocess.Popen(
            [python or python_of(environment), "-m", module, given, found],
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
    asked = {"name": name, "repeats": repeats, "budget": budget, **problem}
    try:
        found = exchange(rival.environment, "benchmarks.rivals.worker", python, timeout, **asked)
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
