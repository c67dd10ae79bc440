"""Starts of the fit of one load that was recorded at several amplitudes.

To a pulse of the current I, a resistor R / (1 + |i| / I_0) looks like the resistance R_I with

    1 / R_I = 1 / R + I / (R I_0).

The records show R_I for each amplitude. A straight line gives R and I_0, even if R_I is far below R
in all of them. A linear fit of such a record would not do: it ends anywhere.
"""

import numpy as np
from jaxtyping import Float

from etid.circuits.circuit import impedance_tree
from etid.circuits.current_dependent import current_dependent
from etid.likelihood.linear import inverse
from etid.likelihood.load import Load
from etid.likelihood.profile import Records
from etid.likelihood.starts import starts as linear_starts
from etid.nonlinear.amplitudes import Amplitudes
from etid.nonlinear.balance import to_time
from etid.signals.transfer import power, reciprocal

# Of the other elements: those of the likeliest linear load are far too large.
LEVELS, TIMES = (1.0, 0.1), (1.0, 0.1, 0.01, 0.001)
STEP = 1e-5  # of the logarithm of an element, for the logarithms of R and I_0


def likeliest(of: Amplitudes) -> Float[np.ndarray, "record own"]:
    """The likeliest linear load for each record alone, without a delay, in the order of `Gains`."""
    spectra, source = of.spectra, of.recorded.source
    output = (each[:, None] for each in (spectra.y, spectra.variance_y, spectra.selected))
    records = Records(spectra.frequency, spectra.x, spectra.variance_x, *output)
    centre = np.concatenate([np.zeros(of.elements + 1), source.mean])
    width = np.where(np.arange(centre.size) < of.elements, np.inf, 1.0)
    load = Load(of.recorded.gains, records, centre, width)
    each = np.where(np.isinf(width), linear_starts(load), centre)
    found = load.objective(each)
    best = np.where(np.isfinite(found), found, np.inf).argmin(0)
    return each[best, np.arange(of.count)]


def starts(of: Amplitudes, alone: Float[np.ndarray, "record own"]) -> Float[np.ndarray, "start q"]:
    """Starts of a fit of all records, from the likeliest linear load of each of them alone."""
    logs = alone[:, : of.elements]
    if not of.recorded.is_linear:
        size = power(of.spectra.x).sum(-1)
        ends = logs[[size.argmin(), size.argmax()]]
        scales = np.log([[level, time] for level in LEVELS for time in TIMES])
        others = ends + (scales @ of.circuit.scaling())[:, None]
        logs = _moved(of, others.reshape(-1, of.elements), _line(*_seen(of, alone)))
    return of.start(logs if of.prior is None else of.prior.placed(logs))


def _seen(
    of: Amplitudes, alone: Float[np.ndarray, "record own"]
) -> tuple[Float[np.ndarray, " record"], Float[np.ndarray, " record"]]:
    """Current [A] and resistance [Ω] of each record: Σ |i|³ / Σ i² and Σ v i / Σ i²."""
    recorded, x, y = of.recorded, of.spectra.x, of.spectra.y
    i = x  # of all harmonics
    if recorded.source.loaded is not None:
        z = recorded.gains.split(alone)[2]
        z_th = recorded.source.z_loaded(recorded.gains.w(z)) - recorded.source.resistance
        i = (x - y) * reciprocal(z_th)
    points = 2 * x.shape[-1]
    i, v = (to_time(np.pad(one, ((0, 0), (1, 0))), points) for one in (i, y))
    squares = (i**2).sum(-1)
    return (np.abs(i) ** 3).sum(-1) / squares, (i * v).sum(-1) / squares


def _line(
    current: Float[np.ndarray, " record"], resistance: Float[np.ndarray, " record"]
) -> Float[np.ndarray, "2"]:
    """Ln R and ln I_0 that give the resistances at these currents best, in relative terms."""
    levels = np.geomspace(current.min() / 100, current.max() * 100, 200)  # of I_0
    small = np.maximum(resistance.max() * np.finfo(float).eps, resistance)
    logs = np.log(small) + np.log1p(current / levels[:, None])  # of R
    best = logs.var(1).argmin()
    return np.array([logs[best].mean(), np.log(levels[best])])


def _element(
    of: Amplitudes, logs: Float[np.ndarray, "*row element"]
) -> Float[np.ndarray, "*row 2"]:
    """Logarithms of R and I_0 of the resistor that depends on its current."""
    element = current_dependent(impedance_tree(of.circuit, logs))
    assert element is not None
    fields = (np.broadcast_to(field, (*logs.shape[:-1], 1)) for field in (element.r, element.i_0))
    return np.log(np.concatenate(list(fields), -1))


def _moved(
    of: Amplitudes, logs: Float[np.ndarray, "start element"], wanted: Float[np.ndarray, "2"]
) -> Float[np.ndarray, "start element"]:
    """The elements with the smallest change that gives the resistor this ln R and ln I_0."""
    steps = STEP * np.eye(logs.shape[-1])[:, None]
    by_logs = (_element(of, logs + steps) - _element(of, logs - steps)) / (2 * STEP)
    off = wanted - _element(of, logs)
    rows = np.moveaxis(by_logs, 0, -1)
    size = inverse(rows @ rows.swapaxes(-1, -2)) @ off[..., None]
    return logs + (rows.swapaxes(-1, -2) @ size)[..., 0]
