"""Any input and output: Steiglitz-McBride on arrays, and what its filter leaves."""

import numpy as np

import etid

rng = np.random.default_rng(0)
u = rng.standard_normal(2000)
truth = etid.Filter.of(np.array([0.0, 0.5, 0.3]), np.array([1.0, -1.5, 0.7]))
y, _ = truth.simulate(u)
noisy = y + 0.1 * np.std(y) * rng.standard_normal(u.size)

for iterations in (1, 20):
    found = etid.steiglitz_mcbride(u, noisy, 2, iterations=iterations)
    left = noisy - found.simulate(u)[0]
    print(
        f"{iterations} iterations: a = {found.a.round(3)}, left {np.std(left) / np.std(noisy):.3f}"
    )
