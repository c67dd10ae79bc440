"""The estimators by name; `etid.estimators.estimator` states what an estimator must provide."""

import ast
import dataclasses
import math

from etid.estimators.estimator import AbstractEstimator, Description
from etid.estimators.maximum_likelihood.estimator import MaximumLikelihood
from etid.estimators.non_parametric.estimator import NonParametric
from etid.estimators.output_error.estimator import OutputError
from etid.estimators.steiglitz_mcbride.estimator import EquationError, SteiglitzMcBride

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


for _estimator in (
    MAXIMUM_LIKELIHOOD,
    NonParametric(),
    OUTPUT_ERROR,
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
        given = {str(one.arg): ast.literal_eval(_Infinite().visit(one.value)) for one in keywords}
        return dataclasses.replace(_ESTIMATORS[name], **given)
    except (SyntaxError, ValueError, TypeError, RecursionError) as error:
        raise ValueError(f"method {method!r}: {name} has no such options") from error


class _Infinite(ast.NodeTransformer):
    """Reads `inf`, which is no literal of Python, as a number."""

    def visit_Name(self, node: ast.Name) -> ast.expr:
        """The number for the name `inf`; other names are left."""
        return ast.Constant(math.inf) if node.id == "inf" else node


def described(method: str) -> Description | None:
    """The description of the method of a fit; None if the name is not registered."""
    if method in _DESCRIPTIONS:
        return _DESCRIPTIONS[method]
    try:
        return named(method).describe()
    except ValueError:
        return None
