"""Pictures for a notebook or a paper: recordings, fits, circuits, impedances, studies, bounds.

`plot` is for people, `figure_of` for programs that write files. The first picture imports
matplotlib.
"""

import os
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, get_args

import numpy as np

from etid.circuits.circuit import AbstractCircuit
from etid.precision import in_float64
from etid.recordings.recording import Recording
from etid.results.data import AnyAxes, MeasuredImpedance, Shown, Size
from etid.results.driver import Driver, SourceImpedance
from etid.results.fit import Fit
from etid.results.fits import Fits
from etid.results.posterior import Posterior, Profile
from etid.results.residual import Residual
from etid.selection.selection import Selection
from etid.simulation.bound import Bound

Impedance = Driver | Fit | AbstractCircuit | SourceImpedance
if TYPE_CHECKING:
    import matplotlib.figure

    from etid.plotting.layout import Layout
    from etid.plotting.style import Canvas

    Seen = Recording | MeasuredImpedance | Posterior | Profile | Residual | Bound
    One = Seen | Fits | Selection | Impedance
    Drawable = One | Mapping[str, Bound] | Mapping[str, Impedance]
else:
    Drawable = Any


@in_float64
def plot(
    x: Drawable,
    recording: Recording | None = None,
    driver: Driver | None = None,
    *,
    axes: AnyAxes = None,
    size: Size = None,
    title: str | None = "",
    show: Shown = "pulse",
    by: Sequence[str] | None = None,
    map: str | None = None,
    layout: "Layout | str | os.PathLike[str] | None" = None,
) -> np.ndarray:
    """Draw a recording, a fit, a posterior, a driver, an impedance, fits, bounds and others.

    | call | shows | axes |
    |---|---|---|
    | `plot(recording)` | V_th and V_out [V]: the whole record, and one pulse | 2 |
    | `plot(recording)` with a current | below them the current, over the same time | 4 |
    | `plot(fit)` | one pulse measured and predicted [V]; residual [mV]; its spectrum | 3 |
    | `plot(fit)` without whole periods or elements | the same without the spectrum | 2 |
    | `plot(fit, show="impedance")` | Nyquist and Bode: fit, measured | 3 |
    | `plot(fit)` of `identify_impedance` | Nyquist and Bode: fit, measured | 3 |
    | `plot(fit.measured)` | Nyquist and Bode: measured | 3 |
    | `plot(fits[0], recording, driver)` | as `plot(fit)`, for one of several fits | 3 |
    | `plot(fits[0], recording)` | that for a fit from a measured current | 3 |
    | `plot(selection, recording, driver)` | impedance measured, and each candidate | 4 |
    | `plot(driver, calibration)` | as `plot(fit)`, for the resistor of a calibration | 3 |
    | `plot(driver)`, `plot(circuit)` | magnitude [kΩ] and phase [deg] of an impedance | 2 |
    | `plot({label: driver, fit or circuit})` | several of these in one diagram | 2 |
    | `plot(posterior)` | each element, and each two of them, beside the errors of the fit | n² |
    | `plot(profile)` | how much worse the fit becomes if one element has another value | 1 |
    | `plot(fit, show="residual")` | the same as `plot(fit.residual())` | 4 or 2 |
    | `plot(residual)` | residual [mV], its size by frequency, its correlations by lag | 4 |
    | `plot(residual)` of `identify_impedance` | size by frequency, correlation of neighbours | 2 |
    | `plot(fits)` | each element by subject, conditions side by side | one per element |
    | `plot(fits, by=("session", "subject"))` | each element by two other labels | the same |
    | `plot(fits, map="r_p")` | an element at each electrode of a display | one per group |
    | `plot(etid.bound(scene))` | smallest relative standard errors [%] of each recording | 1 |

    The band around the residual of a pulse is ±2σ of the noise of both records, the power
    var V_out + |G|² var V_th of all frequencies with G = Z_L / (Z_L + Z_th). If only noise is left,
    95 % of the residual lies inside; aliases above 0.4 of the sample rate may exceed it at the
    edges. The spectrum of the residual [V/√Hz] has a point for each band of harmonics, pale if the
    fit did not use them. Its line is the noise with which the fit weighted each harmonic, and 95 %
    of the points lie in the band if only this noise is left. The legend says which noise it is.

    The bands around impedances are two standard errors, from the covariance of the fit or driver.
    Unusable fits and drivers have a red title, and their points are hollow.

    The points of `show="impedance"` are what the recording measures in bands of frequency, with two
    standard errors. Those of `show="residual"` are what a fit leaves relative to the noise that it
    expects, so that aliases and the colour of noise do not matter: 95 % of the bands of frequency
    and 99 % of the lags of such noise lie in the grey bands.

    The picture of a selection shows magnitude [kΩ] and phase [deg] in bands of frequency with two
    standard errors; points are pale where the error exceeds 30 %. Below are the deviations of each
    candidate from these points, in standard errors.

    Args:
        x: The object to draw.
        recording: Recording of the selection, or calibration of the driver. A fit by
            `identify_skin` knows its recording and its driver; one of several fits does not.
        driver: Driver of the fit or selection, if `recording` is given.
        show: What to draw of a fit: `"pulse"`, `"impedance"` or `"residual"`.
        by: Two labels: that of the horizontal axis, and that of the series side by side; default
            subject and condition. Medians of three fits or more are thick, with the variation
            between fits beyond their errors.
        map: Element to draw at each electrode of a display, a map for each subject, session, site
            and condition. An electrode without a usable trial has a mark for its verdict.
        layout: Places of the electrodes, or a file that `etid.read_layout` reads; if not given,
            `E1` to `E98` of the paper's display.
        axes: Axes to draw on, as many as the table says. Without axes, `plot` makes a figure of
            `matplotlib.pyplot`, which a notebook shows.
        size: Width and height of this figure [inch]; if not given, one for a screen. In a narrow
            one, panels stand below each other, but for those of a posterior.
        title: Replaces the titles of the picture; None leaves them out, as a paper does.

    Returns:
        The axes of the picture, (axis,), for further changes.

    Raises:
        TypeError: etid cannot draw `x`, or `recording` or `driver` is missing.
        ValueError: `x` is empty, the picture needs another number of axes, `size` is given together
            with `axes`, or a fit has no residual.
    """
    from etid.plotting.style import Canvas, titled

    if axes is not None and size is not None:
        raise ValueError("size is that of a new figure; set the size of the figure of your axes")
    canvas = Canvas(axes, size, pyplot=True)
    drawn = _draw(canvas, x, recording, driver, show=show, by=by, map=map, layout=layout)
    if title != "":
        for axis in drawn.flat:
            axis.set_title("", loc="left")
        titled(drawn.flat[0], [title or ""])
    return drawn


def figure_of(
    x: Drawable, recording: Recording | None = None, driver: Driver | None = None, **options: Any
) -> "matplotlib.figure.Figure":
    """The picture of `plot`, on a figure outside of `matplotlib.pyplot`; same arguments."""
    from etid.plotting.style import Canvas

    return _draw(Canvas(), x, recording, driver, **options)[0].figure


@np.errstate(all="ignore")  # a fit that failed may hold any number
def _draw(
    canvas: "Canvas",
    x: Any,
    recording: Recording | None,
    driver: Driver | None,
    *,
    show: Shown = "pulse",
    by: Sequence[str] | None = None,
    map: str | None = None,
    layout: "Layout | str | os.PathLike[str] | None" = None,
) -> np.ndarray:
    import matplotlib as mpl

    from etid.plotting import elements, impedances, judging, maps, pulses, residuals, style
    from etid.plotting.layout import FINGERTIP, Layout, read_layout

    if show not in get_args(Shown) or (show != "pulse" and not isinstance(x, Fit)):
        allowed = ", ".join(repr(one) for one in get_args(Shown))
        raise ValueError(f"show is {show!r}; it is for fits, and one of {allowed}")
    is_map = map is not None or layout is not None
    if is_map and (map is None or not isinstance(x, Fits)):
        raise TypeError("map is for Fits, and layout for a map: plot(fits, map='r_p')")
    if by is not None and (is_map or not isinstance(x, Fits)):
        raise TypeError("by is for Fits without a map: plot(fits, by=('session', 'subject'))")
    if isinstance(x, Fits) and not len(x):
        raise ValueError("there are no fits to draw")
    for one in x.values() if isinstance(x, dict) else [x]:
        if isinstance(one, Fit) and np.ndim(one.rrse):
            raise TypeError(
                f"this is a batch of {np.shape(one.rrse)} fits; draw one fit, fits[i], or all of "
                "them, plot(fits)"
            )
    if isinstance(x, Fit):
        recording, driver = x.source_or_own(recording, driver)
    with_current = recording is not None and "current" in recording.samples
    with mpl.rc_context(style.PAPER):
        match x, recording, driver:
            case Fit(), _, _ if show == "residual":
                return residuals.draw_residual(canvas, x.residual(recording, driver))
            case Fit(), Recording(), _ if driver is not None or with_current:
                draw = pulses.draw_fit if show == "pulse" else judging.draw_impedance
                return draw(canvas, x, recording, driver)
            case Selection(), Recording(), _ if driver is not None or with_current:
                return judging.draw_selection(canvas, x, recording, driver)
            case Driver(), Recording(), None:
                return pulses.draw_calibration(canvas, x, recording)
            case Fit(measured=MeasuredImpedance() as measured), None, _:
                return judging.draw_measured(canvas, x, measured)
            case MeasuredImpedance(), None, None:
                return judging.draw_measured(canvas, None, x)
            case Fit(), _, _:
                why = "this fit does not know its recording: plot(fit, recording, driver)."
                if x.of_impedance:
                    why = f"{x.without_source('plot')}."
                raise TypeError(f'{why} plot({{"skin": fit}}) draws its impedance alone')
            case Selection(), _, _:
                raise TypeError(
                    "to draw a selection, pass its recording and driver: "
                    "plot(selection, recording, driver)"
                )
            case Recording(), None, None:
                return pulses.draw_recording(canvas, x)
            case Fits(), None, None if map is not None:
                places = FINGERTIP if layout is None else layout
                places = places if isinstance(places, Layout) else read_layout(places)
                return maps.draw_map(canvas, x, map, places)
            case Fits(), None, None:
                return elements.draw_fits(canvas, x, by or ("subject", "condition"))
            case Posterior(), None, None:
                return elements.draw_posterior(canvas, x)
            case Profile(), None, None:
                return elements.draw_profile(canvas, x)
            case Residual(), None, None:
                return residuals.draw_residual(canvas, x)
            case Bound(), None, None:
                return elements.draw_bounds(canvas, [x])
            case ((Driver() | SourceImpedance() | AbstractCircuit()), None, None):
                name = type(x).__name__ if isinstance(x, AbstractCircuit) else "Z_th"
                return impedances.draw_bode(canvas, {name: x})
            case dict(), None, None if x and all(isinstance(y, Bound) for y in x.values()):
                return elements.draw_bounds(canvas, list(x.values()))
            case dict(), None, None if x and all(isinstance(y, Impedance) for y in x.values()):
                return impedances.draw_bode(canvas, x)
    given = " with ".join(_kind(one) for one in (x, recording, driver) if one is not None)
    raise TypeError(
        f"cannot draw {given}; plot takes a Recording, a Fit or Selection "
        "with its recording and driver, a Driver alone or with a calibration, a circuit, Fits, a "
        "Posterior, a Profile, a Residual, a Bound, a dictionary of bounds, or a dictionary of "
        "drivers, fits and circuits"
    )


def _kind(x: Any) -> str:
    """The type of an argument, and those of the values of a dictionary."""
    if not isinstance(x, dict):
        return type(x).__name__
    inside = ", ".join(sorted({type(value).__name__ for value in x.values()}))
    return f"a dictionary of {inside or 'nothing'}"
