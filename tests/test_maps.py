import dataclasses
import itertools

import numpy as np
import probeinterface
import pytest
from matplotlib.collections import EllipseCollection

import etid
from etid.plotting import figure_of
from etid.plotting.layout import FINGERTIP, Layout, read_layout
from etid.plotting.style import new_figure
from etid.recordings.errors import RecordingError
from tests import pictures


@pytest.fixture(scope="module")
def display():
    return pictures.display()


def test_the_display_of_the_paper_has_98_places_two_millimetres_apart():
    assert len(FINGERTIP.electrodes) == 98
    apart = np.hypot(FINGERTIP.x[:, None] - FINGERTIP.x, FINGERTIP.y[:, None] - FINGERTIP.y)
    np.testing.assert_allclose(np.sort(apart, axis=1)[:, 1], 2e-3)
    assert (np.ptp(FINGERTIP.x), np.ptp(FINGERTIP.y)) == pytest.approx((12e-3, 26e-3))


def test_each_day_has_a_map_and_values_lie_at_their_electrodes(display):
    _, given = new_figure(1, 2, (6.0, 4.0))
    axes = etid.plot(display, map="r_p", axes=given)
    for day, axis in enumerate(axes):
        [dots] = [one for one in axis.collections if isinstance(one, EllipseCollection)]
        rows = [3 * day, 3 * day + 1]
        places = FINGERTIP.place(display.labels["electrode"][rows])
        expected = 1e3 * np.column_stack([FINGERTIP.x[places], FINGERTIP.y[places]])
        np.testing.assert_allclose(np.asarray(dots.get_offsets(), float), expected)
        shown = np.asarray(dots.get_array(), float)
        np.testing.assert_allclose(shown, 1e-3 * display.circuit.r_p[rows])
        assert f"d{day + 1}" in axis.get_title(loc="left")
        assert "2 of 3 electrodes" in axis.get_title(loc="left")
        failed = axis.lines[-1]
        assert failed.get_marker() != "o"
        assert (failed.get_xdata()[0], failed.get_ydata()[0]) == pytest.approx((12.0, 0.0))
    scales = {tuple(axis.collections[0].get_clim()) for axis in axes}
    assert len(scales) == 1


def test_titles_of_maps_hide_nothing_and_each_column_has_its_places(display):
    fits = display.take(np.resize(np.arange(6), 21))
    names = np.repeat([f"Anna-Maria Schmidt {i}" for i in range(7)], 3).astype(object)
    labels = {"subject": names, "session": np.full(21, "after washing", object)}
    figure = figure_of(dataclasses.replace(fits, labels={**fits.labels, **labels}), map="r_p")
    shown = figure.axes[:7]
    figure.draw_without_rendering()
    boxes = [axis._left_title.get_window_extent() for axis in shown]  # pyright: ignore[reportAttributeAccessIssue]
    for one, other in itertools.combinations(boxes, 2):
        assert not one.overlaps(other)
    labelled = [axis.get_xlabel() == "x [mm]" for axis in shown]
    assert labelled == [False, *[True] * 6]  # six in the first row, one below the first
    assert [axis.xaxis.get_tick_params()["labelbottom"] for axis in shown] == labelled


def test_a_narrow_figure_has_fewer_maps_in_a_row(display):
    import matplotlib.pyplot as plt

    axes = etid.plot(display.take(np.resize(np.arange(6), 6)), map="r_p", size=(2.0, 4.0))
    plt.close(axes[0].figure)
    assert axes[0].get_subplotspec().get_gridspec().get_geometry() == (2, 1)
    assert pictures.faults(axes[0].figure) == []


@pytest.mark.parametrize("days", [("after washing with soap", "before washing"), ("d1", "d1")])
def test_long_titles_have_room_in_the_column_of_a_paper(display, days):
    import matplotlib.pyplot as plt

    labels = {
        "subject": np.full(6, "Anna-Maria Schmidt-Huber", object),
        "session": np.repeat(np.array(days, object), 3),
        "site": np.full(6, "left index finger", object),
    }
    fits = dataclasses.replace(display, labels={**display.labels, **labels})
    axes = etid.plot(fits, map="r_p", size=(3.3, 4.5))
    plt.close(axes[0].figure)
    assert pictures.faults(axes[0].figure) == []
    for axis in axes:  # whole words
        assert {"index", "finger,", "electrodes"} <= {*axis.get_title("left").split()}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"map": "r_q"}, "map is 'r_q', must be one of 'r_s', 'r_p', 'c_p'"),
        (
            {"map": "r_p", "layout": Layout.grid(2, 2, 1e-3, "A1")},
            "electrode 'E1' is not in the layout",
        ),
        ({"layout": FINGERTIP}, "map is for Fits, and layout for a map"),
    ],
)
def test_refusals_of_a_map(display, options, message):
    with pytest.raises((ValueError, TypeError), match=message):
        figure_of(display, **options)


def test_a_layout_is_read_from_a_table_or_a_probe_file(tmp_path):
    table, probe = tmp_path / "display.csv", tmp_path / "display.json"
    table.write_text("electrode, x, y\nA, 0, 0.001\nB, 0.002, 0\n", "utf-8")
    contacts = probeinterface.Probe(ndim=2, si_units="mm")
    contacts.set_contacts([[0, 1], [2, 0]], contact_ids=["A", "B"])
    probeinterface.write_probeinterface(probe, contacts)
    for path in (table, probe):
        layout = read_layout(path)
        assert layout.electrodes == ("A", "B")
        np.testing.assert_allclose([layout.x, layout.y], [[0, 2e-3], [1e-3, 0]])


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.csv", "electrode,x\nA,1\n", "must have the columns electrode, x and y"),
        ("a.csv", "electrode,x,y\nA,1,1\nA,2,2\n", "these electrodes twice: A"),
        ("a.csv", "electrode,x,y\nA,1,far\n", "y: is 'far' for electrode 'A', must be a number"),
        ("a.csv", "electrode,x,y\nA,1,nan\n", "needs a finite place"),
        ("a.json", '{"probes": [], "version": "0.4"}', "must hold one planar probe"),
        ("a.json", "{}", "cannot be read"),
        ("a.json", "{", "cannot be read"),
    ],
)
def test_refusals_of_a_layout(tmp_path, name, text, message):
    path = tmp_path / name
    path.write_text(text, "utf-8")
    with pytest.raises(RecordingError, match=message):
        read_layout(path)


def test_fits_without_electrodes_have_no_map():
    with pytest.raises(ValueError, match="a fit has no label electrode"):
        figure_of(pictures.fits(), map="r_p")
