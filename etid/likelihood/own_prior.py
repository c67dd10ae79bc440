"""A prior of one's own: any function of a circuit, whose terms join those of the likelihood."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from etid.circuits.circuit import AbstractCircuit
from etid.precision import namespace
from etid.signals.transfer import AnyArray

OwnPrior = Callable[[Any], Any]
"""A function of a circuit, whose elements are numbers: terms r of its prior [standard deviations];
ln p = constant - ½ Σ r²."""

STEP = 1e-5  # of the logarithms; slopes by central differences are then right to 1e-10


def terms_of(
    prior: OwnPrior, circuit: AbstractCircuit, logs: Float[AnyArray, "*row element"]
) -> Float[AnyArray, "*row term"]:
    """The terms of the prior at the logarithms of the elements."""
    if namespace(logs) is not np:
        traced = jnp.vectorize(_of_logs(prior, circuit, jnp), signature="(e)->(t)")
        return traced(logs)
    of, rows = _of_logs(prior, circuit, np), logs.reshape(-1, logs.shape[-1])
    return np.stack([of(row) for row in rows]).reshape(*logs.shape[:-1], -1)


def slopes_of(
    prior: OwnPrior, circuit: AbstractCircuit, logs: Float[AnyArray, "*row element"]
) -> Float[AnyArray, "*row term element"]:
    """Derivatives of the terms by the logarithms: of JAX, or by differences in NumPy."""
    if namespace(logs) is not np:
        of = jax.jacfwd(_of_logs(prior, circuit, jnp))
        return jnp.vectorize(of, signature="(e)->(t,e)")(logs)
    moved = logs[..., None, None, :] + STEP * np.array([[[1.0]], [[-1.0]]]) * np.eye(logs.shape[-1])
    upper, lower = np.moveaxis(terms_of(prior, circuit, moved), -3, 0)
    return (upper - lower).swapaxes(-1, -2) / (2 * STEP)


def _of_logs(prior: OwnPrior, circuit: AbstractCircuit, xp: Any) -> Callable[[AnyArray], AnyArray]:
    def call(logs: AnyArray) -> AnyArray:
        terms = xp.asarray(prior(circuit.of_fit(xp.exp(logs))), float)
        return terms.reshape(-1)

    return call
