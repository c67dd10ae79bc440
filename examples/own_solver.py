"""The likelihood in solvers of others: optimistix, and jaxopt beside it."""

import jax
import jax.numpy as jnp
import jaxopt
import numpy as np
import optimistix as optx

import etid

jax.config.update("jax_enable_x64", True)
study = etid.read("data_schema/example.h5")
driver = etid.identify_driver(study["calibration/98k8"], order=5)
recording = study["typical/dry/01"]
likelihood = etid.Likelihood.of(
    recording.v_th, recording.v_out, driver, sample_rate=200e3, pulse_rate=60.0
)
start = jnp.asarray(likelihood.start())

dogleg = optx.Dogleg(rtol=1e-10, atol=1e-10)
one = optx.least_squares(lambda q, _: likelihood.residual(q), dogleg, start).value
other = jaxopt.GaussNewton(likelihood.residual).run(start).params
for name, q in (("optimistix", one), ("jaxopt", other)):
    print(f"{name}: {np.array(likelihood.circuit(q).values())}")
print(f"etid: {likelihood.fit().circuit.values()}")
