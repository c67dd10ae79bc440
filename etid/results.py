import jax.numpy as jnp


def rrse(predicted, measured):
    r = predicted - measured
    return jnp.sqrt(jnp.sum(r**2) / jnp.sum((measured - measured.mean()) ** 2))
