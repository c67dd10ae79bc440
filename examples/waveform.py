"""The waveform at the terminal, and its derivatives by the elements.

The paper's discrete filters: Z_bio by the bilinear map (eq. 7), Z_th likewise, and the divider of
both from V_th to V_out.
"""

import jax
import jax.numpy as jnp
import numpy as np

import etid

jax.config.update("jax_enable_x64", True)
study = etid.read("data_schema/example.h5")
driver = etid.identify_driver(study["calibration/98k8"], order=5)
recording = study["typical/dry/01"]
z_th = etid.Filter.bilinear(driver.source, 200e3)


@jax.jit
def v_out(circuit):
    z_bio = etid.Filter.bilinear(circuit, 200e3)
    return z_bio.divider(z_th).simulate(jnp.asarray(recording.v_th))[0]


skin = jax.tree.map(jnp.asarray, etid.SkinRC(33.4e3, 186e3, 0.12e-9))
slopes = jax.jacfwd(v_out)(skin)
for name in skin.names():
    volts = getattr(slopes, name) * getattr(skin, name) / 100  # for one per cent of the element
    print(f"{name}: {1e3 * np.abs(volts).max():.0f} mV at most for one per cent")
