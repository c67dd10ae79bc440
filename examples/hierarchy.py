"""A hierarchy over subjects in NumPyro, who share one driver: z of Z_th is common to all."""

import jax
import numpy as np
import numpyro
from numpyro.distributions import HalfNormal, Normal

import etid

jax.config.update("jax_enable_x64", True)
study = etid.read("data_schema/example.h5")
driver = etid.identify_driver(study["calibration/98k8"], order=5)
trials = [study[f"typical/dry/{number}"] for number in ("01", "02", "03")]
both = [np.stack([getattr(one, name) for one in trials]) for name in ("v_th", "v_out")]
likelihood = etid.Likelihood.of(*both, driver, sample_rate=200e3, pulse_rate=60.0)
start, count = likelihood.start(), len(trials)
own = np.linalg.inv(likelihood.information(start)[:, :4, :4])  # elements and delay, given z
root, typical = np.linalg.cholesky(own), np.log([30e3, 200e3, 0.1e-9])


def model():
    mean = numpyro.sample("mean", Normal(typical, 1.0).to_event())
    scatter = numpyro.sample("scatter", HalfNormal(0.1 * np.ones(3)).to_event())
    z = numpyro.sample("z", Normal(0.0, 1.0).expand([start.shape[1] - 4]).to_event())
    u = numpyro.sample("u", Normal(0.0, 30.0).expand([count, 4]).to_event())
    q = start[:, :4] + (root @ u[:, :, None])[:, :, 0]  # in standard errors: all numbers are alike
    numpyro.factor("skins", Normal(mean, scatter).log_prob(q[:, :3]).sum())
    log_prob = likelihood.log_prob(likelihood.circuit(q), q[:, 3] / 200e3, z)
    numpyro.factor("records", log_prob.sum() + count * 0.5 * (z**2).sum())  # its prior is above


kernel = numpyro.infer.NUTS(model, max_tree_depth=6)
sampler = numpyro.infer.MCMC(kernel, num_warmup=150, num_samples=150, progress_bar=False)
sampler.run(jax.random.key(0))
mean = np.exp(sampler.get_samples()["mean"])
for name, m, s in zip(("r_s", "r_p", "c_p"), mean.mean(0), mean.std(0), strict=True):
    print(f"{name} of the population: {m:.4g} ± {s:.2g}")
