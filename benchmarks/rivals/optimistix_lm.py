"""Stock optimistix `LevenbergMarquardt`, compiled: harmonics, errors in both records, delays fitted.

The residuals are in standard deviations: where they are small numbers, it ends without a step.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

from benchmarks.rivals.records import (
    driver_misfit,
    driver_starts,
    harmonics,
    skin_misfit,
    source_impedance,
)

jax.config.update("jax_enable_x64", True)
SOLVER = optx.LevenbergMarquardt(rtol=1e-8, atol=1e-8)
STEPS = 500


def driver(v_th, v_out, r_load, fs, f0):
    """Parameters of Z_th of order 5, and R_L."""
    of = harmonics(v_th, v_out, fs, f0)
    fits = [_fit(driver_misfit, start, of) for start in driver_starts(of)]
    misfits = [float(jnp.sum(driver_misfit(q, *of, numpy=jnp) ** 2)) for q, _ in fits]
    return fits[int(np.nanargmin(misfits))][0], r_load


def skin(v_th, v_out, model, start, fs, f0):
    """Elements, and whether optimistix calls its result successful."""
    q, r_load = model
    of = harmonics(v_th, v_out, fs, f0)
    z_th = r_load * source_impedance(np.asarray(q), of.f)
    q, ok = _fit(skin_misfit, np.append(np.log(start), 0.0), (*of, z_th))
    return np.exp(np.asarray(q)[:3]), bool(ok)


@functools.partial(jax.jit, static_argnums=0)
def _fit(misfit, start, of):
    fit = optx.least_squares(
        lambda q, of: misfit(q, *of, numpy=jnp), SOLVER, start, of, max_steps=STEPS, throw=False
    )
    return fit.value, fit.result == optx.RESULTS.successful
