"""Is the simplest circuit found that a recording supports, and are the intervals honest after it?

Recordings of five kinds of circuits, dry and damp, behind drivers drawn anew, from 20 to 80 dB
(`benchmarks.selection_draws`). Written are `selection.csv`, one row for each truth and SNR,
`selection_map.csv`, one row for each cell of the failure map with `circuit="auto"`, and
`selection.svg`. `benchmarks.selection_counts` says what "decisive" means, and which criteria are
compared.
"""

import argparse
import collections
import functools
import pathlib
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

import etid
from benchmarks import charts, runner, selection_rival
from benchmarks import selection_counts as counts
from benchmarks.estimators import Answer
from benchmarks.failure_axes import Cell
from benchmarks.failure_draws import AUTO, Effort, answers
from benchmarks.machine import median_time, timed, write_csv
from benchmarks.perturbed_study import DELAY
from benchmarks.rates import COVERED, clopper_pearson, rate
from benchmarks.rivals import RivalError
from benchmarks.runner import Target, at_least, at_most, each, option, report, tabled
from benchmarks.selection_draws import SNR_DB, TRUTHS, Drawn, draws, scene
from etid.selection.search import USUAL
from etid.simulation import scenes

FIRST = 1000  # number of the first driver; those of other benchmarks are smaller
MAP = Effort(7, 10)  # of a cell of the map
PAIRS = 15  # timed pairs
FEWEST = 10  # intervals whose coverage is looked at
BATCH, SINGLES = 64, 16  # recordings of a pair: at once, and one at a time
# The same of a quick run, which has every 20th cell of the map.
FEW, FEW_PAIRS, FEW_DRIVERS, FEW_SNR, STEP = Effort(1, 4), 3, 2, (20, 60), 20
RIVAL_DRIVERS, RIVAL_SNR = 1, (20, 40, 60)  # ten seconds for each recording

OPTIONS = (
    *(runner.QUICK, runner.WORKERS, runner.FOLDER),
    option("--drivers", default=25, help="of an SNR"),
)
TARGETS = {
    "right circuit where decisive, from 30 dB": at_least(0.99),
    "spurious element, from 20 dB": at_most(0.005),
    "coverage": COVERED,
    "coverage of R_s, one truth at one SNR": at_least(0.75),  # 18 of 25 are one in 5000
    "silent over the failure map": at_most(2e-4),
    "right, not one RC, from 40 dB": at_least(0.95),
    "time, auto / plain fit, one RC": at_most(1.3),
}
# Circuits from the simplest to the richest, with their colours, hatches and labels in the picture.
FACES = {
    "Resistor": ("#d9d9d9", "", "resistor"),
    "ParallelRC": ("#b3cde3", "...", "R‖C"),
    "SkinRC": ("#4f9bd0", "", "R_s + R‖C"),
    "SkinCole": ("#f2b263", "///", "Cole"),
    "SkinLayers": ("#c9564a", "xxx", "two layers"),
    "SkinWarburg": ("#8e6bb0", "\\\\\\", "Warburg"),
}


def chosen(rows: Sequence[dict[str, Any]], drawn: Sequence[Drawn]) -> Iterator[Target]:
    """Right and spurious circuits, and coverage."""
    decisive = {(row["truth"], row["snr_db"]) for row in rows if row["decisive"]}
    asked = [one for one in drawn if (one.truth, one.snr_db) in decisive]
    right = rate([one.is_right for one in asked], [one.driver for one in asked])
    richer = rate([one.is_richer for one in drawn], [one.driver for one in drawn])
    yield Target.of(TARGETS, "right circuit where decisive, from 30 dB", right)
    yield Target.of(TARGETS, "spurious element, from 20 dB", richer)
    groups = {"all SNRs: all": (drawn, counts.QUANTITIES)}
    groups |= {f"all SNRs: {name}": (drawn, (name,)) for name in counts.QUANTITIES}
    for snr in sorted({one.snr_db for one in drawn}):
        groups[f"{snr:g} dB: all"] = [one for one in drawn if one.snr_db == snr], counts.QUANTITIES
    for name, (of, quantities) in groups.items():
        covered = rate(*counts.covered(of, *quantities))
        yield Target.of(TARGETS, "coverage", covered, after=f", {name}")
    for row in rows:
        count, held = row["R_s_intervals"], row["R_s_covered"]
        if count >= FEWEST:
            where = f": {row['truth']} at {row['snr_db']:g} dB"
            ends = clopper_pearson(held * count, count)
            name = "coverage of R_s, one truth at one SNR"
            target = Target.of(TARGETS, name, held, after=where, interval=ends)
            if not target.met:
                yield target


def criteria(rows: Sequence[dict[str, Any]]) -> Iterator[Target]:
    """Comparison of the criteria on the same fits."""
    asked = [row for row in rows if row["decisive"]]
    for name in counts.CRITERIA:
        right, of = (sum(row[key] for row in asked) for key in (f"{name}_right", "drawn"))
        spurious, total = (sum(row[key] for row in rows) for key in (f"{name}_richer", "drawn"))
        text = f"{right} of {of} right where decisive, {spurious} of {total} spurious"
        yield Target(f"{name}, all candidates fitted", right / max(of, 1), text=text)


def failures(every: Sequence[Cell], found: Sequence[Sequence[Answer]]) -> Iterator[Target]:
    """Silent failures over the map, and right answers for skin that is not one RC."""
    asked = [one for answered in found for one in answered if one.target]
    silent, elements = counts.missed_elements(asked)
    low, high = clopper_pearson(silent, elements)
    text = f"{silent} of {elements} elements ({100 * low:.3f} to {100 * high:.3f} %)"
    name, share = "silent over the failure map", silent / max(elements, 1)
    yield Target.of(TARGETS, name, share, text=text, interval=(low, high))
    drivers = len({one.seed for one in asked})
    print(f"determined elements: {elements} in {len(asked)} answers behind {drivers} drivers")
    for cell, answered in zip(every, found, strict=True):
        for one in answered:
            if one.missed:
                print(f"silent: {', '.join(cell.place.values())}: {one.path}, {one.seed}")
    right = counts.right_from_40_db(every, found)
    if right.trials:
        yield Target.of(TARGETS, "right, not one RC, from 40 dB", right)


def time_ratios(pairs: int) -> Iterator[Target]:
    """Time of `circuit="auto"` against the plain fit, on recordings of one RC.

    Both are timed in turns, in seconds of the processor; the median of the ratios counts, at each
    SNR for itself: at 40 dB a second circuit is fitted where it may hide.
    """
    for snr in (40.0, 60.0):
        study = scenes.paper_subjects(snr_db=snr, trigger_jitter_rms=DELAY).simulate(5)
        driver = etid.identify_driver(list(study.calibrations.recordings())[:1], throw=False)
        records = list(study.loaded.recordings())[:BATCH]

        def in_batch(circuit: Any, records=records, driver=driver) -> None:
            etid.identify_skins(records, driver, circuit=circuit)

        def one_by_one(circuit: Any, records=records[:SINGLES], driver=driver) -> None:
            for record in records:
                etid.identify_skin(record, driver, circuit=circuit, throw=False)

        for name, call in {"batch": in_batch, "single recordings": one_by_one}.items():
            ratios = list[float]()
            for _ in range(pairs + 1):
                plain, auto = (
                    timed(functools.partial(call, circuit), time.process_time)[1]
                    for circuit in (None, "auto")
                )
                ratios.append(auto / plain)
            low, middle, high = np.quantile(ratios[1:], (0.25, 0.5, 0.75))  # the first pair traces
            text = f"{middle:.2f} (quartiles {low:.2f} to {high:.2f}) of {pairs} pairs"
            ratio, after = "time, auto / plain fit, one RC", f", {name}, {snr:g} dB"
            yield Target.of(TARGETS, ratio, float(middle), after=after, text=text)


def rival(rows: list[dict[str, Any]], drawn: Sequence[Drawn]) -> Iterator[Target]:
    """Compare right choices, and add those of the rival to the table as columns `rival_NAME`."""
    of_study = dict.fromkeys((one.snr_db, one.driver) for one in drawn)
    theirs = selection_rival.by_impedance_py([selection_rival.measured(*of) for of in of_study])
    for row in rows:
        here = [snr == row["snr_db"] for snr, _ in of_study]
        names = theirs.names[list(TRUTHS).index(row["truth"]), here]
        for kind in USUAL:
            row[f"rival_{kind.__name__}"] = int((names == kind.__name__).sum())
    ours = np.array([one.is_right for one in drawn])
    yield _compared("same recordings", ours, theirs.right)
    print(f"impedance.py: {1e3 * np.median(theirs.seconds):.0f} ms for five fits (median)")
    easier = [selection_rival.exact(*of) for of in of_study]
    ours_too = selection_rival.by_etid(easier)
    theirs_too = selection_rival.by_impedance_py(easier)
    yield _compared("same exact spectra", ours_too.right, theirs_too.right)
    print(f"etid, identify_impedance: {1e3 * np.median(ours_too.seconds):.0f} ms for five fits")


def _compared(name: str, ours: np.ndarray, theirs: np.ndarray) -> Target:
    """Right choices of etid minus those of the rival."""
    text = f"{ours.sum()} against {theirs.sum()} of {ours.size}"
    return Target(f"right, {name}", ours.mean() - theirs.mean(), 0.0, 1.0, text)


def select_time(number: int) -> float:
    """Median time of `etid.select_circuit`, warm, over all truths at 60 dB [s]."""
    study = scene(60.0, number).simulate(number)
    driver = etid.identify_driver(study["calibration"], throw=False)
    choose = functools.partial(etid.select_circuit, driver=driver, throw=False)
    times = [median_time(functools.partial(choose, study[name]), 1) for name in TRUTHS]
    return float(np.median(times))


def draw(rows: Sequence[Mapping[str, Any]], path: pathlib.Path) -> None:
    """Chosen circuits: a bar for each truth, a panel for each SNR; etid, then the rival if any."""
    panels, texts = {}, {}
    for of, who in (("chose", "etid"), ("rival", "impedance.py")):
        for row in rows:
            counts = {kind: int(row.get(f"{of}_{kind}", 0)) for kind in FACES}
            if not sum(counts.values()):
                continue
            panel, truth = f"{who}, {row['snr_db']:g} dB", row["truth"]
            panels.setdefault(panel, {})[truth] = counts
            right = counts[type(TRUTHS[truth]).__name__] / sum(counts.values())
            doubt = "" if of == "rival" or row["decisive"] else " ?"
            texts[panel, truth] = f"{100 * right:.0f} % right{doubt}"
    title = "Chosen circuits (?: below 30 dB, or the evidence is not decisive)"
    charts.shares(panels, FACES, path, title=title, texts=texts)


def main(arguments: argparse.Namespace) -> bool:
    quick, workers, folder = arguments.quick, arguments.workers, arguments.folder
    numbers = range(FIRST, FIRST + (FEW_DRIVERS if quick else arguments.drivers))
    tasks = [(float(snr), n) for snr in (FEW_SNR if quick else SNR_DB) for n in numbers]
    found = dict(each(draws, tasks, workers, "study", "selection"))
    drawn = [one for number in sorted(found) for one in found[number]]
    by_cell = collections.defaultdict(list)
    for one in drawn:
        by_cell[list(TRUTHS).index(one.truth), one.snr_db].append(one)
    rows = [counts.cell(by_cell[place]) for place in sorted(by_cell)]
    refused = len(tasks) - len(drawn) // len(TRUTHS)
    print(f"drivers that were not identified: {refused} of {len(tasks)}")
    targets = [*criteria(rows), *chosen(rows, drawn)]
    few = numbers[:RIVAL_DRIVERS]
    try:
        targets += rival(rows, [d for d in drawn if d.driver in few and d.snr_db in RIVAL_SNR])
    except RivalError as error:
        print(f"impedance.py: {error}")
    write_csv(folder / "selection.csv", rows)
    draw(rows, folder / "selection.svg")
    print(f"etid: {1e3 * select_time(FIRST):.0f} ms for a choice (median)")
    targets += time_ratios(FEW_PAIRS if quick else PAIRS)

    every = counts.chosen_cells()[:: STEP if quick else 1]
    of_map = [(cell, {AUTO: FEW if quick else MAP}) for cell in every]

    def rows_of_map(done: dict[int, list[Answer]]) -> list[dict[str, Any]]:
        return [counts.map_row(every[number], found) for number, found in done.items()]

    answered = tabled(
        folder / "selection_map.csv", rows_of_map, answers, of_map,
        workers=workers, unit="cell", keep="selection_map",
    )  # fmt: skip
    return report([*targets, *failures(every, answered)])
