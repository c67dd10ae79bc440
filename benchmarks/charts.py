"""What all charts have in common: the look of the package's pictures, and where they come from."""

import pathlib
from collections.abc import Mapping

import matplotlib as mpl
from matplotlib.figure import Figure

from benchmarks.machine import provenance
from etid.plotting.style import COLOURS as COLOURS
from etid.plotting.style import DASHES as DASHES
from etid.plotting.style import INK as INK
from etid.plotting.style import MARKS as MARKS
from etid.plotting.style import new_figure as new_figure

# Kinds of answers, with their colours, hatches and labels.
ANSWERS = {
    "right": ("#8fc79a", "", "right"),
    "refused": ("#f6d55c", "...", "right, but refused"),
    "said": ("#f0a35e", "///", "wrong or no answer, and says so"),
    "silent": ("#b3261e", "xxx", "wrong, called successful"),
}
PANEL, LINE = 2.6, 0.15  # [inch] width of a panel of shares, height of a bar


def save(figure: Figure, path: pathlib.Path) -> None:
    """Write SVG or PNG; SVG has the provenance, and is the same file for the same numbers."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix != ".svg":
        figure.savefig(path)
        return
    source = "; ".join(f"{name} {value}" for name, value in provenance().items())
    with mpl.rc_context({"svg.hashsalt": "etid"}):
        figure.savefig(path, metadata={"Date": None, "Description": source})


def shares(
    panels: Mapping[str, Mapping[str, Mapping[str, float]]],
    faces: Mapping[str, tuple[str, str, str]],
    path: pathlib.Path,
    *,
    title: str = "",
    texts: Mapping[tuple[str, str], str] | None = None,
) -> None:
    """Draw bars of the shares of each kind: a bar for each row, a panel for each column.

    `panels` has the counts of each kind by panel and row. `faces` has colour, hatch and label of
    each kind, in the order of the bars; hatches tell them apart in black and white. `texts` stand
    beside a bar, by panel and row.
    """
    rows = list(dict.fromkeys(row for of in panels.values() for row in of))
    size = 2.6 + PANEL * len(panels), 1.4 + LINE * len(rows)
    figure, axes = new_figure(1, len(panels), size, sharey=True)
    for axis, (name, of) in zip(axes.flat, panels.items(), strict=True):
        left = [0.0] * len(rows)
        for kind, (colour, hatch, label) in faces.items():
            width = [
                100 * of[row][kind] / sum(of[row].values()) if row in of else 0 for row in rows
            ]
            axis.barh(
                range(len(rows)), width, left=left, color=colour, hatch=hatch, height=0.85,
                edgecolor="white", linewidth=0.3, label=label,
            )  # fmt: skip
            left = [begin + more for begin, more in zip(left, width, strict=True)]
        for place, row in enumerate(rows):
            text = (texts or {}).get((name, row), "")
            face = {"facecolor": "white", "edgecolor": "none", "pad": 1, "alpha": 0.85}
            axis.text(2, place, text, va="center", fontsize=6.5, bbox=face if text else None)
        axis.set_xlim(0, 100)
        axis.set_title(name, fontsize=9)
        axis.grid(False)
        axis.tick_params(labelsize=7, length=0)
        axis.set_xlabel("%", fontsize=8)
    axes.flat[0].set_yticks(range(len(rows)), rows)
    axes.flat[0].set_ylim(len(rows) - 0.5, -0.5)
    labels = axes.flat[0].get_legend_handles_labels()
    figure.legend(*labels, loc="outside lower center", ncols=len(faces), fontsize=8)
    if title:
        figure.suptitle(title, fontsize=11)
    save(figure, path)
