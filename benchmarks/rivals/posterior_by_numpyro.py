"""numpyro's NUTS draws from the posterior of etid: `python -m ... PROBLEM RESULT`.

NUTS gets F of `etid.identify.posterior` as its potential function, so there is no second copy of
the likelihood. Both samples of the elements are stretched in the same way. PROBLEM holds `snr_db`
and the number of `fits`. RESULT gets, for each
fit and element, the difference of the means in standard deviations, the ratio of the standard
deviations, and the effective draws of NUTS; and the seconds of each.
"""

import time

import jax
import jax.numpy as jnp
import numpy as np
from numpyro.diagnostics import (  # pyright: ignore[reportMissingImports]  # see lmfit_leastsq
    effective_sample_size,
)
from numpyro.infer import MCMC, NUTS  # pyright: ignore[reportMissingImports]  # see lmfit_leastsq

import etid
from benchmarks.rivals import serve
from etid.identify import posterior

DRAWS = 4000
WARM_UP = 500
ACCEPTED = 0.9  # of the proposals


def drawn_by_nuts(least, powers, seed):
    """Draws of q, in coordinates in which Laplace's approximation is a standard normal."""
    load, mean, cov = least
    root = jnp.linalg.cholesky(cov)

    def potential(u):
        q = mean + root @ u
        return load.objective(q[None])[0] - powers @ q  # the prior is uniform in the impedances

    kernel = NUTS(
        potential_fn=potential,
        target_accept_prob=ACCEPTED,
    )
    chain = MCMC(kernel, num_warmup=WARM_UP, num_samples=DRAWS, progress_bar=False)
    chain.run(jax.random.key(seed), init_params=jnp.zeros(mean.size))
    return mean + np.asarray(chain.get_samples()) @ np.asarray(root).T


def compared(snr_db, seed):
    """One row of the result; None if the fit is not successful."""
    study = etid.scenes.paper_dry(snr_db=snr_db).simulate(seed)
    driver = etid.identify_driver(study["calibration/98k8"], order=5, throw=False)
    fit = etid.identify_skin(study["typical/dry/01"], driver, throw=False)
    if fit.verdict != "successful":
        return None
    fit.posterior()  # imports
    started = time.perf_counter()
    ours = fit.posterior(draws=DRAWS)
    between = time.perf_counter()
    lane, known, wanted = posterior.given(fit, None, None)
    least = posterior.Minimum.of(lane, known, fit)
    impedances = posterior.Impedances.of_circuit(fit.circuit, least.q)
    x = np.stack([impedances.of(q) for q in drawn_by_nuts(least, impedances.powers, seed)])
    (at, own), (_, wanted) = (impedances.moments(least.q, of) for of in (least.cov, wanted))
    theirs = impedances.logs(posterior.stretched(x, at, own, wanted))
    ended = time.perf_counter()
    logs = np.log(np.asarray(ours.draws.values()))
    centre = ours.weights @ logs
    spread = np.sqrt(ours.weights @ (logs - centre) ** 2)
    worth = [float(effective_sample_size(column[None])) for column in theirs.T]
    return [
        (centre - theirs.mean(0)) / theirs.std(0),
        spread / theirs.std(0),
        np.array(worth),
        np.array([between - started, ended - between, ours.effective]),
    ]


def solved(problem):
    jax.config.update("jax_enable_x64", True)
    rows = [compared(float(problem["snr_db"]), seed) for seed in range(int(problem["fits"]))]
    columns = zip(*(row for row in rows if row is not None), strict=True)
    return dict(zip(("shift", "ratio", "worth", "seconds"), map(np.stack, columns), strict=True))


if __name__ == "__main__":
    serve(solved)
