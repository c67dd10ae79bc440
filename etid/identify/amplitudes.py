"""One load, recorded at several amplitudes; its resistance may fall with the current."""

import dataclasses
from collections.abc import Iterable, Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from etid.circuits.circuit import AbstractCircuit
from etid.circuits.current_dependent import SkinCurrent, current_dependent
from etid.estimators import judgement
from etid.estimators.amplitudes.fit import fit_amplitudes
from etid.estimators.amplitudes.terms import Amplitudes, currents, with_filter
from etid.estimators.element_limits import Limits
from etid.estimators.element_prior import ElementPrior
from etid.estimators.estimator import serving
from etid.estimators.lanes import Harmonics, stacked
from etid.estimators.maximum_likelihood.estimator import description
from etid.estimators.maximum_likelihood.given_driver import GivenDriver
from etid.estimators.maximum_likelihood.rows import source_of
from etid.estimators.registry import MAXIMUM_LIKELIHOOD, register_description
from etid.identify.arguments import check_alike, check_distinct, circuit_of, driver_of, fed
from etid.identify.arguments import recordings as list_of
from etid.identify.fitting import known_of, remarks_on
from etid.identify.options import Interval, Options, plan
from etid.identify.planning import failed_fit
from etid.identify.skins import successful
from etid.numpy_tier.tiers import program
from etid.precision import in_float64
from etid.recordings.errors import RecordingError
from etid.recordings.preflight import Inspected
from etid.recordings.recording import Recording
from etid.results.driver import Driver, HarmonicDriver
from etid.results.feed import MEASURED_CURRENT, MeasuredCurrent
from etid.results.fit import Fit
from etid.results.verdicts import RESULTS

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


def leaves_much(chi2: Float[Array, ""], rrse: Float[Array, ""]) -> Bool[Array, ""]:
    """Whether the residual is too large for the noise, or for any trust."""
    # Single fits have score tests for a small residual with a large χ², such as the rounding of a
    # converter whose step is not known; several amplitudes have none. At an absurdly large gain the
    # noise of V_th would explain any residual: 1, 3 and 5 mA with one seed ended at χ² 0.26 and
    # RRSE 0.78.
    return (chi2 > 4.0) | (rrse > 0.5)


@program
def _fit(
    lanes: Harmonics,
    known: GivenDriver,
    feed: HarmonicDriver | MeasuredCurrent,
    circuit: AbstractCircuit,
    prior: ElementPrior | None,
    bounds: Limits,
) -> Fit:
    rate = jnp.asarray(lanes.sample_rate)[0]
    of = Amplitudes(with_filter(source_of(known)), feed, circuit, lanes.spectrum, rate, prior)
    estimate = fit_amplitudes(of)
    fit = judgement.judged(estimate, circuit, feed.result, METHOD, bounds, prior)
    fit = judgement.unless(fit, leaves_much(estimate.chi2, estimate.rrse), RESULTS.misfit)
    unsure = fit.stderr.values() > judgement.NO_CURRENT * fit.circuit.values()
    return judgement.unless(fit, jnp.any(unsure & currents(circuit)), RESULTS.insensitive)


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
        throw: Raise an error if the verdict is not successful.

    Returns:
        Elements, standard errors, verdict, and the remarks on all recordings. χ² and RRSE are those
        of the worst recording. The verdict is `insensitive` if the error of I_0 exceeds 0.3 of
        it: as far as the recordings show, the load is linear.

    Raises:
        RecordingError: There is no recording, one is given twice, the recordings have different
            lengths or rates, they lack V_th or the current, or all have one amplitude and the load
            depends on its current.
        ValueError: The driver was identified by another method, or the circuit has several
            resistors that depend on their current.
        IdentificationError: The verdict is not successful and `throw` is set.
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
    check_distinct("recordings", of)
    seen = [Inspected.of(one) for one in fed_by]
    for one in seen:
        _, name = plan(options, one, feed)
        if name is not None:
            fit = failed_fit(name, options, METHOD)
            return successful(one.recording, fit) if throw else fit
    free = set(np.array(load.names())[currents(load)]).difference(of for of, *_ in options.known)
    spans = [float(one.spans[0]) for one in seen]
    if free and max(spans) < 1.1 * min(spans):
        raise RecordingError(
            "have one amplitude, and a load that depends on its current needs a second one",
            field="recordings",
            remedy="Add a recording with a fifth of the amplitude, or fix the current I_0",
        )
    lanes = [Harmonics.of(one) for one in seen]
    known = known_of(lanes[0], feed, False, MAXIMUM_LIKELIHOOD)
    fit = jax.device_get(_fit(stacked(lanes), known, feed, load, of_elements, options.bounds))
    remarks = [fit.remarks, *(remarks_on(one, MAXIMUM_LIKELIHOOD) for one in seen)]
    fit = dataclasses.replace(fit, remarks=np.asarray(np.bitwise_or.reduce(remarks)))
    return successful(seen[0].recording, fit) if throw else fit
