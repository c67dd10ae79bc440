"""Where each method fails, and whether it says so: maps over nine pairs of axes.

    python -m benchmarks failure_map            # all of it, in two processes
    python -m benchmarks failure_map --quick    # few cells, few draws, and what must hold in them
    python -m benchmarks failure_map --only "SNR and periods"   # one map; others are kept

For each method and cell: the rate of wrong answers, of those that are wrong silently, of unstable
poles, and of iterations that did not converge, with 95 % intervals (`benchmarks.estimators` defines
wrong and silent, `benchmarks.rates` the intervals). Written are `failures.csv`, one row for each
cell and method; `silent_failures.csv`, each silent failure with its seed; and one
`failures_NUMBER.svg` for each map.

For skin that is not one RC the truth is the limits of its impedance at low and high frequency, and
the bound that of one RC with them. A resistor that is fitted to skin should be R_s + R_p, in the
place of R_p.

The target: of the trials with an element that is determined to 10 %, the default method is silently
wrong about such an element in 0.1 % at most, over all cells together, and in no cell so often that
the interval of its rate lies above that. A full run has too few drivers to prove it: none in a
thousand still allows 0.4 %, which is printed.

Output error takes ten times as long as all other methods together, and gets fewer draws, as does
what takes longer because of a higher sample rate or more periods.
"""

import argparse
import collections
import csv
import dataclasses
import itertools
import pathlib
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

import etid
from benchmarks import failure_chart
from benchmarks.estimators import DEFAULT, ELEMENTS, NOTHING, OURS, Answer, Drivers, method_of
from benchmarks.failure_axes import MOST, Cell, Cole, TwoLayers, cells
from benchmarks.mappings import make_room
from benchmarks.provenance import write_csv
from benchmarks.rates import rate
from benchmarks.runner import FOLDER, QUICK, WORKERS, Target, each, option, report
from etid.circuits.circuit import AbstractCircuit, Resistor
from etid.estimators.registry import named
from etid.results.driver import DiscreteDriver
from etid.signals.transfer import is_stable
from etid.simulation.scenes import Scene
from etid.simulation.transformer import Impedance, SkinLoad

RATES, SILENT = "failures.csv", "silent_failures.csv"
MAPS = list(dict.fromkeys(cell.chart for cell in cells()))
TARGET = 1e-3  # silent failures of the default method
ALL = 2 * MOST  # trials of a driver
DRIVERS = 3  # an hour on two cores
USUAL = 10_000.0  # samples of three periods at 200 kHz
CHUNK = 8  # cells of one task
NOT_CONVERGED = ("max_steps_reached", "nonfinite")
# Of the quick run: two where all is well for the default method and not for the others, and one
# where another skin has to be noticed.
FEW = {
    ("SNR and trigger delay, rms", "60 dB", "500 ns"),
    ("SNR and trigger delay, rms", "40 dB", "50 ns"),
    ("SNR and skin that is not one RC", "60 dB", "Cole, 0.9"),
}
RANKING = (DEFAULT, "steiglitz_mcbride")  # what is right at least as often as what follows it

OPTIONS = (
    QUICK,
    WORKERS,
    FOLDER,
    option("--only", nargs="+", choices=MAPS, default=[], type=str, help="these maps"),
    option("--drivers", default=DRIVERS, help="of a cell, at most"),
)


class Effort(NamedTuple):
    """How much is drawn of a cell: calibrations, and trials behind each."""

    drivers: int
    trials: int


def effort(cell: Cell, quick: bool, drivers: int) -> dict[str, Effort]:
    """What a run draws of a cell, by method; fewer drivers where a period has more samples."""
    usual = dict.fromkeys(OURS, Effort(1 if quick else drivers, ALL))
    if quick:
        return {**usual, "output_error": Effort(1, 2)}
    usual |= {"non_parametric": Effort(drivers, 3), "output_error": Effort(1, 3)}
    cost = max(1.0, cell.scene.sample_rate / 200e3, cell.scene.samples / USUAL / 3)
    return {name: Effort(max(1, round(of.drivers / cost)), of.trials) for name, of in usual.items()}


# --- draws ----------------------------------------------------------------------------------------


def elements(load: Impedance | AbstractCircuit) -> SkinLoad:
    """The true elements of a load of these scenes."""
    if isinstance(load, TwoLayers | Cole):
        return load.elements
    assert isinstance(load, SkinLoad)
    return load


def _fitted(circuit: AbstractCircuit) -> np.ndarray:
    if isinstance(circuit, Resistor):
        return np.array([np.nan, float(circuit.r), np.nan])
    return np.asarray(circuit.values())


def _true(skin: SkinLoad, circuit: AbstractCircuit) -> np.ndarray:
    if isinstance(circuit, Resistor):
        return np.array([np.nan, skin.r_s + skin.r_p, np.nan])
    return np.array(dataclasses.astuple(skin))


def bounds(scene: Scene) -> dict[str, np.ndarray]:
    """Relative bounds of the elements by path; NaN where an element does not exist."""
    loads = {t.path: t.load for t in scene.trials}
    one_rc = {p: z.skin if isinstance(z, Cole) else elements(z) for p, z in loads.items()}
    trials = tuple(dataclasses.replace(t, load=one_rc[t.path]) for t in scene.trials)
    found = etid.bound(dataclasses.replace(scene, trials=trials))
    exist = {path: np.isfinite(dataclasses.astuple(elements(z))) for path, z in loads.items()}
    return {p: np.where(exist[p], list(of.relative.values()), np.nan) for p, of in found.items()}


def seeds(cell: Cell, count: int) -> Iterator[int]:
    """Seeds of a cell, which no other cell has: their draws are to be independent."""
    first = zlib.crc32(f"{cell.chart}/{cell.row}/{cell.column}".encode())
    return (first + number for number in range(count))


def recordings(cell: Cell, seed: int) -> tuple[list[etid.Recording], list[etid.Recording]]:
    """Calibrations and trials of one seed."""
    rng = np.random.default_rng([seed, *b"change"])
    every = list(cell.scene.simulate(seed).recordings())
    every = every if cell.change is None else [cell.change(record, rng) for record in every]
    return [r for r in every if r.is_calibration], [r for r in every if not r.is_calibration]


def said(
    cell: Cell,
    seed: int,
    name: str,
    records: Sequence[etid.Recording],
    driver: etid.Driver | None,
    limits: Mapping[str, np.ndarray],
) -> Iterator[Answer]:
    """What a method says of some trials of one seed."""
    if driver is None:
        for one in records:
            yield Answer(name, seed, one.path, "driver_failed", NOTHING, NOTHING, limits[one.path])
        return
    loads = {t.path: t.load for t in cell.scene.trials}
    discrete = isinstance(driver, DiscreteDriver) and not bool(is_stable(driver.a))
    fits = etid.identify_skins(records, driver, method=method_of(name), circuit=cell.circuit)
    for number, path in enumerate(record.path for record in records):
        fit, load = fits[number], loads[path]
        truth, words = _true(elements(load), fit.circuit), (fit.verdict, driver.verdict)
        yield Answer(
            *(name, seed, path, fit.verdict),
            error=_fitted(fit.circuit) / truth - 1,
            stderr=_fitted(fit.stderr) / truth,
            bound=limits[path],
            chi2=float(fit.chi2),
            unstable=discrete or "unstable" in words,
            unsettled=any(word in NOT_CONVERGED for word in words),
            exact=isinstance(load, SkinLoad) and cell.circuit is None,
        )


def answers(cell: Cell, efforts: Mapping[str, Effort]) -> list[Answer]:
    """All answers in a cell, by the methods of `efforts`."""
    with jax.enable_x64(True):  # of a worker process
        limits, found = bounds(cell.scene), list[Answer]()
        for number, seed in enumerate(seeds(cell, max(e.drivers for e in efforts.values()))):
            (calibrations, trials), drivers = recordings(cell, seed), Drivers(cell.order)
            for name, of in efforts.items():
                able = cell.circuit is None or name == DEFAULT or named(name).any_circuit
                if able and number < of.drivers:
                    driver = drivers.of(calibrations, name)
                    found += said(cell, seed, name, trials[: of.trials], driver, limits)
        make_room()
        return found


def chunk(chosen: Sequence[Cell], efforts: Sequence[dict[str, Effort]]) -> list[list[Answer]]:
    """The same for several cells."""
    return [answers(*one) for one in zip(chosen, efforts, strict=True)]


def tasks(chosen: Sequence[Cell]) -> list[list[int]]:
    """Numbers of cells that are done by one process: of one shape, so that it compiles once."""
    by_shape = collections.defaultdict(list)
    for number, cell in enumerate(chosen):
        by_shape[cell.shape].append(number)
    found = []
    for numbers in by_shape.values():
        size = CHUNK if len(numbers) > 4 * CHUNK else len(numbers)
        found += [numbers[i : i + size] for i in range(0, len(numbers), size)]
    return sorted(found, key=lambda of: -sum(chosen[i].scene.samples for i in of))


# --- counts ---------------------------------------------------------------------------------------

EVENTS: Mapping[str, Callable[[Answer], bool]] = {
    "wrong": lambda answer: answer.wrong,
    "refused": lambda answer: answer.refused,
    "silent": lambda answer: answer.silent,
    "unstable": lambda answer: answer.unstable,
    "not_converged": lambda answer: answer.unsettled,
}


def rates(given: Iterable[Answer]) -> dict[str, Any]:
    """Numbers of drivers and trials, and the rate of each event with its interval.

    `missed` is the rate of silent failures of elements that are determined to 10 %, among the
    trials that have any.
    """
    every = list(given)
    asked, seeds_of = [a for a in every if a.target], [a.seed for a in every]
    of = {name: rate([event(a) for a in every], seeds_of) for name, event in EVENTS.items()}
    of["missed"] = rate([a.missed for a in asked], [a.seed for a in asked])
    found: dict[str, Any] = {"drivers": len({*seeds_of}), "trials": len(every)}
    found["determined"] = len(asked)
    for name, one in of.items():
        found |= {name: one.rate, f"{name}_low": one.low, f"{name}_high": one.high}
    return found


def table(cell: Cell, every: Sequence[Answer]) -> list[dict[str, Any]]:
    """One row for each method in a cell."""
    largest = float(np.nanmax([answer.bound for answer in every]))
    by_method = {name: [a for a in every if a.method == name] for name in OURS}
    return [
        {**cell.place, "method": name, **rates(of), "largest_bound": largest}
        for name, of in by_method.items()
        if of
    ]


def silent(cell: Cell, every: Sequence[Answer]) -> list[dict[str, Any]]:
    """Every silent failure in a cell: by whom, of which seed, and by how much."""
    return [
        {**cell.place, "method": of.method, "seed": of.seed, "path": of.path, "missed": of.missed}
        | {"chi2": of.chi2}
        | {
            f"{name}_{what}": getattr(of, what)[i]
            for i, name in enumerate(ELEMENTS)
            for what in ("error", "stderr", "bound")
        }
        for of in every
        if of.silent
    ]


def summary(every: Sequence[Answer]) -> Iterator[str]:
    """One line per method over all cells; and its verdicts."""
    for name in dict.fromkeys(answer.method for answer in every):
        of = [answer for answer in every if answer.method == name]
        r, counts = rates(of), collections.Counter(answer.verdict for answer in of)
        events = ", ".join(f"{100 * r[event]:.2f} % {event}" for event in EVENTS)
        yield f"{name}: {r['trials']} trials, {events}"
        yield "    " + ", ".join(f"{count} {verdict}" for verdict, count in counts.most_common())
        yield (
            f"    silently wrong where determined to 10 %: {100 * r['missed']:.3f} % of "
            f"{r['determined']}, 95 % interval {100 * r['missed_low']:.3f} to "
            f"{100 * r['missed_high']:.3f} %"
        )


def targets(rows: Sequence[Mapping[str, Any]], every: Sequence[Answer]) -> Iterator[Target]:
    """Whether the default method fails silently as seldom as it is to."""
    for row in rows:
        if row["method"] == DEFAULT and row["missed_low"] > TARGET:
            place = ", ".join(row[name] for name in ("map", "row", "column"))
            yield Target(f"silent in {place}, at least", row["missed_low"], most=TARGET)
    overall = rates(a for a in every if a.method == DEFAULT)
    if overall["determined"]:
        yield Target("silent where determined, all cells", overall["missed"], most=TARGET)


def ranking(every: Sequence[Answer]) -> Iterator[Target]:
    """Whether each method of `RANKING` is right at least as often as the next."""
    right = {
        name: sum(not (a.wrong or a.refused) for a in every if a.method == name) for name in RANKING
    }
    for better, worse in itertools.pairwise(RANKING):
        yield Target(f"right answers, {better}; of {worse} at most", right[better], right[worse])


# --- the run --------------------------------------------------------------------------------------


def earlier(path: pathlib.Path, new: Sequence[str]) -> list[dict[str, Any]]:
    """Rows of a table of an earlier run, of maps that are not drawn anew."""
    if not new or not path.exists():
        return []
    with path.open(newline="") as file:
        return [row for row in csv.DictReader(file) if row["map"] not in new]


def write(path: pathlib.Path, rows: Sequence[dict[str, Any]]) -> None:
    """Write a table in the order of the maps, in the place of that of an earlier run."""
    path.unlink(missing_ok=True)
    if rows:
        write_csv(path, sorted(rows, key=lambda row: MAPS.index(row["map"])))


def main(arguments: argparse.Namespace) -> bool:
    """Draw, count, print, and write tables and pictures."""
    quick, only, folder = arguments.quick, arguments.only, arguments.folder
    chosen = [
        cell
        for cell in cells()
        if (not quick or tuple(cell.place.values()) in FEW) and (not only or cell.chart in only)
    ]
    efforts = [effort(cell, quick, arguments.drivers) for cell in chosen]
    parts = tasks(chosen)
    given = [([chosen[i] for i in of], [efforts[i] for i in of]) for of in parts]
    kept = {name: earlier(folder / name, only) for name in (RATES, SILENT)}
    found: dict[int, list[Answer]] = {}
    rows, failures = list[dict[str, Any]](), list[dict[str, Any]]()
    for part, done in each(chunk, given, arguments.workers):
        found |= dict(zip(parts[part], done, strict=True))
        pairs = [(chosen[i], found[i]) for i in sorted(found)]
        rows = [row for pair in pairs for row in table(*pair)]
        write(folder / RATES, [*kept[RATES], *rows])  # nothing that is done is lost
        failures = [row for pair in pairs for row in silent(*pair)]
        write(folder / SILENT, [*kept[SILENT], *failures])
    for name in dict.fromkeys(row["map"] for row in rows):
        of = [row for row in rows if row["map"] == name]
        failure_chart.draw(of, folder / f"failures_{MAPS.index(name) + 1}.svg")
    every = [answer for i in sorted(found) for answer in found[i]]
    print("\n".join(summary(every)))
    for row in failures:
        if row["method"] == DEFAULT:
            place = f"{row['map']}, {row['row']}, {row['column']}"
            print(f"silent: {place}, seed {row['seed']}, {row['path']}")
    return report([*targets(rows, every), *(ranking(every) if quick else ())])
