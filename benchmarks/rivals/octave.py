"""Octave's `arx` of first order, its input advanced by a sample, and `n4sid` of one state.

One Octave for all draws of a problem, with the estimators of its control package.
"""

import json
import pathlib
import subprocess
import tempfile

import numpy as np
import scipy.io

SCRIPT = pathlib.Path(__file__).with_suffix(".m")


def batch(estimator, problem, repeats):
    """What `worker` writes, found by an estimator of Octave's control package."""
    with tempfile.TemporaryDirectory() as folder:
        given, found = pathlib.Path(folder, "problem.mat"), pathlib.Path(folder, "result.mat")
        settings = {"repeats": float(repeats), "estimator": estimator}
        scipy.io.savemat(given, {**problem, **settings})
        command = ["octave-cli", "--quiet", "--norc", SCRIPT, given, found]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if not found.exists():  # its exit status tells of trouble at leaving, too
            raise RuntimeError(" ".join(done.stderr.split())[-300:])
        result = scipy.io.loadmat(found, squeeze_me=True)
    draws = len(problem["r_ref"])
    elements = np.reshape(result["elements"], (draws, 3))
    return {
        "elements": elements,
        "ok": np.isfinite(elements).all(axis=1),
        "seconds": np.reshape(result["seconds"], draws),
        "driver_seconds": np.reshape(result["driver_seconds"], draws),
        "first_seconds": result["first_seconds"],
        "versions": json.dumps({name: str(result[name]) for name in ("control", "octave")}),
        "errors": str(result["errors"]),
    }
