"""Fits of one's own arrays: `vmap`, `lax.map` and `shard_map`, with their times."""

import time

import jax
import jax.numpy as jnp
import numpy as np

import etid

jax.config.update("jax_enable_x64", True)
study = etid.scenes.paper_dry(snr_db=60.0).simulate(seed=0)
driver = etid.identify_driver(study["calibration/98k8"], order=5)
trials = [study[f"typical/dry/{number:02d}"] for number in range(1, 11)]
both = [jnp.stack([getattr(one, name) for one in trials]) for name in ("v_th", "v_out")]
P = jax.sharding.PartitionSpec
mesh = jax.make_mesh((1,), ("row",), axis_types=(jax.sharding.AxisType.Auto,))


def fit(v_th, v_out):
    of = etid.Likelihood.of(v_th, v_out, driver, sample_rate=200e3, pulse_rate=60.0)
    return of.fit().circuit.values()


ways = {
    "vmap": jax.jit(jax.vmap(fit)),
    "lax.map": jax.jit(lambda *of: jax.lax.map(lambda one: fit(*one), of, batch_size=5)),
    "shard_map": jax.jit(
        jax.shard_map(
            jax.vmap(fit), mesh=mesh, in_specs=P("row"), out_specs=P("row"), check_vma=False
        )
    ),
    "NumPy, nothing compiled": lambda *of: fit(*map(np.asarray, of)),
}
for name, way in ways.items():
    times = []
    for _ in range(2):
        start, found = time.perf_counter(), np.asarray(way(*both))
        times.append(time.perf_counter() - start)
    print(f"{name}: first {times[0]:.2f} s, again {1e3 * times[1] / len(trials):.1f} ms a fit")
    np.testing.assert_allclose(found.mean(0), [33.4e3, 186e3, 0.12e-9], rtol=0.01)
