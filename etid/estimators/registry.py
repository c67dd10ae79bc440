"""The estimators, and which of them can identify what."""

from collections.abc import Sequence
from typing import Literal, TypeVar, get_args

import numpy as np

from etid.circuits.circuit import AbstractCircuit, SkinRC
from etid.estimators import steiglitz_mcbride
from etid.recordings.preflight import Inspected, preflight
from etid.recordings.recording import Recording
from etid.results.driver import ContinuousDriver, Driver, HarmonicDriver
from etid.signals.harmonics import separates_aliases
from etid.signals.precision import require_float64

Method = Literal[
    "maximum_likelihood",
    "non_parametric",
    "output_error",
    "harmonic_steiglitz_mcbride",
    "steiglitz_mcbride",
    "equation_error",
]
METHODS: tuple[Method, ...] = get_args(Method)
CALIBRATED = METHODS[:2]  # those that use the harmonics of the calibrations
REFINED = METHODS[:3]  # those for any circuit
CONTINUOUS = METHODS[:4]  # those that use a continuous source impedance
HARMONIC = (*CALIBRATED, METHODS[3])  # those on the harmonics of whole pulse periods
SAME_PULSE_RATE = 1e-3  # part by which rates may differ: Z_th is smooth
_Kind = TypeVar("_Kind", bound=Driver)


def iterations(method: Method) -> int:
    """Of Steiglitz-McBride in time."""
    return 1 if method == "equation_error" else steiglitz_mcbride.ITERATIONS


def check_method(method: str | None, circuit: AbstractCircuit | None = None) -> None:
    """Raise ValueError unless the method exists and can identify this circuit."""
    require_float64()
    if method is None:
        return
    if method not in METHODS:
        raise ValueError(f"method {method!r} is not known; use one of {', '.join(METHODS)}")
    if method not in REFINED and circuit is not None and not isinstance(circuit, SkinRC):
        raise ValueError(
            f"method {method!r} identifies SkinRC only, not {type(circuit).__name__}; "
            "use method='maximum_likelihood'"
        )
    if method == "output_error" and circuit is not None and not circuit.is_rational:
        raise ValueError(
            "method 'output_error' needs a ratio of polynomials in s, which "
            f"{_not_rational(circuit)}; use method='maximum_likelihood'"
        )


def _not_rational(circuit: AbstractCircuit) -> str:
    return f"{type(circuit).__name__}, with its constant-phase element, is not"


def check_default(method: Method, circuit: AbstractCircuit) -> None:
    """Raise ValueError if the method that was chosen cannot identify this circuit."""
    if method == "output_error" and not circuit.is_rational:
        raise ValueError(
            "the record holds less than two whole pulse periods or begins in a pulse, or its "
            "driver was identified without harmonics; the method for it is output_error, which "
            f"needs a ratio of polynomials in s, and {_not_rational(circuit)}. Record three "
            "periods or more and identify the driver with method='maximum_likelihood', or ask for "
            "method='maximum_likelihood': in a single period its standard errors leave out what "
            "aliases do"
        )


def choose(method: Method | None, recordings: Sequence[Inspected]) -> Method:
    """The method given, or else maximum likelihood if all records hold several whole periods.

    Where aliases cannot be told from harmonics, as in a single period, it would be biased by more
    than its errors say.
    """
    if method is not None:
        return method
    for seen in recordings:
        if not separates_aliases(*seen.periods) or not seen.is_periodic:
            return "output_error"
    return "maximum_likelihood"


def _choose_for(method: Method | None, seen: Inspected, driver: Driver) -> Method:
    """As `choose`, for a load that is identified with `driver`."""
    if method is None and not isinstance(driver, HarmonicDriver):
        return "output_error"
    return choose(method, [seen])


def plan(given: Method | None, seen: Inspected, driver: Driver) -> tuple[Method, str | None]:
    """The method for a load, and the verdict that forbids to fit it, if there is one.

    Raises:
        ValueError: The driver cannot serve the method.
    """
    name = preflight(seen, periodic=given in HARMONIC)
    if name is None:
        method = _choose_for(given, seen, driver)
    else:
        method = given or "output_error"
    check_driver(driver, method, seen.recording.sample_rate)
    if method == "non_parametric":
        _check_pulse_rate(serving(driver, HarmonicDriver, method), seen.recording)
    return method, name


def _check_pulse_rate(driver: HarmonicDriver, recording: Recording) -> None:
    known = float(driver.spectra.frequency[0, 0])
    if not np.isclose(recording.pulse_rate, known, rtol=SAME_PULSE_RATE):
        raise ValueError(
            f"non_parametric knows Z_th at harmonics of {known:.6g} Hz only, but the recording has "
            f"{recording.pulse_rate:.6g} Hz; use method='maximum_likelihood'"
        )


def serving(driver: Driver, kind: type[_Kind], method: str) -> _Kind:
    """The driver as the kind that `method` needs.

    Raises:
        ValueError: It is of a kind that lacks what the method needs.
    """
    if isinstance(driver, kind):
        return driver
    if not isinstance(driver, ContinuousDriver):
        raise ValueError(
            f"this driver was identified by {driver.method}, which gives no continuous source "
            f"impedance; identify it with method={method!r}"
        )
    raise ValueError(
        f"this driver was identified by {driver.method}, which keeps no harmonics of its "
        "calibrations; identify it with method='maximum_likelihood'"
    )


def check_driver(driver: Driver, method: Method, sample_rate: float) -> None:
    """Raise ValueError if `driver` cannot serve `method` at `sample_rate` [Hz]."""
    if method in CALIBRATED:
        serving(driver, HarmonicDriver, method)
    elif method in CONTINUOUS:
        serving(driver, ContinuousDriver, method)
    elif not np.isclose(float(driver.sample_rate), sample_rate):
        raise ValueError(
            f"{method} needs recording and calibration at one sample rate, but the recording has "
            f"{sample_rate:g} Hz and the driver {float(driver.sample_rate):g} Hz; "
            "use method='output_error'"
        )
