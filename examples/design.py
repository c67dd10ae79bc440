"""A design by the gradient of the Cramer-Rao bound: width of the pulse and known resistor."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import scipy

import etid

jax.config.update("jax_enable_x64", True)
usual = etid.scenes.paper_dry(bits=None)
trial, calibration = usual.trials[0], usual.calibration[0]
noise = usual.waveform().sigma  # [V], for every pulse


def error(q):
    width, ohm = jnp.exp(q)
    driver = dataclasses.replace(usual.driver, width=width)
    known = dataclasses.replace(calibration, load=etid.scenes.ResistorLoad(ohm))
    of = {"trials": (trial,), "calibration": (known,), "driver": driver}
    scene = dataclasses.replace(usual, **of)
    bound = etid.bound(scene)[trial.path].relative["r_s"]
    return jnp.log(bound * noise / scene.waveform().sigma)


start = np.log([usual.driver.width, calibration.load.r])
by_gradient = jax.jit(jax.value_and_grad(error))
found = scipy.optimize.minimize(by_gradient, start, jac=True, method="BFGS")
for name, q in {"usual": start, "found": found.x}.items():
    width, ohm = np.exp(q)
    at = f"pulse {1e6 * width:.0f} µs, resistor {ohm / 1e3:.1f} kΩ"
    print(f"{name}: {at}, R_s ± {100 * np.exp(error(q)):.3f} %")
