"""lmfit's `minimize` (leastsq) on the harmonics: errors in both records, delays fitted."""

import numpy as np
from lmfit import (  # pyright: ignore[reportMissingImports]  # in its own environment
    Parameters,
    minimize,
)

CALLS = 4000  # of the residuals; a fit of the driver needs some hundreds


def fit(misfit, start, arguments):
    """Minimum, and whether lmfit says that it succeeded."""
    unknown = Parameters()
    for i, value in enumerate(start):
        unknown.add(f"q_{i}", value=value)

    def residual(parameters):
        return misfit(_values(parameters), *arguments)

    # A trial step to NaN is one to reject; lmfit's own policy would end the fit there.
    found = minimize(residual, unknown, max_nfev=CALLS, nan_policy="propagate")
    return _values(found.params), found.success


def _values(parameters):
    return np.array([one.value for one in parameters.values()])
