"""Identification of the load of a recording, of many loads, and of the circuit of a load."""

import itertools
import reprlib
from collections.abc import Iterable, Mapping, Sequence
from typing import TypeVar, Unpack, overload

import jax.numpy as jnp
import numpy as np

from etid.circuits.circuit import AbstractCircuit, SkinRC
from etid.estimators.registry import Method
from etid.identify.arguments import driver_of, fed, given_circuit
from etid.identify.arguments import recordings as several
from etid.identify.fitting import Batch, Prepared, is_shared
from etid.identify.impedance import identify_impedance
from etid.identify.options import (
    Circuit,
    FitOptions,
    Interval,
    Options,
    candidates_of,
    plan,
)
from etid.identify.planning import EXPLAINED, explained, failed_fit
from etid.identify.study import fields_of, of_one_circuit, table
from etid.precision import in_float64
from etid.recordings.preflight import Inspected
from etid.recordings.recording import Recording, RecordingError
from etid.recordings.study import Study
from etid.results.data import with_data
from etid.results.driver import Driver
from etid.results.feed import AbstractFeed
from etid.results.fit import Fit, IdentificationError
from etid.results.fits import Fits
from etid.selection.search import usual_circuits
from etid.selection.selection import Selection

_Kind = TypeVar("_Kind", bound=AbstractCircuit)


@overload
def identify_skin(
    recording: Recording,
    driver: Driver | None = None,
    *,
    circuit: None = None,
    throw: bool = True,
    **options: Unpack[FitOptions],
) -> Fit[SkinRC]: ...


@overload
def identify_skin(
    recording: Recording,
    driver: Driver | None = None,
    *,
    circuit: _Kind,
    throw: bool = True,
    **options: Unpack[FitOptions],
) -> Fit[_Kind]: ...


@overload
def identify_skin(
    recording: Recording,
    driver: Driver | None = None,
    *,
    circuit: str,
    throw: bool = True,
    **options: Unpack[FitOptions],
) -> Fit[AbstractCircuit]: ...


@in_float64
def identify_skin(
    recording: Recording,
    driver: Driver | None = None,
    *,
    circuit: Circuit = None,
    method: Method | None = None,
    fixed: Mapping[str, float] | None = None,
    prior: Mapping[str, tuple[float, float]] | None = None,
    bounds: Mapping[str, Interval] | None = None,
    accept: float | None = None,
    throw: bool = True,
) -> Fit:
    """Identify the circuit that is connected to the driver in one recording.

    Args:
        recording: Unloaded and loaded voltage.
        driver: Identified driver. Without a driver the load is identified from the current that the
            recording measured. With a driver, the default method uses a measured current too.
        circuit: Structure of the load and its typical values, or a circuit string such as
            `"R0-p(R1,C1)"`; `SkinRC` if not given. With `"auto"` it is the simplest circuit that
            the recording supports; `select_circuit` shows the choice.
        method: A method of `identify_driver`, or any registered name.
        fixed: Known values of elements by name [SI], as in `{"r_s": 500.0}`. Their standard errors
            are 0.
        prior: Values of elements with their standard deviations, as in `{"r_s": (500.0, 50.0)}`;
            the standard errors of the fit contain this knowledge. Maximum likelihood and output
            error take known elements.
        bounds: Least and largest possible values of elements [SI], as in `{"r_s": (100.0, 2e3)}`;
            None where there is none. The estimate is the mean of what the likelihood leaves inside,
            and the standard errors are its own. The remark `at_bound` says that an element would
            lie outside without its bounds; the verdict `out_of_bounds` that they contradict the
            recording. They take the methods that take known elements.
        accept: What the circuit may leave beyond the noise, relative to the signal; 0.02 if not
            given. A fit that leaves less is `approximate` if nothing with a name explains it, one
            that leaves more a `misfit`. Maximum likelihood takes it.
        throw: Raise an error if the result cannot be used.

    Returns:
        Elements, standard errors and verdict. The fit knows its recording and its driver, so that
        `fit.plot()`, `fit.posterior()` and `fit.profile("c_p")` need no arguments.

    Raises:
        ValueError: The method cannot use this driver or this circuit.
        IdentificationError: The result cannot be used and `throw` is set.
    """
    options = Options.of(
        candidates_of(circuit),
        method=method,
        fixed=fixed,
        prior=prior,
        bounds=bounds,
        accept=accept,
    )
    fits, chosen = candidate_fits(recording, driver, options)
    single = len(options.circuits) == 1
    fit = fits[chosen] if single else Selection.of(fits, chosen, options.circuits).fit
    fit = with_data(fit, recording, driver)
    return usable(recording, fit) if throw else fit


def candidate_fits(
    recording: Recording, driver: Driver | None, options: Options
) -> tuple[dict[int, Fit], int]:
    """Fits of the circuits that a recording asks for, and the number of the chosen one.

    Raises:
        ValueError: The method cannot use this driver.
    """
    recording, feed = fed(recording, driver)
    seen = Inspected.of(recording)
    estimator, name = plan(options, seen, feed)
    if name is not None:
        return {0: failed_fit(name, options, str(estimator))}, 0
    lane = estimator.lane_of(seen).of(seen)
    one = Prepared(seen, feed, estimator, lane, is_shared(seen, feed))
    batch = Batch(one)
    batch.add(0, one)
    found = batch.fitted(options.circuits)
    return found[0], found.chosen(0)


def usable(recording: Recording, fit: Fit) -> Fit:
    """The fit.

    Raises:
        IdentificationError: Its result cannot be used.
    """
    if fit.usable:
        return fit
    why = fit.note
    if fit.verdict in EXPLAINED:
        why = explained(Inspected.of(recording), fit.verdict)
    raise IdentificationError(f"recording {recording.path!r}: {fit.verdict}. {why}", fit)


@overload
def identify_skins(
    recordings: Iterable[Recording] | Study,
    driver: Driver | None = None,
    *,
    circuit: None = None,
    progress: bool = False,
    **options: Unpack[FitOptions],
) -> Fits[SkinRC]: ...


@overload
def identify_skins(
    recordings: Iterable[Recording] | Study,
    driver: Driver | None = None,
    *,
    circuit: _Kind,
    progress: bool = False,
    **options: Unpack[FitOptions],
) -> Fits[_Kind]: ...


@overload
def identify_skins(
    recordings: Iterable[Recording] | Study,
    driver: Driver | None = None,
    *,
    circuit: str,
    progress: bool = False,
    **options: Unpack[FitOptions],
) -> Fits[AbstractCircuit]: ...


@in_float64
def identify_skins(
    recordings: Iterable[Recording] | Study,
    driver: Driver | None = None,
    *,
    circuit: Circuit = None,
    method: Method | None = None,
    fixed: Mapping[str, float] | None = None,
    prior: Mapping[str, tuple[float, float]] | None = None,
    bounds: Mapping[str, Interval] | None = None,
    accept: float | None = None,
    progress: bool = False,
) -> Fits:
    """Identify many recordings that were made with one driver.

    Args:
        recordings: Recordings, or a study of loaded recordings. Lengths and sample rates may
            differ.
        driver: Identified driver. Without a driver the loads are identified from the currents that
            the recordings measured.
        circuit: As in `identify_skin`. With `"auto"` all recordings get one circuit, chosen by
            their joint evidence. The note of a recording that deserves another circuit says which.
        method: As in `identify_skin`.
        fixed: As in `identify_skin`, for all recordings.
        prior: As in `identify_skin`, for all recordings.
        bounds: As in `identify_skin`, for all recordings.
        accept: As in `identify_skin`.
        progress: Show a progress bar.

    Returns:
        One fit for each recording, in the order of the recordings. Each fit has a verdict. The
        name of the method lists all methods that were used.

    Raises:
        ValueError: There is no recording, or the method cannot use this circuit.
    """
    driver = driver_of(driver)
    options = Options.of(
        candidates_of(circuit),
        method=method,
        fixed=fixed,
        prior=prior,
        bounds=bounds,
        accept=accept,
    )
    if isinstance(recordings, Study):
        study, paths = recordings, [*recordings, *recordings.problems]
        known = [fields_of(study, path) for path in paths]

        def load(row: int) -> tuple[Recording, AbstractFeed]:
            return fed(study[paths[row]], driver)
    else:
        records = several("recordings", recordings)
        if records and driver is None and not any("current" in one.samples for one in records):
            records[0].without_v_th()  # raises an error, because there is no current
        known = [vars(record.metadata) for record in records]

        def load(row: int) -> tuple[Recording, AbstractFeed]:
            return fed(records[row], driver)

    if not known:
        raise ValueError("there is no recording to identify")
    fit, notes = of_one_circuit(len(known), load, options, progress, len(known))
    return table(known, fit, notes)


@in_float64
def select_circuit(
    recording: Recording,
    driver: Driver | None = None,
    *,
    candidates: Sequence[AbstractCircuit | str] | None = None,
    method: Method | None = None,
    fixed: Mapping[str, float] | None = None,
    prior: Mapping[str, tuple[float, float]] | None = None,
    bounds: Mapping[str, Interval] | None = None,
    accept: float | None = None,
    throw: bool = True,
) -> Selection:
    """The simplest circuit that a recording supports.

    The search fits the first candidate. It goes on to all that are not simpler if score tests show
    a change that the circuit cannot make, and to simpler ones if an element is hardly determined.
    The evidence is −BIC = 2 log L − p ln n, for p elements and n real numbers in the data (Schwarz
    1978). A candidate that is contradicted by the data, or that has elements which the data do not
    determine, is chosen only if there is no other. Differences below 2 do not count; then the
    circuit with the fewest elements is chosen. Of circuits with equally many elements the first is
    chosen, unless the evidence of another one is larger by 6.

    Args:
        recording: Unloaded and loaded voltage.
        driver: As in `identify_skin`.
        candidates: Circuits or circuit strings, the most usual one first. If None: `SkinRC`,
            `ParallelRC`, `Resistor`, `SkinCole`, `SkinLayers`, `SkinWarburg`.
        method: An estimator that computes a likelihood, `"maximum_likelihood"`; the default for
            records of several whole periods.
        fixed: As in `identify_skin`; every candidate must have these elements.
        prior: As in `identify_skin`; every candidate must have these elements.
        bounds: As in `identify_skin`; each candidate is fitted inside the bounds of its elements.
        accept: As in `identify_skin`.
        throw: Raise an error if the fit of the chosen circuit cannot be used.

    Returns:
        The chosen fit, and evidence, verdict and elements of each candidate. If several circuits
        are likely, the standard errors of the chosen fit contain the difference between them.

    Raises:
        RecordingError: There is no candidate, one of them is no circuit, or no data can tell two of
            them apart.
        ValueError: The method cannot use this driver, or cannot compare circuits, or a known
            element is no element of a candidate.
        IdentificationError: The result cannot be used and `throw` is set.
    """
    circuits = usual_circuits() if candidates is None else checked(candidates)
    options = Options.of(
        circuits, method=method, fixed=fixed, prior=prior, bounds=bounds, accept=accept
    )
    fits, chosen = candidate_fits(recording, driver, options)
    selection = Selection.of(fits, chosen, circuits)
    if throw:
        usable(recording, selection.fit)
    return selection


def checked(candidates: Iterable[AbstractCircuit | str]) -> tuple[AbstractCircuit, ...]:
    """The candidates.

    Raises:
        RecordingError: There is no candidate, one of them is no circuit, or no data can tell two of
            them apart.
    """
    if isinstance(candidates, AbstractCircuit | str) or not isinstance(candidates, Iterable):
        raise RecordingError(
            f"is {reprlib.repr(candidates)}, must be several circuits",
            field="candidates",
            remedy="Pass a list, as in [etid.SkinRC(), etid.SkinCole()]",
        )
    found = tuple(
        given_circuit(f"candidates[{number}]", one) for number, one in enumerate(candidates)
    )
    if not found:
        raise RecordingError(
            "is empty", field="candidates", remedy="Pass a list, as in [etid.SkinRC()]"
        )
    for one, other in itertools.combinations(found, 2):
        same = type(one) is type(other)
        if not same and len(one.names()) == len(other.names()):
            same = _imitates(one, other) and _imitates(other, one)
        if same:
            raise RecordingError(
                f"holds {type(one).__name__} and {type(other).__name__}, which have the same "
                "impedance: no data can tell them apart",
                field="candidates",
                remedy="Leave one of them out",
            )
    return found


def _imitates(one: AbstractCircuit, other: AbstractCircuit) -> bool:
    """Whether a circuit can have the impedance that another one has at its typical values."""
    frequency = np.geomspace(1.0, 1e7, 57)
    z = np.asarray(other.response(jnp.asarray(frequency)))
    fit = identify_impedance(frequency, z, stderr=np.abs(z), circuit=one, throw=False)
    return float(fit.rrse) < 1e-6  # it reaches 1e-9 if they are equal
