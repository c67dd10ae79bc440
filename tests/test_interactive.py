"""Interactive pictures show what those of matplotlib show."""

import numpy as np
import pytest

import etid
from etid.plotting import figure_of
from tests import pictures

pytest.importorskip("plotly")


@pytest.mark.parametrize("name", ["recording", "fit", "fit_impedance", "fits", "driver", "profile"])
def test_an_interactive_picture_has_every_line(name):
    given = pictures.PICTURES[name]()
    show = {"show": given[3]} if len(given) > 3 else {}
    figure = etid.interactive(*given[:3], **show)
    lines = [line for axis in figure_of(*given).axes for line in axis.lines]
    drawn = [np.asarray(trace.y, float) for trace in figure.data]
    for line in lines:
        y = np.asarray(line.get_ydata(), float)
        if y.size > 2:
            assert any(np.array_equal(y, one, equal_nan=True) for one in drawn)
    assert "<html>" in figure.to_html()


def test_elements_and_subjects_are_named():
    figure = etid.interactive(pictures.fits())
    assert figure.layout.yaxis.title.text == "R<sub>s</sub> [kΩ]"
    assert figure.layout.yaxis.type == "log"
    assert set(figure.layout.xaxis3.ticktext) == {"s01", "s02"}
    names = [trace.name for trace in figure.data if trace.showlegend]
    assert len(names) == len(set(names))
