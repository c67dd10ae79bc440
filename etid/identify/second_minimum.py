"""The second minimum that a load may have behind a driver whose resonance is not known.

One known resistor determines Z_th and the trigger delay of its record together. If the driver
resonates above half the sample rate, a record of a load then has two explanations: another Z_th
with another delay, and so other elements. Each is a minimum of the likelihood, up to 25 standard
errors from the other, and both may be equally likely. A search finds one of them. A second search,
from another delay, finds the other one. A second resistor, or a stated delay, leaves only one.
"""

import dataclasses

import numpy as np
from jaxtyping import Float

from etid.circuits.directions import SEEN
from etid.estimators.lanes import replaced, taken
from etid.results.fit import Fit
from etid.results.verdicts import verdicts_of

ASIDE = 0.2  # samples from the first start to the second; the minima are 0.1 to 0.17 apart


def likelier(first: Fit, second: Fit) -> Fit:
    """For each recording the fit of two searches with the smaller deviance.

    If the other minimum cannot be excluded, the verdict of a successful fit is `driver_unclear`.

    Args:
        first: Fits of the recordings, stacked.
        second: The same from starts that are `ASIDE` later.
    """
    less = _deviance(second) - _deviance(first)
    rows = np.flatnonzero(less < 0).tolist()
    kept = replaced(first, rows, taken(second, rows)) if rows else first
    moved = np.abs(np.asarray(second.circuit.values()) - np.asarray(first.circuit.values()))
    # Two searches that end in one minimum differ by at most 0.2 standard errors.
    apart = (moved > 2.0 * np.asarray(kept.stderr.values())).any(axis=1)
    unclear = apart & (np.abs(less) < SEEN**2) & kept.usable
    names = np.where(unclear, "driver_unclear", kept.verdict)
    return dataclasses.replace(kept, result=verdicts_of(names))


def _deviance(fits: Fit) -> Float[np.ndarray, " recording"]:
    """Deviance of each fit; a large number if its search did not settle."""
    assert fits.support is not None
    settled = np.isfinite(fits.support.deviance) & (fits.verdict != "max_steps_reached")
    return np.where(settled, fits.support.deviance, 1e30)
