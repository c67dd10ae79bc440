"""SciPy `least_squares` (MINPACK) on the harmonics: errors in both records, delays fitted."""

from scipy.optimize import least_squares

CALLS = 4000  # of the residuals; a fit of the driver needs some hundreds


def fit(misfit, start, arguments):
    """Minimum, and whether SciPy says that it converged."""
    found = least_squares(misfit, start, args=arguments, method="lm", x_scale="jac", max_nfev=CALLS)
    return found.x, found.success
