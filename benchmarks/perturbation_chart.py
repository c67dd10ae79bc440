"""Bars of the perturbations: how many answers are right, refused, said to be wrong, or silent."""

import math
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

from benchmarks import charts
from benchmarks.perturbation_draws import KINDS, Kind
from benchmarks.perturbation_list import INVISIBLE

# Told apart in black and white as well: what is silent is the darkest, and hatched.
FACES: Mapping[Kind, tuple[str, str, str]] = {
    "right": ("#8fc79a", "", "right"),
    "refused": ("#f6d55c", "...", "right, but refused"),
    "said": ("#f0a35e", "///", "wrong or no answer, and says so"),
    "silent": ("#b3261e", "xxx", "wrong, called successful"),
}
WIDTH, LINE = 2.6, 0.15  # [inch] of a panel and of a row


def _mark(name: str) -> str:
    """What is said of a perturbation that nothing shows."""
    if name not in INVISIBLE:
        return ""
    snr = INVISIBLE[name].snr_db
    return " (invisible)" if math.isinf(snr) else f" (invisible up to {snr:g} dB)"


def draw(rows: Sequence[Mapping[str, Any]], path: pathlib.Path) -> None:
    """Draw one bar for each perturbation, a panel for each skin and noise.

    Args:
        rows: Of the table by perturbation, noise and skin.
        path: SVG or PNG to write.
    """
    names = list(dict.fromkeys(row["perturbation"] for row in rows))
    panels = sorted({(row["path"], row["snr_db"]) for row in rows}, reverse=True)
    size = 2.6 + WIDTH * len(panels), 1.4 + LINE * len(names)
    figure, axes = charts.new_figure(1, len(panels), size, sharey=True)
    for axis, (skin, snr) in zip(axes.flat, panels, strict=True):
        of = {
            row["perturbation"]: row for row in rows if (row["path"], row["snr_db"]) == (skin, snr)
        }
        left = [0.0] * len(names)
        for kind in KINDS:
            colour, hatch, label = FACES[kind]
            share = [
                100 * of[name][kind] / of[name]["answers"] if name in of else 0.0 for name in names
            ]
            axis.barh(
                range(len(names)),
                share,
                left=left,
                color=colour,
                hatch=hatch,
                height=0.85,
                edgecolor="white",
                linewidth=0.3,
                label=label,
            )
            left = [begin + more for begin, more in zip(left, share, strict=True)]
        axis.set_xlim(0, 100)
        axis.set_title(f"{skin}, {snr:g} dB", fontsize=9)
        axis.grid(False)
        axis.tick_params(labelsize=7, length=0)
        axis.set_xlabel("% of answers", fontsize=8)
    labels = [name + _mark(name) for name in names]
    axes.flat[0].set_yticks(range(len(names)), labels)
    axes.flat[0].set_ylim(len(names) - 0.5, -0.5)
    handles, texts = axes.flat[0].get_legend_handles_labels()
    figure.legend(handles, texts, loc="outside lower center", ncols=len(KINDS), fontsize=8)
    charts.save(figure, path)
