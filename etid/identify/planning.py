"""Reading and inspection of recordings: which can be fitted, and why the others cannot."""

import itertools
from collections.abc import Callable, Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from etid.estimators.element_limits import limited, of_circuit
from etid.estimators.estimator import AbstractEstimator
from etid.identify import changes
from etid.identify.options import Options, plan
from etid.recordings.causes import why_implausible, why_misaligned
from etid.recordings.preflight import Group, Inspected, preflight
from etid.recordings.recording import Recording, RecordingError
from etid.results.feed import AbstractFeed
from etid.results.fit import Fit, IdentificationError, Support
from etid.results.verdicts import message, verdict

TOGETHER = 600_000  # samples that are inspected together; their arrays take tens of MB
FEWEST = 16  # recordings that are read at once, however long they are
MOST = 64  # recordings that are read at once if they are short; many more save little time
ERRORS = (RecordingError, ValueError, IdentificationError)  # that a recording or a driver may raise
# Verdicts whose message says more of a recording.
EXPLAINED = ("rate_mismatch", "misaligned", "wrong_unit", "flat", "nonfinite_samples")


def explained(seen: Inspected, name: str) -> str:
    """The message of a verdict of `etid.recordings.preflight`, with the numbers found."""
    found = ""
    if seen.by_current is not None and name in EXPLAINED and preflight(seen) != name:
        seen = seen.by_current  # the fault is in the current
    if name == "rate_mismatch":
        found = seen.train.mismatch
    elif name == "misaligned":
        found = why_misaligned(seen)
    elif name == "wrong_unit":
        found = why_implausible(seen.by_current or seen)
    elif name in ("flat", "nonfinite_samples"):
        found = f"The fault is in {' and '.join(_faulty(seen, name))}."
    return f"{found} {message(name)}".strip()


def _faulty(seen: Inspected, name: str) -> list[str]:
    """Names of the records that are flat, or that hold numbers that are not finite."""
    records = seen.recording.cause, "v_out"
    if name == "flat":
        faults = seen.is_flat
    else:
        faults = [not np.isfinite(seen.recording.samples[one].values).all() for one in records]
    return [one for one, fault in zip(records, faults, strict=True) if fault]


def failed_fit(name: str, options: Options, method: str) -> Fit:
    """A fit without numbers, for a recording that was not fitted."""
    circuit = options.circuit
    size = len(circuit.names())
    nan = np.full((size, size), np.nan)
    empty = circuit.with_log_values(jnp.full(size, jnp.nan))
    scalar = np.asarray(np.nan)
    none = changes.unknown(size)
    fit = Fit(
        circuit=empty,
        cov=nan,
        shared_cov=nan,
        rrse=scalar,
        chi2=scalar,
        result=verdict(name),
        steps=np.asarray(0),
        method=method,
        change=none.size,
        change_stderr=none.stderr,
        support=Support.unknown(size),
        limits=limited(circuit, of_circuit(options.bounds, circuit)),
    )
    return jax.tree.map(np.asarray, fit)


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
    options: Options,
) -> Iterator[tuple[int, Planned | Refusal]]:
    """Some recordings with their drivers and estimators, or the reason why they cannot be fitted.

    Recordings of equal length and rates are inspected together. At least `FEWEST` recordings are
    taken from `rows`, and up to `MOST` as long as they have no more than `TOGETHER` samples.

    Args:
        load: Reads a recording and its driver.
        rows: Numbers of the recordings; the order of the results may differ.
        options: What the caller asks for.
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
                yield row, _planned(Inspected(of, group, number), driver, options)


def calls(count: int) -> range:
    """Numbers of the calls of `planned` that take `count` recordings; the last may take none."""
    return range(-(-count // FEWEST))


def _planned(seen: Inspected, driver: AbstractFeed, options: Options) -> Planned | Refusal:
    try:
        estimator, name = plan(options, seen, driver)
    except ERRORS as error:
        return _refusal(error)
    return (
        Planned(seen, driver, estimator) if name is None else Refusal(name, explained(seen, name))
    )


def _refusal(error: Exception) -> Refusal:
    return Refusal(
        "driver_failed" if isinstance(error, IdentificationError) else "unreadable", str(error)
    )
