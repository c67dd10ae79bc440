"""The paper's experiments: simulated, identified by two methods, and compared with the paper.

    python -m benchmarks.paper.demo FOLDER

Three laboratories make the same 149 recordings. `quiet` has a signal-to-noise ratio (SNR) of 60 dB
and no trigger delay. `noisy` has white noise with an SNR of 40 dB and a trigger delay of 200 ns
(rms). With these values the paper's method has errors of the published size on the built circuit.
In `rough` the driver is no filter and fingertips are other circuits, too
(`benchmarks.paper.rough`). The paper does not describe its noise. Its RRSE of 4 to 13 % would
correspond to white noise with an SNR of 30 dB, but this noise alone gives Steiglitz-McBride an
error of 90 % in R_s.
"""

import argparse
import json
import pathlib
import sys
import textwrap
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

import etid
from benchmarks.paper.rough import rough
from benchmarks.paper.tables import (
    CALIBRATION,
    LABORATORIES,
    METHODS,
    ORDER,
    Outcome,
    built_circuit,
    errors,
    identify,
    resistor_errors,
)
from etid.plotting import figure_of
from etid.plotting.style import save
from etid.printing import as_symbol, scaled, several, significant
from etid.recordings.replacing import replace_text
from etid.report.html import Picture, Section, Table, write_page
from etid.simulation.published import FINGERTIPS, RRSE, TABLE_1, TABLE_4
from etid.simulation.scenes import Scene

ABOUT = (
    "Rows and columns named paper are measurements of the paper. All other numbers come from "
    "simulated recordings, whose true elements are known. Quiet records have a signal-to-noise "
    "ratio of 60 dB and no trigger delay. Noisy records have 40 dB and 200 ns; the errors of "
    "the paper's method then have about the published size. Rough records have 10 bits beside "
    "that, a transformer whose impedance no filter has, and fingertips of two layers, whose "
    "resistance falls by a fifth within a pulse. Their errors are those from the nearest circuit; "
    "that the resistance of damp fingertips falls is found, which is a misfit. The tables include "
    "every estimate, whatever its verdict; `usable` counts the usable fits."
)


def _number(value: float | np.floating) -> str:
    """A number with two decimals, or with three digits if it is 10 000 or more; a dash for none."""
    if not np.isfinite(value):
        return "-"
    return f"{value:.2f}" if abs(value) < 1e4 else f"{value:.3g}"


def _span(low: float, high: float) -> str:
    return f"{significant(low, 3)} to {significant(high, 3)}"


def _successes(fits: etid.Fits) -> str:
    return f"{len(fits.usable())}/{len(fits)}"


def table_1(outcomes: Sequence[Outcome]) -> Table:
    """Table I: errors of the five test resistors [%]."""
    rows = [("paper", "", *(f"{error:g}" for error in TABLE_1.values()))]
    for outcome in outcomes:
        found = resistor_errors(outcome)
        rows.append((*outcome.names, *(_number(found[r]) for r in TABLE_1)))
    return Table(("records", "method", *(f"{r / 1e3:g} kΩ" for r in TABLE_1)), tuple(rows))


def table_fingertips(outcomes: Sequence[Outcome], condition: str) -> Table:
    """Table II (dry) or III (damp): elements and errors of a typical fingertip and ten subjects."""
    rows = []
    units = etid.SkinRC.units()
    for name in ORDER:
        scale, symbol = scaled(units[name])
        typical, *limits = (value / scale for value in FINGERTIPS[condition][name])
        label = f"{as_symbol(name)} [{symbol}]"
        paper = significant(typical, 3), "", "", _span(*limits)
        rows.append(("paper", "", label, *paper, "", "", ""))
        for outcome in outcomes:
            skins = outcome.skins.where(condition=condition)
            trials, truth = skins.where(subject="typical"), outcome.truth
            values, error = np.asarray(getattr(trials.circuit, name)), errors(trials, truth)[name]
            subjects = [
                skins.where(subject=subject)
                for subject in np.unique(skins.labels["subject"])
                if subject != "typical"
            ]
            medians = np.array([np.median(getattr(of.circuit, name)) for of in subjects])
            actual = np.array([truth[str(of.labels["path"][0])][name] for of in subjects])
            off = 100 * np.abs(medians / actual - 1)
            rows.append((
                *outcome.names, label,
                significant(float(np.median(values)) / scale, 4),
                _number(np.median(error)),
                _number(np.std(error, ddof=1)),
                _span(medians.min() / scale, medians.max() / scale),
                _number(np.median(off)),
                _number(off.max()),
                _successes(skins),
            ))  # fmt: skip
    heads = (
        "records", "method", "element", "typical", "error [%]", "spread [%]", "subjects",
        "error [%]", "worst [%]", "usable",
    )  # fmt: skip
    return Table(heads, tuple(rows))


def table_4(outcomes: Sequence[Outcome]) -> Table:
    """Table IV, the built circuit: mean error and scatter of 23 trials [%]."""
    paper = (f"{error:g} / {scatter:g}" for error, scatter in (TABLE_4[name] for name in ORDER))
    rows = [("paper", "", *paper, "{} to {}".format(*RRSE), "")]
    for outcome in outcomes:
        found = built_circuit({outcome.names: [outcome]})
        cells = [f"{_number(row['error'])} / {_number(row['scatter'])}" for row in found]
        usable = "{successful}/{fits}".format_map(found[0])
        rows.append((*outcome.names, *cells, _number(found[0]["rrse"]), usable))
    heads = tuple(f"{as_symbol(name)} [%]" for name in ORDER)
    return Table(("records", "method", *heads, "RRSE [%]", "usable"), tuple(rows))


def table_verdicts(outcomes: Sequence[Outcome]) -> Table:
    """Verdicts, and the percentage of usable fits whose error is within two standard errors."""
    rows = []
    for outcome in outcomes:
        verdicts = ", ".join(f"{count} {name}" for name, count in outcome.skins.counts().items())
        good = outcome.skins.usable()
        cells = [*outcome.names, outcome.driver.verdict, verdicts]
        for name in ORDER:
            known = np.array([outcome.truth[str(path)][name] for path in good.labels["path"]])
            error = np.abs(np.asarray(getattr(good.circuit, name)) - known)
            inside = error <= 2 * np.asarray(getattr(good.stderr, name))
            cells.append(f"{100 * inside.mean():.0f} %" if len(good) else "")
        rows.append(tuple(cells))
    heads = tuple(f"{as_symbol(name)} ± 2 se" for name in ORDER)
    return Table(("records", "method", "driver", "skins and built circuit", *heads), tuple(rows))


def figures(folder: pathlib.Path, study: etid.Study, outcome: Outcome) -> tuple[Picture, ...]:
    """Write the paper's figures 7 to 9 and the elements of all subjects, as PNG and SVG.

    Returns:
        The figures as SVG, with captions, for the page.
    """
    folder.mkdir(exist_ok=True)
    driver = outcome.driver
    dry, damp = (outcome.skins.where(path=f"typical/{name}/01")[0] for name in ("dry", "damp"))
    fingertips = outcome.skins.take(outcome.skins.labels["subject"] != "")
    pictures: dict[str, tuple[str, tuple[Any, ...]]] = {
        "pulse_calibration": (
            "Calibration with 98.8 kΩ: measured, predicted, residual (paper, figure 7)",
            (driver, study[CALIBRATION]),
        ),
        "pulse_dry": (
            "A dry fingertip: measured, predicted, residual (paper, figure 8)",
            (dry, study["typical/dry/01"], driver),
        ),
        "pulse_damp": (
            "A damp fingertip: measured, predicted, residual (paper, figure 8)",
            (damp, study["typical/damp/01"], driver),
        ),
        "impedance": (
            "Source impedance and the impedances of a dry and a damp fingertip (paper, figure 9)",
            ({"Z_th": driver, "Z_bio, dry": dry, "Z_bio, damp": damp},),
        ),
        "elements": ("Elements of all trials by subject, with standard errors", (fingertips,)),
    }
    drawn = []
    for name, (caption, arguments) in pictures.items():
        figure = figure_of(*arguments)
        save(figure, folder / f"{name}.png")
        save(figure, folder / f"{name}.svg")
        drawn.append(Picture(caption, (folder / f"{name}.svg").read_bytes()))
    return tuple(drawn)


def sections(outcomes: Sequence[Outcome]) -> list[Section]:
    """The tables of the paper with the results of every laboratory and method."""
    return [
        Section(
            "Table I: errors of five resistors [%]",
            "Maximum likelihood identifies one resistor. Steiglitz-McBride identifies eq. 7, whose "
            "resistance is R_s + R_p.",
            (table_1(outcomes),),
        ),
        *(
            Section(
                f"Table {number}: {condition} fingertips",
                "One typical fingertip: median of ten trials, its error, and the spread between "
                "the trials. Ten subjects: a median over five trials for each subject; the table "
                "has the range of these medians, and the median and the maximum of their absolute "
                "errors.",
                (table_fingertips(outcomes, condition),),
            )
            for number, condition in (("II", "dry"), ("III", "damp"))
        ),
        Section(
            "Table IV: the built circuit",
            "Mean error / scatter of 23 trials. A dash: the estimate predicts no finite voltage.",
            (table_4(outcomes),),
        ),
        Section(
            "Verdicts",
            "The last three columns: percentage of the usable fits whose error is at most two "
            "standard errors (se). All fits of a study share the error of the driver, so their "
            "errors are correlated.",
            (table_verdicts(outcomes),),
        ),
    ]


def main(argv: Sequence[str] | None = None) -> None:
    """Simulate, identify, print the tables, and write files, figures and a page.

    Args:
        argv: Arguments; default: the arguments of the process.
    """
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.paper.demo",
        description="Simulate and identify the paper's experiments.",
    )
    parser.add_argument("folder", type=pathlib.Path, help="folder for all files")
    folder = parser.parse_args(argv).folder
    jax.config.update("jax_enable_x64", True)

    outcomes: list[Outcome] = []
    drawn: tuple[Picture, ...] = ()
    quiet, noisy = LABORATORIES["quiet"], LABORATORIES["noisy"]
    scenes: dict[str, Scene] = {
        "quiet": etid.scenes.paper(**quiet),
        "noisy": etid.scenes.paper(**noisy),
        "rough": rough(**noisy),
    }
    for laboratory, scene in scenes.items():
        place = folder if laboratory == "quiet" else folder / laboratory
        place.mkdir(parents=True, exist_ok=True)
        truth = scene.truth()
        replace_text(place / "truth.json", json.dumps(truth, indent=1) + "\n")
        scene.simulate(seed=0).write(place / "study.h5")
        with etid.read(place / "study.h5") as study:
            for method in METHODS:
                print(
                    f"{laboratory}: {several(len(study), 'recording')} by {method} …",
                    file=sys.stderr,
                )
                outcome = identify(laboratory, study, truth, method, progress=sys.stderr.isatty())
                ending = "" if method == "maximum_likelihood" else f"_{method}"
                outcome.skins.write(place / f"fits{ending}.h5")
                outcome.resistors.write(place / f"resistors{ending}.h5")
                outcomes.append(outcome)
            if laboratory == "quiet":
                drawn = figures(folder / "figures", study, outcomes[0])
    print(f"\n{textwrap.fill(ABOUT, 100)}")
    tables = sections(outcomes)
    for section in tables:
        print(f"\n{section}")
    page = folder / "index.html"
    shown = Section("Figures", "Quiet records, by maximum likelihood.", pictures=drawn)
    write_page(page, "The paper's experiments, simulated and identified", ABOUT, [*tables, shown])
    print(f"\nTables and figures: {page.resolve()}")


if __name__ == "__main__":
    main()
