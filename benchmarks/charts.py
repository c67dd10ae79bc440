"""What all charts have in common: told apart without colours, readable on a page of any colour."""

import pathlib
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure

from benchmarks.provenance import provenance
from etid.plotting import INK as INK
from etid.plotting import new_figure

DASHES = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)), (0, (1, 3)))
MARKS = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "p", "h", "*")


def new(rows: int, columns: int, size: tuple[float, float], **options: Any) -> tuple[Figure, Any]:
    """A figure on white paper, which a dark page does not show through, and its axes [row, column].

    Args:
        rows: Of axes.
        columns: Of axes.
        size: Width and height [inch].
        **options: As `Figure.subplots` takes them.
    """
    figure, axes = new_figure(rows, columns, size, **options)
    figure.set_facecolor("white")
    for axis in axes.flat:
        axis.set_axisbelow(True)
    return figure, axes


def save(figure: Figure, path: pathlib.Path) -> None:
    """Write SVG or PNG; SVG has the provenance, and is the same file for the same numbers."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix != ".svg":
        figure.savefig(path)
        return
    source = "; ".join(f"{name} {value}" for name, value in provenance().items())
    with mpl.rc_context({"svg.hashsalt": "etid"}):
        figure.savefig(path, metadata={"Date": None, "Description": source})
