"""Score tests of elements that were not fitted together with Z_th on harmonics.

The score tests of `etid.estimators.score_tests.other_circuit`, for elements from another criterion:
Steiglitz-McBride, or output error in time. Z_th varies within its covariance. The elements need not
be at a minimum, because the part of the residual that they could still explain is projected out.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from etid.circuits.circuit import AbstractCircuit
from etid.estimators.maximum_likelihood.calibrations import Calibrations
from etid.estimators.maximum_likelihood.condensed import means
from etid.estimators.maximum_likelihood.given_driver import around
from etid.estimators.maximum_likelihood.load import Load, changes
from etid.estimators.maximum_likelihood.profile import Records
from etid.estimators.sandwich import Linear
from etid.estimators.score_tests import other_circuit
from etid.estimators.unknowns import LoadUnknowns
from etid.results.driver import HarmonicDriver
from etid.signals.harmonics import Spectrum
from etid.solvers.matrices import root


def scores(
    spectrum: Spectrum,
    own: LoadUnknowns,
    sample_rate: Float[Array, ""],
    circuit: AbstractCircuit,
    driver: HarmonicDriver,
) -> other_circuit.Scores:
    """Scores of another circuit.

    Args:
        spectrum: The recording.
        own: Unknowns of the load.
        sample_rate: Its sampling rate [Hz].
        circuit: Structure of the circuit.
        driver: Its driver.
    """
    calibrations, deviations = Calibrations.of(driver), root(driver.later_cov())
    common, count = calibrations.start(), deviations.shape[1]
    directions = jnp.pad(deviations, ((0, common.size - count), (0, 0)))
    z, unit = jnp.zeros(count), jnp.eye(count)
    known = around(calibrations, common, directions, spectrum.frequency, False, z, unit)
    load = Load.behind(known, circuit, Records.of(spectrum), sample_rate)
    q = jnp.concatenate([own.vector(), z])
    near = load.near(q)
    profile, elements = near.profile, own.log_elements.size
    values = jnp.stack([profile.share[None], profile.excess(load.records)])
    prior = jnp.diag(jnp.pad(jnp.ones(count), (elements + 1, 0)))
    share, noise = means([profile], load.knots, values)
    linear = Linear(near.jacobian, share, noise, prior)
    found = other_circuit.scores(
        near.condensed.rows(changes(load, near)),
        linear,
        near.condensed.part,
        jnp.zeros_like(q),
        prior,
        linear.bread(),
        slice(elements),
    )
    return other_circuit.Scores.of(found, gain=True)._replace(gain=None)
