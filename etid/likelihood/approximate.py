"""Fits of loads whose circuit leaves more than the noise: with what it leaves in the likelihood.

A residual that noise does not explain is smooth in frequency: condensed to the knots, it keeps its
squares, while those of noise become few. Such loads get a δ (`etid.likelihood.discrepancy`) of the
size that the data say (`etid.likelihood.restricted`), and are fitted anew. Weights of the noise
trust the strongest harmonics to 1e-4; an error of 0.2 % of the gain then costs 2 to 4 % in R_s and
C_p, with δ 0.4 to 0.7 % (`python -m benchmarks inexact`).

What no δ can make counts as noise of the same spectrum: its power is that of the squares which
parameters and any δ leave. Edges of a current that was commanded are not at its samples.
"""

import dataclasses
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float

from etid.likelihood import scores
from etid.likelihood.discrepancy import POWERS, Discrepancy, kernels, splines
from etid.likelihood.linear import taken
from etid.likelihood.load import Load, Near, of_load
from etid.likelihood.noise import SMOOTH, is_smooth
from etid.likelihood.restricted import Restricted, restricted, without
from etid.likelihood.search import Minimum, minimum, select

ORDINARY = 2 * POWERS.size + 1  # number of the kernel to begin with
ROUGH = 0.05  # part of the squares, which no δ explains; of smooth errors to 3 % it is 1e-3
FAR = 5e-3  # of the signal; the minimum of a circuit that leaves more may lie far away
# Likelihood ratio, from which on a change explains what a circuit leaves: of 200 smooth functions
# that have no name, the largest of all changes had 10.
SURE = 12.0
# Smaller one, from which on it does so if it also explains most of what δ explains: five of these
# 200 functions look so much like another relaxation. Two relaxations have 5 to 9 and 0.87.
LIKELY, MOST = 4.0, 0.8
# Part of it, which makes a change the cause whatever the ratio: a δ can do what one number does, if
# this number is so large that the change is not linear. Four of 740 smooth functions have more; at
# 80 dB Cole's skin with α = 0.8 has 0.96, two layers with 30 % in the second 0.94.
ALMOST_ALL = 0.9


class Approximation(NamedTuple):
    """Fits with δ.

    Attributes:
        load: The recordings, with δ among the parameters.
        least: The minima.
        explains: Whether each change of `etid.likelihood.scores.changes` explains what the circuit
            leaves.
        rough: Power of the noise, relative to what the recordings show (`roughness`).
        exact: The recordings without δ, with this noise.
        least_exact: Their minima.
    """

    load: Load
    least: Minimum
    explains: Mapping[str, Bool[np.ndarray, "row change"]]
    rough: Float[np.ndarray, " row"]
    exact: Load
    least_exact: Minimum


def approximated(load: Load, least: Minimum, start: Float[np.ndarray, "row q"]) -> Approximation:
    """Fits with δ.

    Args:
        load: Recordings without δ.
        least: Their minima.
        start: Other starts: weights of the noise may have led far away.
    """
    left, rough = _left(load, least.near), roughness(load, least.near)
    if (rough > 1).any():
        load = load.louder(rough)
        least = minimum(load, least.q[None])
    exact, near = (load, least), least.near
    harmonics = load.records.x.shape[-1]
    flat = kernels(harmonics)[ORDINARY]
    of = with_delta(load, left[:, None, None] ** 2 * flat)
    least = minimum(of, extended(of, near.q)[None])
    if (far := left > FAR).any():
        other = minimum(of, extended(of, start)[None])
        less = other.near.objective < least.near.objective
        least = select(far & less, other, least)
    near, changes = least.near, scores.changes(of, least.near)
    found = _restricted(of, near, changes, left)
    likely = (found.ratio > LIKELY) & (found.explained > MOST)
    explained = likely | (found.ratio > SURE) | (found.explained > ALMOST_ALL)
    ends = np.cumsum([one.shape[-3] for one in changes.values()])[:-1]
    explains = dict(zip(changes, np.split(explained, ends, -1), strict=True))
    before, of = of, with_delta(load, found.covariance)
    least = minimum(of, _nearest(of, before, near.q)[None])
    return Approximation(of, least, explains, rough, *exact)


def departs(load: Load, near: Near) -> Bool[np.ndarray, " row"]:
    """Whether circuits leave more than noise that some δ explains, near their minima without δ.

    No δ explains edges of a current that were not recorded where they are, or spikes.
    """
    smooth = is_smooth(near.condensed.part, load.gains.exact)
    if (rows := np.flatnonzero(smooth)).size:
        near = taken(near, rows)
        smooth[rows] = _is_smooth(near, _unexplained(load.of(rows), near)[0])
    return smooth


def roughness(load: Load, near: Near) -> Float[np.ndarray, " row"]:
    """Mean square of what neither parameters nor any δ explain, that of the noise being 1.

    It is 1 where noise or δ explains all.
    """
    left, count = _unexplained(load, near)
    # Beside the condensed terms, those of bins between two knots.
    every = left + 2 * near.profile.objective - (near.condensed.part**2).sum(-1)
    mean = every / np.maximum(load.records.terms - count, 1)
    return np.where(_is_smooth(near, left), 1.0, np.maximum(mean, 1.0))


def _is_smooth(near: Near, left: Float[np.ndarray, " row"]) -> Bool[np.ndarray, " row"]:
    """Whether these squares, which no δ explains, are nothing beside those that some δ does."""
    terms = near.condensed.part
    return left - SMOOTH * (terms != 0).sum(-1) < ROUGH * (terms**2).sum(-1)


def _unexplained(load: Load, near: Near) -> tuple[Float[np.ndarray, " row"], int]:
    """Squares of the condensed terms that no parameter and no δ explains; the number of these."""
    terms = near.condensed.part
    made = np.concatenate([_exact_rows(load, near.jacobian), _by_node(load, near)], 1)
    every = np.concatenate([np.nan_to_num(made), terms[:, None]], 1)
    return without(every @ every.swapaxes(-1, -2), made.shape[1])[:, 0, 0], made.shape[1]


def _left(load: Load, near: Near) -> Float[np.ndarray, " row"]:
    """What the circuit leaves beyond noise, relative to the signal."""
    terms, states = near.condensed.part, of_load(load, near)
    states = None if states is None else states[:, None]
    signal = near.condensed.rows(near.slopes.gains[:, None], states)[:, 0]
    beyond = (terms**2).sum(-1) - (terms != 0).sum(-1)
    return np.sqrt(np.maximum(beyond, 0.0) / (signal**2).sum(-1))


def with_delta(load: Load, covariance: Float[np.ndarray, "row node node"]) -> Load:
    """The recordings with a δ that has this covariance between the nodes; without their own."""
    delta = Discrepancy.of_covariance(load.records.x.shape[-1], covariance)
    gains = dataclasses.replace(load.gains, discrepancy=delta)
    of = without_delta(load, load.centre), without_delta(load, load.width)
    load = dataclasses.replace(load, gains=gains)
    return dataclasses.replace(load, centre=extended(load, of[0]), width=extended(load, of[1], 1.0))


def without_delta(
    load: Load, q: Float[np.ndarray, "*row every"]
) -> Float[np.ndarray, "*row exact"]:
    """Parameters without the coefficients of δ."""
    gains = load.gains
    return np.concatenate([q[..., : gains.exact], q[..., gains.owned :]], -1)


def extended(
    load: Load, q: Float[np.ndarray, "*row exact"], value: Float[np.ndarray, "*row c"] | float = 0.0
) -> Float[np.ndarray, "*row every"]:
    """Parameters with coefficients of δ."""
    gains = load.gains
    more = np.broadcast_to(value, (*q.shape[:-1], gains.owned - gains.exact))
    return np.concatenate([q[..., : gains.exact], more, q[..., gains.exact :]], -1)


def _nearest(load: Load, other: Load, q: Float[np.ndarray, "row every"]) -> np.ndarray:
    """Parameters whose δ is nearest to that of parameters with other functions."""
    delta, of = load.gains.discrepancy, other.gains.discrepancy
    assert delta is not None
    assert of is not None
    nodes = of.at_nodes(q[:, other.gains.exact : other.gains.owned])
    return extended(load, without_delta(other, q), delta.nearest(nodes))


def _restricted(
    load: Load,
    near: Near,
    changes: Mapping[str, Complex[np.ndarray, "row change output knot"]],
    left: Float[np.ndarray, " row"],
) -> Restricted:
    """What the restricted likelihood says near a point, of δ and of changes of the gains."""
    gains, outputs = load.gains, load.gains.outputs.count
    jacobian, terms = near.jacobian, near.condensed.part
    own = slice(gains.exact, gains.owned)
    terms = terms - (jacobian[:, own] * near.q[:, own, None]).sum(1)
    harmonics = load.records.x.shape[-1]
    of_changes = near.condensed.rows(np.concatenate(list(changes.values()), 1))
    known = np.concatenate([_exact_rows(load, jacobian), terms[:, None], of_changes], 1)
    told = load.told(near.q)
    pull = without_delta(load, told.gradient)
    precision = without_delta(load, without_delta(load, told.matrix).swapaxes(-1, -2))
    precision = np.broadcast_to(precision, (*pull.shape, pull.shape[-1]))
    of = known, _by_node(load, near), precision, pull, left
    # Numbers of a search that failed are none.
    known, unknown, precision, pull, left = (np.nan_to_num(one) for one in of)
    return restricted(known, unknown, precision, pull, left, harmonics, 2 * outputs)


def _by_node(load: Load, near: Near) -> Float[np.ndarray, "row node part"]:
    """By δ at the nodes: real parts of each output, then imaginary ones."""
    outputs = load.gains.outputs.count
    at = splines(load.records.x.shape[-1])[:, load.knots.index]
    unit = np.eye(outputs)[:, None, :, None] * at[:, None, :]  # output, node, output, knot
    unit = unit.reshape(-1, outputs, at.shape[-1])
    gains, states = near.slopes.gains[:, None] * unit, of_load(load, near)
    if states is not None:
        states = np.concatenate([states[:, None] * unit, 1j * states[:, None] * unit], 1)
    return near.condensed.rows(np.concatenate([gains, 1j * gains], 1), states)


def _exact_rows(
    load: Load, jacobian: Float[np.ndarray, "row every part"]
) -> Float[np.ndarray, "row exact part"]:
    return without_delta(load, jacobian.swapaxes(-1, -2)).swapaxes(-1, -2)
