"""What the residual of a fit looks like, from the scores of the changes that it lacks."""

import numpy as np
from jaxtyping import Float

SEEN = 3.0  # standard deviations; below, the residual does not look like any of the changes
SURE = 5.0  # standard deviations of a change of the circuit that is no chance
_SLOW, _FAST = 2, 3  # number of relaxations at either end of the band


def passive(z: Float[np.ndarray, " change"]) -> Float[np.ndarray, " change"]:
    """The scores of the changes that a passive circuit can make; 0 for all others.

    A negative relaxation, or a spread above that of a capacitor, is not passive. A gain has no sign
    that it must have.

    Args:
        z: `Support.z` of one fit.
    """
    z = np.nan_to_num(np.asarray(z, float))
    return np.append(np.maximum(z[:-1], 0.0), np.abs(z[-1]))


def looks_like(z: Float[np.ndarray, " change"]) -> str:
    """A sentence on the largest score; empty if the residual looks like none of the changes.

    Args:
        z: `Support.z` of one fit.
    """
    z = passive(z)
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


def is_of_circuit(z: Float[np.ndarray, " change"]) -> bool:
    """Whether the largest score is surely that of another circuit.

    A driver that changed looks like one more fast relaxation, and less spread than a capacitor has:
    so do all of 16 drivers with 30 % more leakage inductance at 40 dB.

    Args:
        z: `Support.z` of one fit.
    """
    z = passive(z)
    return bool(z.max() >= SURE and np.argmax(z) < z.size - 1 - _FAST)
