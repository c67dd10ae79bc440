"""Error against time, one panel per scene, told apart by names rather than colours."""

import pathlib
import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from adjustText import adjust_text
from matplotlib.axes import Axes

from benchmarks import charts
from etid.estimators import registry

# What stands in a panel for each estimator.
LETTERS = {
    "default": "etid",
    "maximum_likelihood": "max. likelihood",
    "output_error": "output error",
    "steiglitz_mcbride": "Steiglitz-McBride",
    "SciPy least_squares, harmonics": "SciPy",
    "SciPy least_squares, lfilter": "lfilter",
    "lmfit leastsq": "lmfit",
    "optimistix LM": "optimistix",
    "jaxopt LM": "jaxopt",
    "FFT, impedance.py": "impedance.py",
    "FFT, ImpedanceFitter": "ImpedanceFitter",
    "SIPPY OE": "SIPPY",
    "fastcan NARX": "fastcan",
    "Octave arx": "arx",
    "Octave n4sid": "n4sid",
}
KNOWN = ", Z_th of etid"  # a rival with the driver of etid has a star
COLUMNS = 3
WORST = 1e3  # bounds; what is further off stands here, with an arrow
OFTEN = 0.5  # part of the draws in which an estimator disowns its answer, or has none


def short(name: str) -> str:
    """What stands in a panel for an estimator."""
    own = name.removesuffix(KNOWN)
    return LETTERS.get(own, own) + "*" * (own != name)


def chart(rows: Sequence[Mapping[str, Any]], path: pathlib.Path) -> None:
    """Draw all scenes of a table."""
    names = list(dict.fromkeys(row["scene"] for row in rows))
    down = -(-len(names) // COLUMNS)
    figure, axes = charts.new_figure(
        down, min(COLUMNS, len(names)), (11.5, 4.0 * down + 0.9), sharex=True, sharey=True
    )
    for panel, name in zip(axes.flat, names, strict=False):
        absent = _panel(panel, [row for row in rows if row["scene"] == name])
        notes = "; ".join(f"{why}: {', '.join(of)}" for why, of in absent.items())
        title = f"{name} ({notes})" if notes else name
        panel.set_title("\n".join(textwrap.wrap(title, 58)), fontsize=9)
    for panel in axes.flat[len(names) :]:
        panel.set_visible(False)
    for panel in axes[:, 0]:
        panel.set_ylabel("median error / Cramer-Rao bound")
    for panel in axes[-1]:
        panel.set_xlabel("time per skin [ms]")
    drawn = [row for row in rows if row["draws"]]
    ours = [int(row["draws"]) for row in drawn if row["mode"] != "rival"]
    theirs = [int(row["draws"]) for row in drawn if row["mode"] == "rival"] or ours
    figure.supxlabel(
        "\n".join(
            textwrap.wrap(
                "Filled: etid, its default method in bold; open: rivals, with a star if they know "
                "the Z_th that etid finds. Upright lines are 95 % intervals of the medians, which "
                "fewer than six draws do not give; level ones lead from one recording a call to a "
                "batch. "
                "(In brackets): says itself that most of its answers are not good. Dashed: what "
                "nothing beats in both. Grey: where an efficient estimator is. "
                f"{min(ours)} to {max(ours)} draws of each of etid's methods, {min(theirs)} to "
                f"{max(theirs)} of each rival.",
                150,
            )
        ),
        fontsize=8,
    )
    charts.save(figure, path)


def _panel(axes: Axes, rows: Sequence[Mapping[str, Any]]) -> dict[str, list[str]]:
    """Draw one scene; the estimators that are not drawn, by the reason."""
    axes.set(xscale="log", yscale="log")
    axes.axhline(0.89, color="0.7", linewidth=3, zorder=0)
    texts, marks, absent = [], [], dict[str, list[str]]()
    same = {row["error"] for row in rows if row["estimator"] == "default"}
    for name in dict.fromkeys(row["estimator"] for row in rows):
        if (
            name != "default"
            and name in registry.names()
            and {r["error"] for r in rows if r["estimator"] == name} <= same
        ):
            continue  # what the default has chosen
        of = {row["mode"]: row for row in rows if row["estimator"] == name}
        best = of.get("batched") or next(iter(of.values()))
        if not np.isfinite(best["error"]):
            absent.setdefault("no answer" if best["draws"] else "not run", []).append(short(name))
            continue
        error = min(best["error"], WORST)
        theirs = best["mode"] == "rival"
        if "alone" in of and "batched" in of:
            marks += axes.plot(
                [of["alone"]["ms"], best["ms"]], [error, error], color=charts.INK, linewidth=0.8
            )
        scatter = np.clip([best["error_low"], best["error_high"]], None, WORST)
        if not np.isnan(scatter).any():
            marks += axes.plot([best["ms"]] * 2, scatter, color=charts.INK, linewidth=0.8)
        marks += axes.plot(
            best["ms"],
            error,
            marker="^" if best["error"] > WORST else "o",
            color=charts.INK,
            markerfacecolor="white" if theirs else charts.INK,
            markersize=8 if name == "default" else 5,
        )
        letters = f"({short(name)})" if best["said"] > OFTEN else short(name)
        weight = "bold" if name == "default" else "normal"
        texts.append(axes.text(best["ms"], error, letters, fontsize=7.5, fontweight=weight))
    front = sorted((row["ms"], min(row["error"], WORST)) for row in rows if row["on_front"])
    if front:
        axes.step(*zip(*front, strict=True), where="post", color="0.4", linestyle="--", zorder=1)
    adjust_text(
        texts,
        ax=axes,
        objects=marks,
        expand=(1.2, 1.6),
        force_text=(0.3, 0.6),
        force_static=(0.3, 0.6),
        arrowprops={"arrowstyle": "-", "color": "0.6", "linewidth": 0.5},
    )
    return absent
