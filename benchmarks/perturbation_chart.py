"""Bars of the perturbations: how many answers are right, refused, said to be wrong, or silent."""

import math
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

from benchmarks import charts
from benchmarks.perturbation_list import INVISIBLE

# Told apart in black and white as well: what is silent is the darkest, and hatched.
FACES = {
    "right": ("#8fc79a", "", "right"),
    "refused": ("#f6d55c", "...", "right, but refused"),
    "said": ("#f0a35e", "///", "wrong or no answer, and says so"),
    "silent": ("#b3261e", "xxx", "wrong, called successful"),
}
KINDS = tuple(FACES)
WIDTH, LINE = 2.6, 0.15  # [inch] of a panel and of a row


def _label(name: str) -> str:
    """A perturbation, and what is said of one that nothing shows."""
    if name not in INVISIBLE:
        return name
    snr = INVISIBLE[name].snr_db
    return f"{name} (invisible{'' if math.isinf(snr) else f' up to {snr:g} dB'})"


def draw(rows: Sequence[Mapping[str, Any]], path: pathlib.Path) -> None:
    """Draw rows of the table as SVG or PNG: a bar for each perturbation, a panel for each skin."""
    names = list(dict.fromkeys(row["perturbation"] for row in rows))
    panels = sorted({(row["path"], row["snr_db"]) for row in rows}, reverse=True)
    size = 2.6 + WIDTH * len(panels), 1.4 + LINE * len(names)
    figure, axes = charts.new_figure(1, len(panels), size, sharey=True)
    for axis, (skin, snr) in zip(axes.flat, panels, strict=True):
        of = {r["perturbation"]: r for r in rows if (r["path"], r["snr_db"]) == (skin, snr)}
        left = [0.0] * len(names)
        for kind, (colour, hatch, label) in FACES.items():
            share = [100 * of[n][kind] / of[n]["answers"] if n in of else 0.0 for n in names]
            axis.barh(
                range(len(names)), share, left=left, color=colour, hatch=hatch, height=0.85,
                edgecolor="white", linewidth=0.3, label=label,
            )  # fmt: skip
            left = [begin + more for begin, more in zip(left, share, strict=True)]
        axis.set_xlim(0, 100)
        axis.set_title(f"{skin}, {snr:g} dB", fontsize=9)
        axis.grid(False)
        axis.tick_params(labelsize=7, length=0)
        axis.set_xlabel("% of answers", fontsize=8)
    axes.flat[0].set_yticks(range(len(names)), list(map(_label, names)))
    axes.flat[0].set_ylim(len(names) - 0.5, -0.5)
    handles, texts = axes.flat[0].get_legend_handles_labels()
    figure.legend(handles, texts, loc="outside lower center", ncols=len(KINDS), fontsize=8)
    charts.save(figure, path)
