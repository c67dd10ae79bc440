"""Monte Carlo: do the intervals contain the truth as often as they say, and how far is the bound?

Each repetition draws fresh noise, quantisation and trigger delays for the calibrations, a dry and a
damp trial, and identifies a driver of its own: trials that share a driver share its error, and
would not be independent draws. With `--parts` the parts of the driver are drawn anew as well. With
`--current-snr-db` the loads are identified from the current alone, without calibrations; with
`--resistors` too, from driver and current at once.

Printed are, beside the bound, the part of the 95 % intervals that hold the truth and the root mean
square of z = error / standard error, each with the range that 99 of 100 runs with right standard
errors fall into: of a binomial count, and of chi-squared with a degree of freedom for each fit.
"""

import argparse
import dataclasses
import json
import pathlib
from collections.abc import Sequence

import numpy as np
import scipy.stats
from tqdm import tqdm

import etid
from benchmarks.ladder import LOADS
from benchmarks.perturbed_study import drawn_driver
from benchmarks.spice import ESTIMATORS, FOLDER, JOINT, add_data, scene_of
from etid.simulation.published import REFERENCE
from etid.simulation.scenes import Scene, Trial
from etid.simulation.transformer import ResistorLoad

SILENT = 5.0  # standard errors by which a successful fit may not be wrong
MORE = "more"  # trials that take part in a joint fit, but share its errors and are not counted
OF_RUNS = 0.99
NORMAL_95 = 1.959964  # half-width of a 95 % interval in standard errors


@dataclasses.dataclass(frozen=True)
class Draws:
    """One row per repetition.

    Attributes:
        error: Relative errors of the elements.
        stderr: Relative standard errors, as the fit reports them.
        verdicts: Names of the verdicts.
    """

    error: np.ndarray
    stderr: np.ndarray
    verdicts: np.ndarray

    @property
    def z(self) -> np.ndarray:
        """Errors of the successful fits in standard errors."""
        return (self.error / self.stderr)[self.verdicts == "successful"]

    @property
    def covered(self) -> np.ndarray:
        """Part of the 95 % intervals that hold the truth."""
        return (np.abs(self.z) < NORMAL_95).mean(0)

    @property
    def rms(self) -> np.ndarray:
        """Root mean square of z, 1 if the standard errors are right."""
        return np.sqrt((self.z**2).mean(0))


def expected_rms(fits: int) -> tuple[float, float]:
    """Range of the root mean square of z in `OF_RUNS` of the runs, if z is normal."""
    low, high = scipy.stats.chi2.interval(OF_RUNS, fits)
    return float(np.sqrt(low / fits)), float(np.sqrt(high / fits))


def expected_covered(fits: int) -> tuple[float, float]:
    """Range of the part of 95 % intervals that hold the truth in `OF_RUNS` of the runs."""
    low, high = scipy.stats.binom.interval(OF_RUNS, fits, 0.95)
    return float(low / fits), float(high / fits)


def scene(
    snr_db: float,
    samples: int,
    resistors: Sequence[float] = (REFERENCE,),
    jitter: float = 50e-9,
    shared_v_th: bool = False,
    more: int = 0,
    current_snr_db: float | None = None,
) -> Scene:
    """A dry and a damp fingertip behind the default transformer, and `more` trials of each."""
    trials = [Trial(name, load) for name, load in LOADS.items()]
    trials += [Trial(f"{MORE}/{n}{i}", load) for n, load in LOADS.items() for i in range(more)]
    return Scene(
        tuple(trials),
        tuple(Trial(f"calibration/{i}", ResistorLoad(r)) for i, r in enumerate(resistors)),
        samples=samples,
        snr_db=snr_db,
        current_snr_db=current_snr_db,
        trigger_jitter_rms=jitter,
        shared_v_th=shared_v_th,
    )


def spice_scene(folder: pathlib.Path, name: str) -> Scene:
    """The circuit of a SPICE recording with its first trial, to be drawn afresh."""
    truth = json.loads((folder / "truth.json").read_text())["scenes"][name]
    whole = scene_of(truth)
    return dataclasses.replace(whole, trials=whole.trials[:1])


def monte_carlo(
    scene: Scene,
    repetitions: int,
    method: str | None,
    progress: bool = False,
    parts: float = 0.0,
) -> dict[str, Draws]:
    """Identify fresh recordings of each trial of `scene`.

    Args:
        scene: What is recorded.
        repetitions: How often.
        method: As in `identify_skin`, or `joint`.
        progress: Show a progress bar.
        parts: Standard deviation of the logarithm of every part of the drivers.
    """
    counted = [trial.path for trial in scene.trials if not trial.path.startswith(MORE)]
    rows: dict[str, list] = {path: [] for path in counted}
    for seed in tqdm(range(repetitions), disable=not progress):
        drawn = scene
        if parts:
            driver = drawn_driver(seed, parts, scene.driver)
            drawn = dataclasses.replace(scene, driver=driver)
        fits = _identify(drawn.simulate(seed=seed), counted, method)
        for path in counted:
            truth = np.array(list(scene.truth()[path].values()))
            fit = fits.get(path)
            if fit is None:  # a calibration that pre-flight refuses
                nothing = np.full(truth.size, np.nan)
                rows[path].append((nothing, nothing, "driver_failed"))
                continue
            error = np.asarray(fit.circuit.values()) / truth - 1
            rows[path].append((error, np.asarray(fit.stderr.values()) / truth, fit.verdict))
    return {
        name: Draws(*(np.array(column) for column in zip(*found, strict=True)))
        for name, found in rows.items()
    }


def _identify(study: etid.Study, paths: Sequence[str], method: str | None) -> dict[str, etid.Fit]:
    """Fits by path; none if the driver of the calibrations failed."""
    if method == JOINT:
        fits = etid.identify_jointly(study).fits
        found = list(fits.labels["path"])
        return {path: fits[found.index(path)] for path in paths}
    given = method
    calibrations = list(study.calibrations.recordings())
    try:
        driver = None
        if calibrations:
            driver = etid.identify_driver(calibrations, method=given, throw=False)
    except etid.IdentificationError:
        return {}
    return {
        path: etid.identify_skin(study[path], driver, method=given, throw=False) for path in paths
    }


def run(scene: Scene, repetitions: int, method: str | None, parts: float = 0.0) -> None:
    """Print one line per load and element; efficiency is bound² / mean squared error."""
    draws = monte_carlo(scene, repetitions, method, progress=True, parts=parts)
    bounds = etid.bound(scene)
    print(
        "load      element   bias %  spread %      sd %   bound %  efficiency  covered  rms z"
        "  max |z|"
    )
    for name, of in draws.items():
        good = of.verdicts == "successful"
        names, counts = np.unique(of.verdicts, return_counts=True)
        verdicts = ", ".join(f"{c} {n}" for n, c in zip(names, counts, strict=True))
        for i, (element, limit) in enumerate(bounds[name].relative.items()):
            if not good.any():
                break
            error = of.error[good, i]
            print(
                f"{name:<10}{element:<6}{100 * error.mean():10.3f}{100 * error.std(ddof=1):10.3f}"
                f"{100 * np.median(of.stderr[good, i]):10.3f}{100 * limit:10.3f}"
                f"{limit**2 / np.mean(error**2):12.2f}{of.covered[i]:9.3f}{of.rms[i]:7.2f}"
                f"{np.abs(of.z[:, i]).max():9.1f}"
            )
        if good.any():
            of_covered, of_rms = expected_covered(good.sum()), expected_rms(good.sum())
            print(
                f"{name:<10}expected: covered {of_covered[0]:.3f} to {of_covered[1]:.3f}, "
                f"rms z {of_rms[0]:.2f} to {of_rms[1]:.2f}"
            )
        silent = np.abs(of.z).max(axis=1, initial=0.0) > SILENT
        print(f"{name:<10}{verdicts}; successful and wrong by {SILENT:g} sd: {silent.sum()}")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What is drawn, and what identifies it."""
    parser.add_argument("--snr-db", type=float, default=60.0)
    parser.add_argument("--samples", type=int, default=10_000)
    parser.add_argument("--repetitions", type=int, default=200)
    parser.add_argument("--jitter", type=float, default=50e-9, help="rms trigger delay [s]")
    parser.add_argument("--resistors", type=float, nargs="+", help="of the calibrations [ohm]")
    parser.add_argument(
        "--current-snr-db",
        type=float,
        help="identify from a measured current with this noise; with --resistors from both",
    )
    parser.add_argument("--shared", action="store_true", help="one unloaded record for all")
    parser.add_argument("--method", choices=ESTIMATORS, help="default: that of the records")
    parser.add_argument("--more", type=int, default=0, help="further trials, for a joint fit")
    parser.add_argument(
        "--parts", type=float, default=0.0, help="draw the parts of the driver with this spread"
    )
    parser.add_argument("--spice", metavar="SCENE", help="draw this SPICE recording afresh")
    add_data(parser)


def main(arguments: argparse.Namespace) -> bool:
    """Run the command."""
    if arguments.spice is not None:
        drawn = spice_scene(arguments.data / FOLDER, arguments.spice)
    else:
        drawn = scene(
            arguments.snr_db,
            arguments.samples,
            arguments.resistors or ([REFERENCE] if arguments.current_snr_db is None else []),
            arguments.jitter,
            arguments.shared,
            arguments.more,
            arguments.current_snr_db,
        )
    run(drawn, arguments.repetitions, arguments.method, arguments.parts)
    return True
