"""Loads fitted as rows of arrays, by `etid.likelihood`, behind a driver that is given."""

from collections.abc import Sequence

import jax
import numpy as np

from etid.circuits.circuit import AbstractCircuit
from etid.estimators.element_limits import Limits
from etid.estimators.element_prior import ElementPrior
from etid.estimators.lanes import Harmonics, HarmonicsWithCurrent
from etid.estimators.maximum_likelihood.given_driver import GivenDriver
from etid.estimators.maximum_likelihood.verdict import judged
from etid.likelihood.fit import fit
from etid.likelihood.gains import Gains, Voltage, VoltageAndCurrent
from etid.likelihood.profile import Records
from etid.likelihood.search import ROWS, Load
from etid.likelihood.shared import Calibrated, Unloaded
from etid.likelihood.source import Errors, Source, Tolerances
from etid.likelihood.source_prior import DELAY_WIDTH
from etid.likelihood.starts import starts
from etid.likelihood.unloaded import differs
from etid.numpy_tier.algebra import one_thread
from etid.precision import array_function
from etid.results.feed import AbstractFeed
from etid.results.fit import Fit
from etid.results.instrument import Instrument
from etid.signals.harmonics import same_unloaded


def source_of(known: GivenDriver) -> Source:
    """The driver for the likelihood of rows."""
    known = jax.tree.map(np.asarray, known)
    errors, tolerances, of = None, None, known.errors
    if of is not None:
        stated = np.asarray((of.told or Instrument()).budgeted())
        errors = Errors(of.at, of.by_z, of.unstated, of.direct, of.drift, stated)
    if known.faults is not None:
        bending = np.zeros(()), np.zeros(known.mean.size)
        if of is not None:
            bending = of.at[-1], of.by_z[:, -1]
        tolerances = Tolerances(*known.faults, known.bend, *bending)
    loaded = None if known.by_current else known.loaded
    numbers = known.w_slope, known.slope, known.resistance, known.mean, known.cov
    return Source(known.frequency, loaded, *numbers, known.delay_width, tolerances, errors)


def calibrated(known: GivenDriver) -> Calibrated | None:
    """The calibrations that may share their unloaded record with a load; None without any."""
    of = known.records
    if of is None or known.gains is None or known.gain_slopes is None:
        return None
    numbers = of.x, of.y, of.variance_y, of.selected, known.gains, known.gain_slopes
    return Calibrated(*map(np.asarray, numbers))


def loads_of(
    lanes: Sequence[Harmonics],
    source: Source,
    circuit: AbstractCircuit,
    prior: ElementPrior | None,
    shared: Calibrated | None,
) -> Load:
    """The recordings, all of equal length and rates."""

    def stacked(name: str) -> np.ndarray:
        return np.stack([np.asarray(getattr(lane, name)) for lane in lanes])

    y, variance_y, used = (stacked(name)[:, None] for name in ("y", "variance_y", "selected"))
    frequency, outputs = stacked("frequency"), Voltage()
    if isinstance(lanes[0], HarmonicsWithCurrent) and source.loaded is not None:
        outputs = VoltageAndCurrent()
        y = np.concatenate([y, stacked("i")[:, None]], axis=1)
        variance_y = np.concatenate([variance_y, stacked("variance_i")[:, None]], axis=1)
        used = np.repeat(used, 2, axis=1)
    records = Records(frequency, stacked("x"), stacked("variance_x"), y, variance_y, used)
    gains = Gains(source, circuit, frequency, float(lanes[0].sample_rate), outputs)
    unloaded = None
    if shared is not None and shared.x.shape[-1] == records.x.shape[-1]:
        same = [[bool(same_unloaded(x, one)) for one in shared.x] for x in records.x]
        unloaded = Unloaded.by(shared, records, np.array(same))
    count = gains.elements
    own = np.zeros(count), np.full(count, np.inf)
    if prior is not None:
        own = np.asarray(prior.centre), np.asarray(prior.width)
    others = np.full(gains.outputs.count - 1, DELAY_WIDTH)
    z = np.ones(source.mean.size)
    centre = np.concatenate([own[0], np.zeros(gains.outputs.count), source.mean])
    width = np.concatenate([own[1], [float(source.delay_width)], others, z])
    return Load(gains, records, centre, width, unloaded)


@one_thread()
@array_function
def fit_rows(
    lanes: Sequence[Harmonics],
    driver: AbstractFeed,
    known: GivenDriver,
    circuit: AbstractCircuit,
    method: str,
    prior: ElementPrior | None = None,
    bounds: Limits = (),
) -> list[Fit]:
    """The fits of recordings of equal length and rates, in chunks that are stacked."""
    source, shared, found = source_of(known), calibrated(known), []
    shape = None if known.shape is None else jax.tree.map(np.asarray, known.shape)
    for first in range(0, len(lanes), ROWS):
        load = loads_of(lanes[first : first + ROWS], source, circuit, prior, shared)
        estimate = fit(load, starts(load), float(known.aside))
        changed = np.zeros(len(load.records.x), bool)
        if shape is not None:
            changed = differs(shape, load.records)
        count = load.gains.elements
        told = np.exp(load.centre[:count]) if prior is None else np.asarray(prior.told)
        of = circuit, driver.result, changed, method, told, load.width[:count], bounds
        found.append(judged(estimate, *of))
    return found
