"""Standard errors of an impedance from the covariance of its parameters."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float


def log_stderr(
    response: Callable[[Float[Array, " parameter"]], Complex[Array, " frequency"]],
    values: Float[Array, " parameter"],
    cov: Float[Array, "parameter parameter"],
) -> Float[Array, "2 frequency"]:
    """Standard errors of ln |Z| and of the phase [rad], to first order.

    var = J cov Jᵀ,    J = ∂(ln |Z|, arg Z) / ∂parameters

    Args:
        response: Impedance at all frequencies [Ω] as a function of the parameters.
        values: Parameters at which the response is linearised.
        cov: Covariance of the parameters.
    """

    def parts(p: Float[Array, " parameter"]) -> Float[Array, "2 frequency"]:
        log_z = jnp.log(response(p))
        return jnp.stack([log_z.real, log_z.imag])

    slope = jax.jacfwd(parts)(values)
    return jnp.sqrt(jnp.einsum("cfi,ij,cfj->cf", slope, cov, slope))
