"""One load, recorded at several amplitudes; its resistance may fall with the current."""

import dataclasses
from collections.abc import Iterable, Mapping

import jax
import numpy as np

from etid.circuits.circuit import AbstractCircuit
from etid.circuits.current_dependent import SkinCurrent, current_dependent
from etid.estimators.element_limits import Limits
from etid.estimators.element_prior import ElementPrior
from etid.estimators.estimator import serving
from etid.estimators.lanes import Harmonics, stacked, taken, unstacked
from etid.estimators.maximum_likelihood.estimator import description
from etid.estimators.maximum_likelihood.rows import source_of
from etid.estimators.maximum_likelihood.verdict import ACCEPT, judged
from etid.estimators.registry import MAXIMUM_LIKELIHOOD, register_description
from etid.identify.arguments import (
    check_alike,
    check_distinct,
    check_no_filters,
    circuit_of,
    driver_of,
    fed,
)
from etid.identify.arguments import recordings as list_of
from etid.identify.fitting import known_of, remarks_on
from etid.identify.options import Interval, Options, plan
from etid.identify.planning import failed_fit
from etid.identify.skins import usable
from etid.nonlinear.amplitudes import Amplitudes, currents
from etid.nonlinear.fit import fit_amplitudes
from etid.nonlinear.response import Recorded, with_filter
from etid.precision import array_function, in_float64, one_thread
from etid.recordings.errors import RecordingError
from etid.recordings.preflight import Inspected, preflight
from etid.recordings.recording import Recording
from etid.recordings.remarks import Remark
from etid.results.driver import Driver, HarmonicDriver
from etid.results.feed import MEASURED_CURRENT
from etid.results.fit import Fit
from etid.results.verdicts import RESULTS, verdicts_of

# Largest relative standard error of a current I_0. A linear load has 1/I_0 = 0, whose estimate is
# nearly normal and must be positive: one linear load of two thousand stays below this limit.
NO_CURRENT = 1 / 3.3
METHOD = "amplitudes"
register_description(
    METHOD,
    description(
        "maximum likelihood for several amplitudes",
        "the load was estimated from all its recordings together by",
        "The response of a resistor that depends on its current was computed by harmonic balance. "
        "Z_th and the trigger delays were estimated with the load; each record has its own delay.",
        (),
    ),
)


def leaves_much(chi2: float, rrse: float) -> bool:
    """Whether the residual is too large for the noise, or for any trust."""
    # Single fits have score tests for a small residual with a large χ², such as the rounding of a
    # converter whose step is not known; several amplitudes have none. At an absurdly large gain the
    # noise of V_th would explain any residual: 1, 3 and 5 mA with one seed ended at χ² 0.26 and
    # RRSE 0.78.
    return chi2 > 4.0 or rrse > 0.5


@one_thread()
@array_function
def _fit(of: Amplitudes, driver: RESULTS, bounds: Limits) -> Fit:
    found, late = fit_amplitudes(of)
    none = np.zeros(1, bool)
    fits = judged(found, of.circuit, none, driver, METHOD, of.prior, bounds, ACCEPT)
    (fit,) = unstacked(fits)
    if late:
        remarks = np.asarray(fit.remarks | int(Remark.follows_late))
        fit = dataclasses.replace(fit, remarks=remarks)
    if fit.verdict != "successful":
        return fit
    unsure = fit.stderr.values() > NO_CURRENT * fit.circuit.values()
    name = "insensitive" if (unsure & currents(of.circuit)).any() else "successful"
    name = "misfit" if leaves_much(float(fit.chi2), float(fit.rrse)) else name
    return dataclasses.replace(fit, result=verdicts_of(np.array(name)))


@in_float64
def identify_amplitudes(
    recordings: Iterable[Recording],
    driver: Driver | None = None,
    *,
    circuit: AbstractCircuit | str | None = None,
    fixed: Mapping[str, float] | None = None,
    prior: Mapping[str, tuple[float, float]] | None = None,
    bounds: Mapping[str, Interval] | None = None,
    throw: bool = True,
) -> Fit:
    """Identify one load from recordings at several amplitudes; it may depend on its current.

    All recordings have the same elements. The method is maximum likelihood on the harmonics; the
    response of a resistor that depends on its current is computed by harmonic balance, from the
    record of V_th or of the current. The anti-alias filter of the converter is estimated too. A
    measured current must not have a direct component, which the harmonics do not contain: stimulate
    with charge-balanced pulses.

    Args:
        recordings: Recordings of the same load, of equal length and sample rate, each of several
            whole pulse periods. Amplitudes that differ by a factor of five determine I_0 well.
        driver: Driver identified by maximum likelihood. None for recordings of the current.
        circuit: Structure of the load and its typical values; `SkinCurrent` if not given. Any other
            circuit is fitted to all recordings together.
        fixed: As in `identify_skin`.
        prior: As in `identify_skin`; also for a current I_0.
        bounds: As in `identify_skin`; also for a current I_0.
        throw: Raise an error if the result cannot be used.

    Returns:
        Elements, standard errors, verdict, and the remarks on all recordings. χ² and RRSE are those
        of the worst recording. The verdict is `insensitive` if the error of I_0 exceeds 0.3 of
        it: as far as the recordings show, the load is linear.

    Raises:
        RecordingError: There is no recording, one is given twice, the recordings have different
            lengths or rates, they lack V_th or the current, or all have one amplitude and the load
            depends on its current.
        ValueError: The driver was identified by another method, the circuit has several resistors
            that depend on their current, or a converter holds the command of a recording.
        IdentificationError: The result cannot be used and `throw` is set.
    """
    driver = driver_of(driver)
    load = SkinCurrent() if circuit is None else circuit_of(circuit)
    current_dependent(load.impedance())
    options = Options.of([load], method=MAXIMUM_LIKELIHOOD, fixed=fixed, prior=prior, bounds=bounds)
    of_elements = ElementPrior.of(options.known, load)
    feed = (
        MEASURED_CURRENT
        if driver is None
        else serving(driver, HarmonicDriver, str(MAXIMUM_LIKELIHOOD))
    )
    of = list_of("recordings", recordings)
    check_alike("recordings", of)
    fed_by = [fed(one, driver)[0] for one in of]
    for one in fed_by:
        check_no_filters(one, "a fit of several amplitudes")
    check_distinct("recordings", of)
    seen = [Inspected.of(one) for one in fed_by]
    for one in seen:
        if one.is_held:
            raise ValueError(
                f"recording {one.recording.path!r}: several amplitudes are not fitted behind a "
                "command that a converter holds; identify each recording alone"
            )
        _, name = plan(options, one, feed)
        name = name or preflight(one, periodic=True)
        if name is not None:
            fit = failed_fit(name, options, METHOD)
            return usable(one.recording, fit) if throw else fit
    free = set(np.array(load.names())[currents(load)]).difference(of for of, *_ in options.known)
    spans = [float(one.spans[0]) for one in seen]
    if free and max(spans) < 1.1 * min(spans):
        raise RecordingError(
            "have one amplitude, and a load that depends on its current needs a second one",
            field="recordings",
            remedy="Add a recording with a fifth of the amplitude, or fix the current I_0",
        )
    lanes = stacked([Harmonics.of(one) for one in seen])
    frequency = np.asarray(lanes.frequency)
    known = known_of(taken(lanes, 0), feed, False, MAXIMUM_LIKELIHOOD)
    source = with_filter(source_of(jax.tree.map(np.asarray, known)))
    rate = float(lanes.sample_rate[0])
    recorded = Recorded(source, feed, load, frequency, rate)
    of_all = Amplitudes(recorded, lanes.fields, of_elements)
    fit = _fit(of_all, feed.result, options.bounds)
    remarks = [fit.remarks, *(remarks_on(one, MAXIMUM_LIKELIHOOD) for one in seen)]
    fit = dataclasses.replace(fit, remarks=np.asarray(np.bitwise_or.reduce(remarks)))
    return usable(seen[0].recording, fit) if throw else fit
