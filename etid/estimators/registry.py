"""The estimators by name, and the default estimator of a recording."""

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
_DESCRIPTIONS: dict[str, Description] = {}  # of methods that do not fit single recordings


def register(estimator: AbstractEstimator) -> None:
    """Add an estimator under its name. `method`, files of fits and reports then know the name.

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
    """Add the text of a methods section for fits whose `method` is this name."""
    _DESCRIPTIONS[name] = description


def names() -> tuple[str, ...]:
    """The names of all estimators."""
    return tuple(_ESTIMATORS)


def named(method: str) -> AbstractEstimator:
    """The estimator of a name and options, as `str(estimator)` writes them.

    Raises:
        ValueError: No estimator has this name, or the estimator has no such options.
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
    """The description of the method of a fit; None if the name is not registered."""
    if method in _DESCRIPTIONS:
        return _DESCRIPTIONS[method]
    try:
        return named(method).describe()
    except ValueError:
        return None


def estimator_of(
    method: Method | None, circuit: AbstractCircuit | None = None
) -> AbstractEstimator | None:
    """The requested estimator; None if `method` is None, so that each recording gets its default.

    Raises:
        ValueError: No estimator has this name, or the estimator cannot identify this circuit.
    """
    require_float64()
    if method is None:
        return None
    estimator = method if isinstance(method, AbstractEstimator) else named(str(method))
    if circuit is not None:
        estimator.check_circuit(circuit)
    return estimator


def check_default(estimator: AbstractEstimator, circuit: AbstractCircuit) -> None:
    """Raise ValueError if the default estimator cannot identify this circuit."""
    try:
        estimator.check_circuit(circuit)
    except ValueError as error:
        raise ValueError(
            "the record holds less than two whole pulse periods or begins in a pulse, or its "
            f"driver was identified without harmonics; {str(error).partition(';')[0]}. Record "
            "three periods or more and identify the driver with method='maximum_likelihood', or "
            "ask for method='maximum_likelihood', whose standard errors do not include the "
            "effect of aliases in a single period"
        ) from error


def for_calibrations(
    asked: AbstractEstimator | None, recordings: Sequence[Inspected]
) -> AbstractEstimator:
    """The requested estimator, or the default estimator of calibrations.

    The default is maximum likelihood if all records hold several periods. Otherwise it is output
    error. If aliases and harmonics cannot be separated, as in a single period, the bias of maximum
    likelihood exceeds its standard errors.
    """
    if asked is not None:
        return asked
    several = all(separates_aliases(*seen.periods) and seen.is_periodic for seen in recordings)
    return MAXIMUM_LIKELIHOOD if several else OUTPUT_ERROR


def for_samples(driver: Driver, periods: tuple[int, int]) -> AbstractEstimator:
    """The default estimator of arrays with this number of whole periods and samples."""
    several = isinstance(driver, HarmonicDriver) and separates_aliases(*periods)
    return MAXIMUM_LIKELIHOOD if several else OUTPUT_ERROR


def plan(
    asked: AbstractEstimator | None, seen: Inspected, driver: Driver
) -> tuple[AbstractEstimator, str | None]:
    """The estimator of a load, and the verdict that excludes a fit; None if it can be fitted.

    Raises:
        ValueError: The estimator cannot use this driver.
    """
    name = preflight(seen, periodic=asked is not None and asked.lane.periodic)
    estimator = asked or OUTPUT_ERROR
    if name is None and isinstance(driver, HarmonicDriver):
        estimator = for_calibrations(asked, [seen])
    estimator.check_driver(driver, seen.recording.sample_rate, seen.recording.pulse_rate)
    return estimator, name
