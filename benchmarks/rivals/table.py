"""The table of the rivals: installed or why not, and errors and times where each should work."""

import argparse
from collections.abc import Mapping, Sequence

import numpy as np
from tqdm import tqdm

import etid
from benchmarks.ladder import CALIBRATION, START, TRIAL, rung
from benchmarks.rivals import Outcome, problem, run
from benchmarks.rivals.roster import RIVALS, SCENES
from etid.simulation.scenes import Scene

WORKS = 0.1  # largest relative error of any element of what is said to work


def show(names: Sequence[str], failed: Mapping[str, str], arguments: argparse.Namespace) -> bool:
    """Run some rivals and print a line for each.

    Args:
        names: Modules of `RIVALS`.
        failed: By environment why it could not be made.
        arguments: Draws, repeats and timeout.

    Returns:
        Whether all worked.
    """
    lines, worked = [], True
    scenes = {label: rung("dry", **settings) for label, settings in SCENES.items()}
    problems = {
        label: problem(pairs(scenes[label], arguments.draws), START)
        for label in dict.fromkeys(RIVALS[name].works for name in names)
    }
    for name in tqdm(names):
        rival = RIVALS[name]
        if rival.environment in failed:
            outcome = Outcome(missing=failed[rival.environment])
        else:
            outcome = run(name, problems[rival.works], arguments.repeats, arguments.timeout)
        truth = np.array(list(scenes[rival.works].truth()[TRIAL].values()))
        text, works = line(name, outcome, truth)
        lines.append(text)
        worked &= works
    print(
        f"{'rival':<32}{'environment':<17}{'version':<10}{'scene':<17}"
        f"{'R_s':>8}{'R_p':>8}{'C_p':>8} %  ok  ms/fit  first s  driver s"
    )
    print(*lines, sep="\n")
    return worked


def pairs(scene: Scene, draws: int) -> list[tuple[etid.Recording, etid.Recording]]:
    """Trial and calibration of a scene drawn with the seeds from 0 on."""
    studies = [scene.simulate(seed) for seed in range(draws)]
    return [(study[TRIAL], study[CALIBRATION]) for study in studies]


def line(name: str, outcome: Outcome, truth: np.ndarray) -> tuple[str, bool]:
    """One rival: median of the absolute errors, and of the times; and whether it works."""
    rival = RIVALS[name]
    version = outcome.versions.get(rival.package, "-")
    head = f"{rival.name:<32}{rival.environment:<17}{version:<10}"
    if outcome.missing:
        return f"{head}{outcome.missing}", False
    errors = np.median(np.abs(outcome.elements / truth - 1), axis=0)
    numbers = "".join(f"{100 * error:8.3f}" for error in errors)
    said = f"{outcome.ok.sum()}/{outcome.ok.size}"
    times = (
        f"{1e3 * np.median(outcome.seconds):8.1f}{outcome.first_seconds:9.2f}"
        f"{np.median(outcome.driver_seconds):10.2f}"
    )
    notes = "".join(f"\n    {message}" for message in dict.fromkeys(outcome.errors) if message)
    text = f"{head}{rival.works:<17}{numbers}{said:>6}{times}\n    {rival.setting}{notes}"
    return text, bool((errors < WORKS).all() and outcome.ok.all())
