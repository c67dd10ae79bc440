"""The estimators by name; `etid.estimators.estimator` states what an estimator must provide."""

import dataclasses

from etid.estimators.estimator import AbstractEstimator, Description
from etid.estimators.maximum_likelihood.estimator import MaximumLikelihood
from etid.estimators.output_error import OutputError
from etid.estimators.steiglitz_mcbride.estimator import SteiglitzMcBride
from etid.results.method_options import options_of

Method = str | AbstractEstimator  # a name in the registry, or an estimator with its options
MAXIMUM_LIKELIHOOD = MaximumLikelihood()
WITH_CURRENT = MaximumLikelihood(with_current=True)
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


for _estimator in (MAXIMUM_LIKELIHOOD, OUTPUT_ERROR, SteiglitzMcBride()):
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
    name = method.partition("(")[0]
    if name not in _ESTIMATORS:
        raise ValueError(f"method {method!r} is not known; use one of {', '.join(names())}")
    try:
        return dataclasses.replace(_ESTIMATORS[name], **options_of(method)[1])
    except (ValueError, TypeError) as error:
        raise ValueError(f"method {method!r}: {name} has no such options") from error


def described(method: str) -> Description | None:
    """The description of the method of a fit; None if the name is not registered."""
    if method in _DESCRIPTIONS:
        return _DESCRIPTIONS[method]
    try:
        return named(method).describe()
    except ValueError:
        return None
