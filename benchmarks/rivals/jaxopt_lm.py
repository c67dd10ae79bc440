"""jaxopt `LevenbergMarquardt`, compiled: harmonics, errors in both records, delays fitted.

It knows no failure but the last step: a step to NaN ends it as convergence does.
"""

import functools

import jax
import jax.numpy as jnp
import jaxopt
import numpy as np

from benchmarks.rivals.records import (
    driver_misfit,
    driver_starts,
    harmonics,
    skin_misfit,
    source_impedance,
)

jax.config.update("jax_enable_x64", True)
STEPS = 500


def driver(v_th, v_out, r_load, fs, f0):
    """Parameters of Z_th of order 5, and R_L."""
    of = harmonics(v_th, v_out, fs, f0)
    fits = [_fit(driver_misfit, start, of) for start in driver_starts(of)]
    misfits = [float(jnp.sum(driver_misfit(q, *of, numpy=jnp) ** 2)) for q, _ in fits]
    return fits[int(np.nanargmin(misfits))][0], r_load


def skin(v_th, v_out, model, start, fs, f0):
    """Elements, and whether jaxopt ended before its last step."""
    q, r_load = model
    of = harmonics(v_th, v_out, fs, f0)
    z_th = r_load * source_impedance(np.asarray(q), of.f)
    q, steps = _fit(skin_misfit, np.append(np.log(start), 0.0), (*of, z_th))
    return np.exp(np.asarray(q)[:3]), bool(steps < STEPS)


@functools.partial(jax.jit, static_argnums=0)
def _fit(misfit, start, of):
    solver = jaxopt.LevenbergMarquardt(
        lambda q, of: misfit(q, *of, numpy=jnp),
        maxiter=STEPS,
        stop_criterion="madsen-nielsen",
        xtol=1e-8,
        gtol=1e-8,
        solver="cholesky",
        materialize_jac=True,
    )
    found = solver.run(jnp.asarray(start), of)
    return found.params, found.state.iter_num
