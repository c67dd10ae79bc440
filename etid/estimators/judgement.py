"""Limits of verdicts, and the distance of an estimate from the minimum of its model."""

from jaxtyping import Float

from etid.likelihood.linear import NormalEquations
from etid.results.verdicts import verdict
from etid.signals.transfer import AnyArray
from etid.solvers.matrices import inverse

# Inherited from lineax; the type checker does not see them as members of our class.
SUCCESSFUL = verdict("successful")
MAX_STEPS_REACHED = verdict("max_steps_reached")
# Increase of the calibrations' sum of squares in a joint fit. Its distribution is chi-squared. The
# degrees of freedom are at most the number of parameters of Z_th and the delays. With 12 degrees of
# freedom the increase exceeds this value once in ten thousand.
STRAINED = 39.0
BIASED = 16.0  # squared standard errors from an estimate to the minimum of its model


def distance_to_minimum(equations: NormalEquations) -> Float[AnyArray, ""]:
    """Squared distance to the minimum [standard errors squared]."""
    return equations.gradient @ inverse(equations.matrix) @ equations.gradient
