"""The paper's Tables I to IV and its figures 3 and 7 to 10 from simulated measurements.

Five laboratories make the same recordings. `good` has 60 dB and one clock. Each of the next three
has one thing worse: white noise of 40 or of 30 dB, or trigger delays of 200 ns (rms) in every
record, the calibration included. `both`, with 40 dB and 200 ns, is where the paper's method errs as
much as the paper prints. The tables put the two causes apart: noise biases Steiglitz-McBride, the
same in every trial; delays spread its trials.

A study is made several times, each with a calibration of its own. `--source spice` takes its
waveforms from ngspice.
"""

import argparse
import dataclasses
import pathlib
import textwrap
from collections.abc import Mapping, Sequence

from tqdm import tqdm

import etid
from benchmarks import paper_figures, paper_tables
from benchmarks.ladder import SOURCES
from benchmarks.paper_tables import Groups, Row
from benchmarks.provenance import write_csv
from benchmarks.runner import QUICK, option
from etid.paper.tables import LABORATORIES as ENDS
from etid.paper.tables import METHODS, Outcome, identify
from etid.report.html import Section
from etid.simulation.scenes import Scene, Trial

LABORATORIES: Mapping[str, Mapping[str, float]] = {
    "good": ENDS["quiet"],
    "noise 40 dB": {"snr_db": 40.0},
    "noise 30 dB": {"snr_db": 30.0},
    "delays 200 ns": {"snr_db": 60.0, "trigger_jitter_rms": 200e-9},
    "both": ENDS["noisy"],
}
DEFAULT, THEIRS = METHODS
STUDIES = 4
FEW = {"01", "02", "03"}  # trials of a quick run, and the last digits of its subjects
RESISTOR_LIMIT = 0.1  # [%]
STANDARD_ERRORS = 2.0
OWN_NOISE = "noise 30 dB"  # what the paper's RRSE of 4 to 13 % amounts to


def scene_of(laboratory: str, quick: bool) -> Scene:
    """All experiments of the paper in one laboratory; a few trials and subjects if quick."""
    whole = etid.scenes.paper(**LABORATORIES[laboratory])
    if not quick:
        return whole
    return dataclasses.replace(whole, trials=tuple(filter(_is_among_few, whole.trials)))


def _is_among_few(trial: Trial) -> bool:
    is_subject = trial.subject not in ("", "typical")
    return (not trial.trial or trial.trial in FEW) and (
        not is_subject or trial.subject.removeprefix("s") in FEW
    )


def check(first: Sequence[Row], fourth: Sequence[Row]) -> list[tuple[str, bool]]:
    """What must hold of the default method, in words, and whether it does."""
    worst = max(
        (row for row in first if (row["laboratory"], row["method"]) == ("good", DEFAULT)),
        key=lambda row: row["rms"],
    )
    text = f"Table I at 60 dB: {worst['r'] / 1e3:g} kΩ has {worst['rms']:.3f} % rms"
    found = [(f"{text}, at most {RESISTOR_LIMIT} %", bool(worst["rms"] <= RESISTOR_LIMIT))]
    for row in fourth:
        if (row["laboratory"], row["method"]) == (OWN_NOISE, DEFAULT):
            stderr = row["stderr"] / row["studies"] ** 0.5
            text = f"Table IV at 30 dB: {row['element']} is off by {row['error']:.2f} %"
            met = abs(row["error"]) <= STANDARD_ERRORS * stderr
            found.append(
                (
                    f"{text}, {STANDARD_ERRORS:g} standard errors are "
                    f"{STANDARD_ERRORS * stderr:.2f} %",
                    bool(met),
                )
            )
    return found


def run(folder: pathlib.Path, source: str, quick: bool) -> bool:
    """Make, identify, print, write tables and figures; whether all of `check` holds."""
    truth = etid.scenes.paper().truth()
    seeds = range(1 if quick else STUDIES)
    groups: dict[tuple[str, str], list[Outcome]] = {}
    shown: dict[str, etid.Study] = {}
    jobs = [(laboratory, seed) for laboratory in LABORATORIES for seed in seeds]
    for laboratory, seed in tqdm(jobs, desc="studies"):
        study = SOURCES[source](scene_of(laboratory, quick), seed)
        shown.setdefault(laboratory, study)
        for method in METHODS:
            groups.setdefault((laboratory, method), []).append(identify(laboratory, study, method))
    return report(folder, source, groups, truth, shown)


def report(
    folder: pathlib.Path,
    source: str,
    groups: Groups,
    truth: Mapping[str, Mapping[str, float]],
    shown: Mapping[str, etid.Study],
) -> bool:
    """Print and write what was identified; whether all of `check` holds."""
    first, fourth = paper_tables.table_1(groups), paper_tables.table_4(groups, truth)
    second, third = (
        paper_tables.table_fingertips(groups, truth, condition) for condition in ("dry", "damp")
    )
    for name, rows in {"1": first, "2": second, "3": third, "4": fourth}.items():
        write_csv(folder / f"table_{name}.csv", [{"source": source, **row} for row in rows])
    fingertips = (
        "Typical fingertip: median, its error [%], spread between trials [%]. Subjects: range of "
        "their medians; median and largest absolute error [%]. Means over the studies in which "
        "every subject has a circuit."
    )
    for section in (
        Section(
            "Table I: errors of five resistors [%]",
            "Mean over the studies ± standard deviation between them.",
            (paper_tables.show_1(first),),
        ),
        Section("Table II: dry fingertips", fingertips, (paper_tables.show_fingertips(second),)),
        Section("Table III: damp fingertips", fingertips, (paper_tables.show_fingertips(third),)),
        Section(
            "Table IV: the built circuit",
            "Mean error / scatter between the trials of a study (standard deviation between the "
            "means of the studies, each with its own calibration). The paper tells no sign.",
            (paper_tables.show_4(fourth),),
        ),
    ):
        print(f"\n{section}")
    print(f"\n{textwrap.fill(cause(fourth), 100)}\n")
    paper_figures.draw(folder, groups, truth, shown, fourth)
    found = check(first, fourth)
    for text, met in found:
        print(f"{text}: {'met' if met else 'MISSED'}")
    print(f"Tables and figures: {folder.resolve()}")
    return all(met for _, met in found)


def cause(fourth: Sequence[Row]) -> str:
    """What Table IV says of the causes, in its own numbers."""

    def r_s(laboratory: str) -> Row:
        return next(
            row for row in fourth
            if (row["laboratory"], row["method"], row["element"]) == (laboratory, THEIRS, "r_s")
        )  # fmt: skip

    noise, delays, both = map(r_s, ("noise 40 dB", "delays 200 ns", "both"))
    return (
        f"R_s of the built circuit by the paper's method: white noise alone shifts all trials by "
        f"{noise['error']:.1f} % and scatters them by {noise['scatter']:.1f} %; delays alone shift "
        f"them by {delays['error']:.1f} % and scatter them by {delays['scatter']:.1f} %, and leave "
        f"{delays['fits'] - delays['circuits']} of {delays['fits']} without a circuit; both give "
        f"{both['error']:.1f} % and {both['scatter']:.1f} %. The paper prints "
        f"{both['paper_error']:g} % and {both['paper_scatter']:g} %."
    )


OPTIONS = (
    QUICK,
    option("--source", default="simulated", choices=SOURCES),
    option("--folder", default=pathlib.Path("results/paper"), type=pathlib.Path),
)


def main(arguments: argparse.Namespace) -> bool:
    """Run the command."""
    return run(arguments.folder, arguments.source, arguments.quick)
