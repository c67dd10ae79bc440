"""The methods section of a paper, written from the settings of the fits.

Each estimator describes itself. The numbers and thresholds in the text are those that the estimator
uses; the sentences around them are in `templates/methods.txt`. The entries to cite come from
`citations.bib` and are printed unchanged, except for the version of etid.
"""

import importlib.resources
import itertools
import pathlib
import re
from collections.abc import Iterable, Sequence
from typing import Any

import etid.estimators.online
import etid.identify.jointly
import etid.nonlinear.identify  # these modules describe their methods
from etid.estimators.estimator import Description
from etid.estimators.registry import MAXIMUM_LIKELIHOOD, described
from etid.likelihood.driver import MAX_STEPS
from etid.printing import as_symbol, per_cent, quantity, several
from etid.report.html import Section, Table, template
from etid.results.driver import ContinuousDriver
from etid.results.fits import AND, Fits
from etid.results.study_fits import Settings, StudyFits
from etid.selection.common import LIMIT


def methods_section(found: StudyFits) -> Section:
    """Methods of a study as text for a paper, with the BibTeX entries to cite.

    Args:
        found: The fits. If they have no settings, the section says what is missing.
    """
    named = {name: described(name) for name in _method(found).split(AND)}
    used = [one for one in named.values() if one is not None]
    by_driver = [described(driver.method) for driver in found.drivers.values()]
    of_drivers = [one for one in by_driver if one is not None]
    cited = {"etid", "fingertip", "jax2018"}
    if not found.by_current:
        cited.add("steiglitz1965")  # fits behind a driver start from it
    cited.update(key for one in (*used, *of_drivers) for key in one.cited)
    settings = found.settings
    if settings is not None and (settings.order == 0 or settings.candidates):
        cited.add("schwarz1978")
    text = template("methods.txt").render(_facts(found, used, of_drivers))
    brief, *details = (" ".join(one.split()) for one in text.split("\n\n") if one.strip())
    warnings = [
        f"The estimator {name!r} is not registered: import the module that registers it."
        for name, one in named.items()
        if one is None
    ]
    if settings is None:
        warnings.append(
            "This file of fits does not say from which recordings, with which order of the driver "
            "and with which versions it was made. Fit again with this version of etid to store it."
        )
    return Section(
        "Methods",
        brief,
        () if settings is None else (_table(found, settings),),
        warning=" ".join(warnings),
        details="\n\n".join(details),
        code=bibtex(cited),
    )


def _facts(
    found: StudyFits, used: Sequence[Description], of_drivers: Sequence[Description]
) -> dict[str, Any]:
    """What `templates/methods.txt` makes sentences of."""
    fits, settings, drivers = found.fits, found.settings, list(found.drivers.values())
    recordings = "recording" if len(fits) == 1 else f"{len(fits)} recordings"
    candidates, typical, instrument = "", "", _instrument(found)
    if settings is not None:
        if settings.source:
            recordings += f" of {pathlib.Path(settings.source).name}"
        candidates = ", ".join(sorted(settings.candidates))
        units = fits.circuit.units().items()
        typical = ", ".join(
            f"{as_symbol(name)} {quantity(value, unit)}"
            for (name, unit), value in zip(units, settings.start, strict=True)
        )
    conditions = [c for one in used for c in one.conditions]
    if not found.by_current:
        conditions += [c for one in used for c in one.behind_conditions]
        conditions += ["the driver was identified successfully"] if conditions else []
    continuous = [one for one in drivers if isinstance(one, ContinuousDriver)]
    r_load = {r for driver in continuous for r in driver.calibration.r_load.tolist()}
    resistors = ", ".join(f"{r / 1e3:.6g}" for r in sorted(r_load))
    single = sum(map(len, [*found.drivers, *found.failures])) == 1
    calibrations = "a calibration" if single else "calibrations"
    calibrations += " with a known resistor" if len(r_load) == 1 else " with known resistors"
    calibrations += f" of {resistors} kΩ" if resistors else ""
    return {
        "found": found,
        "settings": settings,
        "used": used,
        "count": len(fits),
        "recordings": recordings,
        "circuit": type(fits.circuit).__name__,
        "formula": fits.circuit.formula,
        "words": words(_method(found)),
        "version": etid.__version__,
        "succeeded": succeeded(fits),
        "typical": typical,
        "candidates": candidates,
        "limit": f"{LIMIT:g}",
        "steps": MAX_STEPS,
        "drivers": len(found.drivers) + len(found.failures),
        "driver_methods": [words(one) for one in sorted({driver.method for driver in drivers})],
        "orders": sorted({driver.order for driver in drivers}),
        "continuous": bool(continuous),
        "calibrations": calibrations,
        "instrument": instrument,
        "r_load_uncertain": "r_load" in instrument,
        "conditions": list(dict.fromkeys(conditions)),
        "of_driver": list(dict.fromkeys(c for one in of_drivers for c in one.of_driver)),
    }


def _method(found: StudyFits) -> str:
    """The method of the fits; a joint run that needed no driver identified each load alone."""
    method = found.fits.fit.method
    alone = found.by_current and method == etid.identify.jointly.METHOD
    return str(MAXIMUM_LIKELIHOOD) if alone else method


def _instrument(found: StudyFits) -> str:
    """What is stated of the instrument: in the settings and by the drivers."""
    drivers = [one for one in found.drivers.values() if isinstance(one, ContinuousDriver)]
    told = [() if found.settings is None else found.settings.instrument]
    told += [one.instrument.listed() for one in drivers if one.instrument is not None]
    return ", ".join(dict.fromkeys(itertools.chain.from_iterable(told)))


def words(method: str) -> str:
    """The estimators of one or several fits, as words for a sentence."""
    found = {name: described(name) for name in method.split(AND)}
    return " and ".join(name if one is None else one.words for name, one in found.items())


def succeeded(fits: Fits) -> str:
    """A sentence on the number of usable fits."""
    good, approximate = int(fits.fit.usable.sum()), fits.counts().get("approximate", 0)
    if len(fits) == 1:
        return f"The fit is {'' if good else 'unusable: '}{fits.verdicts[0]}."
    are = "is" if good == 1 else "are"
    share = f"{several(good, 'fit')} ({per_cent(good / len(fits), 3)})"
    inexact = f", {approximate} of them approximate" if approximate else ""
    return f"{share} {are} usable{inexact}; only these enter medians and spreads."


def _table(found: StudyFits, settings: Settings) -> Table:
    """The settings of the run as a table."""
    source = "in memory"
    if settings.source:
        source = f"file {settings.source}, SHA-256 {settings.source_sha256}"
    driver = f"of {settings.driver}, " if settings.driver else ""
    circuit = type(found.fits.circuit).__name__
    if settings.candidates:
        circuit += f", chosen among {', '.join(sorted(settings.candidates))}"
    low, high = settings.plausible
    rows = {
        "recordings": source,
        "method": f"asked for {settings.asked_method or 'none'}, used {found.fits.fit.method}",
        "circuit": circuit,
        "Z_th": f"{driver}order {settings.order or 'auto'}, accepted from {low:g} to {high:g} ohm "
        "at 1 kHz",
        "tolerances of the instrument": _instrument(found) or "none",
        "known elements": ", ".join(settings.fixed + settings.prior + settings.bounds) or "none",
        "a circuit may leave": f"{per_cent(settings.accept)} of the signal beyond the noise",
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
    return text.replace("{VERSION}", f"{{{etid.__version__}}}")
