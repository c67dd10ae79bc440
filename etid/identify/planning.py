"""Reading and inspection of many recordings: which can be fitted, and why the others cannot."""

import itertools
from collections.abc import Callable, Iterator
from typing import NamedTuple

from etid.estimators.estimator import AbstractEstimator
from etid.identify.arguments import Asked, plan
from etid.identify.unfitted import explained
from etid.recordings.preflight import Group, Inspected
from etid.recordings.recording import Recording, RecordingError
from etid.results.feed import AbstractFeed
from etid.results.fit import IdentificationError
from etid.results.verdicts import message

TOGETHER = 600_000  # samples that are inspected together; their arrays take tens of MB
FEWEST = 16  # recordings that are read at once, however long they are
MOST = 64  # recordings that are read at once if they are short; many more save little time
ERRORS = (RecordingError, ValueError, IdentificationError)  # that a recording or a driver may raise


class Refusal:
    """A recording that cannot be fitted: the name of its verdict and a note."""

    def __init__(self, name: str, note: str = "") -> None:
        self.name = name
        self.note = note or message(name)


class Planned(NamedTuple):
    """A recording that can be fitted, with its driver and its estimator."""

    seen: Inspected
    driver: AbstractFeed
    estimator: AbstractEstimator


def planned(
    load: Callable[[int], tuple[Recording, AbstractFeed]],
    rows: Iterator[int],
    asked: Asked,
) -> Iterator[tuple[int, Planned | Refusal]]:
    """Some recordings with their drivers and estimators, or the reason why they cannot be fitted.

    Recordings of equal length and rates are inspected together. At least `FEWEST` recordings are
    taken from `rows`, and up to `MOST` as long as they have no more than `TOGETHER` samples.

    Args:
        load: Reads a recording and its driver.
        rows: Numbers of the recordings; the order of the results may differ.
        asked: What the caller asks for.
    """
    loaded: dict[tuple[int, str, float, float], list[tuple[int, Recording, AbstractFeed]]] = {}
    held = 0
    for number, row in enumerate(itertools.islice(rows, MOST), 1):
        try:
            of, driver = load(row)
        except ERRORS as error:
            yield row, _refusal(error)
        else:
            key = of.samples["v_out"].stored.size, of.cause, of.sample_rate, of.pulse_rate
            loaded.setdefault(key, []).append((row, of, driver))
            held += key[0]
            if number >= FEWEST and held + key[0] > TOGETHER:
                break
    for (size, *_), alike in loaded.items():
        together = max(1, TOGETHER // max(1, size))
        for first in range(0, len(alike), together):
            part = alike[first : first + together]
            group = Group([of for _, of, _ in part])
            for number, (row, of, driver) in enumerate(part):
                yield row, _planned(Inspected(of, group, number), driver, asked)


def calls(count: int) -> range:
    """Numbers of the calls of `planned` that take `count` recordings; the last may take none."""
    return range(-(-count // FEWEST))


def _planned(seen: Inspected, driver: AbstractFeed, asked: Asked) -> Planned | Refusal:
    try:
        estimator, name = plan(asked, seen, driver)
    except ERRORS as error:
        return _refusal(error)
    return (
        Planned(seen, driver, estimator) if name is None else Refusal(name, explained(seen, name))
    )


def _refusal(error: Exception) -> Refusal:
    return Refusal(
        "driver_failed" if isinstance(error, IdentificationError) else "unreadable", str(error)
    )
