"""Stock optimistix LM, compiled: harmonics, errors in both records, delays fitted.

The residuals are in standard deviations: where they are small numbers, it ends without a step.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

jax.config.update("jax_enable_x64", True)
SOLVER = optx.LevenbergMarquardt(rtol=1e-8, atol=1e-8)
STEPS = 500


def fit(misfit, start, arguments):
    """Minimum, and whether optimistix calls its result successful."""
    q, ok = _compiled(misfit, start, arguments)
    return np.asarray(q), bool(ok)


@functools.partial(jax.jit, static_argnums=0)
def _compiled(misfit, start, arguments):
    found = optx.least_squares(
        lambda q, of: misfit(q, *of, numpy=jnp),
        SOLVER,
        start,
        arguments,
        max_steps=STEPS,
        throw=False,
    )
    return found.value, found.result == optx.RESULTS.successful
