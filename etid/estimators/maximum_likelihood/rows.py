"""Loads fitted as rows of arrays, by `etid.likelihood`, behind a driver that is given."""

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

from etid.circuits.circuit import AbstractCircuit
from etid.estimators.element_limits import Limits
from etid.estimators.element_prior import ElementPrior
from etid.estimators.lanes import Bins, Harmonics, HarmonicsWithCurrent, Held, stacked, taken
from etid.estimators.maximum_likelihood.given_driver import GivenDriver
from etid.estimators.maximum_likelihood.verdict import judged
from etid.likelihood.fit import Estimate, fit
from etid.likelihood.gains import Gains, Voltage, VoltageAndCurrent
from etid.likelihood.load import ROWS, Load
from etid.likelihood.profile import Records
from etid.likelihood.shared import Calibrated, Unloaded
from etid.likelihood.source import Errors, Source, Tolerances
from etid.likelihood.source_prior import DELAY_WIDTH
from etid.likelihood.starts import starts
from etid.likelihood.transient import Transient, ends, width_of
from etid.likelihood.unloaded import differs
from etid.precision import array_function, is_traced, namespace, one_thread
from etid.results.feed import AbstractFeed
from etid.results.fit import Fit
from etid.results.instrument import Instrument
from etid.signals.harmonics import same_unloaded
from etid.signals.hold import DELAY, NODES, images


def source_of(known: GivenDriver) -> Source:
    """The driver for the likelihood of rows."""
    errors, tolerances, of = None, None, known.errors
    if of is not None:
        stated = (of.told or Instrument()).budgeted()
        errors = Errors(of.at, of.by_z, of.unstated, of.direct, of.drift, stated)
    if known.faults is not None:
        bending = np.zeros(()), np.zeros(known.mean.size)
        if of is not None:
            bending = of.at[-1], of.by_z[:, -1]
        tolerances = Tolerances(*known.faults, known.bend, *bending)
    loaded = None if known.by_current else known.loaded
    numbers = known.w_slope, known.slope, known.resistance, known.mean, known.cov
    beyond = None if known.beyond is None else source_of(known.beyond)
    of_states = known.delay_width, tolerances, errors, known.decays, beyond
    return Source(known.frequency, loaded, *numbers, *of_states)


def calibrated(known: GivenDriver) -> Calibrated | None:
    """The calibrations that may share their unloaded record with a load; None without any."""
    of = known.records
    if of is None or known.gains is None or known.gain_slopes is None:
        return None
    return Calibrated(of.x, of.y, of.variance_y, of.selected, known.gains, known.gain_slopes)


@array_function
def load_of(
    lane: Harmonics,
    source: Source,
    circuit: AbstractCircuit,
    prior: ElementPrior | None,
    shared: Calibrated | None,
) -> Load:
    """One recording, or several with equal rates along leading axes."""
    xp, outputs = namespace(lane.x), Voltage()
    y, variance_y, used = (of[..., None, :] for of in (lane.y, lane.variance_y, lane.selected))
    if isinstance(lane, HarmonicsWithCurrent) and source.loaded is not None:
        outputs = VoltageAndCurrent()
        y = xp.stack([lane.y, lane.i], -2)
        variance_y = xp.stack([lane.variance_y, lane.variance_i], -2)
        used = xp.stack([lane.selected, lane.selected], -2)
    of_x, ignored = lane.noise_of_x
    records = Records(lane.frequency, lane.x, of_x, y, variance_y, used)
    unloaded = None
    if shared is not None and shared.x.shape[-1] == records.x.shape[-1]:
        same = same_unloaded(records.x[..., None, :], shared.x)
        unloaded = Unloaded.by(shared, records, same)
    rate, filters = lane.sample_rate.reshape(-1)[0], lane.filters
    gains = Gains(source, circuit, lane.frequency, rate, outputs, filters=filters)
    if isinstance(lane, Held):
        gains = held(gains, lane.x.shape[:-1])
    load = load_with(gains, records, prior, unloaded)
    load = dataclasses.replace(load, ignored=ignored)
    if not isinstance(lane, Bins):
        return load
    assert source.decays is not None
    first = lane.frequency.reshape(-1)[0]
    of = source.decays * first, ends(lane.x.shape[-1]) * (first / rate), width_of(y, used)
    transient = Transient(*of, behind=source.loaded is not None)
    if filters is not None:
        of_x = width_of(lane.x[..., None, :], used)[..., 0]
        transient = transient.filtered(filters, lane.frequency, of_x)
    if source.loaded is not None:  # one instrument records a current and its voltage, in volts
        transient = transient.disturbed(first)
    return dataclasses.replace(load, transient=transient)


def held(gains: Gains, rows: tuple[int, ...]) -> Gains:
    """The gains behind a command that a converter holds."""
    assert gains.source.beyond is not None
    place = gains.frequency.reshape(-1, gains.frequency.shape[-1])[0] / gains.sample_rate
    at = namespace(gains.frequency).broadcast_to(NODES * gains.sample_rate, (*rows, NODES.size))
    nodes = Gains(gains.source.beyond, gains.circuit, at, gains.sample_rate, gains.outputs)
    return dataclasses.replace(gains, images=images(place), nodes=nodes)


def load_with(
    gains: Gains,
    records: Records,
    prior: ElementPrior | None = None,
    unloaded: Unloaded | None = None,
) -> Load:
    """Recordings of any outputs, with the priors of elements, delays, corners and source."""
    source, count, delays = gains.source, gains.elements, gains.outputs.count
    xp, own = namespace(source.mean, source.delay_width), (np.zeros(count), np.full(count, np.inf))
    if prior is not None:
        own = prior.centre, prior.width
    # How little the delays of V_out scatter tells nothing about those of other outputs.
    of_delays = xp.reshape(source.delay_width, 1), np.full(delays - 1, DELAY_WIDTH)
    if gains.images is not None:
        of_delays = (np.full(delays, DELAY),)
    corners = gains.exact - gains.delays.stop  # [their standard deviations]
    centre = xp.concatenate([own[0], np.zeros(delays + corners), source.mean])
    width = xp.concatenate([own[1], *of_delays, np.ones(corners + source.mean.size)])
    return Load(gains, records, centre, width, unloaded, own=prior and prior.own)


def loads_of(lanes: Sequence[Harmonics], *of: Any) -> Load:
    """Recordings as rows; the other arguments are those of `load_of`."""
    return load_of(stacked(lanes), *of)


@array_function
def fit_one(
    lane: Harmonics,
    driver: AbstractFeed,
    known: GivenDriver,
    circuit: AbstractCircuit,
    method: str,
    prior: ElementPrior | None,
    bounds: Limits,
    accept: float,
) -> Fit:
    """The fit of a recording by JAX, which can transform it."""
    load = load_of(lane, source_of(known), circuit, prior, calibrated(known))
    found = fit(load, starts(load), known.aside)
    changed = False if known.shape is None else differs(known.shape, load.records)
    return judged(found, circuit, changed, driver.result, method, prior, bounds, accept)


def estimates(
    lanes: Sequence[Harmonics],
    known: GivenDriver,
    circuit: AbstractCircuit,
    prior: ElementPrior | None,
    inexact: bool,
) -> Iterator[tuple[Estimate, Bool[np.ndarray, " row"]]]:
    """Fits of recordings of equal length and rates without their verdicts, a few at a time.

    Beside each stands whether its unloaded voltage shows that the driver has changed. What a
    circuit leaves beyond noise becomes part of the fit if circuits may be `inexact`.
    """
    known = jax.tree.map(np.asarray, known)
    source, shared = source_of(known), calibrated(known)
    for first in range(0, len(lanes), ROWS):
        load = loads_of(lanes[first : first + ROWS], source, circuit, prior, shared)
        changed = np.zeros(len(load.records.x), bool)
        if known.shape is not None:
            changed = differs(known.shape, load.records)
        yield fit(load, starts(load), float(known.aside), inexact), changed


def fit_lane(lane: Harmonics, driver: AbstractFeed, known: GivenDriver, *of: Any) -> Fit:
    """The fit of a recording; JAX can transform it, without JAX it is a fit of one row."""
    if is_traced((lane, driver, known)):
        return fit_one(jax.tree.map(jnp.asarray, lane), driver, known, *of)
    return taken(fit_rows([lane], driver, known, *of)[0], 0)


@one_thread()
@array_function
def fit_rows(
    lanes: Sequence[Harmonics],
    driver: AbstractFeed,
    known: GivenDriver,
    circuit: AbstractCircuit,
    method: str,
    prior: ElementPrior | None,
    bounds: Limits,
    accept: float,
) -> list[Fit]:
    """The fits of recordings of equal length and rates, in chunks that are stacked."""
    of = driver.result, method, prior, bounds, accept
    every = estimates(lanes, known, circuit, prior, accept > 0)
    return [judged(found, circuit, changed, *of) for found, changed in every]
