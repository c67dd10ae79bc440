"""A network of equinox, trained by optax, corrects the Z_th of a driver of too low order."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax

import etid

jax.config.update("jax_enable_x64", True)
study = etid.read("data_schema/example.h5")
record = study["calibration/98k8"]
driver = etid.identify_driver(record, order=3, throw=False)  # the transformer has five poles
x, y = (np.fft.rfft(of)[3:1000:3] for of in (record.v_th, record.v_out))  # three periods
f = 60.0 * np.arange(1, x.size + 1)
z_th, place = driver.response(f), np.log(f)[:, None] - 8.0


def error(network):
    ratio = jax.vmap(network)(place)
    z = z_th * jnp.exp(ratio[:, 0] + 1j * ratio[:, 1])
    return jnp.linalg.norm(y - x * 98.8e3 / (98.8e3 + z)) / np.linalg.norm(y)


@eqx.filter_jit
def step(network, state):
    gradient = eqx.filter_grad(error)(network)
    updates, state = adam.update(gradient, state)
    return eqx.apply_updates(network, updates), state


network = eqx.nn.MLP(1, 2, 16, 2, jax.nn.tanh, key=jax.random.key(0))
network = jax.tree.map(lambda leaf: 0.3 * leaf if eqx.is_array(leaf) else leaf, network)
adam = optax.adam(optax.cosine_decay_schedule(1e-2, 2000))
state, before = adam.init(eqx.filter(network, eqx.is_array)), float(driver.rrse)
for _ in range(2000):
    network, state = step(network, state)
print(f"left of V_out: {100 * before:.2f} % by three poles, {100 * error(network):.2f} % corrected")
