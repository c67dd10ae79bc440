"""Runs one rival: `python -m benchmarks.rivals.worker PROBLEM RESULT`.

PROBLEM is that of `rivals.run`; its `name` is a module beside this, run by the Python of its own
environment, which has `skin` for one record and Z_th as measured, or `fit` for the residuals of
`harmonic_fit`, or `batch` of an estimator for all of a problem at once. If the problem has `z_th`,
at the harmonics of each draw, no driver is fitted. After the `budget` [s] no
further draw is begun, but for the second; a first fit that took as long is the only one. RESULT
gets the fields of `rivals.Outcome`, `versions` and `errors` as JSON.
"""

import functools
import importlib
import importlib.metadata
import json
import os
import sys
import time
import warnings

import numpy as np

from benchmarks.rivals import harmonic_fit, serve
from benchmarks.rivals.records import measured_driver
from benchmarks.rivals.roster import RIVALS

FEWEST = 2  # draws


def results(rival, problem, repeats, budget):
    """All draws, one after the other; what fails costs its own draw alone."""
    if hasattr(rival, "fit"):
        driver = functools.partial(harmonic_fit.driver, rival.fit)
        skin = functools.partial(harmonic_fit.skin, rival.fit)
    else:
        driver, skin = measured_driver, rival.skin
    fs, f0, start = float(problem["fs"]), float(problem["f0"]), problem["start"]
    draws = len(problem["r_ref"])
    found = {
        "elements": np.full((draws, 3), np.nan),
        "ok": np.zeros(draws, bool),
        "seconds": np.full(draws, np.nan),
        "driver_seconds": np.full(draws, np.nan),
        "first_seconds": np.nan,
    }
    errors = [""] * draws
    started = time.perf_counter()
    for i in range(draws):
        if i >= FEWEST and time.perf_counter() - started > budget:
            cut = {key: of[:i] if np.ndim(of) else of for key, of in found.items()}
            return {**cut, "errors": json.dumps(errors[:i])}
        try:
            reference = problem["ref_th"][i], problem["ref_out"][i], float(problem["r_ref"][i])
            begin = time.perf_counter()
            known = "z_th" in problem
            model = problem["z_th"][i] if known else driver(*reference, fs, f0)
            found["driver_seconds"][i] = np.nan if known else time.perf_counter() - begin
            arguments = (problem["v_th"][i], problem["v_out"][i], model, start, fs, f0)
            runs = []
            if np.isnan(found["first_seconds"]):
                first = _timed(skin, arguments)
                found["first_seconds"] = first[0]
                runs = [first] if first[0] > budget else []
            runs = runs or [_timed(skin, arguments) for _ in range(repeats)]
            found["seconds"][i] = np.median([seconds for seconds, _ in runs])
            elements, found["ok"][i] = runs[-1][1]
            found["elements"][i] = elements
        except Exception as error:  # anything a package may raise
            errors[i] = f"{type(error).__name__}: {error}"
    return {**found, "errors": json.dumps(errors)}


def _timed(call, arguments):
    begin = time.perf_counter()
    found = call(*arguments)
    return time.perf_counter() - begin, found


def solved(problem):
    """Run a rival on one core."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    repeats, budget = int(problem.pop("repeats")), float(problem.pop("budget"))
    name = str(problem.pop("name"))
    estimator = RIVALS[name].estimator
    module = importlib.import_module(f"benchmarks.rivals.{name.removesuffix(f'_{estimator}')}")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of trial steps; what comes of them is judged
        if estimator:  # of which the time is short
            found = module.batch(estimator, problem, repeats)
        else:
            found = results(module, problem, repeats, budget)
    owners = importlib.metadata.packages_distributions()
    imported = sorted({owner for module in {*sys.modules} & {*owners} for owner in owners[module]})
    versions = {package: importlib.metadata.version(package) for package in imported}
    return {"versions": json.dumps(versions), **found}


if __name__ == "__main__":
    serve(solved)
