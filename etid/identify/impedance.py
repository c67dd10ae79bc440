"""Identification of circuits from measured impedances: frequency, Z, standard error.

Potentiostats and impedance analysers measure Z itself, without a driver in between. The fit
minimises what it leaves relative to the standard errors, or without them its relative errors
(`etid.identify.spectrum`).
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from jaxtyping import Complex
from tqdm import tqdm

from etid.estimators.element_limits import checked_limits
from etid.estimators.element_prior import checked
from etid.estimators.lanes import stacked
from etid.identify.arguments import bounds_of, known_elements
from etid.identify.kramers_kronig import NotFinite, checked_spectrum
from etid.identify.options import Circuit, Interval, Options, candidates_of
from etid.identify.planning import Refusal, failed_fit
from etid.identify.spectrum import chain_of
from etid.identify.spectrum_fit import METHOD, Told, fit_spectrum
from etid.identify.study import table
from etid.precision import in_float64, one_thread
from etid.printing import several
from etid.recordings.errors import RecordingError
from etid.recordings.fields import LABELS
from etid.recordings.remarks import Remark
from etid.results.data import MeasuredImpedance, with_data
from etid.results.fit import Fit, IdentificationError
from etid.results.fits import Fits, concatenated
from etid.selection.common import common, deserves
from etid.selection.evidence import best
from etid.selection.selection import Selection


@in_float64
@one_thread()
def identify_impedance(
    frequency: npt.ArrayLike,
    impedance: npt.ArrayLike,
    *,
    stderr: float | npt.ArrayLike | None = None,
    circuit: Circuit = None,
    fixed: Mapping[str, float] | None = None,
    prior: Mapping[str, tuple[float, float]] | None = None,
    bounds: Mapping[str, Interval] | None = None,
    throw: bool = True,
) -> Fit:
    """Identify a circuit from its impedance.

    Args:
        frequency: Frequencies [Hz], > 0.
        impedance: Complex impedance [Ω] at each frequency.
        stderr: Standard error [Ω] of the real and of the imaginary part: one number, or one for
            each frequency. If not given, the noise is taken to be a part of |Z|, which the residual
            shows. χ² is then NaN. A residual that is not noise is a `misfit` where it exceeds 1 %
            of |Z|, and else widens the standard errors, with the remark `not_noise`.
        circuit: Structure of the circuit, or a circuit string; `SkinRC` if not given. Its values
            matter little. With `"auto"` it is the simplest circuit that the impedance supports, of
            those of `select_circuit`; all are fitted.
        fixed: Known values of elements by name [SI], as in `{"alpha_1": 0.9}`. Their standard
            errors are 0.
        prior: Values of elements with their standard deviations, as in `{"r_s": (500.0, 50.0)}`;
            the standard errors of the fit contain this knowledge.
        bounds: Least and largest possible values of elements [SI], as in `identify_skin`.
        throw: Raise an error if the result cannot be used.

    Returns:
        Elements, standard errors and verdict. `fit.plot()` draws the fit and the measured points,
        `fit.profile("r_s")` and `fit.posterior()` show how certain an element is.

    Raises:
        ValueError: The shapes of the arrays differ, there are too few impedances for the elements,
            a number is missing, not finite or not positive where it must be, or a known element or
            a bound is not of this circuit, or no element is free.
        IdentificationError: The result cannot be used and `throw` is set.
    """
    options = _options(circuit, fixed, prior, bounds)
    measured = _measured((frequency, impedance, stderr))
    fit = with_data(_choice(measured, options).fit, measured)
    if throw and not fit.usable:
        causes = " ".join([fit.note, *fit.remarked])
        raise IdentificationError(f"impedance: {fit.verdict}. {causes}", fit)
    return fit


@in_float64
@one_thread()
def identify_impedances(
    spectra: Mapping[str, tuple],
    *,
    labels: Mapping[str, Mapping[str, str]] | None = None,
    circuit: Circuit = None,
    fixed: Mapping[str, float] | None = None,
    prior: Mapping[str, tuple[float, float]] | None = None,
    bounds: Mapping[str, Interval] | None = None,
    progress: bool = False,
) -> Fits:
    """Identify many measured impedances: subjects, electrodes, or the cycles of a cell.

    Args:
        spectra: Frequencies and impedances by path, as in `{"s01/dry": (frequency, impedance)}`,
            with standard errors or without, as `identify_impedance` takes them. Their frequencies
            may differ.
        labels: Labels of some paths, as in `{"s01/dry": {"subject": "s01"}}`: subject, session,
            site, condition, electrode, trial.
        circuit: As in `identify_impedance`. With `"auto"` all impedances get one circuit, chosen by
            their joint evidence. The note of one that deserves another circuit says which.
        fixed: As in `identify_impedance`, for all impedances.
        prior: As in `identify_impedance`, for all impedances.
        bounds: As in `identify_impedance`, for all impedances.
        progress: Show a progress bar.

    Returns:
        One fit for each impedance, in their order, each with a verdict; the note of one that cannot
        be fitted says why.

    Raises:
        ValueError: There is no impedance, a label has no such name or path, or a known element or a
            bound is not of the circuit.
    """
    options, labels = _options(circuit, fixed, prior, bounds), labels or {}
    if not isinstance(spectra, Mapping):
        raise RecordingError(
            f"is {type(spectra).__name__}, must name the impedances",
            field="spectra",
            remedy='Pass {"s01/dry": (frequency, impedance)}',
        )
    if not spectra:
        raise ValueError("there is no impedance to identify")
    unknown = [path for path in labels if path not in spectra]
    unknown += [name for one in labels.values() for name in one if name not in LABELS]
    if unknown:
        raise ValueError(
            f"labels has {unknown[0]!r}; its keys are paths of impedances, and each has some of "
            f"{', '.join(LABELS)}"
        )
    found, measured = [], np.full(len(spectra), None, object)
    every = tqdm(spectra.items(), unit="fit", disable=not progress)
    for row, (path, arrays) in enumerate(every):
        try:
            measured[row] = one = _measured(arrays)
            found.append(_choice(one, options))
        except (ValueError, TypeError) as error:
            refusal = Refusal.of(RecordingError(str(error), path=path))
            if isinstance(error, NotFinite):
                refusal = refusal._replace(name="nonfinite_samples")
            found.append(refusal)
    chosen = [one for one in found if isinstance(one, Selection)]
    number = common(chosen, options.circuits) if chosen else 0
    alone = dataclasses.replace(options, circuits=(options.circuits[number],))
    fits, notes = [], []
    for one in found:
        if isinstance(one, Refusal):
            fits.append(failed_fit(one.name, alone, METHOD))
            notes.append(one.note)
            continue
        again = one if one.chosen == number else Selection.of(one.fits, number, options.circuits)
        fits.append(again.fit)
        notes.append(" ".join(filter(None, (again.fit.note, deserves(again, number)))))
    named = [{"path": path, **labels.get(path, {})} for path in spectra]
    whole = table(named, concatenated([stacked([one]) for one in fits]), notes)
    return dataclasses.replace(whole, measured=measured)


def _options(
    circuit: Circuit,
    fixed: Mapping[str, float] | None,
    prior: Mapping[str, tuple[float, float]] | None,
    bounds: Mapping[str, Interval] | None,
) -> Options:
    circuits = candidates_of(circuit)
    options = Options(circuits, known=known_elements(fixed, prior), bounds=bounds_of(bounds))
    for one in circuits:
        checked(options.known, one)
        if set(one.names()) <= {name for name, _, error in options.known if error == 0}:
            raise ValueError("fixed holds every element; leave at least one free")
    checked_limits(options.bounds, options.known, circuits)
    return options


def _measured(of: Sequence[Any]) -> MeasuredImpedance:
    """The impedance from its arrays."""
    if not 2 <= len(of) <= 3:
        raise ValueError(f"has {several(len(of), 'array')}; give frequencies and impedances")
    three: list[Any] = [*of, None][:3]
    return MeasuredImpedance(*checked_spectrum(*three))


def _choice(measured: MeasuredImpedance, options: Options) -> Selection:
    """The fits of all circuits; they take a few hundredths of a second each."""
    of = chain_of(measured), Told(options.known, options.bounds)
    fits = {i: fit_spectrum(measured, one, *of) for i, one in enumerate(options.circuits)}
    selection = Selection.of(fits, best(fits), options.circuits)
    if selection.fit.usable:
        return selection
    remarks = np.asarray(selection.fit.remarks | int(_remarks(measured.z)))
    return dataclasses.replace(selection, fit=dataclasses.replace(selection.fit, remarks=remarks))


def _remarks(z: Complex[np.ndarray, " frequency"]) -> Remark:
    """Obvious causes of an unusable fit."""
    if not np.imag(z).any():
        return Remark.no_phase
    return Remark.positive_imaginary if np.median(np.imag(z)) > 0 else Remark(0)
