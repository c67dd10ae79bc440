"""The fit of an electrode from its state: elements, standard errors, verdict."""

import jax.numpy as jnp
from jaxtyping import Array, Bool

from etid.estimators.estimator import Description
from etid.estimators.judgement import MISFIT_CHI2, MISFIT_RRSE, SUCCESSFUL
from etid.estimators.maximum_likelihood.given_driver import GivenDriver
from etid.estimators.registry import register_description
from etid.estimators.score_tests.other_circuit import MOVED
from etid.estimators.unknowns import LoadUnknowns
from etid.online.gain_test import SEEN_GAIN
from etid.online.pulse_fit import DELAYS, GainModel, Pulse
from etid.online.state import ElectrodeState
from etid.results.fit import Fit
from etid.results.verdicts import RESULTS, first_verdict
from etid.signals.harmonics import real_parts
from etid.signals.transfer import as_complex, power, reciprocal
from etid.solvers.matrices import inverse

METHOD = "online"

register_description(
    METHOD,
    Description(
        words="on-line tracking",
        text="The loads were identified on-line, anew with each pulse, by an extended Kalman "
        "filter in information form, iterated at each pulse (Bell and Cathey, 1993). In bands of "
        "frequency of each pulse, the ratio of the loaded to the unloaded voltage was compared "
        "with Z_L / (Z_L + Z_th) exp(-jωτ), in continuous time and with what has aliased; the "
        "trigger delay τ of each pulse was one more unknown. The logarithms of the elements follow "
        "a random walk. After a change (generalised likelihood ratio, Willsky and Jones, 1976, or "
        "moving mean of the innovations, Lowry et al., 1992) an electrode began anew. Z_th "
        "is that of the calibrations.",
        conditions=(
            "the last pulse passed the checks for flat, clipped and missing samples",
            "its iteration settled",
            "its residual does not exceed the noise (χ² per degree of freedom of at most "
            f"{MISFIT_CHI2:g} or of what noise exceeds once in ten million pulses, or an "
            f"unexplained part of at most {100 * MISFIT_RRSE:g} % of the signal)",
            "a score test, summed over the pulses since the electrode began anew, finds no "
            "difference between the gains of the two records that moves an element by "
            f"{100 * MOVED:g} % (at most {SEEN_GAIN:g} standard deviations)",
            f"its trigger delay is at most {DELAYS[-1]:g} samples",
            "no change of the driver was seen since the calibrations",
            "every relative standard error is below 1",
        ),
        errors="accumulate the information of all pulses; to them the error of Z_th and of the "
        "unloaded voltage was added, which no number of pulses lessens",
        noise="The variance of the noise was estimated at each pulse from the quiet between two "
        "pulses, at six frequencies and without a parabola through each block.",
        cited=("bell1993", "willsky1976", "lowry1992"),
    ),
)


def fit_of(
    model: GainModel,
    known: GivenDriver,
    driver_result: RESULTS,
    driver_changed: Bool[Array, ""],
    state: ElectrodeState,
) -> Fit:
    """The fit of one electrode.

    Args:
        model: Model of the gain.
        known: Z_th in the bands and its covariance.
        driver_result: Verdict of the driver.
        driver_changed: Whether the driver has changed since its calibration.
        state: State of the electrode.
    """
    bands = model.bands
    logs = LoadUnknowns.of(state.own).log_elements
    elements = logs.size
    expected = model.expected(logs)
    nothing = jnp.zeros((elements, elements))
    weight = bands.weight / state.variance
    pulse = Pulse(model, jnp.zeros_like(expected.gain), weight, logs, nothing)
    jacobian = pulse.jacobian(expected)
    by_term = inverse(jacobian @ jacobian.T)[:elements] @ jacobian
    # Z_th + R = e^W, so that ∂G/∂W = −Z_L (Z_th + R) / (Z_L + Z_th)².
    z = model.circuit.with_log_values(logs).response(bands.frequency)
    admittance = reciprocal(z + model.source)
    loaded = model.source + as_complex(known.resistance)
    by_w = as_complex(jnp.sqrt(weight)) * z * loaded * admittance * admittance
    by_z = by_w[None, :] * known.slope
    of_z = by_term @ real_parts(by_z).T
    # The noise of X is the same in every pulse. It enters Ĝ multiplied by G.
    of_x = jnp.tile(power(expected.gain) * bands.variance_x / state.variance, 2)
    shared = of_z @ known.cov @ of_z.T + (by_term * of_x[None, :]) @ by_term.T
    cov = inverse(state.information) + shared
    relative = jnp.sqrt(jnp.diagonal(cov))
    fitted = model.circuit.with_log_values(logs)
    scale = jnp.outer(fitted.values(), fitted.values())
    known_at_all = state.pulses > 0
    return Fit(
        circuit=fitted,
        cov=jnp.where(known_at_all, cov * scale, jnp.nan),
        shared_cov=jnp.where(known_at_all, shared * scale, jnp.nan),
        rrse=state.rrse,
        chi2=state.chi2,
        result=first_verdict(
            (state.result != SUCCESSFUL, state.result),
            (~jnp.all(relative < 1), RESULTS.insensitive),
            (driver_result != SUCCESSFUL, RESULTS.driver_failed),
            (driver_changed, RESULTS.inconsistent),
        ),
        steps=state.pulses,
        method=METHOD,
    )
