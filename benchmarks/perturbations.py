"""What a laboratory does to recordings: is any answer wrong without saying so?

Each perturbation (`benchmarks.perturbation_list`) is done to studies of several drivers, dry and
damp skin behind each. An answer is *right* if every element is within five of its own standard
errors of the truth and, where the bound of its standard error is 10 % at most, within 20 % of it.
It is *refused* if it is right and not called usable, *said* if it is wrong, or missing, and not
called usable, and *silent* if it is wrong and called usable. An element that changes during
a record is wrong if one of its values is farther away than that; if the fit remarks on something
in the recording, any of them will do. A method without standard errors is held to the bound.
"""

import argparse
import collections
import functools
import itertools
import pathlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

import etid
from benchmarks import charts, estimators
from benchmarks.estimators import DEFAULT, ELEMENTS, FAR, Answer, Drivers, fits, found_by
from benchmarks.laboratory import Record
from benchmarks.ladder import LOADS, recorded
from benchmarks.perturbation_list import AND, INVISIBLE, PERTURBATIONS, UNDISTURBED, change_of, pair
from benchmarks.perturbed_study import PARTS, Truth, undisturbed
from benchmarks.runner import FOLDER, QUICK, WORKERS, Target, at_most, option, report, show, tabled

TARGETS = {
    "silent": at_most(0),  # but for what no test can see
    "undisturbed recordings refused": at_most(1 / 2000),
    "silent pairs of faults that are seen alone": at_most(0),
}
KINDS = tuple(charts.ANSWERS)
FEW = ("base", "polarity_out", "rp_linear_0.2", "driver_Rload_wrong_5%")

OPTIONS = (
    QUICK,
    WORKERS,
    FOLDER,
    option("--only", nargs="+", choices=PERTURBATIONS, metavar="NAME", help="these perturbations"),
    option("--drivers", default=10),
    option("--snr-db", default=(40.0, 60.0), metavar="DB"),
    option("--parts", default=PARTS, help="spread of the parts of the drivers"),
    option("--pairs", default=0, help="so many pairs of faults, drawn at random, in their place"),
)


def in_stderrs(of: Answer) -> np.ndarray:
    """Errors in standard errors; in bounds, where the method gives no standard error.

    An infinite element is infinitely far off, although its standard error is infinite, too.
    """
    far = np.abs(of.error)
    size = np.where(of.stderr > 0, of.stderr, of.bound)
    return np.divide(far, size, out=far.copy(), where=np.isfinite(far))


def kind(of: Answer) -> str:
    """What an answer is, of `KINDS`."""
    far = (in_stderrs(of) > FAR) & of.exact
    far |= (np.abs(of.error) > estimators.OFF) & (of.bound <= estimators.DETERMINED)
    wrong = bool(far.any() or np.isnan(of.error).any())
    if of.usable:
        return "silent" if wrong else "right"
    return "said" if wrong else "refused"


def error_of(values: np.ndarray, truth: Truth, remarked: bool) -> np.ndarray:
    """Relative errors of an answer; 0 where the truth has no such element.

    What moves is near enough everywhere in its range, if the answer has remarked on the recording.
    """
    to_low, to_high = values / truth.low - 1, values / truth.high - 1
    inside = (to_low >= 0) & (to_high <= 0)
    low_is_near = np.abs(to_low) < np.abs(to_high)
    if truth.moves and not remarked:
        error = np.where(low_is_near, to_high, to_low)
    else:
        error = np.where(inside, 0.0, np.where(low_is_near, to_low, to_high))
    return np.where(np.isnan(truth.low), 0.0, error)


def _bound(of: Record, snr_db: float) -> np.ndarray:
    """Bounds of the undisturbed scene with this noise and converter."""
    own = {name: getattr(of, name) for name in ("samples", "bits", "full_scale")}
    if of.out.electronics is not None:
        own |= {"electronics": of.out.electronics, "antialias": of.out.antialias}
    return _bounds(snr_db=snr_db, **own)[of.path]


@functools.cache
def _bounds(**settings: Any) -> dict[str, np.ndarray]:
    scene = recorded(LOADS, **settings)
    return {path: np.array(list(of.relative.values())) for path, of in etid.bound(scene).items()}


def answers_of(names: Sequence[str], number: int, snr_db: float, parts: float) -> list[Answer]:
    """All answers behind one driver with one noise; perturbations that share a driver together."""
    drivers, found = Drivers(), list[Answer]()
    together: dict[int, tuple[etid.Driver | None, list[tuple[str, Record, Truth]]]] = {}
    for name in names:
        study = change_of(name)(undisturbed(number, snr_db, parts))
        driver = drivers.of([of.recording(number) for of in study.calibrations], DEFAULT)
        _, trials = together.setdefault(id(driver), (driver, []))
        trials += [(name, of, study.truths[of.path]) for of in study.trials]
    for driver, trials in together.values():
        every = fits([of.recording(number) for _, of, _ in trials], driver, DEFAULT)
        for (name, of, truth), fit in zip(trials, every, strict=True):
            values, stderr, verdict = found_by(fit)
            one = Answer(
                *(DEFAULT, number, of.path, verdict),
                error=error_of(values, truth, fit is not None and int(fit.remarks) != 0),
                stderr=stderr / ((truth.low + truth.high) / 2),
                bound=_bound(of, snr_db),
                exact=not truth.words,
                perturbation=name,
                snr_db=snr_db,
            )
            found.append(one)
    return found


def grouped(answers: Sequence[Answer], by: Sequence[str]) -> dict[tuple, list[Answer]]:
    """Answers with the same attributes `by`, in their order."""
    groups: dict[tuple, list[Answer]] = {}
    for answer in answers:
        groups.setdefault(tuple(getattr(answer, name) for name in by), []).append(answer)
    return groups


def table(answers: Sequence[Answer], by: Sequence[str]) -> list[dict[str, Any]]:
    """Counts for each group of answers with the same attributes `by`."""
    rows = []
    for key, of in grouped(answers, by).items():
        counts = collections.Counter(map(kind, of))
        row = {**dict(zip(by, key, strict=True)), "answers": len(of)}
        row |= {name: counts[name] for name in KINDS}
        row |= _worst([answer for answer in of if kind(answer) == "silent"])
        rows.append({**row, "verdicts": estimators.verdicts(of)})
    return rows


def _worst(silent: Sequence[Answer]) -> dict[str, Any]:
    """The element of silent answers that is farthest off in standard errors."""
    found: tuple[Any, ...] = ("",) * 4
    if silent:
        worst = max(silent, key=lambda answer: np.nanmax(in_stderrs(answer)))
        off = in_stderrs(worst)
        i = int(np.nanargmax(off))
        found = worst.path, ELEMENTS[i], float(off[i]), float(worst.error[i])
    return dict(zip(("worst_path", "worst_element", "worst_stderrs", "worst_error"), found,
                    strict=True))  # fmt: skip


def targets(answers: Sequence[Answer]) -> Iterator[Target]:
    """What the default method misses."""
    silent, refused, _ = TARGETS
    for (name, path, snr_db), of in grouped(answers, ("perturbation", "path", "snr_db")).items():
        count, known = sum(kind(one) == "silent" for one in of), INVISIBLE.get(name)
        if not count:
            continue
        if not (known and known.excuses(path, snr_db, count, len(of), max(map(_beyond, of)))):
            where, text = f": {name}, {path} at {snr_db:g} dB", f"{count} of {len(of)}"
            yield Target.of(TARGETS, silent, count, after=where, text=text)
    of = [answer for answer in answers if answer.perturbation in UNDISTURBED]
    if of:
        share = estimators.rate_of(of, lambda one: kind(one) in {"refused", "said"})
        yield Target.of(TARGETS, refused, share)


def _beyond(of: Answer) -> float:
    """Largest relative error of a successful answer beyond what a right one may have."""
    allowed = np.minimum(FAR * of.stderr, estimators.OFF)
    return float(np.nanmax(np.abs(of.error) - allowed)) if of.usable else 0.0


def draw(rows: Sequence[Mapping[str, Any]], path: pathlib.Path) -> None:
    """Draw rows of one method: a bar for each perturbation, a panel for each skin and noise."""
    panels: dict[str, dict[str, dict[str, int]]] = {}
    for row in sorted(rows, key=lambda row: (row["path"], row["snr_db"]), reverse=True):
        panel = panels.setdefault(f"{row['path']}, {row['snr_db']:g} dB", {})
        panel[_label(row["perturbation"])] = {kind: row[kind] for kind in KINDS}
    charts.shares(panels, charts.ANSWERS, path)


def _label(name: str) -> str:
    """A perturbation, and what is said of one that nothing shows."""
    return f"{name} (invisible)" if name in INVISIBLE else name


def pairs(arguments: argparse.Namespace) -> bool:
    """Two faults at once, each pair behind a driver of its own."""
    levels = itertools.cycle(arguments.snr_db)
    parts, numbers = arguments.parts, range(arguments.pairs)
    tasks = [([pair(number)], number, next(levels), parts) for number in numbers]

    def rows(done: Mapping[int, Sequence[Answer]]) -> list[dict[str, Any]]:
        every = [answer for found in done.values() for answer in found]
        return table(every, ("perturbation", "snr_db", "path"))

    path, settings = arguments.folder / "perturbation_pairs.csv", {"keep": "perturbation_pairs"}
    found = tabled(path, rows, answers_of, tasks, workers=arguments.workers, **settings)
    every = [answer for of in found for answer in of]
    silent = [answer for answer in every if kind(answer) == "silent"]
    alone = [of for of in silent if INVISIBLE.keys().isdisjoint(of.perturbation.split(AND))]
    counts = collections.Counter(map(kind, every))
    print(f"{arguments.pairs} pairs: {', '.join(f'{counts[name]} {name}' for name in KINDS)}")
    for of in silent:
        far = f"{np.nanmax(in_stderrs(of)):.1f} standard errors"
        print(f"silent: {of.perturbation}, {of.path} at {of.snr_db:g} dB, seed {of.seed}: {far}")
    *_, missed = TARGETS
    return report([Target.of(TARGETS, missed, float(len(alone)))])


def main(arguments: argparse.Namespace) -> bool:
    if arguments.pairs:
        return pairs(arguments)
    quick, folder = arguments.quick, arguments.folder
    names = list(FEW) if quick else arguments.only or list(PERTURBATIONS)
    numbers = range(2 if quick else arguments.drivers)
    parts, levels = arguments.parts, arguments.snr_db
    tasks = [(names, number, snr, parts) for number in numbers for snr in levels]

    def ordered(done: Iterable[Sequence[Answer]]) -> list[Answer]:
        every = (answer for found in done for answer in found)
        place = {name: number for number, name in enumerate(names)}
        return sorted(every, key=lambda a: (a.snr_db, place[a.perturbation], a.path, a.seed))

    def rows(done: Mapping[int, Sequence[Answer]]) -> list[dict[str, Any]]:
        return table(ordered(done.values()), ("perturbation", "snr_db", "path", "method"))

    workers = 1 if quick else arguments.workers
    settings = {"workers": workers, "unit": "driver", "keep": "perturbations"}
    found = tabled(folder / "perturbations.csv", rows, answers_of, tasks, **settings)
    draw(rows(dict(enumerate(found))), folder / "perturbations.svg")
    for row in table(ordered(found), ("perturbation", "snr_db")):
        show(row)
    return report(targets(ordered(found)))
