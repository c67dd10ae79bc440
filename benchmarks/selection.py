"""Is the simplest circuit found that a recording supports, and are the intervals honest after it?

    python -m benchmarks selection            # all of it, 45 minutes of processor time
    python -m benchmarks selection --quick    # few drivers and cells, a minute or two

Recordings of five kinds of circuits, dry and damp, behind drivers drawn anew, from 20 to 80 dB
(`benchmarks.selection_draws`). Written are `selection.csv`, one row for each truth and SNR,
`selection_map.csv`, one row for each cell of the failure map with `circuit="auto"`, and the picture
`selection.svg`. `benchmarks.selection_counts` says what "decisive" means, and which criteria are
compared.
"""

import argparse
import collections
import concurrent.futures
import functools
import pathlib
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from tqdm import tqdm

import etid
from benchmarks import selection_chart, selection_counts, selection_map, selection_rival
from benchmarks.failure_axes import Cell
from benchmarks.failure_counts import Rate, clopper_pearson, rate
from benchmarks.failure_draws import Answer
from benchmarks.perturbed_study import DELAY
from benchmarks.provenance import RESULTS, write_csv
from benchmarks.selection_draws import SNR_DB, TRUTHS, Drawn, draws, scene
from benchmarks.speed import median_time
from etid.identify import file as streaming
from etid.identify.arguments import Circuit
from etid.selection.search import USUAL
from etid.simulation import scenes

DRIVERS = 25
FIRST = 1000  # number of the first driver; those of other benchmarks are smaller
MAP = (7, 10)  # drivers of a cell of the map, and trials behind each
FEW = (1, 4)  # the same of a quick run
PAIRS = 15  # timed pairs
SINGLES = 16  # recordings of a pair that are identified one at a time
COVERED = (0.93, 0.97)  # part of the 95 % intervals that is to hold the truth
QUICK_SNR = (20, 60)
RIVAL_DRIVERS, RIVAL_SNR = 1, (20, 40, 60)  # ten seconds for each recording


class Line(NamedTuple):
    """One line of the table of targets.

    Attributes:
        name: What is measured.
        found: Rate or ratio.
        text: It, as text, with its interval.
        least: Smallest value that meets the target.
        most: Largest one.
    """

    name: str
    found: float
    text: str
    least: float
    most: float

    @property
    def met(self) -> bool:
        """Whether the target is met."""
        return self.least <= self.found <= self.most


def _share(name: str, of: Rate, trials: int, least: float = 0.0, most: float = 1.0) -> Line:
    text = f"{100 * of.rate:.2f} % ({100 * of.low:.2f} to {100 * of.high:.2f}) of {trials}"
    return Line(name, of.rate, text, least, most)


def spread(
    call: Callable[..., list], tasks: Sequence[tuple], workers: int, unit: str
) -> Iterator[tuple[int, list]]:
    """Results of calls with their numbers, as they are done, in `workers` processes."""
    with tqdm(total=len(tasks), unit=unit) as bar:
        if workers == 1:
            for number, task in enumerate(tasks):
                yield number, call(*task)
                bar.update()
            return
        with streaming.processes(workers) as executor:
            futures = {executor.submit(call, *task): i for i, task in enumerate(tasks)}
            for future in concurrent.futures.as_completed(futures):
                yield futures[future], future.result()
                bar.update()


def by_cell(drawn: Sequence[Drawn]) -> dict[tuple[str, float], list[Drawn]]:
    """Recordings by truth and SNR, in the order of the picture."""
    found = collections.defaultdict(list)
    for one in drawn:
        found[one.truth, one.snr_db].append(one)
    names = list(TRUTHS)
    return dict(sorted(found.items(), key=lambda item: (names.index(item[0][0]), item[0][1])))


def _coverage(name: str, drawn: Sequence[Drawn], *quantities: str) -> Line:
    """Coverage; it misses its target if its interval lies outside.

    The records behind a driver share its error: those of 25 drivers scatter by 2 %.
    """
    inside, drivers = selection_counts.covered(drawn, *quantities)
    of = rate(inside, drivers)
    line = _share(name, of, len(inside), *COVERED)
    return line._replace(found=float(np.clip(np.mean(COVERED), of.low, of.high)))


def chosen(rows: Sequence[dict[str, Any]], drawn: Sequence[Drawn]) -> list[Line]:
    """Right and spurious circuits, and coverage."""
    decisive = {(row["truth"], row["snr_db"]) for row in rows if row["decisive"]}
    asked = [one for one in drawn if (one.truth, one.snr_db) in decisive]
    right = selection_counts.of_all([selection_counts.is_right(one) for one in asked], asked)
    richer = selection_counts.of_all([selection_counts.is_richer(one) for one in drawn], drawn)
    lines = [
        _share("right circuit where decisive, from 30 dB", right, len(asked), least=0.99),
        _share("spurious element, from 20 dB", richer, len(drawn), most=0.005),
    ]
    every, all_of = "coverage, all SNRs: ", selection_counts.QUANTITIES
    lines.append(_coverage(f"{every}all", drawn, *all_of))
    lines += [_coverage(every + name, drawn, name) for name in all_of]
    for snr in sorted({one.snr_db for one in drawn}):
        some = [one for one in drawn if one.snr_db == snr]
        lines.append(_coverage(f"coverage, {snr:g} dB: all", some, *all_of))
    return lines


def criteria(rows: Sequence[dict[str, Any]]) -> None:
    """Print the comparison of the criteria on the same fits."""
    print(f"{'all candidates fitted':<24}{'right where decisive':>22}{'spurious':>12}")
    asked = [row for row in rows if row["decisive"]]
    for name in selection_counts.CRITERIA:
        right = sum(row[f"{name}_right"] for row in asked)
        of = sum(row["drawn"] for row in asked)
        spurious, total = (sum(row[key] for row in rows) for key in (f"{name}_richer", "drawn"))
        print(
            f"{name:<24}{f'{right} of {of}, {100 * right / max(of, 1):.2f} %':>22}"
            f"{f'{spurious} of {total}':>16}"
        )


def failures(every: Sequence[Cell], found: Sequence[Sequence[Answer]]) -> list[Line]:
    """Silent failures over the map, and right answers for skin that is not one RC."""
    asked = [one for answered in found for one in answered if one.target]
    silent, elements = selection_map.missed_elements(asked)
    low, high = clopper_pearson(silent, elements)
    text = f"{silent} of {elements} elements ({100 * low:.3f} to {100 * high:.3f} %)"
    lines = [Line("silent over the failure map", silent / max(elements, 1), text, 0.0, 2e-4)]
    drivers = len({one.seed for one in asked})
    print(f"determined elements: {elements} in {len(asked)} answers behind {drivers} drivers")
    for cell, answered in zip(every, found, strict=True):
        for one in answered:
            if one.missed:
                print(f"silent: {cell.chart}, {cell.row}, {cell.column}: {one.path}, {one.seed}")
    right = list(selection_map.right_from_40_db(every, found))
    if right:
        of = rate([one for one, _ in right], [seed for _, seed in right])
        lines.append(_share("right, not one RC, from 40 dB", of, len(right), least=0.95))
    return lines


def time_ratios(pairs: int) -> list[Line]:
    """Time of `circuit="auto"` against the plain fit, on recordings of one RC.

    Both are timed in turns, in seconds of the processor; the median of the ratios counts.
    """
    batch, single = [], []
    for snr in (40.0, 60.0):
        study = scenes.paper_subjects(snr_db=snr, trigger_jitter_rms=DELAY).simulate(5)
        driver = etid.identify_driver(list(study.calibrations.recordings())[:1], throw=False)
        records = list(study.loaded.recordings())[:64]
        one = functools.partial(etid.identify_skin, driver=driver, throw=False)

        def in_batch(circuit: Circuit, records=records, driver=driver) -> None:
            etid.identify_skins(records, driver, circuit=circuit)

        def one_by_one(circuit: Circuit, records=records[:SINGLES], one=one) -> None:
            for record in records:
                one(record, circuit=circuit)

        for ratios, call in ((batch, in_batch), (single, one_by_one)):
            for number in range(pairs + 1):
                seconds = []
                for circuit in (None, "auto"):
                    begin = time.process_time()
                    call(circuit)
                    seconds.append(time.process_time() - begin)
                if number:  # the first pair compiles
                    ratios.append(seconds[1] / seconds[0])
    return [_ratio("batch", batch), _ratio("single recordings", single)]


def _ratio(name: str, ratios: Sequence[float]) -> Line:
    low, middle, high = np.quantile(ratios, (0.25, 0.5, 0.75))
    text = f"{middle:.2f} (quartiles {low:.2f} to {high:.2f}) of {len(ratios)} pairs"
    return Line(f"time, auto / plain fit, one RC, {name}", float(middle), text, 0.0, 1.3)


def rival(rows: list[dict[str, Any]], drawn: Sequence[Drawn]) -> list[Line]:
    """Add the choices of the rival to the rows, and compare right choices.

    Args:
        rows: The table; it gets the columns `rival_NAME`.
        drawn: The recordings for which the rival chooses too.
    """
    of_study = dict.fromkeys((one.snr_db, one.driver) for one in drawn)
    theirs = selection_rival.by_impedance_py([selection_rival.measured(*of) for of in of_study])
    for row in rows:
        here = [snr == row["snr_db"] for snr, _ in of_study]
        names = theirs.names[list(TRUTHS).index(row["truth"]), here]
        for kind in USUAL:
            row[f"rival_{kind.__name__}"] = int((names == kind.__name__).sum())
    ours = np.array([selection_counts.is_right(one) for one in drawn])
    lines = [_compared("same recordings", ours, selection_rival.right(theirs))]
    print(f"impedance.py: {1e3 * np.median(theirs.seconds):.0f} ms for five fits (median)")

    easier = [selection_rival.exact(*of) for of in of_study]
    ours_too = selection_rival.by_etid(easier)
    rights = [
        selection_rival.right(of) for of in (ours_too, selection_rival.by_impedance_py(easier))
    ]
    lines.append(_compared("same exact spectra", *rights))
    print(f"etid, identify_impedance: {1e3 * np.median(ours_too.seconds):.0f} ms for five fits")
    return lines


def _compared(name: str, ours: np.ndarray, theirs: np.ndarray) -> Line:
    """Right choices of etid minus those of the rival."""
    text = f"{ours.sum()} against {theirs.sum()} of {ours.size}"
    return Line(f"right, {name}", ours.mean() - theirs.mean(), text, 0.0, 1.0)


def select_time(number: int) -> float:
    """Median time of `etid.select_circuit`, warm, over all truths at 60 dB [s]."""
    study = scene(60.0, number).simulate(number)
    driver = etid.identify_driver(study["calibration"], throw=False)
    choose = functools.partial(etid.select_circuit, driver=driver, throw=False)
    times = [median_time(functools.partial(choose, study[name]), 1) for name in TRUTHS]
    return float(np.median(times))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Size of the run."""
    parser.add_argument("--quick", action="store_true", help="few drivers, SNRs and cells")
    parser.add_argument("--drivers", type=int, default=DRIVERS, help="of an SNR")
    parser.add_argument("--workers", type=int, default=2, help="processes, each on its own core")
    parser.add_argument("--folder", type=pathlib.Path, default=RESULTS, help="of table and picture")


def main(arguments: argparse.Namespace) -> bool:
    """Run the command."""
    quick, workers = arguments.quick, arguments.workers
    numbers = range(FIRST, FIRST + (2 if quick else arguments.drivers))
    tasks = [(float(snr), n) for snr in (QUICK_SNR if quick else SNR_DB) for n in numbers]
    drawn = [one for _, found in spread(draws, tasks, workers, "study") for one in found]
    rows = [selection_counts.cell(of) for of in by_cell(drawn).values()]
    refused = len(tasks) - len(drawn) // len(TRUTHS)
    print(f"drivers that were not identified: {refused} of {len(tasks)}")
    criteria(rows)
    lines = chosen(rows, drawn)

    missing = selection_rival.missing()
    if missing:
        print(f"impedance.py: {missing}")
    else:
        few = numbers[:RIVAL_DRIVERS]
        lines += rival(rows, [d for d in drawn if d.driver in few and d.snr_db in RIVAL_SNR])
    write_csv(arguments.folder / "selection.csv", rows)
    selection_chart.draw(rows, TRUTHS, arguments.folder / "selection.svg", missing)
    print(f"etid: {1e3 * select_time(FIRST):.0f} ms for a choice (median)")
    lines += time_ratios(3 if quick else PAIRS)

    every = selection_map.chosen_cells()[:: 20 if quick else 1]
    of_map = [(cell, *(FEW if quick else MAP)) for cell in every]
    answered = dict(spread(selection_map.answers, of_map, workers, "cell"))
    found = [answered[number] for number in range(len(every))]
    table = [selection_map.row(*one) for one in zip(every, found, strict=True)]
    write_csv(arguments.folder / "selection_map.csv", table)
    lines += failures(every, found)
    return report(lines)


def report(lines: Sequence[Line]) -> bool:
    """Print the table of targets; whether all are met."""
    for line in lines:
        mark = "" if line.met else "   missed"
        low = f"{line.least:g} to " if line.least else "at most "
        print(f"{line.name:<44}{line.text:<46}{low}{line.most:g}{mark}")
    return all(line.met for line in lines)
