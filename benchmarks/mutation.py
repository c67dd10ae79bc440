"""Would the tests tell? Bugs are put in, one at a time, and the tests of the files concerned run.

    python -m benchmarks mutation --mutants 40 --modules estimators.judgement signals.harmonics

A mutant that all tests let pass has survived. Some are no bug at all: another start of an
iteration, a tolerance that nothing depends on; they are counted all the same. Mutants are drawn by
a seed from a copy of the working tree. Tests that killed a mutant of the same module come first,
those of the nearest lines before the others. Each outcome is kept at once in `mutation.jsonl`: the
same command goes on where it was interrupted, and as the mutants are done in the order in which
they were drawn, what is done is a fair sample. The table is `mutation.csv`.
"""

import argparse
import collections
import json
import os
import pathlib
import shutil
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from benchmarks.mutant_tests import Runner
from benchmarks.mutants import Mutant, drawn, mutants
from benchmarks.provenance import ROOT, write_csv
from benchmarks.rates import clopper_pearson
from benchmarks.runner import option

TARGET = 0.1  # part of the mutants that may survive
COPIED = (
    *("etid", "tests", "benchmarks", "data_schema", "docs", "notebooks", ".ci"),
    ".pytest_cache",  # what was compiled for tests without a mutant
)
LIMIT = 600.0  # [s] of a mutant; one that takes longer counts as a survivor
# The tests of each module, the cheapest first.
_WELL = ("maximum_likelihood", "own_circuits", "current", "other_circuit", "mains")
_OVERVIEW = ("overview", "fit", "exporting", "recording", "identification")
TESTS: Mapping[str, Sequence[str]] = {
    "estimators.joint.errors": ("joint_errors", "joint"),
    "estimators.joint.fit": ("joint",),
    "estimators.joint.terms": ("joint",),
    "estimators.judgement": ("judging",),
    "estimators.maximum_likelihood.given_driver": (
        *("given_driver", "maximum_likelihood", "current"),
    ),
    "estimators.maximum_likelihood.load": _WELL,
    "estimators.maximum_likelihood.load_fit": _WELL,
    "estimators.maximum_likelihood.profile": ("maximum_likelihood", "mains"),
    "estimators.non_parametric.fit": ("non_parametric",),
    "estimators.output_error.fit": ("output_error", "current", "identification"),
    "estimators.output_error.information": ("output_error", "identification"),
    "estimators.output_error.prediction": ("output_error", "identification"),
    "identify.changes": ("other_in_time", "changes"),
    "identify.file": ("streaming", "interrupt", "current"),
    "online.changes": ("electrode", "online"),
    "online.electrode": ("electrode", "online"),
    "online.gain_bands": ("gain_bands", "online"),
    "online.projection": ("gain_bands", "online"),
    "online.tick": ("electrode", "online"),
    "online.tracker": ("electrode", "online"),
    "results.driver": ("driver", "overview", "given_driver"),
    "results.fit": _OVERVIEW,
    "results.fits": (*_OVERVIEW, "batch"),
    "results.hdf5_table": ("tables", "exporting", "cli"),
    "results.verdicts": ("judging", "verdicts"),
    "signals.harmonics": ("spectra",),
    "solvers.levenberg_marquardt": ("solver_steps", "levenberg_marquardt"),
}


def copied(root: pathlib.Path, folder: pathlib.Path) -> None:
    """A working tree to break, with the reference data beside it if there are any."""
    for path in root.iterdir():
        if path.is_file() and not path.name.startswith("."):
            shutil.copy2(path, folder)
        elif path.name in COPIED:
            ignored = shutil.ignore_patterns("__pycache__")
            shutil.copytree(path, folder / path.name, ignore=ignored)
    shared = root.parent / "shared"
    if shared.exists():
        (folder.parent / "shared").symlink_to(shared.resolve())


def nearest(rows: Sequence[Mapping[str, Any]], module: str, line: int) -> list[str]:
    """Tests that killed a mutant of this module, those of the nearest lines first."""
    distance = {}
    for row in rows:
        if row["module"] == module and row["killer"]:
            far = abs(int(row["place"].rpartition(":")[2]) - line)
            distance[row["killer"]] = min(far, distance.get(row["killer"], far))
    return sorted(distance, key=lambda killer: distance[killer])


def outcomes(
    root: pathlib.Path,
    tests: Mapping[str, Sequence[str]],
    chosen: Sequence[Mutant],
    kept: pathlib.Path,
    limit: float,
) -> Iterator[dict[str, Any]]:
    """One row for each mutant, as they are done; those that are kept already come as they were.

    Args:
        root: The working tree.
        tests: Test files of each module.
        chosen: The mutants.
        kept: File of what was done before.
        limit: Time of a mutant [s].

    Raises:
        SystemExit: The tests fail without any mutant.
    """
    before = {}
    if kept.exists():
        lines = kept.read_text("utf-8").splitlines()
        before = {row["key"]: row for row in map(json.loads, lines)}
    with tempfile.TemporaryDirectory() as place:
        folder = pathlib.Path(place, "tree")
        folder.mkdir()
        copied(root, folder)
        run = Runner(folder)
        sound: set[str] = set()
        for index, mutant in enumerate(chosen):
            if mutant.key in before:
                yield before[mutant.key]
                continue
            name = mutant.path.removeprefix("etid/").removesuffix(".py").replace("/", ".")
            for test in set(tests[name]) - sound:
                if run([test], f"etid.{name}", 10 * limit).passed is not True:
                    raise SystemExit(f"tests/test_{test}.py fails without any mutant")
                sound.add(test)
            path = folder / mutant.path
            source = path.read_text("utf-8")
            path.write_text(mutant.applied(source), "utf-8")
            # Python takes bytecode for that of a source of the same length and time.
            os.utime(path, (index, index))
            begun = time.perf_counter()
            first = nearest(list(before.values()), name, mutant.line)
            passed, killer = run(tests[name], f"etid.{name}", limit, first)
            path.write_text(source, "utf-8")
            row = {
                "key": mutant.key,
                "module": name,
                "place": f"{mutant.path}:{mutant.line}",
                "kind": mutant.kind,
                "before": mutant.before,
                "after": mutant.after,
                "outcome": {True: "survived", False: "killed", None: "too long"}[passed],
                "killer": killer,
                "seconds": round(time.perf_counter() - begun, 1),
            }
            before[mutant.key] = row
            with kept.open("a", encoding="utf-8") as file:
                file.write(json.dumps(row) + "\n")
            yield row


def _on_one_line(row: Mapping[str, Any]) -> dict[str, Any]:
    code = {name: " ".join(row[name].split()) for name in ("before", "after")}
    return {name: value for name, value in row.items() if name != "key"} | code


def show(rows: Sequence[Mapping[str, Any]]) -> float:
    """Print what survived, and return the part of all that it is."""
    modules = collections.defaultdict(list)
    for row in rows:
        modules[row["module"]].append(row["outcome"] != "killed")
    print(f"{'module':<44}{'mutants':>8}{'survived':>10}")
    for name, survived in sorted(modules.items()):
        print(f"{name:<44}{len(survived):>8}{sum(survived):>10}")
    left = [row for row in rows if row["outcome"] != "killed"]
    low, high = clopper_pearson(len(left), len(rows))
    share = len(left) / len(rows)
    print(f"{len(left)} of {len(rows)} survive, {share:.0%} (95 %: {low:.0%} to {high:.0%})")
    for row in left:
        code = " ".join(row["before"].split())[:70], " ".join(row["after"].split())[:70]
        print(f"  {row['place']}: {row['kind']}: {code[0]}  ->  {code[1]}")
    return share


OPTIONS = (
    option("--mutants", default=40, help="how many to draw"),
    option("--modules", nargs="+", choices=TESTS, default=list(TESTS), type=str),
    option("--seed", default=0),
    option("--limit", default=LIMIT, help="time of a mutant [s]"),
    option("--output", default=pathlib.Path("mutation.jsonl"), type=pathlib.Path),
)


def main(arguments: argparse.Namespace) -> bool:
    """Run the command."""
    every = []
    for name in arguments.modules:
        path = f"etid/{name.replace('.', '/')}.py"
        every += mutants(path, (ROOT / path).read_text("utf-8"))
    chosen = drawn(every, arguments.mutants, arguments.seed)
    print(f"{len(chosen)} of {len(every)} mutants of {len(arguments.modules)} modules")
    rows = []
    for row in outcomes(ROOT, TESTS, chosen, arguments.output, arguments.limit):
        rows.append(row)
        what = f"{row['place']:<52}{row['kind']:<20}{row['outcome']:<10}"
        print(f"{what}{row['seconds']:6.1f} s", flush=True)
    table = [{"seed": arguments.seed, **row} for row in rows]
    write_csv(arguments.output.with_suffix(".csv"), [_on_one_line(row) for row in table])
    return show(rows) <= TARGET
