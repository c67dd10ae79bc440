"""The paragraphs on methods that a paper needs, written from the settings of the fits themselves.

Numbers in them, thresholds included, are those that the estimators use.
"""

import math
import pathlib

import numpy as np

from etid.circuits import circuit as circuits
from etid.circuits.display import quantity
from etid.estimators import judgement, steiglitz_mcbride
from etid.estimators.baseline import BIASED
from etid.estimators.estimate import MAX_STEPS
from etid.estimators.score_tests import missing_pole, other_circuit
from etid.report import citations
from etid.report.html import Section, Table
from etid.results.driver import ContinuousDriver
from etid.results.provenance import Settings
from etid.results.study_fits import StudyFits

_HARMONICS = (
    "At the harmonics of the pulse rate, in the periodic steady state and in continuous time, "
)
_TEXTS = {
    "maximum_likelihood": "the load was estimated by maximum likelihood with noise on both "
    "records (Pintelon and Schoukens, 2012, ch. 9): the residual Y - G exp(-jωτ) X of the loaded "
    "record Y and the unloaded record X is weighted by its variance, var Y + |G|² var X, G = Z_L / "
    "(Z_L + Z_th). Each load was estimated jointly with what the calibrations tell of Z_th and of "
    "their trigger delays; its own trigger delay τ is one more unknown.",
    "joint": "each driver and all recordings made with it were estimated in one fit by maximum "
    "likelihood with noise on both records (Pintelon and Schoukens, 2012, ch. 9): the residual "
    "Y - G exp(-jωτ) X of each loaded record Y and its unloaded record X is weighted by its "
    "variance, var Y + |G|² var X, G = Z_L / (Z_L + Z_th). Z_th is common to all, each record has "
    "its own trigger delay τ.",
    "non_parametric": "the load was estimated by maximum likelihood with Z_th as the calibrations "
    "show it at each harmonic, without a model of it, noise on all records being accounted for "
    "(Pintelon and Schoukens, 2012, ch. 9 and 10). Trigger delays were estimated with the load.",
    "output_error": "the load was estimated by output error (Ljung, 1999): the terminal voltage "
    "was predicted in continuous time from the band-limited unloaded record, and its difference to "
    "the loaded record, weighted by the noise of both, was minimised. The state at the start of "
    "the record, an offset and the trigger delay were estimated with the load.",
    "harmonic_steiglitz_mcbride": "the load was estimated by Steiglitz-McBride iteration "
    "(Steiglitz and McBride, 1965) with the variance of the noise taken out of its sums "
    "(Söderström, 2007) and the trigger delay as one more linear unknown.",
    "steiglitz_mcbride": "Z_th and the load were estimated as discrete filters by at most "
    f"{steiglitz_mcbride.ITERATIONS} iterations of Steiglitz and McBride (1965), of which the one "
    "that predicts the terminal voltage best was kept. It accounts neither for trigger delays nor "
    "for the noise that both of its regressors share, and gives no standard errors.",
    "equation_error": "Z_th and the load were estimated as discrete filters by least squares of "
    "the equation error, the first iteration of Steiglitz and McBride (1965). It is biased by "
    "noise and gives no standard errors.",
}  # fmt: skip
_IN_TIME = ("output_error", "steiglitz_mcbride", "equation_error")
_BY_LEVENBERG_MARQUARDT = ("maximum_likelihood", "joint", "non_parametric", "output_error")
_CITED = {
    "maximum_likelihood": ("pintelon2012", "optimistix2024", "white1980"),
    "joint": ("pintelon2012", "optimistix2024", "white1980"),
    "non_parametric": ("pintelon2012", "optimistix2024", "white1980"),
    "output_error": ("ljung1999", "optimistix2024"),
    "harmonic_steiglitz_mcbride": ("soderstrom2007", "white1980"),
    "steiglitz_mcbride": (),
    "equation_error": (),
}


def methods_section(found: StudyFits) -> Section:
    """Methods of a study, ready to be copied into a paper, with what to cite.

    Args:
        found: The fits; without settings the section says what is missing.
    """
    used = _methods(found)
    by_driver = {driver.method for driver in found.drivers.values()}
    cited = {"etid", "fingertip", "steiglitz1965", "jax2018"}
    cited.update(key for method in used | (by_driver & _CITED.keys()) for key in _CITED[method])
    settings = found.settings
    paragraphs = [
        _model(found),
        _driver(found),
        _estimator(found, used),
        _errors(used, settings),
        _verdicts(used, by_driver),
        _computed(settings),
    ]
    warning = ""
    if settings is None:
        warning = (
            "This file of fits does not say from which recordings, with which order of the driver "
            "and with which versions it was made. Fit again with this version of etid to have it."
        )
    return Section(
        "Methods",
        "\n\n".join(filter(None, paragraphs)),
        () if settings is None else (_table(found, settings),),
        warning=warning,
        code=citations.bibtex(cited),
    )


def _methods(found: StudyFits) -> set[str]:
    """The estimators that were used, "mixed" told apart."""
    method = found.fits.fit.method
    if method in _TEXTS:
        return {method}
    return {"maximum_likelihood", "output_error"}


def _model(found: StudyFits) -> str:
    fits = found.fits
    settings = found.settings
    circuit = fits.circuit
    which = f"{len(fits)} recordings"
    if settings is not None and settings.source:
        which += f" of {pathlib.Path(settings.source).name}"
    text = f"The {which} were identified with etid as loads of a driver with source impedance Z_th,"
    text += " V_out = V_th Z_L / (Z_L + Z_th). "
    text += f"The load is the circuit {type(circuit).__name__}"
    if circuit.formula:
        text += f", Z_L = {circuit.formula}"
    if settings is not None:
        typical = ", ".join(
            f"{name} {quantity(value, unit)}"
            for (name, unit), value in zip(circuit.units().items(), settings.start, strict=True)
        )
        text += f"; fits started around the typical {typical}"
    return text + "."


def _driver(found: StudyFits) -> str:
    drivers = list(found.drivers.values())
    continuous = [driver for driver in drivers if isinstance(driver, ContinuousDriver)]
    known = [driver.calibration.r_load for driver in continuous]
    resistors = sorted(set(np.concatenate(known).tolist())) if known else []
    order = found.settings.order if found.settings is not None else None
    if order is None and drivers:
        order = drivers[0].order
    if order is None:
        return ""
    text = f"Z_th is a rational function of order {order}"
    if continuous:
        text += ", stable by its modal parameters"
    count = len(found.drivers) + len(found.failures)
    text += ". It was identified from calibrations"
    if count > 1:
        text = text.replace("It was identified", f"It was identified for {count} drivers")
    if resistors:
        text += " with known resistors of "
        text += ", ".join(f"{r / 1e3:.6g}" for r in resistors) + " kΩ"
    methods = sorted({driver.method for driver in drivers})
    if methods:
        text += f", by {' or '.join(map(words, methods))}"
    return text + "."


def _estimator(found: StudyFits, used: set[str]) -> str:
    asked = found.settings.asked_method if found.settings is not None else None
    text = ""
    if asked == "" or len(used) > 1:
        text = (
            "Maximum likelihood was the method for recordings of several whole pulse periods, "
            "whose harmonics can be told from aliases; output error for all others. "
        )
        text += "Both occurred. " if len(used) > 1 else f"Here it was {words(*used)} for all. "
    for method in sorted(used):
        sentence = _TEXTS[method] if method in _IN_TIME else _HARMONICS + _TEXTS[method]
        text += sentence[0].upper() + sentence[1:] + " "
    if used & set(_BY_LEVENBERG_MARQUARDT):
        text += _refined(found.fits.circuit)
    text += (
        "The variances of the noise were estimated from each record by the median of its "
        "differences of sixth order."
    )
    return text


def _refined(circuit: circuits.AbstractCircuit) -> str:
    at = "around the typical elements and, for Z_th"
    if isinstance(circuit, circuits.SkinRC):
        at += " and the load alike"
    return (
        "Minima were found by Levenberg-Marquardt, composed of the parts of optimistix (Rader et "
        f"al., 2024), in at most {MAX_STEPS} steps, from several starts {at}, from "
        "the estimate of Steiglitz and McBride (1965). "
    )


def words(method: str) -> str:
    """The name of an estimator in a sentence."""
    return "joint maximum likelihood" if method == "joint" else method.replace("_", " ")


def _errors(used: set[str], settings: Settings | None) -> str:
    if not used - {"steiglitz_mcbride", "equation_error"}:
        return "The estimator gives no standard errors."
    text = "Standard errors follow from the curvature at the minimum, "
    if used - {"output_error"}:
        text += (
            "and were made with the variance that the residuals have around each harmonic where "
            "that exceeds the noise (White, 1980). "
        )
    else:
        text += (
            "and were multiplied by the square root of χ² where the residual exceeds the noise. "
        )
    text += (
        "They are told in two parts: own, the noise of a recording, and shared, the error of the "
        "driver, which all recordings with one driver have in common and no spread between them "
        "shows."
    )
    tolerance = settings.r_load_tolerance if settings is not None else 0.0
    if tolerance > 0:
        text += (
            f" The shared part contains a tolerance of {100 * tolerance:.3g} % (standard "
            "deviation) of the known resistors."
        )
    else:
        text += (
            " The tolerance of the known resistors is not contained: it passes 1:1 into every "
            "resistance and inversely into every capacitance."
        )
    return text


def _verdicts(used: set[str], by_driver: set[str]) -> str:
    text = (
        "A fit counts as successful if the records passed the checks for flat, clipped, missing "
        "and misplaced samples, the iteration settled, all elements are positive, and the residual "
        "does not exceed the noise (χ² per degree of freedom of at most "
        f"{judgement.MISFIT_CHI2:g}, or an unexplained part of at most "
        f"{100 * judgement.MISFIT_RRSE:g} % of the signal)"
    )
    if used - {"steiglitz_mcbride", "equation_error"}:
        text += ", the trigger delay is at most one sample, every relative standard error below 1"
    if used & {"maximum_likelihood", "joint"}:
        text += (
            ", score tests against a relaxation that is spread over time constants (at "
            f"{other_circuit.SEEN_SPREAD:g} standard deviations) and against one more relaxation "
            f"(at {other_circuit.SEEN_RELAXATION:g}) find none"
        )
    if used & {"maximum_likelihood", "joint"}:
        text += (
            ", recording and calibrations agree about Z_th (the calibrations' sum of squares grows "
            f"by at most {judgement.STRAINED:g})"
        )
    if used & {"harmonic_steiglitz_mcbride", "steiglitz_mcbride", "equation_error"}:
        text += (
            f", the estimate is within {math.sqrt(BIASED):g} standard errors of the minimum of its "
            "own model"
        )
    text += ", and the driver was identified successfully"
    if by_driver & {"maximum_likelihood", "joint"}:
        text += (
            ", for which it has to be passive, and its calibrations must not show one more section "
            f"of Z_th (score test, χ² of at most {missing_pole.SEEN:g} with two degrees of freedom)"
        )
    return text + "."


def _computed(settings: Settings | None) -> str:
    if settings is None:
        return ""
    return (
        f"Computed in {settings.precision} by JAX (Bradbury et al., 2018) on {settings.backend}, "
        f"with {', '.join(settings.versions)}."
    )


def _table(found: StudyFits, settings: Settings) -> Table:
    """The settings as the file has them."""
    source = "in memory"
    if settings.source:
        source = f"file {settings.source} of {settings.source_size} bytes"
    rows = {
        "recordings": source,
        "method": f"asked for {settings.asked_method or 'none'}, used {found.fits.fit.method}",
        "circuit": type(found.fits.circuit).__name__,
        "Z_th": f"order {settings.order}, drift of {100 * settings.driver_drift:g} %",
        "R_L": f"standard deviation of {100 * settings.r_load_tolerance:g} %",
        "computed": f"in {settings.precision} on {settings.backend}",
        "versions": ", ".join(settings.versions),
    }
    shown = tuple(rows.items())
    return Table(("setting", "value"), shown, caption="Settings")
