"""A likelihood profile by hand: the best fit for each R_s, by Newton's steps on all others."""

import jax
import jax.numpy as jnp
import numpy as np

import etid

jax.config.update("jax_enable_x64", True)
study = etid.read("data_schema/example.h5")
driver = etid.identify_driver(study["calibration/98k8"], order=5)
one = study["typical/damp/01"]
likelihood = etid.Likelihood.of(one.v_th, one.v_out, driver, sample_rate=200e3, pulse_rate=60.0)


@jax.jit
def profile(log_r_s):
    q = jnp.asarray(likelihood.start()).at[0].set(log_r_s)
    for _ in range(6):
        slopes, r = jax.jacfwd(likelihood.residual)(q)[:, 1:], likelihood.residual(q)
        q = q.at[1:].add(-jnp.linalg.lstsq(slopes, r)[0])
    return 0.5 * jnp.sum(likelihood.residual(q) ** 2)


fit = likelihood.fit()
r_s, error = float(fit.circuit.r_s), float(fit.stderr.r_s)
for away in (-2.0, -1.0, 0.0, 1.0, 2.0):
    rise = 2 * (profile(np.log(r_s + away * error)) - profile(np.log(r_s)))
    print(f"{away:+.0f} standard errors: -2 ln L rises by {rise:.2f} (normal: {away**2:.0f})")
