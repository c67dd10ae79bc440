"""Monte Carlo: do the intervals contain the truth as often as they say, and how far is the bound?

Each repetition draws noise, quantisation and trigger delays of the calibrations, a dry and a damp
trial, and identifies a driver of its own: trials that share a driver share its error. With
`--current-snr-db` the loads are identified from the current alone; with `--resistors` too, from
driver and current at once.

Noise is white by default; what `--electronics` names beside that is drawn a fifth as often.

The part of the 95 % intervals that hold the truth, and the root mean square of z = error / standard
error, stand beside the ranges into which 99 of 100 runs with right standard errors fall. The target
is of all elements of a load: a single one scatters by 1.5 % with 200 draws.
"""

import argparse
import dataclasses
import json
import math
import pathlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from tqdm import tqdm

import etid
from benchmarks.estimators import DEFAULT, Drivers, found_by
from benchmarks.ladder import BEFORE, ELECTRONICS, LOADS, WHITE, recorded
from benchmarks.perturbed_study import drawn_driver
from benchmarks.rates import COVERED, NORMAL_95, covered, expected_covered, expected_rms
from benchmarks.runner import Target, at_most, option, report
from benchmarks.spice import DATA, ESTIMATORS, FOLDER, JOINT, scene_of
from etid.recordings.remarks import Remark
from etid.results.verdicts import USABLE, counted
from etid.simulation.published import REFERENCE
from etid.simulation.scenes import Scene

SILENT = 5.0  # standard errors by which a successful fit may not be wrong
TARGETS = {
    "covered": COVERED,
    f"successful and wrong by {SILENT:g} sd": at_most(0),
}
HEADS = (
    "load      element   bias %  spread %      sd %   bound %  efficiency  covered  rms z  max |z|"
)
PART = 5  # of the repetitions, for what is not white noise
MORE = "more"  # trials that take part in a joint fit, but share its errors and are not counted

OPTIONS = (
    option("--snr-db", default=(60.0,)),
    option("--repetitions", default=200),
    option("--electronics", default=(WHITE, BEFORE), choices=ELECTRONICS),
    option("--jitter", default=50e-9, help="rms trigger delay [s]"),
    option("--resistors", type=float, nargs="+", help="of the calibrations [ohm]"),
    option("--current-snr-db", type=float, help="identify from a measured current with this noise"),
    option("--method", default=(DEFAULT,), choices=(DEFAULT, *ESTIMATORS)),
    option("--more", default=0, help="further trials, for a joint fit"),
    option("--parts", default=0.0, help="draw the parts of the driver with this spread"),
    option("--spice", metavar="SCENE", help="draw this SPICE recording afresh"),
    option("-o", "--output", type=pathlib.Path, help="CSV to write"),
    DATA,
)


class Draws(NamedTuple):
    """One row per repetition."""

    error: np.ndarray  # relative errors of the elements
    stderr: np.ndarray  # their standard errors
    verdicts: np.ndarray
    cov: np.ndarray  # of the errors
    chi2: np.ndarray
    limited: np.ndarray  # whether a joint fit has limited the delay

    @classmethod
    def of(cls, rows: Sequence[tuple]) -> "Draws":
        """Several of `draw`."""
        return cls(*map(np.array, zip(*rows, strict=True)))

    @property
    def z(self) -> np.ndarray:
        """Errors of the usable fits in standard errors."""
        return (self.error / self.stderr)[np.isin(self.verdicts, USABLE)]

    @property
    def distance(self) -> np.ndarray:
        """Squared errors of the usable fits in their covariance: χ² of as many elements."""
        good = np.isin(self.verdicts, USABLE)
        return np.einsum(
            "ni,nij,nj->n", self.error[good], np.linalg.inv(self.cov[good]), self.error[good]
        )

    @property
    def covered(self) -> np.ndarray:
        """Part of the 95 % intervals that hold the truth."""
        return (np.abs(self.z) < NORMAL_95).mean(0)


def scene(
    snr_db: float,
    samples: int,
    resistors: Sequence[float] = (REFERENCE,),
    jitter: float = 50e-9,
    shared_v_th: bool = False,
    more: int = 0,
    current_snr_db: float | None = None,
    electronics: str = WHITE,
) -> Scene:
    """A dry and a damp fingertip behind the default transformer, and `more` trials of each."""
    every = LOADS | {f"{MORE}/{n}{i}": load for n, load in LOADS.items() for i in range(more)}
    return recorded(
        every,
        {f"calibration/{i}": r for i, r in enumerate(resistors)},
        samples=samples,
        snr_db=snr_db,
        current_snr_db=current_snr_db,
        trigger_jitter_rms=jitter,
        shared_v_th=shared_v_th,
        **ELECTRONICS[electronics],
    )


def with_driver(of: Scene, number: int, parts: float) -> Scene:
    """The scene with a driver drawn anew; `parts` is the spread of their logarithms."""
    return dataclasses.replace(of, driver=drawn_driver(number, parts, of.driver)) if parts else of


def draw(fit: etid.Fit | None, truth: Sequence[float]) -> tuple:
    """A row of `Draws`, if there is a fit."""
    true, size = np.array(truth), len(truth)
    values, stderr, verdict = found_by(fit, size)
    cov, chi2, limited = np.full((size, size), np.nan), np.nan, False
    if fit is not None:
        cov, chi2 = fit.cov / np.outer(true, true), float(fit.chi2)
        limited = bool(int(fit.remarks) & Remark.small_delays)
    return values / true - 1, stderr / true, verdict, cov, chi2, limited


def monte_carlo(
    scene: Scene,
    repetitions: int,
    method: str | None,
    parts: float = 0.0,
    drivers: Drivers | None = None,
) -> dict[str, Draws]:
    """Identify fresh recordings of each trial of `scene`, behind drivers drawn with this spread.

    `drivers` are those that other methods have identified from the same draws.
    """
    every = {trial.path: list(scene.truth()[trial.path].values()) for trial in scene.trials}
    truth = {path: values for path, values in every.items() if not path.startswith(MORE)}
    studies = (with_driver(scene, s, parts).simulate(seed=s) for s in range(repetitions))
    return identified(studies, truth, method, drivers)


def identified(
    studies: Iterable[etid.Study],
    truth: Mapping[str, Sequence[float]],
    method: str | None = None,
    drivers: Drivers | None = None,
) -> dict[str, Draws]:
    """Identify the recordings of studies whose elements are known by their paths."""
    every, known = list(studies), drivers or Drivers()
    if method == JOINT:
        rows = []
        for study in tqdm(every, disable=None):
            fits = etid.identify_jointly(study).fits
            rows.append({path: fits[i] for i, path in enumerate(fits.labels["path"])})
    elif every[0].calibrations:
        rows = [_behind_driver(of, truth, method, known) for of in tqdm(every, disable=None)]
    else:  # all draws of a trial as one batch, for no driver differs
        by_path = {
            path: etid.identify_skins([study[path] for study in every], None, method=method)
            for path in truth
        }
        rows = [{path: fits[i] for path, fits in by_path.items()} for i in range(len(every))]
    return {
        path: Draws.of([draw(row.get(path), true) for row in rows]) for path, true in truth.items()
    }


def _behind_driver(
    study: etid.Study, paths: Iterable[str], method: str | None, drivers: Drivers
) -> dict[str, etid.Fit]:
    """Fits by path; none if the driver of the calibrations failed."""
    driver = drivers.of(list(study.calibrations.recordings()), method or DEFAULT)
    if driver is None:
        return {}
    return {
        path: etid.identify_skin(study[path], driver, method=method, throw=False) for path in paths
    }


def lines(name: str, of: Draws, bounds: dict[str, float]) -> Iterator[str]:
    """One line per element of a load; efficiency is bound² / mean squared error."""
    good = np.isin(of.verdicts, USABLE)
    if good.any():
        for i, (element, limit) in enumerate(bounds.items()):
            error, z = of.error[good, i], of.z[:, i]
            yield (
                f"{name:<10}{element:<6}{100 * error.mean():10.3f}{100 * error.std(ddof=1):10.3f}"
                f"{100 * np.median(of.stderr[good, i]):10.3f}{100 * limit:10.3f}"
                f"{limit**2 / np.mean(error**2):12.2f}{of.covered[i]:9.3f}"
                f"{np.sqrt(np.mean(z**2)):7.2f}{np.abs(z).max():9.1f}"
            )
        covered, rms = expected_covered(good.sum()), expected_rms(good.sum())
        limited = f"; delays limited in {of.limited.mean():.0%}" if of.limited.any() else ""
        yield (
            f"{name:<10}expected: covered {covered[0]:.3f} to {covered[1]:.3f}, "
            f"rms z {rms[0]:.2f} to {rms[1]:.2f}{limited}"
        )


def targets(name: str, of: Draws) -> Iterator[Target]:
    """Whether the usable fits of a load are as right as they say."""
    draws = np.flatnonzero(np.isin(of.verdicts, USABLE))
    inside = covered(of.z, draws)  # the elements of one fit share its error
    silent = np.sum(np.abs(of.z).max(axis=1, initial=0.0) > SILENT)
    text = f"{silent} of {len(of.verdicts)} fits; {counted(of.verdicts)}"
    first, second = TARGETS
    yield Target.of(TARGETS, first, inside, f"{name}: ")
    yield Target.of(TARGETS, second, float(silent), f"{name}: ", text=text)


def main(arguments: argparse.Namespace) -> bool:
    if arguments.spice is not None:
        truth = json.loads((arguments.data / FOLDER / "truth.json").read_text())
        drawn = scene_of(truth["scenes"][arguments.spice])
        scenes = {arguments.spice: dataclasses.replace(drawn, trials=drawn.trials[:1])}
    else:
        current = arguments.current_snr_db
        resistors = arguments.resistors or ([REFERENCE] if current is None else [])
        scenes = {
            f"{snr_db:g} dB{'' if name == WHITE else f', {name}'}": scene(
                snr_db,
                10_000,
                resistors,
                arguments.jitter,
                more=arguments.more,
                current_snr_db=current,
                electronics=name,
            )
            for name in arguments.electronics
            for snr_db in arguments.snr_db
        }
    asked = list[Target]()
    print(HEADS)
    for of_scene, drawn in scenes.items():
        bounds, drivers = etid.bound(drawn), Drivers()
        for method in arguments.method:
            by = None if method == DEFAULT else method
            most = arguments.repetitions
            count = most if drawn.electronics is None else max(2, math.ceil(most / PART))
            found = monte_carlo(drawn, count, by, arguments.parts, drivers)
            for name, of in found.items():
                print("\n".join(lines(name, of, bounds[name].relative)))
                asked += targets(f"{of_scene}, {name}, {method}", of)
    return report(asked, arguments.output)
