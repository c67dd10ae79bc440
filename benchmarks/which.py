"""Which estimator when: a table of the benchmarks' README, from results of `speed_accuracy`."""

import argparse
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from benchmarks.estimators import OURS
from benchmarks.machine import RESULTS, ROOT, read_csv
from benchmarks.runner import option
from benchmarks.speed_accuracy import FILE
from etid.estimators.registry import names

README = ROOT / "benchmarks" / "README.md"
BEGIN, END = "<!-- python -m benchmarks which -->\n", "<!-- end -->\n"
WORTH = 0.5  # of the time that the first of them takes, from which on that is a reason
ENOUGH = 200  # draws of an estimator that is recommended: the interval of its median is ±13 %
TRUSTED = 0.5  # part of the draws that have an answer which the estimator itself stands by

OPTIONS = (
    option("--results", type=pathlib.Path, default=RESULTS / FILE),
    option("--readme", type=pathlib.Path, default=README),
)
Row = Mapping[str, Any]


def read(path: pathlib.Path) -> list[dict[str, Any]]:
    """Rows of our estimators."""
    return [row for row in read_csv(path) if row["mode"] != "rival"]


def table(rows: Sequence[Row]) -> str:
    """Markdown: a row for each scene with the error of each estimator, and which to use.

    Behind an error is the 95 % interval of the median, if there are draws enough for one.
    """
    of_method = {name: [row for row in rows if row["estimator"] == name] for name in names()}
    methods = [name for name, of in of_method.items() if of]
    heads = ["recording", *(name.replace("_", " ") for name in methods), "use"]
    lines = ["| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    for scene in dict.fromkeys(row["scene"] for row in rows):
        of = {row["estimator"]: row for row in rows if row["scene"] == scene}
        use = best(list(of.values()))
        cells = [_cell(of.get(method), method == use) for method in methods]
        name = use.replace("_", " ") if use else "-"
        lines.append(f"| {scene} | " + " | ".join(cells) + f" | {name} |")
    times, draws = [], []
    for of in (of_method[name] for name in methods):
        ms = [row["ms"] for row in of if row["mode"] == "batched" and np.isfinite(row["ms"])]
        times.append(f"{np.median(ms):.3g}" if ms else "-")
        ends = dict.fromkeys(int(end(row["draws"] for row in of)) for end in (min, max))
        draws.append(" to ".join(map(str, ends)))
    lines.append("| *ms, in a batch* | " + " | ".join(times) + " | |")
    lines.append("| *draws* | " + " | ".join(draws) + " | |")
    return "\n".join(lines) + "\n"


def best(rows: Sequence[Row]) -> str | None:
    """The first that is as good as the best, within the scatter, or one that takes half its time.

    Only what is trusted counts, and only what has enough draws is used.
    """
    trusted = [
        row
        for row in sorted(rows, key=lambda row: OURS.index(row["estimator"]))
        if row["estimator"] in names() and row["silent"] == 0 and np.isfinite(row["error"])
        if _is_trusted(row)
    ]
    highs = [row["error_high"] for row in trusted if np.isfinite(row["error_high"])]
    limit = min(highs, default=np.nan)
    good = [row for row in trusted if row["error_low"] <= limit and row["draws"] >= ENOUGH]
    if not good:
        return None
    fastest = min(good, key=lambda row: row["ms"])
    return (fastest if fastest["ms"] <= WORTH * good[0]["ms"] else good[0])["estimator"]


def _is_trusted(row: Row) -> bool:
    return row["none"] + row["said"] <= 1 - TRUSTED


def _cell(row: Row | None, used: bool) -> str:
    if row is None or not np.isfinite(row["error"]):
        return "-"
    text, low, high = (_short(row[name]) for name in ("error", "error_low", "error_high"))
    scatter = f" ({low} to {high})" if np.isfinite(row["error_low"]) else ""
    text = f"{text}{scatter}" if _is_trusted(row) else f"[{text}]"
    text += " silent" if row["silent"] > 0 else ""
    return f"**{text}**" if used else text


def _short(number: float) -> str:
    return f"{number:.2g}" if number < 100 else f"{number:.0f}"


def inserted(text: str, made: str) -> str:
    """A page with the table between its marks; a `ValueError` if it has none."""
    head, begin, rest = text.partition(BEGIN)
    _, end, tail = rest.partition(END)
    if not (begin and end):
        raise ValueError(f"no {BEGIN.strip()!r} … {END.strip()!r} to put the table between")
    return head + begin + made + end + tail


def main(arguments: argparse.Namespace) -> bool:
    """Print the table and put it into the page."""
    made = table(read(arguments.results))
    print(made)
    arguments.readme.write_text(inserted(arguments.readme.read_text(), made))
    return True
