"""The estimators by name, and which one a recording needs if none was asked for."""

import ast
import dataclasses
from collections.abc import Sequence

from etid.circuits.circuit import AbstractCircuit
from etid.estimators.estimator import AbstractEstimator, Description
from etid.estimators.harmonic_steiglitz_mcbride.estimator import HarmonicSteiglitzMcBride
from etid.estimators.maximum_likelihood.estimator import MaximumLikelihood
from etid.estimators.non_parametric.estimator import NonParametric
from etid.estimators.output_error.estimator import OutputError
from etid.estimators.steiglitz_mcbride.estimator import EquationError, SteiglitzMcBride
from etid.recordings.preflight import Inspected, preflight
from etid.results.driver import Driver, HarmonicDriver
from etid.signals.harmonics import separates_aliases
from etid.signals.precision import require_float64

Method = str | AbstractEstimator  # a name in the registry, or an estimator with its options
MAXIMUM_LIKELIHOOD = MaximumLikelihood()
OUTPUT_ERROR = OutputError()

_ESTIMATORS: dict[str, AbstractEstimator] = {}
_DESCRIPTIONS: dict[str, Description] = {}  # of what is no estimator of single recordings


def register(estimator: AbstractEstimator) -> None:
    """Make an estimator known by its name, for `method`, files of fits and reports.

    Raises:
        ValueError: Another estimator has this name.
    """
    if estimator != _ESTIMATORS.setdefault(estimator.name, estimator):
        raise ValueError(f"{estimator.name} is the name of {_ESTIMATORS[estimator.name]!r}")


for _estimator in (
    MAXIMUM_LIKELIHOOD,
    NonParametric(),
    OUTPUT_ERROR,
    HarmonicSteiglitzMcBride(),
    SteiglitzMcBride(),
    EquationError(),
):
    register(_estimator)


def register_description(name: str, description: Description) -> None:
    """Say for a methods section what fits are whose `method` is this name."""
    _DESCRIPTIONS[name] = description


def names() -> tuple[str, ...]:
    """The names of all estimators."""
    return tuple(_ESTIMATORS)


def named(method: str) -> AbstractEstimator:
    """The estimator that a text names, as `str(estimator)` writes it.

    Raises:
        ValueError: There is none of this name, or it has no such option.
    """
    name, _, options = method.partition("(")
    if name not in _ESTIMATORS:
        raise ValueError(f"method {method!r} is not known; use one of {', '.join(names())}")
    if not options:
        return _ESTIMATORS[name]
    try:
        call = ast.parse(f"dict({options}", mode="eval").body
        keywords = call.keywords if isinstance(call, ast.Call) else []
        given = {str(one.arg): ast.literal_eval(one.value) for one in keywords}
        return dataclasses.replace(_ESTIMATORS[name], **given)
    except (SyntaxError, ValueError, TypeError, RecursionError) as error:
        raise ValueError(f"method {method!r}: {name} has no such options") from error


def described(method: str) -> Description | None:
    """The description of the method that a fit names; None if no module has registered it."""
    if method in _DESCRIPTIONS:
        return _DESCRIPTIONS[method]
    try:
        return named(method).describe()
    except ValueError:
        return None


def estimator_of(
    method: Method | None, circuit: AbstractCircuit | None = None
) -> AbstractEstimator | None:
    """The estimator that was asked for; None if the recordings are to choose.

    Raises:
        ValueError: There is no such estimator, or it cannot identify this circuit.
    """
    require_float64()
    if method is None:
        return None
    estimator = method if isinstance(method, AbstractEstimator) else named(str(method))
    if circuit is not None:
        estimator.check_circuit(circuit)
    return estimator


def check_default(estimator: AbstractEstimator, circuit: AbstractCircuit) -> None:
    """Raise ValueError if the estimator that was chosen cannot identify this circuit."""
    try:
        estimator.check_circuit(circuit)
    except ValueError as error:
        raise ValueError(
            "the record holds less than two whole pulse periods or begins in a pulse, or its "
            f"driver was identified without harmonics; {str(error).partition(';')[0]}. Record "
            "three periods or more and identify the driver with method='maximum_likelihood', or "
            "ask for method='maximum_likelihood': in a single period its standard errors leave "
            "out what aliases do"
        ) from error


def for_calibrations(
    asked: AbstractEstimator | None, recordings: Sequence[Inspected]
) -> AbstractEstimator:
    """The estimator asked for, or else maximum likelihood if all records hold several periods.

    Where aliases cannot be told from harmonics, as in a single period, it would be biased by more
    than its errors say.
    """
    if asked is not None:
        return asked
    several = all(separates_aliases(*seen.periods) and seen.is_periodic for seen in recordings)
    return MAXIMUM_LIKELIHOOD if several else OUTPUT_ERROR


def for_samples(driver: Driver, periods: tuple[int, int]) -> AbstractEstimator:
    """The estimator for bare arrays of so many whole periods and samples."""
    several = isinstance(driver, HarmonicDriver) and separates_aliases(*periods)
    return MAXIMUM_LIKELIHOOD if several else OUTPUT_ERROR


def plan(
    asked: AbstractEstimator | None, seen: Inspected, driver: Driver
) -> tuple[AbstractEstimator, str | None]:
    """The estimator for a load, and the verdict that forbids to fit it, if there is one.

    Raises:
        ValueError: The driver cannot serve it.
    """
    name = preflight(seen, periodic=asked is not None and asked.lane.periodic)
    estimator = asked or OUTPUT_ERROR
    if name is None and isinstance(driver, HarmonicDriver):
        estimator = for_calibrations(asked, [seen])
    estimator.check_driver(driver, seen.recording.sample_rate, seen.recording.pulse_rate)
    return estimator, name
