"""Pictures: what is in each, what its axes say, and what is refused."""

import dataclasses
import functools
import json

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.patches import Rectangle

import etid
from etid.estimators.lanes import Harmonics
from etid.plotting import figure_of
from etid.plotting.bands import CLEAR, bands
from etid.plotting.by_frequency import sample_std
from etid.plotting.pulses import pulse
from etid.plotting.style import COLOURS, RED, VIOLET, new_figure
from etid.recordings.preflight import Inspected
from etid.results.verdicts import verdicts_of
from tests import pictures

EXPECTED = json.loads(pictures.DESCRIBED.read_text())


@pytest.mark.parametrize("name", pictures.PICTURES)
def test_a_picture_shows_what_it_did(name):
    """After a change that is meant: `python -m tests.pictures`, and look at what it made."""
    pictures.compare(pictures.described(pictures.drawn(name)), EXPECTED[name])


@pytest.mark.parametrize(
    "change",
    [
        lambda axis: axis.lines[0].remove(),
        lambda axis: axis.lines[0].set_ydata(1.001 * axis.lines[0].get_ydata()),
        lambda axis: axis.lines[0].set_color("red"),
        lambda axis: axis.figure.legends[0].remove(),
        lambda axis: axis.set_xscale("linear"),
    ],
    ids=["curve", "data", "colour", "legend", "scale"],
)
def test_a_picture_that_lacks_or_changes_something_is_different(change):
    figure = pictures.drawn("impedances")
    change(figure.axes[0])
    with pytest.raises(AssertionError):
        pictures.compare(pictures.described(figure), EXPECTED["impedances"])


def title(axis):
    return axis.get_title(loc="left")


def y(line):
    return np.asarray(line.get_ydata())


@pytest.fixture(scope="module")
def recording():
    return pictures.dry()


@pytest.fixture(scope="module")
def driver():
    return pictures.driver()


def test_one_pulse_of_two_phases_is_shown_from_its_beginning():
    """Its largest step is between the phases, and twice as large as the first."""
    current = np.zeros(10_000)
    for start in (100, 3433, 6767):
        current[start : start + 40], current[start + 40 : start + 80] = 1e-3, -1e-3

    def shown(current):
        return pulse(
            etid.Recording(v_out=current, current=current, sample_rate=200e3, pulse_rate=60.0)
        )

    for sign in (1, -1):
        part = shown(sign * current)
        assert 3433 - 40 <= part.start < 3433
        assert current[part].sum() == 0
        assert np.abs(current[part]).sum() == pytest.approx(80e-3)
    assert shown(current[120:]).start > 3000  # this record begins in a pulse


def test_a_fit_shows_its_residual_in_millivolts_in_a_band_of_two_sigma(recording, driver):
    fit = pictures.fit()
    upper, lower, _ = figure_of(fit, recording, driver).axes
    np.testing.assert_allclose(y(lower.lines[-1]), 1e3 * (y(upper.lines[2]) - y(upper.lines[1])))
    (band,) = lower.patches
    assert isinstance(band, Rectangle)
    sigma = 1e3 * sample_std(Inspected.of(recording), driver, fit.circuit)
    np.testing.assert_allclose((band.get_y(), band.get_height()), (-2 * sigma, 4 * sigma))
    assert r"successful, χ² 1.02, RRSE 0.1 %" in title(upper)
    assert r"$R_\mathrm{s}$ 33.40 ± 0.67 kΩ" in title(upper)
    for given, shown in ((None, ""), ("dry", "dry")):
        drawn = etid.plot(fit, recording, driver, title=given)
        assert [title(axis) for axis in drawn] == [shown, "", ""]


def test_what_did_not_succeed_looks_so(recording, driver):
    nothing = pictures.SKIN.with_log_values(jnp.full(3, jnp.nan))
    misfit, too_short = pictures.fit("misfit"), pictures.fit("too_short", nothing)
    for figure, verdict in (
        (figure_of(misfit, recording, driver), "misfit"),
        (figure_of(too_short, recording, driver), "too_short"),
        (figure_of(pictures.driver("order_too_low")), "order_too_low"),
    ):
        upper, lower = figure.axes[:2]
        assert f"unusable: {verdict}" in title(upper)
        assert "nan" not in title(upper)
        assert to_hex(upper._left_title.get_color()) == RED  # pyright: ignore[reportAttributeAccessIssue]
        told = ["no elements, nothing predicted"] if verdict == "too_short" else []
        assert [text.get_text() for text in lower.texts] == told


@pytest.fixture(scope="module")
def found(driver):
    """Bands of the skin that is not one RC, for its circuit and the nearest other one."""
    lane = Harmonics.of(Inspected.of(pictures.spread()))
    return [bands(lane, driver, circuit) for circuit in (pictures.SPREAD, pictures.NEAREST)]


def test_bands_of_a_recording_deviate_from_its_circuit_by_noise_alone(found):
    true, nearest = found
    # 2 of 38 normal numbers exceed 2; the chance of more than 6 is 1 %.
    assert true.deviation.size > 30
    assert np.count_nonzero(np.abs(true.deviation) > 2) <= 6
    assert np.abs(true.deviation).max() < 4
    assert np.abs(nearest.deviation).max() > 5
    for measured in found:
        z = np.asarray(pictures.SPREAD.response(jnp.asarray(measured.frequency)))
        off = np.log(measured.z / z)
        sure = measured.stderr < 0.1
        assert np.count_nonzero(sure) > 10
        # Z_th and the delay of the nearest circuit are not those of the true one.
        limit = 4 if measured is true else 12
        assert (np.abs(off[sure]) < limit * measured.stderr[sure]).all()


def test_a_selection_shows_what_is_measured_and_each_candidate(driver, found):
    selection = pictures.selection(SkinRC="misfit")
    magnitude, _, of_size, of_phase = figure_of(selection, pictures.spread(), driver).axes
    lines = [line for line in magnitude.lines if not str(line.get_label()).startswith("_")]
    sure = found[0].z[found[0].stderr <= CLEAR]
    np.testing.assert_allclose(y(magnitude.lines[0]), np.abs(sure) / 1e3)
    z = np.asarray(pictures.SPREAD.response(1e3 * jnp.asarray(lines[0].get_xdata())))
    np.testing.assert_allclose(y(lines[0]), np.abs(z) / 1e3)
    assert [line.get_label() for line in lines] == [
        "SkinCole, chosen",
        "SkinRC, 2 log evidence -592, misfit",
    ]
    assert lines[0].get_linewidth() > lines[1].get_linewidth()
    for part, axis in enumerate((of_size, of_phase)):
        for line, of in zip(list(axis.lines)[1:], found, strict=True):
            np.testing.assert_allclose(y(line), of.deviation[part])
    assert all(word in title(magnitude) for word in ("successful", "SkinCole", "alpha"))


def test_an_impedance_is_in_kilohms_and_degrees_in_a_band_of_two_standard_errors(driver):
    magnitude, phase = figure_of({"Z_th": driver}).axes
    frequency = 1e3 * jnp.asarray(magnitude.lines[0].get_xdata())
    z = np.asarray(driver.response(frequency))
    np.testing.assert_allclose(y(magnitude.lines[0]), np.abs(z) / 1e3)
    np.testing.assert_allclose(y(phase.lines[0]), np.degrees(np.angle(z)))
    (band,) = magnitude.collections
    top = np.abs(z) / 1e3 * np.exp(2 * np.asarray(driver.response_stderr(frequency)) / np.abs(z))
    assert np.asarray(band.get_paths()[0].vertices)[:, 1].max() == pytest.approx(max(top), rel=1e-6)
    # A circuit without a covariance has no band.
    assert not figure_of(pictures.SKIN).axes[0].collections


def test_fits_are_by_subject_unusable_ones_hollow_and_approximate_ones_of_a_colour():
    fits = pictures.fits()
    axis = figure_of(fits).axes[0]
    lines = [line for line in axis.lines if y(line).size]
    points = [line for line in lines if line.get_marker() != "_"]
    values = np.asarray(fits.circuit.r_s) / 1e3
    inexact = fits.verdicts == "approximate"
    for face, of in (("white", ~fits.fit.usable), (VIOLET, inexact)):
        drawn = [y(line) for line in points if line.get_markerfacecolor() == face]
        np.testing.assert_allclose(np.sort(np.concatenate(drawn)), np.sort(values[of]))
    assert sum(y(line).size for line in points) == len(fits)
    (medians,) = set(lines) - set(points)
    groups = [one for one in fits.summary("subject", "condition") if one["usable"] > 2]
    np.testing.assert_allclose(y(medians), [one["r_s"] / 1e3 for one in groups])
    (bars,) = axis.containers[-1][2]
    lengths = [np.ptp(segment[:, 1]) for segment in bars.get_segments()]
    np.testing.assert_allclose(lengths, [2e-3 * one["r_s_between"] for one in groups])


def test_a_fit_beside_fits_without_elements_is_at_its_tick():
    of = pictures.fits().take(np.arange(3))
    nothing = np.where([[True], [False], [False]], of.circuit.values(), np.nan)
    bad = dataclasses.replace(
        of.fit,
        circuit=etid.SkinRC.of_fit(nothing.T),
        result=verdicts_of(np.array(["successful", "flat", "misaligned"])),
    )
    labels = dict.fromkeys(("subject", "condition"), np.full(3, "", object))
    figure = figure_of(dataclasses.replace(of, fit=bad, labels=labels))
    axis = figure.axes[-1]
    drawn = np.concatenate([np.asarray(line.get_xdata()) for line in axis.lines])
    assert set(drawn.tolist()) == {0.0}
    assert axis.get_xlim() == (-0.5, 0.5)
    assert not figure.legends  # nothing unusable is drawn


def test_a_nyquist_plot_has_little_room_below_zero():
    nyquist = pictures.drawn("measured_impedance").axes[0]
    nyquist.figure.canvas.draw()
    low, high = nyquist.get_ylim()
    assert 0 < -low < 0.2 * high


def test_fits_are_by_any_two_labels():
    fits = pictures.fits()
    days = np.resize(np.array(["d1", "d2", "d3"], object), len(fits))
    fits = dataclasses.replace(fits, labels={**fits.labels, "session": days})
    axes = figure_of(fits, by=("session", "subject")).axes
    assert [one.get_text() for one in axes[-1].get_xticklabels()] == ["d1", "d2", "d3"]
    assert axes[-1].get_xlabel() == "session"
    [legend] = axes[0].figure.legends
    assert [one.get_text() for one in legend.get_texts()][:2] == ["s01", "s02"]


def test_a_bound_shows_per_cent_and_what_is_undetermined():
    (axis,) = figure_of(pictures.bounds()).axes
    assert "undetermined elements (100 % or more) in 1 of 2 recordings" in title(axis)
    points = [line for line in axis.lines if line.get_marker() != "None"]
    noisy = [(np.asarray(line.get_xdata()), line.get_markerfacecolor()) for line in points[1::2]]
    assert [round(size.item()) for size, _ in noisy] == [40, 2, 300]
    assert [face == "white" for _, face in noisy] == [False, False, True]


def test_without_axes_it_is_a_figure_of_pyplot_and_figure_of_is_none(recording, monkeypatch):
    import matplotlib.pyplot as plt

    before = plt.get_fignums()
    figure_of(recording)
    assert plt.get_fignums() == before
    monkeypatch.setattr(plt, "show", lambda: None)
    axes = etid.plot(recording, size=(3.3, 3.6))
    [new] = set(plt.get_fignums()) - set(before)
    assert plt.figure(new) is axes[0].figure
    np.testing.assert_allclose(axes[0].figure.get_size_inches(), (3.3, 3.6))
    plt.close(new)


@pytest.mark.parametrize(
    ("name", "height", "rows"),
    [
        ("recording", 3.6, 2),
        ("recording_with_current", 6.0, 4),
        ("fit", 4.8, 3),
        ("fit_impedance", 6.0, 3),
        ("residual", 6.0, 4),
        ("measured_impedance", 6.0, 3),
        ("selection", 6.0, 4),
        ("calibration", 4.8, 3),
        ("impedances", 4.0, 2),
        ("fits", 6.0, 3),
        ("posterior", 3.6, 3),
        ("profile", 2.6, 1),
        ("bound", 2.6, 1),
    ],
)
def test_a_picture_for_a_column_of_a_paper_is_whole_and_clear(name, height, rows, monkeypatch):
    narrow = functools.partial(pictures.narrow, height=height, title=None)
    monkeypatch.setattr(pictures, "figure_of", narrow)
    figure = pictures.PICTURES[name]()
    assert pictures.faults(figure) == []
    assert len({round(axis.get_position().y0, 2) for axis in figure.axes}) == rows


@pytest.mark.parametrize("show", ["pulse", "impedance", "residual"])
def test_a_long_path_is_whole_and_hides_nothing(recording, driver, show):
    path = "subject07/session02/dry/finger-left-index/12-repeat"
    fit = pictures.fit("misfit")
    figure = figure_of(fit, recording.replace(path=path), driver, show=show)
    assert pictures.faults(figure) == []
    assert path in title(figure.axes[0])


def test_a_fit_without_elements_says_so_in_every_panel_and_has_no_residual(recording, driver):
    nothing = pictures.SKIN.with_log_values(jnp.full(3, jnp.nan))
    fit = pictures.fit("saturated", nothing)
    figure = figure_of(fit, recording, driver, show="impedance")
    assert "unusable: saturated" in title(figure.axes[0])
    assert [text.get_text() for axis in figure.axes for text in axis.texts] == ["no elements"] * 3
    with pytest.raises(ValueError, match="this fit has no elements"):
        figure_of(fit, recording, driver, show="residual")


def test_a_legend_on_axes_of_the_caller_stays_in_them(recording, driver):
    figure, given = new_figure(3, 2, (9.0, 6.0))
    etid.plot(pictures.fit(), recording, driver, axes=given[:, 0])
    assert not figure.legends
    legend = given[0, 0].get_legend()
    assert legend is not None
    assert legend.get_frame_on()


def test_fits_outside_the_axis_and_fits_without_elements_are_told_apart():
    fits = pictures.fits()
    values = np.asarray(fits.circuit.values()).copy()
    values[1] = np.nan
    of = dataclasses.replace(fits.fit, circuit=etid.SkinRC(*jnp.asarray(values.T)))
    axis = figure_of(dataclasses.replace(fits, fit=of)).axes[0]
    [told] = [one.get_text() for one in axis.texts if "without" in one.get_text()]
    assert told == "1 unusable outside, 1 without elements"


def colours(axis):
    """Colours of the lines of a panel."""
    return [to_hex(line.get_color()) for line in axis.lines]


def test_red_is_what_has_no_success_and_nothing_else():
    """A failed driver was blue, and the good one beside it red and dashed."""
    both = {"bad": pictures.driver("misfit"), "good": pictures.driver()}
    for axis in figure_of(both).axes:
        bad, good = colours(axis)
        assert bad == RED != good
    assert RED not in [to_hex(one) for one in COLOURS]


@pytest.mark.parametrize("name", [n for n in pictures.PICTURES if not n.startswith("report")])
def test_letters_are_legible_in_400_pixels(name):
    """Of 10 points, in a picture of 7.5 inch: 7.4 pixels; a figure of 12 inch had 4.6."""
    figure = pictures.drawn(name)
    assert 400 / figure.get_figwidth() * 10 / 72 >= 6.9  # posterior: 7.8 inch


def test_ticks_close_to_each_other_are_whole_numbers():
    """The axis said +1.858e2."""
    profile = dataclasses.replace(
        pictures.profile(),
        value=0.1858e-9,
        values=0.1858e-9 * (1 + 1e-5 * np.linspace(-1, 1, 29)),
        stderr=1e-15,
    )
    figure = figure_of(profile)
    figure.draw_without_rendering()
    assert figure.axes[0].xaxis.get_offset_text().get_text() == ""


def test_a_colour_bar_of_a_short_range_has_several_ticks():
    figure = pictures.drawn("report_electrodes")  # C_p from 0.09 to 0.12 nF
    figure.draw_without_rendering()
    bar = figure.axes[-1]
    low, high = bar.get_ylim()
    assert sum(low <= tick <= high for tick in bar.get_yticks()) >= 2


def test_fits_say_their_errors_what_is_pooled_and_what_stands_beside_the_points():
    fits = pictures.fits()
    days = np.resize(np.array(["d1", "d2"], object), len(fits))
    fits = dataclasses.replace(fits, labels={**fits.labels, "session": days})
    axis = figure_of(fits).axes[0]
    assert "pooled: sessions" in title(axis)
    assert "beside the points: trial" in title(axis)
    assert "median error 2 %" in [one.get_text() for one in axis.texts]
    assert axis.get_ylabel() == r"$R_\mathrm{s}$ [kΩ]"
    assert "Each row pools sessions." in str(fits)
    of_days = title(figure_of(fits, by=("session", "subject")).axes[0])
    assert "pooled: conditions" in of_days
    assert "sessions" not in of_days


def test_equal_labels_do_not_stand_beside_the_points():
    """At the electrodes of a display each point said 0."""
    fits = pictures.display()
    labels = {**fits.labels, "trial": np.full(len(fits), "0", object)}
    axis = figure_of(dataclasses.replace(fits, labels=labels)).axes[0]
    beside = {one.get_text() for one in axis.texts} & {"0", "E1", "E8", "E9", "E98"}
    assert beside == {"E1", "E8", "E9", "E98"} & beside != set()
    assert "beside the points: electrode" in title(axis)


def spectrum():
    """The impedance that an instrument measured, without its fit."""
    measured = pictures.measured().measured
    assert measured is not None
    return measured


@pytest.mark.parametrize(
    ("method", "function"),
    [
        (lambda: pictures.dry().plot(), lambda: etid.plot(pictures.dry())),
        (lambda: pictures.driver().plot(), lambda: etid.plot(pictures.driver())),
        (
            lambda: pictures.driver().plot(pictures.study()["calibration/98k8"], title="one"),
            lambda: etid.plot(pictures.driver(), pictures.study()["calibration/98k8"], title="one"),
        ),
        (
            lambda: spectrum().plot(size=(4.0, 6.0)),
            lambda: etid.plot(spectrum(), size=(4.0, 6.0)),
        ),
    ],
)
def test_a_method_draws_what_the_function_draws(method, function):
    figures = [draw()[0].figure for draw in (method, function)]
    plt.close("all")
    one, other = map(pictures.described, figures)
    pictures.compare(one, other)
    assert figures[0].get_size_inches().tolist() == figures[1].get_size_inches().tolist()
