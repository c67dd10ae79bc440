"""A driver from its impedance: measured by an analyser, computed from a netlist, or published.

Z_th is fitted by `etid.results.feed.SourceImpedance`, with residuals of its logarithm,

    (ln |Z(q)/Z_th|, arg Z(q)/Z_th) / stderr,

from several starts, by Levenberg-Marquardt. Its covariance is (Jᵀ J)⁻¹.
"""

import dataclasses
import operator
from collections.abc import Iterator
from typing import Any

import numpy as np
import scipy.optimize
from jaxtyping import Complex, Float

from etid.circuits.discrete import Filter
from etid.identify.arguments import LARGEST_ORDER, number_of
from etid.likelihood.noise import misses
from etid.precision import array_function, in_float64, unmasked
from etid.printing import several
from etid.recordings.errors import RecordingError
from etid.results.driver import Calibration, ContinuousDriver
from etid.results.feed import SourceImpedance
from etid.results.fit import complex_rrse
from etid.results.verdicts import verdict
from etid.signals.harmonics import real_parts
from etid.solvers.matrices import inverse

METHOD = "impedance"
KNOWN = 1e-3  # relative rms error up to which poles explain an impedance that is known
SETTLED = 1e-4  # of ½ χ², below which a step changes nothing that the standard errors show
EXACT = 1e-12  # the same where the impedance is known
STEPS = 1000  # evaluations from each start
PLACES = (0.03, 0.1, 0.3)  # of a resonance in the starts, relative to the highest frequency


@in_float64
@array_function
def driver_of_response(
    frequency: Float[np.ndarray, "..."],
    z_th: Complex[np.ndarray, "..."],
    *,
    sample_rate: float,
    stderr: Float[np.ndarray, "..."] | float = 0.0,
    order: int = 5,
) -> ContinuousDriver:
    """A driver from its source impedance at some frequencies.

    Args:
        frequency: Frequencies [Hz] from the pulse rate to half the sample rate. Beyond them Z_th is
            that of the poles, and its standard errors are too small.
        z_th: Source impedance [ohm] at these.
        sample_rate: Rate of the recordings to identify [Hz].
        stderr: Relative standard error of |Z_th|, and of its phase [rad], at each frequency. 0 for
            an impedance that is known, such as of a netlist.
        order: Number of poles.

    Returns:
        The driver, for `identify_skin`. Its verdict is `misfit` if this order leaves more than the
        standard errors, or more than 0.1 % of an impedance that is known.

    Raises:
        RecordingError: The arrays are not finite or too short, or a number is not possible.
    """
    f, told = (np.asarray(unmasked(of), float) for of in (frequency, stderr))
    z_th = np.asarray(unmasked(z_th), complex)
    rate, order = number_of("sample_rate", sample_rate), operator.index(order)
    _check(f, z_th, told, rate, order)
    told, known = np.broadcast_to(told, f.shape), not told.any()
    weight = 1.0 if known else 1 / np.where(told > 0, told, told[told > 0].min())
    of = _like(order)
    found = [_nearest(of, start, f, z_th, weight, known) for start in _starts(of, f, z_th)]
    best = min(found, key=lambda one: one.cost)
    source = of.of_vector(best.x)
    squares, terms = 2 * best.cost, 2 * f.size - best.x.size
    rrse = complex_rrse(source.response(f), z_th)
    scatter = squares / terms if known else 1.0
    chi2 = np.asarray(np.nan if known else squares / terms)
    missed = rrse > KNOWN if known else misses(chi2, rrse)
    # What has no effect on Z_th, such as the frequency of a pole of gain 0, needs no error.
    cov = np.asarray(inverse(best.jac.T @ best.jac, drop=True))
    ended = best.success or known or best.cost < 0.01  # exact ones are found to their last digits
    discrete = Filter.bilinear(source, rate)
    return ContinuousDriver(
        b=np.asarray(discrete.b),
        a=np.asarray(discrete.a),
        sample_rate=rate,
        rrse=rrse,
        chi2=chi2,
        result=verdict("misfit" if missed else "successful" if ended else "max_steps_reached"),
        steps=np.asarray(best.nfev),
        method=METHOD,
        source=source,
        cov=scatter * cov,
        calibration=Calibration(np.abs(z_th).max(keepdims=True), np.zeros(1), np.zeros(())),
    )


def _check(
    f: Float[np.ndarray, "..."],
    z_th: Complex[np.ndarray, "..."],
    stderr: Float[np.ndarray, "..."],
    sample_rate: float,
    order: int,
) -> None:
    """Raise RecordingError if no driver can be found from these."""
    for name, of, shapes in (("z_th", z_th, [f.shape]), ("stderr", stderr, [f.shape, ()])):
        if f.ndim != 1 or of.shape not in shapes:
            raise RecordingError(
                f"has the shape {of.shape}, frequency {f.shape}",
                field=name,
                remedy="Give one number for each frequency",
            )
    for name, of, sound in (
        ("frequency", f, f > 0),
        ("z_th", z_th, np.abs(z_th) > 0),
        ("stderr", stderr, stderr >= 0),
        ("sample_rate", np.array([sample_rate]), np.array([sample_rate > 0])),
    ):
        if not (np.isfinite(of) & sound).all():
            raise RecordingError(
                "must be finite and positive", field=name, remedy="Leave out what is not"
            )
    if not 1 <= order <= LARGEST_ORDER:
        raise RecordingError(f"is {order}, must be 1 to {LARGEST_ORDER}", field="order")
    if 2 * f.size <= 2 * order + 1:
        raise RecordingError(
            f"has {several(f.size, 'value')} for {2 * order + 1} parameters",
            field="z_th",
            remedy="Give more frequencies, or a lower order",
        )


def _like(order: int) -> SourceImpedance:
    """A source of this order."""
    pairs = (order - 1) // 2
    some, few = np.zeros(pairs), np.zeros(order - 2 * pairs)
    return SourceImpedance(np.zeros(()), some, some, some, some, few, few)


def _starts(
    like: SourceImpedance,
    f: Float[np.ndarray, " frequency"],
    z_th: Complex[np.ndarray, " frequency"],
) -> Iterator[Float[np.ndarray, " parameter"]]:
    """Starts with a resonance at several places, whose gains are those of least squares."""
    pairs, reals = like.log_omega.size, like.log_omega_real.size
    for place in PLACES:
        omega = 2 * np.pi * f.max() * np.geomspace(place, 1.0, max(pairs, 1))[:pairs]
        real = 2 * np.pi * f.min() * np.geomspace(3.0, 1e3, reals)
        of = dataclasses.replace(
            like,
            log_omega=np.log(omega),
            log_zeta=np.log(0.5) + 0 * omega,
            log_omega_real=np.log(real),
        )
        yield _with_gains(of, f, z_th)


def _with_gains(
    of: SourceImpedance,
    f: Float[np.ndarray, " frequency"],
    z_th: Complex[np.ndarray, " frequency"],
) -> Float[np.ndarray, " parameter"]:
    """The parameters with the gains that come nearest, in which Z_th is linear."""
    small = 0.01 * np.abs(z_th).min()
    q = dataclasses.replace(of, log_resistance=np.log(small)).vector()
    slopes = of.slopes(q, f)[1][of.gains] / z_th
    rest = real_parts((z_th - small) / z_th)
    q[of.gains] = np.linalg.lstsq(real_parts(slopes).T, rest, rcond=None)[0]
    return q


def _nearest(
    of: SourceImpedance,
    start: Float[np.ndarray, " parameter"],
    f: Float[np.ndarray, " frequency"],
    z_th: Complex[np.ndarray, " frequency"],
    weight: Float[np.ndarray, " frequency"] | float,
    known: bool,
) -> Any:
    """The minimum from a start, as SciPy gives it."""

    def terms(q: np.ndarray) -> np.ndarray:
        return real_parts(np.log(of.impedance(q, f) / z_th) * weight)

    def jacobian(q: np.ndarray) -> np.ndarray:
        z, slopes = of.slopes(q, f)
        return real_parts(slopes / z * weight).T

    how: Any = {"jac": jacobian, "method": "lm", "x_scale": "jac", "max_nfev": STEPS}
    how["ftol"] = EXACT if known else SETTLED
    return scipy.optimize.least_squares(terms, start, **how)
