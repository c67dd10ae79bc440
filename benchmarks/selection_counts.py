"""From choices to rates: right and spurious circuits by three criteria, and coverage.

A circuit is *decisively* supported at an SNR if 2 log evidence of the true circuit exceeds that of
every candidate that is not richer by `DECISIVE` in the mean over the drivers. Richer candidates
cannot enter this: they contain the truth, and lose ln n, about 7, for each spurious element
whatever the SNR.

The criteria are compared on the same fits, all candidates being fitted, with the rest of the rule
unchanged (`etid.selection.evidence`). AICc is −2 log L + 2 p + 2 p (p + 1) / (n − p − 1). The
evidence of Laplace is −2 log ∫ L π with normal priors of the logarithms of the elements, the
typical value within a factor of 10, and α uniform from 0 to 1. An answer in a cell of the failure
map is *right* if it is successful and no element is wrong.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from benchmarks.estimators import Answer, rate_of
from benchmarks.failure_axes import Cell, cells
from benchmarks.rates import NORMAL_95, Rate, rate
from benchmarks.selection_draws import TRUTHS, Drawn, errors
from etid.results.fit import Fit
from etid.selection.evidence import best, bic, elements
from etid.selection.search import USUAL

DECISIVE = 10.0
DECISIVE_SNR = 30.0  # [dB] at least
QUANTITIES = ("R_s", "Z(0)", "corner")
PRIOR = math.log(10.0)  # standard deviation of the logarithm of an element

OTHER_SKIN = "SNR and skin that is not one RC"
RIGHT_SNR = ("40 dB", "60 dB", "80 dB")

Criterion = Callable[[Mapping[int, Fit]], dict[int, float]]


def _penalised(penalty: Callable[[Fit, int], float]) -> Criterion:
    def criterion(fits: Mapping[int, Fit]) -> dict[int, float]:
        supports = [fit.support for fit in fits.values() if fit.support is not None]
        # Variance of the residuals of the best candidate, 1 at least, as `bic` has it.
        noise = max(1.0, np.nanmin([float(of.deviance) / float(of.terms) for of in supports]))
        found = {}
        for number, fit in fits.items():
            assert fit.support is not None
            value = float(fit.support.deviance) / noise + penalty(fit, number)
            found[number] = value if math.isfinite(value) else math.inf
        return found

    return criterion


def _aicc(fit: Fit, _: int) -> float:
    assert fit.support is not None
    p, n = elements(fit), float(fit.support.terms)
    return 2 * p + 2 * p * (p + 1) / (n - p - 1)


def _laplace(fit: Fit, number: int) -> float:
    """−2 log of prior and of the Gaussian integral at the minimum."""
    values, typical = (
        np.array([float(np.asarray(getattr(one, name))) for name in one.names()])
        for one in (fit.circuit, USUAL[number]())
    )
    uniform = np.array([unit == "1" for unit in fit.circuit.units().values()])
    if not (values > 0).all():
        return math.inf
    with np.errstate(invalid="ignore", over="ignore"):  # an element without end has no sign
        sign, volume = np.linalg.slogdet(np.asarray(fit.cov) / np.outer(values, values))
    if not sign > 0:
        return math.inf
    q = np.log(values / typical) / PRIOR
    normal = -math.log(PRIOR * math.sqrt(2 * math.pi)) - 0.5 * q**2
    prior = np.where(uniform, np.log(values), normal)  # dα = α d ln α
    return -values.size * math.log(2 * math.pi) - volume - 2 * float(prior.sum())


CRITERIA: Mapping[str, Criterion] = {
    "BIC": bic,
    "AICc": _penalised(_aicc),
    "Laplace": _penalised(_laplace),
}


def gained(drawn: Drawn) -> float:
    """2 log evidence of the true circuit minus the largest one of a circuit that is not richer."""
    truth, evidence = TRUTHS[drawn.truth], bic(drawn.fits)
    size = {number: len(kind.names()) for number, kind in enumerate(USUAL)}
    true = USUAL.index(type(truth))
    others = [evidence[of] for of in size if size[of] <= size[true] and of != true]
    return min(others, default=math.inf) - evidence[true]


def cell(drawn: Sequence[Drawn]) -> dict[str, Any]:
    """One row of the table, of recordings of one truth at one SNR."""
    first, truth = drawn[0], type(TRUTHS[drawn[0].truth])
    expected = float(np.mean([gained(one) for one in drawn]))
    decisive = first.snr_db >= DECISIVE_SNR and expected >= DECISIVE
    row: dict[str, Any] = {"truth": first.truth, "snr_db": first.snr_db, "drawn": len(drawn)}
    row |= {"expected_evidence": round(expected, 1), "decisive": decisive}
    row |= {f"chose_{kind.__name__}": sum(one.chosen is kind for one in drawn) for kind in USUAL}
    row["richer"] = sum(one.is_richer for one in drawn)
    row["fits"] = float(np.mean([len(one.selection.fits) for one in drawn]))
    for name, criterion in CRITERIA.items():
        found = [USUAL[best(one.fits, criterion(one.fits))] for one in drawn]
        row[f"{name}_right"] = sum(one is truth for one in found)
        row[f"{name}_richer"] = sum(len(one.names()) > len(truth.names()) for one in found)
    for name in QUANTITIES:
        of = rate(*covered(drawn, name))
        row |= {f"{name}_intervals": of.trials, f"{name}_covered": of.rate}
    return row


def covered(drawn: Sequence[Drawn], *names: str) -> tuple[list[bool], list[int]]:
    """For each successful choice, whether the 95 % interval holds the truth; and its driver."""
    inside, drivers = [], []
    for one in drawn:
        if not one.selection.fit.usable:
            continue
        found = errors(one)
        for name in names:
            if name in found:
                inside.append(abs(found[name]) < NORMAL_95)
                drivers.append(one.driver)
    return inside, drivers


def chosen_cells() -> list[Cell]:
    """Cells of the map in which the circuit is not given, and the records are as usual.

    Another length, rate or order would compile all candidates anew, a minute for each.
    """
    every = [cell for cell in cells() if cell.circuit is None]
    [usual] = {cell.shape for cell in every if cell.chart == OTHER_SKIN}
    return [cell for cell in every if cell.shape == usual]


def is_right(one: Answer) -> bool:
    """Whether an answer is successful and no element is wrong."""
    return one.usable and not one.wrong


def missed_elements(answers: Sequence[Answer]) -> tuple[int, int]:
    """Elements determined to 10 % that are silently wrong, and number of all such elements."""
    missed = [one.silent_elements & one.determined for one in answers]
    return int(np.sum(missed)), int(np.sum([one.determined for one in answers]))


def map_row(of: Cell, found: Sequence[Answer]) -> dict[str, Any]:
    """One row of the table."""
    asked = [one for one in found if one.target]
    return {
        **of.place,
        "drivers": len({one.seed for one in found}),
        "trials": len(found),
        "right": float(np.mean([is_right(one) for one in found])),
        "successful": sum(one.usable for one in found),
        "silent": sum(one.silent for one in found),
        "determined": len(asked),
        "missed": sum(one.missed for one in asked),
        "determined_elements": missed_elements(asked)[1],
    }


def right_from_40_db(every: Sequence[Cell], found: Sequence[Sequence[Answer]]) -> Rate:
    """Right answers for skin that is not one RC, from 40 dB on."""
    asked = [
        one
        for cell, answered in zip(every, found, strict=True)
        for one in answered
        if cell.chart == OTHER_SKIN and cell.row in RIGHT_SNR
    ]
    return rate_of(asked, is_right)
