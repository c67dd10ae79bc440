"""What texts say of the results of benchmarks is what the tables of results hold."""

import csv
import pathlib
import re

import numpy as np
import pytest

ROOT = pathlib.Path(__file__).parents[1]
README = "benchmarks/README.md"
METHODS = ("default", "output_error", "steiglitz_mcbride", "equation_error")
EVENTS = ("wrong", "refused", "silent", "unstable", "not_converged")
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
    ("docs/control.md", CAP): (
        lambda: total("control", "pulses"),
        lambda: total("control", "above_after_unseen_change"),
        lambda: column("control", "largest_of_them_nC").max() / 1000,
    ),
    (README, "Of # answers behind ten drivers, # are silent."): (
        lambda: total("perturbations", "answers"),
        lambda: total("perturbations", "silent"),
    ),
    (README, f"Of # answers {PAIRS}, # are silent"): (
        lambda: total("perturbation_pairs", "answers"),
        lambda: total("perturbation_pairs", "silent"),
    ),
    (README, "silent over the failure map, elements determined to 10 % | # of #"): (
        lambda: total("selection_map", "missed"),
        lambda: total("selection_map", "determined_elements"),
    ),
    (README, "| right circuit where decisive, from 30 dB | # % of # |"): (
        lambda: 100 * decisive("BIC_right") / decisive("drawn"),
        lambda: decisive("drawn"),
    ),
    (README, "| R_s; Z(0); corner frequency | #; #; # % |"): (
        lambda: held("R_s"),
        lambda: held("Z(0)"),
        lambda: held("corner"),
    ),
    (README, "| 95 % intervals that hold the truth, all | # % of # |"): (
        lambda: held("R_s", "Z(0)", "corner"),
        lambda: sum(total("selection", f"{name}_intervals") for name in ("R_s", "Z(0)", "corner")),
    ),
    **{
        (README, f"| {method.replace('_', ' ')} | # | # | # | # | # |"): tuple(
            lambda method=method, i=i: failed(method)[i] for i in range(len(EVENTS))
        )
        for method in METHODS
    },
}


@pytest.mark.parametrize(("page", "sentence"), CLAIMS)
def test_a_text_has_the_numbers_of_the_results(page, sentence):
    found = re.search(dotted(sentence), (ROOT / page).read_text("utf-8"))
    assert found, f"{page} does not say: {sentence}"
    for told, value in zip(found.groups(), CLAIMS[page, sentence], strict=True):
        told = told.replace(" ", "")
        half = 0.5 * 10.0 ** -len(told.partition(".")[2])
        assert abs(float(told) - value()) <= 1.02 * half, f"{page}: {told}, the table has {value()}"
