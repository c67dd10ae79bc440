"""A prior of one's own: correlated normals of the logarithms, as of a former study."""

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

import etid

jax.config.update("jax_enable_x64", True)
study = etid.scenes.paper_damp(snr_db=24.0).simulate(seed=1)
driver = etid.identify_driver(study["calibration/98k8"], order=5)
one = study["typical/damp/01"]
likelihood = etid.Likelihood.of(one.v_th, one.v_out, driver, sample_rate=200e3, pulse_rate=60.0)

mean = jnp.log(jnp.array([6.2e3, 17e3, 0.64e-9]))
root = jnp.linalg.cholesky(jnp.array([[0.02, 0.01, 0.0], [0.01, 0.03, -0.01], [0.0, -0.01, 0.02]]))


def residual(q, _):
    own = jax.scipy.linalg.solve_triangular(root, q[:3] - mean, lower=True)
    return jnp.concatenate([likelihood.residual(q), own])


start = jnp.asarray(likelihood.start()).at[:3].set(mean)
solver = optx.LevenbergMarquardt(rtol=1e-9, atol=1e-9)
q = optx.least_squares(residual, solver, start).value
slopes = jax.jacfwd(residual)(q, None)
stderr = jnp.sqrt(jnp.diag(jnp.linalg.inv(slopes.T @ slopes)))[:3]
alone = likelihood.fit()
for name, one, error in (
    ("without", alone.circuit, alone.stderr.values() / alone.circuit.values()),
    ("with", likelihood.circuit(q), stderr),
):
    print(f"{name}: {np.array(one.values())}, ± {np.round(100 * np.array(error))} %")
