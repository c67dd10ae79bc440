"""SciPy `least_squares` (MINPACK) on the harmonics: errors in both records, delays fitted."""

import functools

from scipy.optimize import least_squares

from benchmarks.rivals import harmonic_fit

CALLS = 4000  # of the residuals; a fit of the driver needs some hundreds


def fit(misfit, start, arguments):
    """Minimum, and whether SciPy says that it converged."""
    found = least_squares(misfit, start, args=arguments, method="lm", x_scale="jac", max_nfev=CALLS)
    return found.x, found.success


driver = functools.partial(harmonic_fit.driver, fit)
skin = functools.partial(harmonic_fit.skin, fit)
