"""The quiet parts of records of whole periods, and a window that leaves only these.

A period has `BLOCKS` parts. The edges of pulses, and what follows them, change from sample to
sample by more than the noise: these parts are loud. The window is 0 there and smooth. It repeats in
each period, so that a periodic signal remains periodic.
"""

import functools
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float, Int

from etid.signals.harmonics import namespace

BLOCKS = 128
LOUD = 4.0  # power of the differences of a loud part, relative to that of quiet parts
PULSED = 30.0  # the same of the edges of a pulse; the crests of a multisine stay below
QUIET = 0.1  # mean of a window that leaves enough of a record
EDGE = 8  # half of the parts over which the window rises
FINE = 64  # points from part to part between which the window is a straight line, to 1e-6


class _Places(NamedTuple):
    """Where the parts of records of one length are.

    Attributes:
        at: First sample of each part of each period.
        point: Point of the window before each sample.
        beyond: Place of each sample between this point and the next one, 0 to 1.
    """

    at: Int[np.ndarray, " part"]
    point: Int[np.ndarray, " time"]
    beyond: Float[np.ndarray, " time"]


@functools.lru_cache(maxsize=16)
def _places(periods: int, samples: int) -> _Places:
    length = samples / (periods * BLOCKS)
    at = np.minimum(np.rint(np.arange(periods * BLOCKS) * length), samples - 2).astype(int)
    place = (np.arange(samples) / length - 0.5) * FINE  # points are counted from a part's centre
    point = np.floor(place).astype(int)
    return _Places(at, point % (BLOCKS * FINE), place - point)


def changes(
    v: Float[Array | np.ndarray, "*record time"], periods: int
) -> Float[Array | np.ndarray, "*record period part"]:
    """Sum of the squares of the differences of samples in each part."""
    xp, change = namespace(v), namespace(v).diff(v)
    change *= change
    change = xp.add.reduceat(change, _places(periods, v.shape[-1]).at, axis=-1)
    return change.reshape(*change.shape[:-1], periods, BLOCKS)


def are_loud(
    changes: Float[Array | np.ndarray, "*record period part"],
) -> Bool[Array | np.ndarray, "*record part"]:
    """Which parts of a period change by more than the noise, by the median of the periods."""
    xp = namespace(changes)
    change = xp.sort(changes, axis=-2)[..., changes.shape[-2] // 2, :]
    usual = xp.sort(change, axis=-1)[..., [BLOCKS // 4]]
    # Without much louder parts nothing shows that the rest is quiet.
    pulsed = xp.max(change, axis=-1, keepdims=True) > PULSED * usual
    return (change > LOUD * usual) & pulsed


def window_of(
    loud: Bool[Array | np.ndarray, "*record part"], periods: int, samples: int
) -> tuple[Float[Array | np.ndarray, "*#record time"], Float[Array | np.ndarray, "*#record 1"]]:
    """The windows of records with these loud parts, and their mean squares.

    A window is 1 everywhere if too little would be left. Records with the same parts share one.
    """
    if not isinstance(loud, np.ndarray):
        return _window(loud, periods, samples)
    known = [one.tobytes() for one in loud]
    known = known[:1] if len(set(known)) == 1 else known  # most records are alike
    windows, kept = zip(*(_known(one, periods, samples) for one in known), strict=True)
    return (
        (windows[0][None], kept[0][None])
        if len(known) == 1
        else (np.stack(windows), np.stack(kept))
    )


@functools.lru_cache(maxsize=64)
def _known(
    loud: bytes, periods: int, samples: int
) -> tuple[Float[np.ndarray, " time"], Float[np.ndarray, "1"]]:
    window, kept = _window(np.frombuffer(loud, bool), periods, samples)
    return np.asarray(window), np.asarray(kept)


def _rise(place: Float[np.ndarray, "*place"]) -> Float[np.ndarray, "*place"]:
    """A raised cosine from 0 to 1, over 2 `EDGE` parts around 0."""
    turn = np.clip(place / (2 * EDGE), -0.5, 0.5)
    return turn + 0.5 + np.sin(2 * np.pi * turn) / (2 * np.pi)


# What each part beside a point gives to the window there, if it is far from all loud parts.
_BESIDE = np.arange(-EDGE, EDGE + 2)
_NEAR = (np.arange(BLOCKS)[:, None] + _BESIDE) % BLOCKS
_AWAY = np.arange(FINE) / FINE - _BESIDE[:, None]
_SHARES = _rise(_AWAY + 0.5) - _rise(_AWAY - 0.5)


def _window(
    loud: Bool[Array | np.ndarray, "*record part"], periods: int, samples: int
) -> tuple[Float[Array | np.ndarray, "*record time"], Float[Array | np.ndarray, "*record 1"]]:
    """0 in loud parts, 1 from 2 `EDGE` parts beside them, and a raised cosine between."""
    xp, places = namespace(loud), _places(periods, samples)
    far = xp.where(loud[..., _NEAR[:, :-1]].any(-1), 0.0, 1.0)
    points = (far[..., _NEAR] @ _SHARES).reshape(*loud.shape[:-1], -1)
    rise = xp.roll(points, -1, axis=-1) - points
    window = points[..., places.point] + places.beyond * rise[..., places.point]
    window = xp.where(xp.mean(window, axis=-1)[..., None] > QUIET, window, 1.0)
    return window, xp.vecdot(window, window)[..., None] / samples
