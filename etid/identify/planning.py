"""Reading and inspection of many recordings: which can be fitted, and why the others cannot."""

from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

from etid.estimators.estimator import AbstractEstimator
from etid.identify.arguments import Asked, plan
from etid.identify.one import explained
from etid.recordings.preflight import Group, Inspected
from etid.recordings.recording import Recording, RecordingError
from etid.results.feed import AbstractFeed
from etid.results.fits import IdentificationError
from etid.results.verdicts import message

TOGETHER = 600_000  # samples that are inspected together; their arrays take tens of MB
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
    rows: Iterable[int],
    asked: Asked,
) -> Iterator[tuple[int, Planned | Refusal]]:
    """Each recording with its driver and its estimator, or the reason why it cannot be fitted.

    Recordings of equal length and rates are inspected together.

    Args:
        load: Reads a recording and its driver.
        rows: Numbers of the recordings; the order of the results may differ.
        asked: What the caller asks for.
    """
    loaded: dict[tuple[int, str, float, float], list[tuple[int, Recording, AbstractFeed]]] = {}
    for row in rows:
        try:
            of, driver = load(row)
        except ERRORS as error:
            yield row, _refusal(error)
        else:
            key = of.samples["v_out"].stored.size, of.cause, of.sample_rate, of.pulse_rate
            loaded.setdefault(key, []).append((row, of, driver))
    for (size, *_), alike in loaded.items():
        together = max(1, TOGETHER // max(1, size))
        for first in range(0, len(alike), together):
            part = alike[first : first + together]
            group = Group([of for _, of, _ in part])
            for number, (row, of, driver) in enumerate(part):
                yield row, _planned(Inspected(of, group, number), driver, asked)


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
