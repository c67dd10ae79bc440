"""How far do the scores of good recordings deviate? The limits in `DIRECTIONS` follow from it.

Each study is `benchmarks.perturbed_study.undisturbed` with another driver, whose parts differ by 3
or 10 % from the usual ones. For each noise and skin the table has the root mean square of z of each
change that a fit tests for, the largest if there are several. The largest of all is to be the
deviation in `DIRECTIONS` to 10 %, and no more recordings are to be refused by a test than chance
explains.
"""

import argparse

import numpy as np
import scipy.stats

import etid
from benchmarks import perturbed_study as lab
from benchmarks.estimators import load_behind
from benchmarks.runner import WORKERS, Target, each, option, report
from etid.circuits.directions import DIRECTIONS, FALSE_ALARMS
from etid.likelihood.fit import fit
from etid.likelihood.starts import starts

FIRST = 3000  # number of the first driver
RARE = 1e-3  # probability that chance explains so many refusals

OPTIONS = (
    WORKERS,
    option("--snr-db", default=(40.0, 50.0, 60.0)),
    option("--parts", default=(0.03, 0.1)),
    option("--drivers", default=300),
)


def scores_of(number: int, snr_db: float, parts: float) -> dict[str, dict[str, list[list[float]]]]:
    """Score of each change and whether it is a finding, by path; none if the driver failed."""
    of = lab.undisturbed(number, snr_db, parts).recordings()
    driver = etid.identify_driver(list(of.calibrations.recordings()), throw=False)
    if driver.verdict != "successful":
        return {}
    found = {}
    for one in of.loaded.recordings():
        load = load_behind(one, driver)
        scores = fit(load, starts(load)).tested
        found[str(one.path)] = {
            name: [np.nan_to_num(of.z[0]).tolist(), DIRECTIONS[name].seen(*of[:3])[0].tolist()]
            for name, of in scores.items()
            if of.z.size
        }
    return found


def main(arguments: argparse.Namespace) -> bool:
    largest: dict[str, float] = {}
    refused, asked = dict.fromkeys(DIRECTIONS, 0), 0
    for parts in arguments.parts:
        for snr_db in arguments.snr_db:
            numbers = range(FIRST, FIRST + arguments.drivers)
            tasks = [(number, snr_db, parts) for number in numbers]
            done = [of for _, of in each(scores_of, tasks, arguments.workers, "driver") if of]
            for path in done[0]:
                asked += len(done)
                line = []
                for name in done[0][path]:
                    z, seen = zip(*(of[path][name] for of in done), strict=True)
                    deviation = float(np.sqrt(np.mean(np.square(z), axis=0)).max())
                    refused[name] += int(np.any(seen, axis=1).sum())
                    largest[name] = max(largest.get(name, 0.0), deviation)
                    line.append(f"{name} {deviation:.2f} (at most {np.abs(z).max():.1f})")
                print(f"{parts:.0%}, {snr_db:g} dB, {path}: {', '.join(line)}", flush=True)
    targets = []
    for name, deviation in largest.items():
        row = DIRECTIONS[name]
        targets.append(Target(f"{name}: deviation", deviation, most=1.1 * row.deviation))
        if row.verdict:
            most = float(scipy.stats.poisson.isf(RARE, row.count * FALSE_ALARMS * asked))
            targets.append(Target(f"{name}: refused of {asked}", refused[name], most=most))
    return report(targets)
