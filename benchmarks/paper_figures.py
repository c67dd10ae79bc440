"""The paper's figures 3 and 7 to 10 from simulated measurements, and a picture of Table IV.

What these panels show is what the text around the paper's figures calls for; their exact layout is
not known here:

    figure 3    a pulse, unloaded and with three loads
    figure 7    the driver: pulses on known resistors, measured and predicted, with residuals
    figure 8    a dry fingertip in a good and in a noisy laboratory: measured and predicted pulse
                with residual, and the impedance that was found
    figure 9    the same of a damp one
    figure 10   the elements of all subjects in the noisy laboratory
    table 4     error and scatter of the built circuit by cause

The residuals ring at the edges of a pulse: what the anti-alias filter of 80 kHz lets pass above
half of 200 kHz is in the records as aliases, which a prediction cannot tell from the signal.
"""

import pathlib
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

import etid
from benchmarks import charts
from benchmarks.paper_tables import Groups, Row, with_circuit
from etid.circuits.display import DISPLAY
from etid.paper.tables import CALIBRATION, METHODS, ORDER, Outcome, Truth
from etid.plotting.pulses import draw_pulse, pulse
from etid.simulation import published

GOOD, NOISY = "good", "both"
OURS, THEIRS = METHODS
LABELS = {OURS: "maximum likelihood", THEIRS: "Steiglitz-McBride"}
RESISTORS = ("resistors/21k62", "resistors/555k")  # the ends of Table I
HEIGHTS = {"height_ratios": [2.4, 1]}
ROOM = 3.0  # factor of the paper's range up to which figure 10 shows estimates


def draw(
    folder: pathlib.Path,
    groups: Groups,
    truth: Truth,
    shown: Mapping[str, etid.Study],
    table_4: Sequence[Row],
) -> None:
    """Write all figures as SVG.

    Args:
        folder: Where to.
        groups: What was identified; the first study of each laboratory is drawn.
        truth: Elements by path.
        shown: The first study of each laboratory.
        table_4: Rows of Table IV.
    """
    first = {key: outcomes[0] for key, outcomes in groups.items()}
    pulses(shown[GOOD], folder / "figure_3.svg")
    driver(shown[GOOD], first[GOOD, OURS].driver, folder / "figure_7.svg")
    for number, condition in ((8, "dry"), (9, "damp")):
        fingertip(shown, first, truth, condition, folder / f"figure_{number}.svg")
    subjects(first, truth, folder / "figure_10.svg")
    causes(table_4, folder / "table_4.svg")


def pulses(study: etid.Study, path: pathlib.Path) -> None:
    """Figure 3: the record of an open output and one pulse of it, beside loaded ones."""
    loads = {
        "98.8 kΩ": CALIBRATION,
        "dry fingertip": "typical/dry/01",
        "damp fingertip": "typical/damp/01",
    }
    figure, axes = charts.new_figure(1, 2, (9.5, 3.4), gridspec_kw={"width_ratios": [1, 1.6]})
    unloaded = study[CALIBRATION]
    part = pulse(unloaded)
    milliseconds = 1e3 * unloaded.time
    axes[0, 0].plot(milliseconds, unloaded.v_th, color=charts.INK, lw=0.9)
    axes[0, 0].set(xlabel="time [ms]", ylabel="voltage [V]", title="unloaded, V_th")
    axes[0, 1].plot(
        milliseconds[part], unloaded.v_th[part], color="0.6", lw=1.6, label="unloaded, V_th"
    )
    for i, (label, of) in enumerate(loads.items()):
        axes[0, 1].plot(
            milliseconds[part], study[of].v_out[part], color=charts.COLOURS[i],
            linestyle=charts.DASHES[i], lw=1.1, label=label,
        )  # fmt: skip
    axes[0, 1].set(xlabel="time [ms]", title="one pulse, V_out")
    axes[0, 1].legend(frameon=False, fontsize=8)
    charts.save(figure, path)


def driver(study: etid.Study, found: etid.Driver, path: pathlib.Path) -> None:
    """Figure 7: the calibration, and two resistors that the driver has not seen."""
    figure, axes = charts.new_figure(2, 3, (12.0, 4.6), gridspec_kw=HEIGHTS, sharex="col")
    known = published.TABLE_1
    resistances = {etid.scenes.resistor_label(r): r for r in known}
    for (upper, lower), of in zip(axes.T, (CALIBRATION, *RESISTORS), strict=True):
        record = study[of]
        r = record.r_load or resistances[of.rpartition("/")[2]]
        draw_pulse(upper, lower, record, found, etid.Resistor(r))
        kind = "calibration" if record.r_load else "not in the calibration"
        upper.set_title(f"{r / 1e3:g} kΩ, {kind}", fontsize=10)
    charts.save(figure, path)


def fingertip(
    shown: Mapping[str, etid.Study],
    first: Mapping[tuple[str, str], Outcome],
    truth: Truth,
    condition: str,
    path: pathlib.Path,
) -> None:
    """Figures 8 and 9: a fingertip as the default method finds it, and its impedance."""
    figure, axes = charts.new_figure(2, 3, (12.5, 4.8), gridspec_kw=HEIGHTS)
    name = f"typical/{condition}/01"
    for (upper, lower), laboratory in zip(axes.T[:2], (GOOD, NOISY), strict=True):
        record, outcome = shown[laboratory][name], first[laboratory, OURS]
        skin = outcome.skins.where(path=name)[0].circuit
        draw_pulse(upper, lower, record, outcome.driver, skin)
        upper.sharex(lower)
        upper.tick_params(labelbottom=False)
        upper.set_title(f"{condition}, {_settings(laboratory)}\n{_elements(skin)}", fontsize=9)
    impedances: dict[str, etid.AbstractCircuit | etid.Fit | etid.Driver] = {
        "truth": etid.SkinRC(**truth[name])
    }
    for method, label in LABELS.items():
        fits = with_circuit(first[NOISY, method].skins.where(path=name))
        if len(fits):
            impedances[label] = fits[0]
    impedances["Z_th"] = first[NOISY, OURS].driver
    for axis in etid.plot(impedances, axes=axes[:, 2]):
        axis.lines[0].set(color="0.6", linewidth=2.4, linestyle="-")  # the truth, below the others
    axes[0, 2].tick_params(labelbottom=False)
    axes[0, 2].legend(frameon=False, fontsize=8)
    axes[0, 2].set_title(f"impedance, {_settings(NOISY)}", fontsize=9)
    charts.save(figure, path)


def _settings(laboratory: str) -> str:
    return {GOOD: "60 dB, no delays", NOISY: "40 dB, delays of 200 ns"}[laboratory]


def _elements(skin: etid.AbstractCircuit) -> str:
    parts = []
    for name, unit in skin.units().items():
        scale, symbol = DISPLAY[unit]
        parts.append(f"{name} {float(getattr(skin, name)) / scale:.4g} {symbol}")
    return ", ".join(parts)


def _one_two_five(axis: Axis) -> None:
    """Numbers of a logarithmic axis that may span less than a decade."""
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(NullFormatter())


def _legend_above(figure: Figure, axes: Axes) -> None:
    """The legend of one panel, for all, outside of them."""
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=4, frameon=False, fontsize=8)


def subjects(first: Mapping[tuple[str, str], Outcome], truth: Truth, path: pathlib.Path) -> None:
    """Figure 10: true and identified elements of all subjects; the paper's range is grey."""
    figure, axes = charts.new_figure(len(ORDER), 2, (10.5, 7.5), sharex="col")
    for column, condition in zip(axes.T, published.FINGERTIPS, strict=True):
        for axis, name in zip(column, ORDER, strict=True):
            _elements_of(axis, first, truth, condition, name)
        column[0].set_title(f"{condition}, {_settings(NOISY)}", fontsize=10)
        column[-1].set_xlabel("subject; typ.: the typical fingertip")
    _legend_above(figure, axes[0, 0])
    charts.save(figure, path)


def _elements_of(
    axis: Axes,
    first: Mapping[tuple[str, str], Outcome],
    truth: Truth,
    condition: str,
    name: str,
) -> None:
    """One panel of figure 10; estimates that lie outside are counted."""
    scale, symbol = DISPLAY[etid.SkinRC.units()[name]]
    typical, lowest, highest = (v / scale for v in published.FINGERTIPS[condition][name])
    axis.axhspan(lowest, highest, color="0.93", label="range of the paper's subjects", zorder=0)
    low, high = min(typical, lowest) / ROOM, max(typical, highest) * ROOM
    outside = []
    for i, method in enumerate(METHODS):
        fits = first[NOISY, method].skins.where(condition=condition)
        labels = fits.labels["subject"].tolist()
        order = sorted(set(labels))
        place = np.array([order.index(label) for label in labels]) + 0.36 * (i - 0.5)
        values = np.asarray(getattr(fits.circuit, name)) / scale
        inside = (values > low) & (values < high)
        axis.plot(
            place[inside], values[inside], charts.MARKS[i], ms=4, mew=0.8,
            color=charts.COLOURS[i], markerfacecolor="none", label=LABELS[method],
        )  # fmt: skip
        if not inside.all():
            outside.append(f"{(~inside).sum()} of {inside.size} by {LABELS[method]} outside")
        if i == 0:
            paths = fits.labels["path"].tolist()
            first_paths = [paths[labels.index(subject)] for subject in order]
            known = [truth[of][name] / scale for of in first_paths]
            span = np.arange(len(order))
            axis.hlines(known, span - 0.42, span + 0.42, color=charts.INK, lw=1.2, label="truth")
            axis.set_xticks(
                span, [label.removeprefix("s").replace("typical", "typ.") for label in order]
            )
    axis.set_yscale("log")
    axis.set_ylim(low, high)
    _one_two_five(axis.yaxis)
    axis.set_ylabel(f"{name} [{symbol}]")
    if outside:
        axis.text(0.99, 0.97, "\n".join(outside), transform=axis.transAxes, ha="right", va="top",
                  fontsize=7)  # fmt: skip


def causes(rows: Sequence[Row], path: pathlib.Path) -> None:
    """Error and scatter by laboratory and element, beside what the paper prints."""
    figure, axes = charts.new_figure(1, len(ORDER), (11.0, 3.6), sharey=True)
    laboratories = list(dict.fromkeys(row["laboratory"] for row in rows))
    names = ["paper", *laboratories]
    for axis, element in zip(axes[0], ORDER, strict=True):
        error, scatter = published.TABLE_4[element]
        axis.axvline(0.0, color="0.6", lw=0.8)
        axis.errorbar(
            error, 0, xerr=scatter, fmt="D", ms=5, color=charts.INK, lw=1.2, capsize=3,
            label="paper (sign unknown)",
        )  # fmt: skip
        for i, method in enumerate(METHODS):
            of = [row for row in rows if (row["element"], row["method"]) == (element, method)]
            place = np.array([names.index(row["laboratory"]) for row in of]) + 0.3 * (i - 0.5)
            axis.errorbar(
                [row["error"] for row in of], place, xerr=[row["scatter"] for row in of],
                fmt=charts.MARKS[i], ms=5, color=charts.COLOURS[i], lw=1.2, capsize=3,
                markerfacecolor="none", label=LABELS[method],
            )  # fmt: skip
        axis.set(xlabel=f"{element}: mean error ± scatter of trials [%]")
    axes[0, 0].set_yticks(range(len(names)), names)
    axes[0, 0].invert_yaxis()
    _legend_above(figure, axes[0, 0])
    charts.save(figure, path)
