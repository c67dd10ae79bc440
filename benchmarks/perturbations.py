"""What a laboratory does to recordings: is any answer wrong without saying so?

    python -m benchmarks perturbations                       # all of it, in two processes
    python -m benchmarks perturbations --only base hum60_0.02V_all --drivers 3 --snr-db 60
    python -m benchmarks perturbations --quick               # few perturbations, in a minute

Each perturbation (`benchmarks.perturbation_list`) is done to studies of several drivers, dry and
damp skin behind each. An answer is *right* if every element is within five of its own standard
errors of the truth and, where the bound of its standard error is 10 % at most, within 20 % of it.
It is *refused* if it is right and not called successful, *said* if it is wrong, or missing, and not
called successful, and *silent* if it is wrong and called successful. An element that changes during
a record is wrong if one of its values is farther away than that; if the fit remarks on something
in the recording, any of them will do. A method without standard errors is held to the bound.

Written are `perturbations.csv`, one row for each perturbation, noise, skin and method, and
`perturbations.svg`. The targets: no silent answer but for the perturbations of `INVISIBLE`, of
which no more are silent than the best possible test would miss (`benchmarks.visibility`), and at
most 2 % of the undisturbed recordings refused.
"""

import argparse
import concurrent.futures
import itertools
import pathlib
from collections.abc import Iterator, Sequence

from tqdm import tqdm

from benchmarks import perturbation_chart
from benchmarks.estimators import DEFAULT, OURS
from benchmarks.perturbation_draws import Answer, draw, table
from benchmarks.perturbation_list import INVISIBLE, PERTURBATIONS, UNDISTURBED
from benchmarks.provenance import RESULTS, write_csv
from etid.identify import file as streaming

DRIVERS = 10
SNR_DB = (40.0, 60.0)
REFUSED = 0.02  # of undisturbed recordings, at most
QUICK = ("base", "polarity_out", "rp_linear_0.2", "driver_Rload_wrong_5%")


def draws(
    names: Sequence[str],
    drivers: int,
    snr_db: Sequence[float],
    methods: Sequence[str],
    workers: int,
) -> Iterator[list[Answer]]:
    """All answers, driver by driver."""
    tasks = list(itertools.product(range(drivers), snr_db))
    if workers == 1:
        yield from (draw(names, number, snr, methods) for number, snr in tasks)
        return
    with streaming.processes(workers) as executor:
        futures = [executor.submit(draw, names, number, snr, methods) for number, snr in tasks]
        yield from (future.result() for future in concurrent.futures.as_completed(futures))


def summary(answers: Sequence[Answer]) -> Iterator[str]:
    """Lines of a table: one for each perturbation, noise and method."""
    yield f"{'perturbation':<36}{'SNR':>4}  right refused  said silent   worst silent error"
    for row in table(answers, ("perturbation", "snr_db", "method")):
        worst = ""
        if row["silent"]:
            worst = (
                f"{row['worst_element']} {row['worst_stderrs']:.1f} standard errors, "
                f"{100 * row['worst_error']:.1f} %, {row['worst_path']}"
            )
        method = "" if row["method"] == DEFAULT else f"{row['method']}  "
        yield (
            f"{row['perturbation']:<36}{row['snr_db']:>4.0f}{row['right']:>7}{row['refused']:>8}"
            f"{row['said']:>6}{row['silent']:>7}   {method}{worst}  {row['verdicts']}"
        )


def met(answers: Sequence[Answer]) -> bool:
    """Whether the targets are met by the default method; else says where not."""
    holds = True
    of_default = [a for a in answers if a.method == DEFAULT]
    for row in table(of_default, ("perturbation", "snr_db", "path")):
        name, place = row["perturbation"], (row["path"], row["snr_db"])
        count = row["silent"], row["answers"]
        if row["silent"] and not (name in INVISIBLE and INVISIBLE[name].excuses(*place, *count)):
            print(f"silent: {name}, {place[0]} at {place[1]:g} dB, {count[0]} of {count[1]}")
            holds = False
    for row in table(of_default, ("perturbation",)):
        name = row["perturbation"]
        if name in UNDISTURBED and row["refused"] + row["said"] > REFUSED * row["answers"]:
            print(f"refused: {name}, {row['refused'] + row['said']} of {row['answers']}")
            holds = False
    return holds


def write(answers: Sequence[Answer], method: str, folder: pathlib.Path) -> None:
    """Write the table, and the figure of one method, into `folder`."""
    rows = table(answers, ("perturbation", "snr_db", "path", "method"))
    write_csv(folder / "perturbations.csv", rows)
    of_one = [row for row in rows if row["method"] == method]
    perturbation_chart.draw(of_one, folder / "perturbations.svg")


def run(
    names: Sequence[str],
    drivers: int,
    snr_db: Sequence[float],
    methods: Sequence[str],
    folder: pathlib.Path,
    workers: int,
) -> bool:
    """Draw, count and print; write the table and the figure with every driver that is done."""
    answers: list[Answer] = []
    place = {name: number for number, name in enumerate(names)}
    with tqdm(total=drivers * len(snr_db), unit="driver") as bar:
        for found in draws(names, drivers, snr_db, methods, workers):
            answers += found
            answers.sort(
                key=lambda a: (a.snr_db, place[a.perturbation], a.path, a.method, a.number)
            )
            write(answers, methods[0], folder)  # nothing that is done is lost
            bar.update()
    print("\n".join(summary(answers)))
    return met(answers)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Size of the run."""
    parser.add_argument("--only", nargs="+", metavar="NAME", help="these perturbations")
    parser.add_argument("--quick", action="store_true", help="few perturbations and drivers")
    parser.add_argument("--drivers", type=int, default=DRIVERS)
    parser.add_argument("--snr-db", type=float, nargs="+", default=list(SNR_DB), metavar="DB")
    parser.add_argument("--method", nargs="+", choices=OURS, default=[DEFAULT])
    parser.add_argument("--workers", type=int, default=2, help="processes, each on a core")
    parser.add_argument(
        "--folder", type=pathlib.Path, default=RESULTS, help="of the table and the figure"
    )


def main(arguments: argparse.Namespace) -> bool:
    """Run the command."""
    names = list(QUICK) if arguments.quick else arguments.only or list(PERTURBATIONS)
    unknown = sorted(set(names) - set(PERTURBATIONS))
    if unknown:
        raise SystemExit(
            f"no perturbation {', '.join(unknown)}; there are {', '.join(PERTURBATIONS)}"
        )
    return run(
        names,
        2 if arguments.quick else arguments.drivers,
        arguments.snr_db,
        arguments.method,
        arguments.folder,
        1 if arguments.quick else arguments.workers,
    )
