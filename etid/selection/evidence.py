"""Evidence of fitted circuits, and the choice between them.

The criterion is that of Schwarz (1978), 2 log p(data | circuit) ≈ −BIC with

    BIC = −2 log L + p ln n,

for p elements and n real numbers in the data. It stands for Laplace's integral over the elements
with the prior of one single datum. Unlike AICc, it allows a superfluous element once in some
hundred fits only; unlike an integral over broad priors, its penalty does not become small when the
noise is large. `python -m benchmarks selection` compares the three.

Noise that exceeds its estimate divides −2 log L: by −2 log L / n of the best candidate, if that is
above 1 (quasi-likelihood, Wedderburn 1974).

What a circuit leaves beyond the noise, as a smooth error δ of the gain, is integrated over in L
(`etid.likelihood.approximate`). A richer circuit that only bends towards such an error gains less
than its penalty; one that explains it needs no δ, and has far more evidence.

A circuit must be adequate before it can be better. A candidate that the data contradict is chosen
only if no candidate is adequate that has more evidence, or as much with fewer elements.
"""

import math
from collections.abc import Collection, Mapping

import numpy as np
from jaxtyping import Float

from etid.results.fit import Fit, Support
from etid.results.verdicts import USABLE

# That a load changed, or that Z_th is open, is no fault of the circuit. Another one with less
# evidence would be chosen in its place: untested, for only the chosen one is tested for changes.
_ADEQUATE = (*USABLE, "changed", "driver_unclear")
# The data do not determine all elements: they do not contradict the circuit.
_UNDETERMINED = ("insensitive", "resolution", "driver_failed")
# Difference of BIC that is "not worth more than a bare mention" (Kass and Raftery 1995, section
# 3.2): of circuits that are so close, the simplest is chosen.
MENTION = 2.0
# Difference that is "strong" (same source): with less, circuits with equally many elements fit
# alike, and the more usual one is chosen. In 5 of 96 recordings of damp skin at 30 and 40 dB, a
# layer of diffusion with a third of R_s was likelier than R_s + R_p ‖ C_p by 2 to 4.3.
ALIKE = 6.0


def rank(fit: Fit) -> int:
    """How far the data accept a circuit.

    Returns:
        0 if they accept it; 1 if the data do not determine all its parts, or if a constant-phase
        element is a capacitor; 2 if the data contradict the circuit.
    """
    name = fit.verdict
    if name in _ADEQUATE:
        # A driver of too low an order can imitate an exponent of 0.994.
        return int(any(float(alpha) > 0.99 for alpha in fit.circuit.exponents()))
    return 1 if name in _UNDETERMINED else 2


def bic(fits: Mapping[int, Fit]) -> dict[int, float]:
    """BIC of each candidate for the same data; infinite if the fit has no likelihood."""
    support = {number: fit.support or Support.unknown(0) for number, fit in fits.items()}
    deviance = {number: float(one.deviance) for number, one in support.items()}
    terms = {number: float(one.terms) for number, one in support.items()}
    known = [number for number in fits if math.isfinite(deviance[number])]
    if not known:
        return dict.fromkeys(fits, math.inf)
    noise = max(1.0, min(deviance[number] / terms[number] for number in known))
    return {
        number: deviance[number] / noise + elements(fit) * math.log(terms[number])
        if number in known
        else math.inf
        for number, fit in fits.items()
    }


def elements(fit: Fit) -> int:
    """Number of elements of the circuit of a fit."""
    return len(fit.circuit.names())


def values_of(fit: Fit) -> Float[np.ndarray, " element"]:
    """The elements of one fit [SI]; `circuit.values()` would make arrays of JAX."""
    return np.array([float(np.asarray(getattr(fit.circuit, name))) for name in fit.circuit.names()])


def best(fits: Mapping[int, Fit], criterion: Mapping[int, float] | None = None) -> int:
    """Number of the candidate to choose, by `criterion`, which is to be small: `bic` if not given.

    It is the simplest of those whose evidence is largest, up to `MENTION`, among the candidates of
    the best rank; of equally simple ones the first, which is the most usual, if it fits alike: up
    to `ALIKE`. A candidate with less evidence than one with no more elements is not chosen,
    whatever their ranks: it is no remedy for what that one lacks.
    """
    if len(fits) == 1:
        return next(iter(fits))
    criterion = criterion or bic(fits)
    ranks = {number: rank(fit) for number, fit in fits.items()}
    size = {number: elements(fit) for number, fit in fits.items()}

    def is_beaten(number: int) -> bool:
        least = min(criterion[other] + _ahead(number, other, size) for other in fits)
        return bool(least < criterion[number])

    left = [number for number in fits if not is_beaten(number)]
    good = [number for number in left if ranks[number] == min(ranks[one] for one in left)]
    least = min(criterion[number] for number in good)
    near = [number for number in good if criterion[number] <= least + MENTION]
    return first_alike(min(near, key=size.__getitem__), good, size, criterion)


def _ahead(number: int, other: int, size: Mapping[int, int]) -> float:
    """By how much the evidence of another candidate must exceed that of this one to beat it."""
    if size[other] > size[number]:
        return math.inf
    return ALIKE if size[other] == size[number] and other > number else MENTION


def first_alike(
    best: int, numbers: Collection[int], size: Mapping[int, int], criterion: Mapping[int, float]
) -> int:
    """The first candidate with as many elements as the best, that fits alike."""
    least = min(criterion[one] for one in numbers if size[one] == size[best])
    alike = [one for one in numbers if size[one] == size[best] and criterion[one] <= least + ALIKE]
    return min(alike)


def weights(fits: Mapping[int, Fit]) -> dict[int, float]:
    """Probability of each candidate, if all are equally probable before the data are known.

    Candidates that the data contradict have the weight 0, unless all are contradicted.
    """
    if len(fits) == 1:
        return dict.fromkeys(fits, 1.0)
    criterion = bic(fits)
    chosen = best(fits, criterion)
    # Undetermined elements do not make a circuit untrue.
    worst = max(rank(fits[chosen]), 1)
    usable = [number for number, fit in fits.items() if rank(fit) <= worst]
    least = min(criterion[number] for number in usable)
    if not math.isfinite(least):
        return {number: float(number == chosen) for number in fits}
    share = {number: math.exp(0.5 * (least - criterion[number])) for number in usable}
    total = math.fsum(share.values())
    return {number: share.get(number, 0.0) / total for number in fits}


def with_close(fits: Mapping[int, Fit], chosen: int, share: Mapping[int, float]) -> np.ndarray:
    """Covariance of the chosen elements [SI²], with the differences to other likely circuits.

    For each element that another candidate has under the same name and unit,

        var = Σ_m w_m (σ_m² + (θ_m − θ)²),

    with the probabilities w_m of the candidates, and θ of the chosen circuit. Elements that a
    candidate does not determine are left out.
    """
    mine = fits[chosen]
    cov = np.array(mine.cov, float)
    others = [number for number in fits if number != chosen and share[number] > 0]
    if not others:
        return cov
    units = mine.circuit.units()
    own = _determined(mine)
    for number in others:
        fit = fits[number]
        other = _determined(fit)
        difference, wider = np.zeros(len(units)), np.zeros(len(units))
        for i, (name, unit) in enumerate(units.items()):
            if name in own and name in other and fit.circuit.units()[name] == unit:
                difference[i] = other[name][0] - own[name][0]
                wider[i] = max(other[name][1] ** 2 - own[name][1] ** 2, 0.0)
        cov += share[number] * (np.outer(difference, difference) + np.diag(wider))
    return cov


def _determined(fit: Fit) -> dict[str, tuple[float, float]]:
    """Values and standard errors of the elements that the data determine."""
    errors = np.sqrt(np.maximum(np.diagonal(np.asarray(fit.cov)), 0.0))
    return {
        name: (float(value), error)
        for name, value, error in zip(fit.circuit.names(), values_of(fit), errors, strict=True)
        if 0 < error < abs(value)
    }
