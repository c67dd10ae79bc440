"""Score tests of elements that were not fitted together with Z_th on harmonics.

The score tests of `etid.estimators.score_tests.other_circuit`, for elements from another criterion:
Steiglitz-McBride, or output error in time. Z_th varies within its covariance. The elements need not
be at a minimum, because the part of the residual that they could still explain is projected out.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Complex, Float

from etid.circuits.circuit import AbstractCircuit
from etid.estimators.maximum_likelihood.condensed import apart
from etid.estimators.maximum_likelihood.profile import Profile, excess
from etid.estimators.sandwich import Linear
from etid.estimators.score_tests import other_circuit
from etid.estimators.unknowns import LoadUnknowns
from etid.results.driver import ContinuousDriver
from etid.signals.harmonics import Spectrum, real_parts, signal_share
from etid.signals.transfer import as_complex, frequency_variable, reciprocal, turns
from etid.solvers.matrices import root


def scores(
    spectrum: Spectrum,
    own: LoadUnknowns,
    sample_rate: Float[Array, ""],
    circuit: AbstractCircuit,
    driver: ContinuousDriver,
) -> other_circuit.Scores:
    """Scores of another circuit.

    Args:
        spectrum: The recording.
        own: Unknowns of the load.
        sample_rate: Its sampling rate [Hz].
        circuit: The circuit with these elements.
        driver: Its driver.
    """
    f, elements = spectrum.frequency, own.log_elements.size
    s = frequency_variable(f)
    vector, unflatten = ravel_pytree(driver.source)
    deviations = root(driver.later_cov()).T

    def along(
        function: Callable[[Float[Array, " q"]], Complex[Array, " harmonic"]],
        at: Float[Array, " q"],
        directions: Float[Array, "direction q"],
    ) -> Complex[Array, "direction harmonic"]:
        return jax.vmap(lambda of: jax.jvp(function, (at,), (of,))[1])(directions)

    def load(log_values: Float[Array, " element"]) -> Complex[Array, " harmonic"]:
        return circuit.with_log_values(log_values).impedance()(s)

    def of_gain(_) -> tuple[Complex[Array, " harmonic"], Complex[Array, "slope harmonic"]]:
        """The gain, and its derivatives with respect to all parameters and changes."""
        z_th = unflatten(vector).response(f)
        z, changes = other_circuit.changes(circuit.impedance(), f)
        total = reciprocal(z + z_th)
        g = z * total * turns(-f[0] * own.delay_samples / sample_rate, f.size)
        by_load = g * z_th * total * reciprocal(z)
        by_source = along(lambda p: unflatten(p).response(f), vector, deviations)
        by_own = [
            by_load[None, :] * along(load, own.log_elements, jnp.eye(elements)),
            (-g * s * as_complex(1 / sample_rate))[None, :],
        ]
        slopes = [*by_own, (-g * total)[None, :] * by_source, by_load[None, :] * changes]
        return g, jnp.concatenate(slopes)

    g, slopes = apart(of_gain, own.vector())

    def of_residual(_) -> tuple[Float[Array, "slope part"], Float[Array, " part"]]:
        # At the X estimated from both records: the noise of one record is in the residual too.
        profile = Profile.of_output(spectrum, g)
        rows = slopes * (-profile.x * as_complex(jnp.sqrt(profile.weight[0])))[None, :]
        share = signal_share(profile.x, profile.variance_x)
        return real_parts(rows), jnp.tile(share, 2)

    rows, share = apart(of_residual, own.vector())
    count = elements + 1 + vector.size
    prior = jnp.diag(jnp.pad(jnp.ones(vector.size), (elements + 1, 0)))
    part = Profile.of_output(spectrum, g).terms[0]
    linear = Linear(rows[:count], share, excess(part, spectrum.selected), prior)
    found = other_circuit.scores(
        rows[count:],
        linear,
        part,
        jnp.zeros(count),
        prior,
        linear.bread(),
        slice(elements),
    )
    return other_circuit.Scores.of(found)
