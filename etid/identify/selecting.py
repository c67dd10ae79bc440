"""The choice between circuits for one recording, and for several recordings with one driver."""

import itertools
import reprlib
from collections.abc import Iterable, Mapping, Sequence

import jax.numpy as jnp
import numpy as np

from etid.circuits.circuit import AbstractCircuit
from etid.estimators.registry import Method
from etid.identify.arguments import given_circuit
from etid.identify.impedance import identify_impedance
from etid.identify.one import candidate_fits, successful
from etid.identify.options import Interval, Options
from etid.precision import in_float64
from etid.recordings.recording import Recording, RecordingError
from etid.results.driver import Driver
from etid.selection.search import usual_circuits
from etid.selection.selection import Selection

FREQUENCY = np.geomspace(1.0, 1e7, 57)  # [Hz], where two impedances are compared
EQUAL = 1e-6  # relative difference of two impedances that are equal; a fit reaches 1e-9


@in_float64
def select_circuit(
    recording: Recording,
    driver: Driver | None = None,
    *,
    candidates: Sequence[AbstractCircuit | str] | None = None,
    method: Method | None = None,
    fixed: Mapping[str, float] | None = None,
    prior: Mapping[str, tuple[float, float]] | None = None,
    bounds: Mapping[str, Interval] | None = None,
    throw: bool = True,
) -> Selection:
    """The simplest circuit that a recording supports.

    The search fits the first candidate. It goes on to all that are not simpler if score tests show
    a change that the circuit cannot make, and to simpler ones if an element is hardly determined.
    The evidence is −BIC = 2 log L − p ln n, for p elements and n real numbers in the data (Schwarz
    1978). A candidate that is contradicted by the data, or that has elements which the data do not
    determine, is chosen only if there is no other. Differences below 2 do not count; then the
    circuit with the fewest elements is chosen, of those the first.

    Args:
        recording: Unloaded and loaded voltage.
        driver: As in `identify_skin`.
        candidates: Circuits or circuit strings, the most usual one first. If None: `SkinRC`,
            `ParallelRC`, `Resistor`, `SkinCole`, `SkinLayers`, `SkinWarburg`.
        method: An estimator that computes a likelihood, `"maximum_likelihood"`; the default for
            records of several whole periods.
        fixed: As in `identify_skin`; every candidate must have these elements.
        prior: As in `identify_skin`; every candidate must have these elements.
        bounds: As in `identify_skin`; each candidate is fitted inside the bounds of its elements.
        throw: Raise an error if the verdict of the chosen circuit is not successful.

    Returns:
        The chosen fit, and evidence, verdict and elements of each candidate. If several circuits
        are likely, the standard errors of the chosen fit contain the difference between them.

    Raises:
        RecordingError: There is no candidate, one of them is no circuit, or no data can tell two of
            them apart.
        ValueError: The method cannot use this driver, or cannot compare circuits, or a known
            element is no element of a candidate.
        IdentificationError: The verdict is not successful and `throw` is set.
    """
    circuits = usual_circuits() if candidates is None else checked(candidates)
    options = Options.of(circuits, method=method, fixed=fixed, prior=prior, bounds=bounds)
    fits, chosen = candidate_fits(recording, driver, options)
    selection = Selection.of(fits, chosen, circuits)
    if throw:
        successful(recording, selection.fit)
    return selection


def checked(candidates: Iterable[AbstractCircuit | str]) -> tuple[AbstractCircuit, ...]:
    """The candidates.

    Raises:
        RecordingError: There is no candidate, one of them is no circuit, or no data can tell two of
            them apart.
    """
    if isinstance(candidates, AbstractCircuit | str) or not isinstance(candidates, Iterable):
        raise RecordingError(
            f"is {reprlib.repr(candidates)}, must be several circuits",
            field="candidates",
            remedy="Pass a list, as in [etid.SkinRC(), etid.SkinCole()]",
        )
    found = tuple(
        given_circuit(f"candidates[{number}]", one) for number, one in enumerate(candidates)
    )
    if not found:
        raise RecordingError(
            "is empty", field="candidates", remedy="Pass a list, as in [etid.SkinRC()]"
        )
    for one, other in itertools.combinations(found, 2):
        if _are_equal(one, other):
            raise RecordingError(
                f"holds {type(one).__name__} and {type(other).__name__}, which have the same "
                "impedance: no data can tell them apart",
                field="candidates",
                remedy="Leave one of them out",
            )
    return found


def _are_equal(one: AbstractCircuit, other: AbstractCircuit) -> bool:
    """Whether each circuit can have the impedance that the other has at its typical values."""
    if type(one) is type(other):
        return True
    if len(one.names()) != len(other.names()):
        return False
    return _imitates(one, other) and _imitates(other, one)


def _imitates(one: AbstractCircuit, other: AbstractCircuit) -> bool:
    z = np.asarray(other.response(jnp.asarray(FREQUENCY)))
    fit = identify_impedance(FREQUENCY, z, stderr=np.abs(z), circuit=one, throw=False)
    return float(fit.rrse) < EQUAL
