"""The public plots of things made by hand, and what is in them; writes this anew.

    python -m tests.pictures

writes `tests/baseline/pictures.json`, which is compared, and `tests/baseline/NAME.png`, which the
guide shows. Look at each before it is committed.
"""

import dataclasses
import functools
import itertools
import json
import pathlib
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.collections import Collection
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.path import Path
from matplotlib.spines import Spine
from matplotlib.text import Text

import etid
from etid.plotting import figure_of
from etid.plotting.layout import FINGERTIP
from etid.report import figures, tables
from etid.report.tables import Components
from etid.results.driver import Calibration, ContinuousDriver, Driver, SourceImpedance
from etid.results.fit import Fit, Support
from etid.results.fits import Fits
from etid.results.verdicts import verdicts_of
from etid.selection.search import usual_circuits
from etid.simulation.scenes import PRESETS, Trial

BASELINE = pathlib.Path(__file__).parent / "baseline"
DESCRIBED = BASELINE / "pictures.json"
SKIN = etid.SkinRC(33.4e3, 186e3, 0.12e-9)
RELATIVE = np.array([0.02, 0.005, 0.03])  # standard errors of SKIN
SPREAD = etid.SkinCole(33.4e3, 186e3, 22e-6, 0.85)
NEAREST = etid.SkinRC(45.7e3, 169e3, 0.117e-9)  # about what a fit of SPREAD gives


@functools.cache
def measured() -> Fit:
    """A fit to an impedance that an instrument measured with 2 % of noise."""
    frequency = jnp.geomspace(60.0, 1e5, 25)
    z = np.asarray(SKIN.response(frequency))
    rng = np.random.default_rng(0)
    noise = 0.02 * np.abs(z) * (rng.normal(size=25) + 1j * rng.normal(size=25))
    return etid.identify_impedance(frequency, z + noise, stderr=0.02 * np.abs(z))


@functools.cache
def study() -> etid.Study:
    """A calibration and dry trials at 40 dB."""
    return PRESETS["paper_dry"](snr_db=40.0).simulate(seed=3)


def driver(verdict: str = "successful") -> Driver:
    """About what that calibration gives."""
    of_poles = [12.6542, 12.87402], [0.04925, -1.4639], [2380.0, 9885.0], [2956.0, 14014.0]
    source = SourceImpedance(*map(jnp.array, (6.0525, *of_poles, [5.531], [-6754.0])))
    errors = np.array([0.3, 0.05, 0.02, 0.1, 0.02, 100, 50, 200, 50, 0.02, 50])
    return ContinuousDriver(
        b=jnp.ones(6),
        a=jnp.ones(6),
        sample_rate=200e3,
        source=source,
        cov=jnp.diag(jnp.asarray(errors**2)),
        calibration=Calibration(jnp.array([98.8e3]), jnp.zeros(1), jnp.array(0.5)),
        rrse=jnp.array(1e-3),
        chi2=jnp.array(1.02),
        result=verdicts_of(np.array(verdict)),
        steps=jnp.array(12),
        method="maximum_likelihood",
    )


def as_kind(driver: Driver, kind: type[Driver]) -> Driver:
    """A driver as another kind, which keeps less of it."""
    return kind(**{field.name: getattr(driver, field.name) for field in dataclasses.fields(kind)})


def fit(
    verdict: str | np.ndarray = "successful",
    circuit: etid.AbstractCircuit = SKIN,
    own: float | np.ndarray = RELATIVE,
    shared: float = 0.0,
) -> Fit:
    """A fit of one trial, or of many, with these relative standard errors of the elements."""
    values = np.asarray(circuit.values())
    shape = values.shape[:-1]
    each = np.eye(values.shape[-1])
    of_noise, of_driver = (
        np.einsum("...i,ij->...ij", (error * values) ** 2, each) for error in (own, shared)
    )
    return Fit(
        circuit=circuit,
        cov=of_noise + of_driver,
        shared_cov=of_driver,
        rrse=np.full(shape, 1e-3),
        chi2=np.full(shape, 1.02),
        result=verdicts_of(np.asarray(verdict)),
        steps=np.full(shape, 5),
        method="maximum_likelihood",
        remarks=np.zeros(shape, int),
    )


def fits_of(found: Fit, **labels: np.ndarray) -> Fits:
    """Fits with these labels; other labels are empty."""
    empty = np.full(np.shape(found.rrse), "")
    names = ("path", "subject", "condition", "electrode", "trial")
    return Fits(found, dict.fromkeys(names, empty) | labels, empty)


@functools.cache
def spread() -> etid.Recording:
    """A trial at 40 dB of skin that is not one RC."""
    scene = PRESETS["paper_dry"](snr_db=40.0)
    return dataclasses.replace(scene, trials=(Trial("spread", SPREAD),)).simulate(seed=4)["spread"]


def selection(**verdicts: str) -> etid.Selection:
    """Two candidates for that trial; the chosen one is its true circuit."""
    found = {}
    for number, circuit, deviance in ((0, NEAREST, 2600.0), (3, SPREAD, 2000.0)):
        verdict = verdicts.get(type(circuit).__name__, "successful")
        unseen = (np.zeros(of) for of in (Support.changes(), (), len(circuit.names()), ()))
        support = Support(np.array(deviance), np.array(2e3), *unseen)
        one = fit(verdict, circuit, 0.01)
        found[number] = dataclasses.replace(one, chi2=np.array(deviance / 2e3), support=support)
    return etid.Selection.of(found, 3, usual_circuits())


def fits() -> Fits:
    """Two subjects, two conditions, three trials; two unusable, one approximate, one far away."""
    rng = np.random.default_rng(1)
    count = 12
    spread = np.exp(0.1 * rng.normal(size=(3, count)))
    dry = np.arange(count) % 6 < 3
    values = np.where(dry, SKIN.values()[:, None], [[6.1e3], [17.4e3], [0.66e-9]]) * spread
    values[:, 4] *= 1e3
    verdicts = np.full(count, "successful", dtype=object)
    verdicts[[1, 2, 4]] = "misfit", "approximate", "insensitive"
    return fits_of(
        fit(verdicts, etid.SkinRC(*jnp.asarray(values))),
        path=np.array([f"recording/{i:02d}" for i in range(count)]),
        subject=np.repeat(["s01", "s02"], 6),
        condition=np.where(dry, "dry", "damp"),
        trial=np.array([str(i % 3) for i in range(count)]),
    )


def display() -> Fits:
    """Three fits of each of two days at electrodes of a display; the last of each is unusable."""
    found = fits().take(np.array([0, 2, 1] * 2))
    names = np.array(["E1", "E8", "E98", "E1", "E9", "E98"], object)
    days = np.array(["d1"] * 3 + ["d2"] * 3, object)
    return dataclasses.replace(found, labels={**found.labels, "electrode": names, "session": days})


def nothing_found() -> etid.Selection:
    """A choice for a recording that no candidate can be fitted to."""
    nothing = SKIN.with_log_values(jnp.full(3, jnp.nan))
    one = dataclasses.replace(fit("too_short", nothing), support=selection().fit.support)
    return etid.Selection.of({0: one}, 0, usual_circuits())


def narrow(*of: Any, height: float = 6.0, **options: Any) -> Figure:
    """A picture as wide as the column of a paper."""
    figure = etid.plot(*of, **options, size=(3.3, height))[0].figure
    plt.close(figure)
    return figure


def components(of: Fits) -> tuple[list[Components], list[str]]:
    """Variations of the elements, and the conditions."""
    return tables.components(of, of.summary("subject", "condition")), tables.frequent(of, 4)


def bounds() -> dict[str, etid.Bound]:
    """Of a dry trial at 60 dB, and one whose capacitance is not determined."""
    one = etid.bound(PRESETS["paper_dry"](snr_db=60.0))["typical/dry/01"]
    noisy = np.diag(np.square([0.4, 0.02, 3.0]))
    return {"dry": one, "noisy": dataclasses.replace(one, path="noisy/01", log_cov=noisy)}


def dry() -> etid.Recording:
    """One dry trial."""
    return study()["typical/dry/01"]


def with_current() -> etid.Recording:
    """One dry trial with its current at 40 dB."""
    scene = dataclasses.replace(PRESETS["paper_dry"](snr_db=40.0), current_snr_db=40.0)
    return scene.simulate(seed=3)["typical/dry/01"]


def posterior() -> etid.Posterior:
    """Skewed draws around that fit."""
    rng = np.random.default_rng(2)
    mix = np.array([[1.0, 0, 0], [-0.7, 0.7, 0], [0.3, 0, 1.0]])
    logs = RELATIVE * 4 * (rng.normal(size=(1000, 3)) @ mix.T)
    logs += 2 * logs**2
    draws = etid.SkinRC(*jnp.asarray(np.asarray(SKIN.values())[:, None] * np.exp(logs.T)))
    found = fit()
    return etid.Posterior(found.circuit, 16 * np.asarray(found.cov), draws, np.full(1000, 1e-3))


def profile() -> etid.Profile:
    """A skewed profile of C_p."""
    logs = np.linspace(-0.6, 0.6, 29)
    values = 0.12e-9 * np.exp(logs)
    return etid.Profile("c_p", "farad", 0.12e-9, 0.024e-9, values, (logs / 0.2 - logs**2) ** 2)


def faults(figure: Figure) -> list[str]:
    """What of a picture is cut, hides another part, or lies on the data."""
    figure.draw_without_rendering()
    found, whole = [], figure.get_tightbbox()
    if min(*whole.min, *(figure.get_size_inches() - whole.max)) < 0:
        found.append(f"cut: {whole.extents}")
    axes = [axis for axis in figure.axes if axis.get_visible()]
    ticks = [
        [one for one in axis.get_xticklabels() if one.get_text() and one.get_visible()
         and axis.get_xlim()[0] <= one.get_position()[0] <= axis.get_xlim()[1]]
        for axis in axes
    ]  # fmt: skip
    labels = [axis.yaxis.label for axis in axes if axis.get_ylabel()]
    titles = [vars(axis)["_left_title"] for axis in axes if axis.get_title(loc="left")]
    for kind, texts in (*(("ticks", one) for one in ticks), ("labels", labels), ("titles", titles)):
        boxes = [(one.get_text(), one.get_window_extent()) for one in texts]
        for (name, one), (beside, other) in itertools.combinations(boxes, 2):
            if one.overlaps(other):
                found.append(f"{kind} {name!r} and {beside!r}")
    for legend in figure.legends:
        box = legend.get_window_extent()
        found += ["legend on data" for axis in axes if box.overlaps(axis.get_window_extent())]
    return found


# Of the largest number of a list. The same commands give the same digits; the condition of the
# equations behind an error bar takes rounding of a processor up to 1e-7.
TOLERANCE = 1e-4
# What of an artist is compared: what it shows and how, but no places that depend on letters.
SHOWN = (
    *("label", "text", "color", "facecolor", "edgecolor", "linestyle", "linewidth", "marker"),
    *("markersize", "markerfacecolor", "alpha", "zorder", "visible", "xlim", "ylim", "xscale"),
    *("yscale", "xlabel", "ylabel", "xdata", "ydata", "xy", "width", "height", "position"),
    *("paths", "offsets", "array", "clim", "fontsize", "rotation", "frame_on"),
    *("horizontalalignment", "verticalalignment"),
)


def artists(of: Artist) -> Iterator[Artist]:
    """All that is drawn, without ticks and spines."""
    for one in of.get_children():
        if not isinstance(one, Axis | Spine) and one is not getattr(of, "patch", None):
            yield one
            yield from artists(one)


def simple(value: Any) -> Any:
    """Something that JSON knows; many numbers as their mean, size, ends and limits."""
    if value is None or isinstance(value, str | bool):
        return value
    if isinstance(value, list) and value and isinstance(value[0], Path):
        value = np.concatenate([one.vertices for one in value])
    try:
        numbers = np.ma.filled(np.ma.asarray(value, float), np.nan).ravel()
    except (TypeError, ValueError):
        return str(value)
    known = numbers[np.isfinite(numbers)]
    if numbers.size > 8 and known.size:
        size = np.sqrt(np.mean(known**2))
        ends = known[0], known[-1], known.min(), known.max()
        numbers = np.array([known.mean(), size, *ends])
    return [float(f"{one:.6g}") if np.isfinite(one) else str(one) for one in numbers.tolist()]


def described(figure: Figure) -> list[dict[str, Any]]:
    """What is in a picture, by `SHOWN`; of axes also what they share and the names of ticks."""
    found = []
    for one in artists(figure):
        if not isinstance(one, Axes | Collection | Legend | Line2D | Patch | Text):
            continue
        shown: dict[str, Any] = {"kind": type(one).__name__}
        for name in SHOWN:
            if hasattr(one, f"get_{name}"):
                shown[name] = simple(getattr(one, f"get_{name}")())
        if isinstance(one, Axes):
            formatters = [axis.get_major_formatter() for axis in (one.xaxis, one.yaxis)]
            shown["position"] = None  # the letters beside it have their room
            shown["ticks"] = [[*getattr(of, "seq", ())] for of in formatters]
            shown["labelled"] = one.xaxis.get_tick_params().get("labelbottom", True)
            shown["shared"] = len(one.get_shared_x_axes().get_siblings(one))
        shown["hidden"] = not shown.pop("visible")
        if shown.get("text") != "":
            found.append({name: of for name, of in shown.items() if of not in (None, "", False)})
    return found


def compare(found: list[dict[str, Any]], expected: list[dict[str, Any]]) -> None:
    """Raise AssertionError if two descriptions differ by more than `TOLERANCE`."""
    assert [one["kind"] for one in found] == [one["kind"] for one in expected]
    for one, other in zip(found, expected, strict=True):
        for key in one.keys() | other.keys():
            told = f"{one['kind']} {one.get('label', '')}: {key}"
            if isinstance(one.get(key), list) and key != "ticks":
                values = [np.asarray(of.get(key), float) for of in (one, other)]
                size = np.max(np.abs(values[1]), initial=0.0, where=np.isfinite(values[1]))
                np.testing.assert_allclose(*values, rtol=0, atol=TOLERANCE * size, err_msg=told)
            else:
                assert one.get(key) == other.get(key), told


def of_report(call: Callable[..., bytes], *arguments: Any) -> Figure:
    """The figure that a function of a report draws."""
    drawn: list[Figure] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(figures, "svg", lambda figure: drawn.append(figure) or b"")
        call(*arguments)
    return drawn[0]


PICTURES: dict[str, Callable[[], Figure]] = {
    "recording": lambda: figure_of(dry()),
    "recording_with_current": lambda: figure_of(with_current()),
    "fit": lambda: figure_of(fit(), dry(), driver()),
    "fit_without_success": lambda: figure_of(fit("misfit"), dry(), driver()),
    "measured_impedance": lambda: figure_of(measured()),
    "fit_impedance": lambda: figure_of(fit(), dry(), driver(), show="impedance"),
    "selection": lambda: figure_of(selection(SkinRC="misfit"), spread(), driver()),
    "calibration": lambda: figure_of(driver(), study()["calibration/98k8"]),
    "driver": lambda: figure_of(driver()),
    "impedances": lambda: figure_of(
        {"Z_th": driver("order_too_low"), "skin": fit(), "typical": SKIN}
    ),
    "fits": lambda: figure_of(fits()),
    "posterior": lambda: figure_of(posterior()),
    "profile": lambda: figure_of(profile()),
    "residual": lambda: figure_of(fit(), dry(), driver(), show="residual"),
    "residual_of_impedance": lambda: figure_of(measured().residual()),
    "bound": lambda: figure_of(bounds()),
    "map": lambda: figure_of(display(), map="r_p"),
    "selection_without_elements": lambda: figure_of(nothing_found(), spread(), driver()),
    "selection_for_a_column": lambda: narrow(selection(), spread(), driver()),
    "report_distributions": lambda: of_report(figures.distributions, fits()),
    "report_subjects": lambda: of_report(figures.by_subject, fits()),
    "report_quality": lambda: of_report(
        figures.quality, np.geomspace(0.9, 9.0, 20), np.linspace(0.01, 0.02, 20)
    ),
    "report_components": lambda: of_report(figures.components, *components(fits())),
    "report_fits": lambda: of_report(figures.each_fit, fits()),
    "report_electrodes": lambda: of_report(figures.electrodes, display(), "c_p", FINGERTIP),
    "report_drivers": lambda: of_report(figures.drivers, {"98k8": driver()}),
}


def drawn(name: str) -> Figure:
    """One picture as it is compared."""
    with mpl.rc_context():
        mpl.rcdefaults()
        return PICTURES[name]()


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    every = {}
    for picture in PICTURES:
        figure = drawn(picture)
        every[picture] = described(figure)
        figure.savefig(BASELINE / f"{picture}.png", dpi=60, metadata={"Software": None})
    rows = (
        f'"{name}": [\n' + ",\n".join(map(json.dumps, of)) + "\n]" for name, of in every.items()
    )
    DESCRIBED.write_text("{\n" + ",\n".join(rows) + "\n}\n")
