"""What the residual of a fit looks like, from the scores of the changes that it lacks."""

import numpy as np

from etid.recordings.remarks import Remark
from etid.results.fit import Fit

SEEN = 3.0  # standard deviations; below, the residual does not look like any of the changes
_SLOW, _FAST = 2, 3  # number of relaxations at either end of the band


def looks_like(fit: Fit) -> str:
    """A sentence on the largest score; empty if the residual looks like none of the changes.

    Args:
        fit: One fit.
    """
    if fit.verdict == "changed":
        return fit.changes
    if int(fit.remarks) & Remark.mains_hum:
        return "The residual looks like mains hum."
    if fit.support is None:
        return ""
    z = np.nan_to_num(np.asarray(fit.support.z, float))
    # A negative relaxation, or a spread above that of a capacitor, is not passive. A gain has no
    # sign that it must have.
    z = np.append(np.maximum(z[:-1], 0.0), np.abs(z[-1]))
    if z.max() < SEEN:
        return ""
    worst, last = int(np.argmax(z)), z.size - 1
    if worst == 0:
        what = "a spread of time constants that the circuit cannot make"
    elif worst == last:
        what = "another gain of v_out than of v_th"
    elif worst <= _SLOW:
        what = "one more slow relaxation, a slow tail after each pulse"
    elif worst >= last - _FAST:
        what = (
            "one more fast relaxation at the edges of each pulse, of the load or of the driver "
            "(a higher order)"
        )
    else:
        what = "one more relaxation in the middle of the band"
    return f"The residual looks like {what} ({z[worst]:.0f} standard deviations)."
