"""What all charts have in common: the look of the package's pictures, and where they come from."""

import pathlib

import matplotlib as mpl
from matplotlib.figure import Figure

from benchmarks.provenance import provenance
from etid.plotting.style import COLOURS as COLOURS
from etid.plotting.style import DASHES as DASHES
from etid.plotting.style import INK as INK
from etid.plotting.style import MARKS as MARKS
from etid.plotting.style import new_figure as new_figure


def save(figure: Figure, path: pathlib.Path) -> None:
    """Write SVG or PNG; SVG has the provenance, and is the same file for the same numbers."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix != ".svg":
        figure.savefig(path)
        return
    source = "; ".join(f"{name} {value}" for name, value in provenance().items())
    with mpl.rc_context({"svg.hashsalt": "etid"}):
        figure.savefig(path, metadata={"Date": None, "Description": source})
