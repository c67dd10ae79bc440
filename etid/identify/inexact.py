"""The smooth error δ of the gain that a fit allowed for, by frequency."""

import numpy as np
from jaxtyping import Float

from etid.estimators.lanes import Harmonics
from etid.estimators.maximum_likelihood.rows import calibrated, loads_of, source_of
from etid.identify.posterior import Known
from etid.likelihood.approximate import approximated, departs
from etid.likelihood.search import minimum
from etid.likelihood.starts import starts
from etid.precision import array_function, one_thread
from etid.results.fit import Fit


@one_thread()
@array_function
def discrepancy(fit: Fit, lane: Harmonics, known: Known) -> Float[np.ndarray, " harmonic"]:
    """Standard deviation of |δ| at each harmonic; 0 where noise explains the residual.

    Args:
        fit: The fit.
        lane: Its harmonics.
        known: What is known besides.
    """
    driver = source_of(known.driver), fit.circuit, known.elements, calibrated(known.driver)
    load = loads_of([lane], *driver)
    every = starts(load)
    least = minimum(load, every, float(known.driver.aside))
    # Of fits in a file, the verdict alone says it, and not that of a successful one.
    if not (fit.inexact or departs(load, least.near).any()):
        return np.zeros(load.records.x.shape[-1])
    of = approximated(load, least, every[0]).load.gains.discrepancy
    assert of is not None
    return np.sqrt(2 * ((of.root[0].T @ of.splines) ** 2).sum(0))  # of two equal parts
