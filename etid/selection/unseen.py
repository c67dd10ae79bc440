"""What may be there unseen, and would change the elements: a spread of time constants, and R_s.

With much noise a Cole element passes for a capacitor, and R_s is then wrong by more than its
standard error. The score of a fit tells, without another fit, the estimate ε̂ ± σ of α − 1, and how
the elements would move with it (`etid.likelihood.scores`). Let −ε have a
half-normal prior of width τ. Then ε is normal below 0 with

    v = 1 / (1/σ² + 1/τ²),   m = v ε̂ / σ²,

and the evidence for the spread, against none, is

    B = 2 √v / τ · exp(m² / 2v) · Φ(−m / √v).

In the mean over no spread and any spread, which are equally probable before the data are known, the
elements θ with slopes b have

    var = σ_θ² + B / (1 + B) · E(ε²) b bᵀ

(Hoeting et al., Bayesian model averaging, Statistical Science 14, 1999, 382-417). This adds nothing
where the data determine α well, σ ≪ τ.

R_s is treated alike. Where noise hides it, R ‖ C is chosen, whose R_p is then R_s + R_p. The share
of R_s in this sum has a prior of the same width. BIC has the prior of one single datum, which gives
R_s of two standard errors the weight 0.1 at most, although skin is expected to have it.
"""

import math
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from etid.results.fit import Fit
from etid.selection.evidence import elements, values_of

# τ; 1 − α is 0.2 for dry skin (Gabriel, Lau and Gabriel 1996, see `SkinCole`), and the share of R_s
# is 0.15 for the dry and 0.26 for the damp skin of the paper.
WIDTH = 0.2


def unseen(fit: Fit) -> Float[np.ndarray, "element element"]:
    """Covariance that a spread adds to that of the elements [SI²]; 0 if it is not known."""
    size, support = elements(fit), fit.support
    if support is None or fit.circuit.exponents():
        return np.zeros((size, size))  # another shape of the spread that it has is no candidate
    sigma = float(support.spread_stderr)
    if not sigma > 0:
        return np.zeros((size, size))
    # A positive score means α < 1.
    evidence, square = posterior(-float(support.of("spread")[0]) * sigma, sigma)
    moved = np.asarray(support.spread_slope, float) * values_of(fit)
    return evidence / (1 + evidence) * square * np.outer(moved, moved)


def hidden(fits: Mapping[int, Fit], chosen: int) -> dict[int, float]:
    """Probability of the candidate that is the chosen circuit and R_s; empty if there is none."""
    own = dict(zip(fits[chosen].circuit.names(), values_of(fits[chosen]), strict=True))
    found = {}
    if "r_p" not in own or "r_s" in own:
        return found
    for number, fit in fits.items():
        names = fit.circuit.names()
        if set(names) != {*own, "r_s"}:
            continue
        at = names.index("r_s")
        sigma = math.sqrt(max(float(np.asarray(fit.cov)[at, at]), 0.0)) / own["r_p"]
        if sigma > 0:
            evidence, _ = posterior(-float(values_of(fit)[at]) / own["r_p"], sigma)
            found[number] = evidence / (1 + evidence)
    return found


def posterior(estimate: float, sigma: float) -> tuple[float, float]:
    """Evidence B for ε against none, from its estimate ± sigma, and the mean of ε²."""
    variance = 1 / (1 / sigma**2 + 1 / WIDTH**2)
    mean, deviation = variance * estimate / sigma**2, math.sqrt(variance)
    u = -mean / deviation
    below = 0.5 * math.erfc(-u / math.sqrt(2))
    if below < 1e-9:  # far above a capacitor
        return 0.0, 0.0
    # An evidence of more than e⁵⁰ is as certain.
    evidence = 2 * deviation / WIDTH * math.exp(min(u**2 / 2, 50.0)) * below
    density = math.exp(-(u**2) / 2) / math.sqrt(2 * math.pi)
    return evidence, mean**2 + variance - mean * deviation * density / below
