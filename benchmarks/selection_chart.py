"""What was chosen: rows are truths, columns SNRs; etid beside a rival."""

import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.patches import Patch, Rectangle

from benchmarks import charts
from etid.circuits.circuit import AbstractCircuit

# Letters and colours of the circuits, from the simplest to the richest.
KEY = {
    "Resistor": ("R", "R: resistor", "#d9d9d9"),
    "ParallelRC": ("P", "P: R‖C", "#b3cde3"),
    "SkinRC": ("S", "S: R_s + R‖C", "#4f9bd0"),
    "SkinCole": ("C", "C: Cole", "#f2b263"),
    "SkinLayers": ("L", "L: two layers", "#c9564a"),
}
TITLES = {"chose": "etid", "rival": "impedance.py and BIC, from spectra of the same recordings"}
HEIGHT = 0.8  # of a cell's bar
LEAST = 0.12  # share of a cell that has room for a letter


def draw(
    rows: Sequence[Mapping[str, Any]],
    truths: Mapping[str, AbstractCircuit],
    path: pathlib.Path,
    rival: str,
) -> None:
    """Draw the table of choices.

    Args:
        rows: Its rows, with the columns `chose_NAME`, and `rival_NAME` if there is a rival.
        truths: Circuits by name of the truth.
        path: SVG or PNG to write.
        rival: Why there are no choices of the rival; empty if there are.
    """
    size = (7.0 if rival else 12.5), 0.36 * len(truths) + 1.6
    figure, axes = charts.new_figure(1, 1 if rival else 2, size, sharey=True)
    for panel, (name, title) in zip(axes.flat, TITLES.items(), strict=False):
        drawn = [row for row in rows if any(int(row[f"{name}_{key}"]) for key in KEY)]
        columns = sorted({row["snr_db"] for row in drawn})
        for row in drawn:
            at = columns.index(row["snr_db"]), list(truths).index(row["truth"])
            right = type(truths[row["truth"]]).__name__
            _cell(panel, at, {key: int(row[f"{name}_{key}"]) for key in KEY}, right)
            if name == "chose" and not row["decisive"]:
                panel.text(at[0] + 0.44, at[1], "?", ha="center", va="center", fontsize=8)
        panel.set_title(title, fontsize=10)
        panel.set(xlim=(-0.5, len(columns) - 0.5), ylim=(len(truths) - 0.5, -0.5))
        panel.set_xticks(range(len(columns)), [f"{one:g} dB" for one in columns])
        panel.set_yticks(range(len(truths)), list(truths))
        panel.grid(False)
        panel.spines[:].set_visible(False)
        panel.tick_params(length=0, labelsize=8)
    handles = [Patch(color=colour, label=label) for _, label, colour in KEY.values()]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(KEY), fontsize=8)
    title = "Chosen circuits, and % right (?: below 30 dB, or the evidence is not decisive)"
    figure.suptitle(title, fontsize=11)
    charts.save(figure, path)


def _cell(panel: Axes, at: tuple[int, int], counts: Mapping[str, int], right: str) -> None:
    """A bar of the shares of the chosen circuits, and the share of the right one."""
    total, left, row = sum(counts.values()), at[0] - 0.46, at[1]
    for name, count in counts.items():
        part = count / total
        if not part:
            continue
        letter, _, colour = KEY[name]
        width = 0.84 * part
        corner = (left, row - HEIGHT / 2)
        panel.add_patch(Rectangle(corner, width, HEIGHT, color=colour, linewidth=0))
        if part >= LEAST:
            text = f"{letter} {100 * part:.0f}" if name == right and part > 0.3 else letter
            weight = "bold" if name == right else "normal"
            panel.text(left + width / 2, row, text, ha="center", va="center", fontsize=7.5,
                       weight=weight)  # fmt: skip
        left += width
