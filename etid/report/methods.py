"""The methods section of a paper, written from the settings of the fits.

Each estimator describes itself. The numbers and thresholds in the text are those that the estimator
uses. The entries to cite come from `citations.bib` and are printed unchanged, except for the
version of etid.
"""

import importlib.metadata
import importlib.resources
import pathlib
import re
from collections.abc import Iterable, Sequence

import etid.identify.amplitudes
import etid.identify.jointly
import etid.online.state  # noqa: F401 - these modules describe their methods
from etid.circuits.display import quantity, several
from etid.estimators.estimate import MAX_STEPS
from etid.estimators.estimator import Description
from etid.estimators.registry import MAXIMUM_LIKELIHOOD, OUTPUT_ERROR, described
from etid.report.html import Section, Table
from etid.results.driver import ContinuousDriver
from etid.results.fits import AND, Fits, joined
from etid.results.study_fits import Settings, StudyFits
from etid.selection.common import LIMIT


def methods_section(found: StudyFits) -> Section:
    """Methods of a study as text for a paper, with the BibTeX entries to cite.

    Args:
        found: The fits. If they have no settings, the section says what is missing.
    """
    used = {name: described(name) for name in found.fits.fit.method.split(AND)}
    known = [one for one in used.values() if one is not None]
    by_driver = [described(driver.method) for driver in found.drivers.values()]
    of_drivers = [one for one in by_driver if one is not None]
    cited = {"etid", "fingertip", "steiglitz1965", "jax2018"}
    cited.update(key for one in (*known, *of_drivers) for key in one.cited)
    settings = found.settings
    if settings is not None and (settings.order == 0 or settings.candidates):
        cited.add("schwarz1978")
    details = [
        _model(found),
        _driver(found),
        _estimator(found, known),
        _errors(known, settings),
        _verdicts(known, of_drivers),
        _computed(settings),
    ]
    warnings = [
        f"The estimator {name!r} is not registered: import the module that registers it."
        for name, one in used.items()
        if one is None
    ]
    if settings is None:
        warnings.append(
            "This file of fits does not say from which recordings, with which order of the driver "
            "and with which versions it was made. Fit again with this version of etid to store it."
        )
    return Section(
        "Methods",
        _brief(found, known),
        () if settings is None else (_table(found, settings),),
        warning=" ".join(warnings),
        details="\n\n".join(filter(None, details)),
        code=bibtex(cited),
    )


def words(method: str) -> str:
    """The estimators of one or several fits, as words for a sentence."""
    found = {name: described(name) for name in method.split(AND)}
    return " and ".join(name if one is None else one.words for name, one in found.items())


def succeeded(fits: Fits) -> str:
    """A sentence on the number of successful fits."""
    good = fits.counts().get("successful", 0)
    are = "is" if good == 1 else "are"
    share = f"{several(good, 'fit')} ({100 * good / len(fits):.1f} %)"
    return f"{share} {are} successful; only these enter medians and spreads."


def _brief(found: StudyFits, known: Sequence[Description]) -> str:
    """The methods in at most 120 words."""
    circuit, errors = found.fits.circuit, "the noise of its recording"
    load = f"{type(circuit).__name__}{f' (Z_L = {circuit.formula})' if circuit.formula else ''}"
    text = (
        f"The load of each recording was identified as the circuit {load} by "
        f"{words(found.fits.fit.method)} (etid {importlib.metadata.version('etid')})"
    )
    if found.by_current:
        text += ", from the measured current through it. "
    else:
        orders = " or ".join(map(str, sorted({driver.order for driver in found.drivers.values()})))
        order = f", a rational function of order {orders}" if orders else ""
        text += f", behind the source impedance Z_th of the driver{order}, from calibrations"
        text += f" with known resistors{_resistors(found)}. "
        errors += " and the error of the driver, which all recordings with that driver share"
    if any(one.errors for one in known):
        text += f"The standard error of a fit contains {errors}. "
    text += (
        "A fit counts as successful if it converged to plausible elements that its recording "
        "determines, and leaves a residual that noise explains. "
    )
    return text + succeeded(found.fits)


def _resistors(found: StudyFits) -> str:
    """The known resistors of continuous drivers, such as ` of 21.62, 98.8 kΩ`."""
    drivers = [one for one in found.drivers.values() if isinstance(one, ContinuousDriver)]
    known = sorted({r for driver in drivers for r in driver.calibration.r_load.tolist()})
    return f" of {', '.join(f'{r / 1e3:.6g}' for r in known)} kΩ" if known else ""


def _model(found: StudyFits) -> str:
    fits = found.fits
    settings = found.settings
    circuit = fits.circuit
    which = "recording" if len(fits) == 1 else f"{len(fits)} recordings"
    if settings is not None and settings.source:
        which += f" of {pathlib.Path(settings.source).name}"
    were = "was" if len(fits) == 1 else "were"
    text = f"The {which} {were} identified with etid "
    if found.by_current:
        text += "from the measured current I through each load, V_out = Z_L I; in what follows I "
        text += "takes the place of the unloaded record, and G = Z_L. "
    else:
        text += "behind a driver with source impedance Z_th, V_out = V_th Z_L / (Z_L + Z_th). "
    text += f"The load is the circuit {type(circuit).__name__}"
    if circuit.formula:
        text += f", Z_L = {circuit.formula}"
    if settings is not None:
        typical = ", ".join(
            f"{name} {quantity(value, unit)}"
            for (name, unit), value in zip(circuit.units().items(), settings.start, strict=True)
        )
        text += f"; fits started around the typical {typical}"
    text += "."
    if settings is not None and settings.candidates:
        text += (
            f" It was chosen among {', '.join(sorted(settings.candidates))} by the joint evidence "
            "of a sample of the recordings, -BIC = 2 log L - p ln n for p elements and n real "
            "numbers in the data (Schwarz, 1978); circuits that a recording contradicts lose "
            f"{LIMIT:g}, and no recording counts more."
        )
    return text


def _driver(found: StudyFits) -> str:
    drivers = list(found.drivers.values())
    asked = found.settings.order if found.settings is not None else None
    orders = sorted({driver.order for driver in drivers})
    if found.by_current or not (asked or orders):
        return ""
    order = " or ".join(map(str, [asked] if asked else orders))
    text = f"Z_th is a rational function of order {order}"
    if any(isinstance(driver, ContinuousDriver) for driver in drivers):
        text += ", stable by its modal parameters"
    if asked == 0:
        text += (
            ". The calibrations of each driver chose the order: the least one after which neither "
            "a score test nor Schwarz's criterion (1978) asks for another pole"
        )
    count = len(found.drivers) + len(found.failures)
    whose = f" for {count} drivers" if count > 1 else ""
    text += f". It was identified{whose} from calibrations"
    if known := _resistors(found):
        text += f" with known resistors{known}"
    methods = sorted({driver.method for driver in drivers})
    if methods:
        text += f", by {' or '.join(map(words, methods))}"
    return text + "."


def _estimator(found: StudyFits, used: Sequence[Description]) -> str:
    method = found.fits.fit.method
    automatic = joined([str(MAXIMUM_LIKELIHOOD), str(OUTPUT_ERROR)])
    text = ""
    if method == automatic or (found.settings is not None and not found.settings.asked_method):
        text = (
            "Maximum likelihood was the method for recordings of several whole pulse periods, "
            "whose harmonics can be told from aliases; output error for all others. "
        )
        text += "Both occurred. " if method == automatic else f"Here it was {words(method)}. "
    parts = [one.text for one in used]
    if any(one.refined for one in used):
        parts.append(
            "Minima were found by Levenberg-Marquardt, composed of the parts of optimistix (Rader "
            f"et al., 2024), in at most {MAX_STEPS} steps, from several starts around the typical "
            "elements and, for Z_th and the load alike, from the estimate of Steiglitz and McBride "
            "(1965)."
        )
    parts += dict.fromkeys(one.noise for one in used)
    return text + " ".join(parts)


def _errors(used: Sequence[Description], settings: Settings | None) -> str:
    ways = dict.fromkeys(one.errors for one in used if one.errors)
    if not ways:
        return "The estimator gives no standard errors." if used else ""
    text = "Standard errors follow from the curvature at the minimum, "
    if len(ways) == 1:
        text += f"and {next(iter(ways))}. "
    else:
        text += "; ".join(f"those by {one.words} {one.errors}" for one in used) + ". "
    text += (
        "They have two parts: own, from the noise of a recording, and shared, from the error of "
        "the driver. All recordings with one driver share this error, so the spread between them "
        "does not show it."
    )
    instrument = settings.instrument if settings is not None else ()
    if instrument:
        text += (
            " The shared part contains errors of the instrument, as parameters with these standard "
            f"deviations: {', '.join(instrument)} (relative; capacitance in farad)."
        )
    if not any(one.startswith("r_load") for one in instrument):
        text += (
            " They do not contain the tolerance of the known resistors. This tolerance passes 1:1 "
            "into every resistance and inversely into every capacitance."
        )
    return text


def _verdicts(used: Sequence[Description], of_drivers: Sequence[Description]) -> str:
    conditions = dict.fromkeys(condition for one in used for condition in one.conditions)
    if not conditions:
        return ""
    text = f"A fit counts as successful if {', '.join(conditions)}, "
    text += "and the driver was identified successfully"
    driver = dict.fromkeys(condition for one in of_drivers for condition in one.of_driver)
    if driver:
        text += f", for which {', and '.join(driver)}"
    return text + "."


def _computed(settings: Settings | None) -> str:
    if settings is None:
        return ""
    return (
        f"Computed in {settings.precision} by JAX (Bradbury et al., 2018) on {settings.backend}, "
        f"with {', '.join(settings.versions)}."
    )


def _table(found: StudyFits, settings: Settings) -> Table:
    """The settings of the run as a table."""
    source = "in memory"
    if settings.source:
        source = f"file {settings.source}, SHA-256 {settings.source_sha256 or 'not known'}"
    driver = f"of {settings.driver}, " if settings.driver else ""
    circuit = type(found.fits.circuit).__name__
    if settings.candidates:
        circuit += f", chosen among {', '.join(sorted(settings.candidates))}"
    low, high = settings.plausible
    rows = {
        "recordings": source,
        "method": f"asked for {settings.asked_method or 'none'}, used {found.fits.fit.method}",
        "circuit": circuit,
        "Z_th": f"{driver}order {settings.order or 'auto'}, drift of "
        f"{100 * settings.driver_drift:g} %, accepted from {low:g} to {high:g} ohm at 1 kHz",
        "tolerances of the instrument": ", ".join(settings.instrument) or "none",
        "known elements": ", ".join(settings.fixed + settings.prior + settings.bounds) or "none",
        "computed": f"in {settings.precision} on {settings.backend}",
        "versions": ", ".join(settings.versions),
    }
    if found.by_current:
        del rows["Z_th"]
    shown = tuple(rows.items())
    return Table(("setting", "value"), shown, caption="Settings")


def entries() -> dict[str, str]:
    """All entries of the file by key, in the order of the file."""
    text = (importlib.resources.files("etid.report") / "citations.bib").read_text("utf-8")
    return {key: entry for entry, key in re.findall(r"(?ms)^(@\w+\{(\w+),$.*?^\})", text)}


def bibtex(keys: Iterable[str]) -> str:
    """The BibTeX entries with these keys, in the order of the file.

    Raises:
        KeyError: The file has no entry with one of the keys.
    """
    known, wanted = entries(), set(keys)
    unknown = wanted - known.keys()
    if unknown:
        raise KeyError(f"citations.bib has no entry {', '.join(sorted(unknown))}")
    text = "\n\n".join(entry for key, entry in known.items() if key in wanted)
    return text.replace("{VERSION}", f"{{{importlib.metadata.version('etid')}}}")
