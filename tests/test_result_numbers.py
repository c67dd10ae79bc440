"""What texts say of the results of benchmarks is what the tables of results hold."""

import csv
import functools
import pathlib
import re

import numpy as np
import pytest

from benchmarks.failure_map import EVENTS
from benchmarks.selection_counts import QUANTITIES

ROOT = pathlib.Path(__file__).parents[1]
README = "benchmarks/README.md"
METHODS = ("default", "output_error", "steiglitz_mcbride")
NUMBER = r"\**([\d ]*\d(?:\.\d+)?)\**"  # thousands are apart; a missed target is bold


def column(table, name, **of):
    """A column of a table of results, of the rows with these values."""
    with (ROOT / "benchmarks" / "results" / f"{table}.csv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if {**row, **of} == row]
    return np.array([float(row[name] or "nan") for row in rows])


def total(table, name, **of):
    return column(table, name, **of).sum()


def failed(method):
    """Per cent of the answers of all cells, event by event."""
    trials = column("failures", "trials", method=method)
    of = [column("failures", event, method=method) for event in EVENTS]
    return [100 * np.average(rates, weights=trials) for rates in of]


def decisive(name):
    """Sum over the cells in which the choice is decisive; the targets begin at 30 dB."""
    high = column("selection", "snr_db", decisive="True") >= 30
    return column("selection", name, decisive="True")[high].sum()


def held(*names):
    """Per cent of the intervals that hold the truth."""
    number = np.stack([column("selection", f"{name}_intervals") for name in names])
    share = np.stack([column("selection", f"{name}_covered") for name in names])
    return 100 * np.nansum(number * share) / number.sum()


def dotted(sentence):
    """A pattern for a sentence of any line breaks, with `#` for numbers."""
    return re.escape(sentence).replace(r"\ ", r"\s+").replace(r"\#", NUMBER)


CAP = "In # simulated pulses, # exceeded 120 nC after an unseen change, with up to # µC"
PAIRS = "about 500 pairs of faults, drawn from different groups (`--pairs 500`)"
CLAIMS = {
    ("docs/control.md", CAP): lambda: [
        total("control", "pulses"),
        total("control", "above_after_unseen_change"),
        column("control", "largest_of_them_nC").max() / 1000,
    ],
    ("docs/control.md", "In # runs of a simulated display"): lambda: [
        total("control_loop", "runs")
    ],
    ("docs/control.md", "and none of # pulses exceeded the cap"): lambda: [
        total("control_loop", "pulses")
    ],
    (README, "After a hazard of the loop 0 comes within # s"): lambda: [
        column("control_loop", "longest_s").max()
    ],
    (README, "Of # answers behind ten drivers, # are silent."): lambda: [
        total("perturbations", "answers"),
        total("perturbations", "silent"),
    ],
    (README, f"Of # answers {PAIRS}, # are silent"): lambda: [
        total("perturbation_pairs", "answers"),
        total("perturbation_pairs", "silent"),
    ],
    (README, "silent over the failure map, elements determined to 10 % | # of #"): lambda: [
        total("selection_map", "missed"),
        total("selection_map", "determined_elements"),
    ],
    (README, "| right circuit where decisive, from 30 dB | # % of # |"): lambda: [
        100 * decisive("BIC_right") / decisive("drawn"),
        decisive("drawn"),
    ],
    (README, "| R_s; Z(0); corner frequency | #; #; # % |"): lambda: [
        held(name) for name in QUANTITIES
    ],
    (README, "| 95 % intervals that hold the truth, all | # % of # |"): lambda: [
        held(*QUANTITIES),
        sum(total("selection", f"{name}_intervals") for name in QUANTITIES),
    ],
    **{
        (README, f"| {method.replace('_', ' ')} | # | # | # | # | # |"): functools.partial(
            failed, method
        )
        for method in METHODS
    },
}


@pytest.mark.parametrize(("page", "sentence"), CLAIMS)
def test_a_text_has_the_numbers_of_the_results(page, sentence):
    found = re.search(dotted(sentence), (ROOT / page).read_text("utf-8"))
    assert found, f"{page} does not say: {sentence}"
    for told, value in zip(found.groups(), CLAIMS[page, sentence](), strict=True):
        told = told.replace(" ", "")
        half = 0.5 * 10.0 ** -len(told.partition(".")[2])
        assert abs(float(told) - value) <= 1.02 * half, f"{page}: {told}, the table has {value}"
