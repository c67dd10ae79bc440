"""What one would use instead of etid: other packages on the same recordings.

Printed is for each: installed or why not, and errors and times where it should work.
"""

import argparse
from collections.abc import Iterable

import numpy as np
from tqdm import tqdm

import etid
from benchmarks.ladder import CALIBRATION, START, TRIAL, rung
from benchmarks.rivals import Outcome, make, problem, run
from benchmarks.rivals.roster import RIVALS, SCENES
from benchmarks.runner import option
from etid.simulation.scenes import Scene

WORKS = 0.1  # largest relative error of any element of what is said to work

OPTIONS = (
    option("rivals", nargs="*", metavar="RIVAL", help=f"of {', '.join(RIVALS)}"),
    option("--draws", default=3),
    option("--repeats", default=5, help="fits of each draw"),
    option("--timeout", default=600.0, help="for each rival [s]"),
)


def pairs(scene: Scene, draws: int) -> list[tuple[etid.Recording, etid.Recording]]:
    """Trial and calibration of a scene drawn with the seeds from 0 on."""
    studies = [scene.simulate(seed) for seed in range(draws)]
    return [(study[TRIAL], study[CALIBRATION]) for study in studies]


def line(name: str, outcome: Outcome, truth: np.ndarray | Iterable[float]) -> tuple[str, bool]:
    """One rival: median of the absolute errors, and of the times; and whether it works."""
    rival, true = RIVALS[name], np.array(list(truth))
    version = outcome.versions.get(rival.package, "-")
    head = f"{rival.name:<32}{rival.environment:<17}{version:<10}"
    if outcome.missing:
        return f"{head}{outcome.missing}", False
    errors = np.median(np.abs(outcome.elements / true - 1), axis=0)
    numbers = "".join(f"{100 * error:8.3f}" for error in errors)
    said = f"{outcome.ok.sum()}/{outcome.ok.size}"
    times = (
        f"{1e3 * np.median(outcome.seconds):8.1f}{outcome.first_seconds:9.2f}"
        f"{np.median(outcome.driver_seconds):10.2f}"
    )
    notes = "".join(f"\n    {message}" for message in dict.fromkeys(outcome.errors) if message)
    text = f"{head}{rival.works:<17}{numbers}{said:>6}{times}\n    {rival.setting}{notes}"
    return text, bool((errors < WORKS).all() and outcome.ok.all())


def main(arguments: argparse.Namespace) -> bool:
    names = arguments.rivals or list(RIVALS)
    unknown = sorted({*names} - {*RIVALS})
    if unknown:
        raise SystemExit(f"no rivals {', '.join(unknown)}; there are {', '.join(RIVALS)}")
    environments = dict.fromkeys(RIVALS[name].environment for name in names)
    failed, lines = {of: make(of) for of in environments}, list[tuple[str, bool]]()
    scenes = {label: rung("dry", **settings) for label, settings in SCENES.items()}
    given = {
        label: problem(pairs(scenes[label], arguments.draws), START)
        for label in dict.fromkeys(RIVALS[name].works for name in names)
    }
    for name in tqdm(names):
        rival = RIVALS[name]
        if failed[rival.environment]:
            outcome = Outcome(missing=failed[rival.environment])
        else:
            outcome = run(name, given[rival.works], arguments.repeats, arguments.timeout)
        lines.append(line(name, outcome, scenes[rival.works].truth()[TRIAL].values()))
    print(
        f"{'rival':<32}{'environment':<17}{'version':<10}{'scene':<17}"
        f"{'R_s':>8}{'R_p':>8}{'C_p':>8} %  ok  ms/fit  first s  driver s"
    )
    print(*(text for text, _ in lines), sep="\n")
    return all(works for _, works in lines)
