"""The options of a fit, checked when a public function is called, and the estimator they select."""

import dataclasses
import functools
import math
import os
from collections.abc import Mapping, Sequence
from typing import TypedDict, TypeGuard, Unpack

import equinox as eqx
import jax

from etid.circuits.circuit import AbstractCircuit, SkinRC
from etid.circuits.current_dependent import current_dependent
from etid.estimators.element_limits import Limits, checked_limits
from etid.estimators.element_prior import Known, checked
from etid.estimators.estimator import AbstractEstimator
from etid.estimators.lanes import Harmonics, Held
from etid.estimators.maximum_likelihood.estimator import MaximumLikelihood
from etid.estimators.maximum_likelihood.verdict import ACCEPT
from etid.estimators.output_error import OutputError
from etid.estimators.registry import MAXIMUM_LIKELIHOOD, WITH_CURRENT, Method, named
from etid.identify.arguments import (
    Interval,
    bounds_of,
    circuit_of,
    known_elements,
    number_of,
    order_of,
    range_of,
    require,
)
from etid.recordings.fields import Metadata
from etid.recordings.preflight import Inspected, preflight
from etid.recordings.recording import Recording, RecordingError
from etid.recordings.study import Study
from etid.results.driver import AUTO, ContinuousDriver, HarmonicDriver, Order
from etid.results.feed import AbstractFeed
from etid.results.instrument import Instrument
from etid.results.study_fits import PLAUSIBLE, Settings, sha256, versions
from etid.selection.search import usual_circuits

Circuit = AbstractCircuit | str | None
"""A circuit or a circuit string; `"auto"` for the simplest circuit that the data support; None for
`SkinRC`."""


class FitOptions(TypedDict, total=False):
    """The options of a fit, which overloads of one function share, for type checkers."""

    method: Method | None
    fixed: Mapping[str, float] | None
    prior: Mapping[str, tuple[float, float]] | None
    bounds: Mapping[str, Interval] | None
    accept: float | None


@dataclasses.dataclass(frozen=True)
class Options:
    """What a caller asks for. Each public function makes it once, by `Options.of`.

    Attributes:
        circuits: Circuits to choose from. They are not compared: their numbers may be arrays, and
            no driver depends on them.
        estimator: The requested estimator; None for the default of each recording.
        known: Elements that are known.
        bounds: Elements with bounds.
        accept: What a circuit may leave beyond the noise, relative to the signal.
        order: Number of poles of Z_th.
        instrument: As in `identify_driver`.
        plausible: As in `identify_driver`.
    """

    circuits: tuple[AbstractCircuit, ...] = dataclasses.field(default=(), compare=False)
    estimator: AbstractEstimator | None = None
    known: Known = ()
    bounds: Limits = ()
    accept: float = ACCEPT
    order: Order = 5
    instrument: Instrument | None = None
    plausible: tuple[float, float] = PLAUSIBLE

    @classmethod
    def of(
        cls,
        circuits: Sequence[AbstractCircuit] = (),
        *,
        order: Order = 5,
        instrument: Instrument | None = None,
        plausible: tuple[float, float] = PLAUSIBLE,
        **of_fit: Unpack[FitOptions],
    ) -> "Options":
        """The options, from the keywords of a public function.

        Raises:
            RecordingError: A value has a wrong type, the order is not from 2 to `LARGEST_ORDER`,
                or `plausible` is no range.
            ValueError: No estimator has this name, or the estimator cannot identify these circuits,
                cannot choose between them, or has no use for another option. A known element is no
                element of a circuit, bounds are impossible, or a relative standard deviation or
                `accept` is not in 0 ≤ value < 1.
        """
        if instrument is not None:
            require("instrument", instrument, Instrument)
        estimator, method = None, of_fit.get("method")
        if method is not None:
            estimator = method if isinstance(method, AbstractEstimator) else named(str(method))
            check_circuits(estimator, circuits)
        options = cls(
            circuits=tuple(circuits),
            estimator=estimator,
            known=known_elements(of_fit.get("fixed"), of_fit.get("prior")),
            bounds=bounds_of(of_fit.get("bounds")),
            accept=_accepted(of_fit.get("accept"), estimator),
            order=order_of(order),
            instrument=instrument,
            plausible=range_of("plausible", plausible),
        )
        if estimator is not None:
            options.given_to(estimator)
            check_order(options.order, estimator)
            check_instrument(instrument, estimator)
        options._check_elements()
        return options

    @property
    def circuit(self) -> AbstractCircuit:
        """The first circuit: the only one, or that of all recordings once it is chosen."""
        return self.circuits[0]

    def given_to(self, estimator: AbstractEstimator) -> AbstractEstimator:
        """The estimator with the known elements, the bounds, and what a circuit may leave.

        Raises:
            ValueError: It takes no known elements and no bounds.
        """
        if _accepts(estimator) and estimator.accept != self.accept:
            estimator = dataclasses.replace(estimator, accept=self.accept)
        if not self.known and not self.bounds:
            return estimator
        if not isinstance(estimator, MaximumLikelihood):
            raise ValueError(
                f"method {str(estimator)!r} takes no known elements and no bounds; use "
                "the method maximum_likelihood or output_error"
            )
        return dataclasses.replace(estimator, known_elements=self.known, bounds=self.bounds)

    def settings(self, study: Study, count: int, method: str = "") -> Settings:
        """The settings of a run in this process.

        Args:
            study: The recordings.
            count: Number of recordings to identify.
            method: Name of the method; that of the requested estimator if not given.
        """
        source = os.path.abspath(study.file) if study.file else ""
        several = len(self.circuits) > 1
        return Settings(
            source=source,
            source_sha256=sha256(source) if source else "",
            recordings=count,
            asked_method=method or str(self.estimator or ""),
            order=0 if self.order == AUTO else self.order,
            start=tuple(self.circuit.values().tolist()),
            candidates=tuple(type(one).__name__ for one in self.circuits if several),
            instrument=() if self.instrument is None else self.instrument.listed(),
            plausible=self.plausible,
            fixed=tuple(f"{name} {value!r}" for name, value, error in self.known if not error),
            prior=tuple(
                f"{name} {value!r} ± {error!r}" for name, value, error in self.known if error
            ),
            bounds=tuple(
                f"{name} above {low!r}" if high == math.inf else f"{name} {low!r} to {high!r}"
                for name, low, high in self.bounds
            ),
            accept=self.accept,
            precision="float64",
            backend=jax.default_backend(),
            versions=versions(),
        )

    def _check_elements(self) -> None:
        """Raise ValueError unless the circuits have the known elements, with possible values."""
        for name, *_ in self.known if len(self.circuits) > 1 else ():
            without = [type(one).__name__ for one in self.circuits if name not in one.names()]
            if without:
                raise ValueError(
                    f"{name} is known, but {' and '.join(without)} have no such element, so the "
                    "choice would compare circuits with different knowledge; pass one circuit, or "
                    "call select_circuit with candidates that all have it"
                )
        for circuit in self.circuits if self.known else ():
            checked(self.known, circuit)
        if self.bounds:
            checked_limits(self.bounds, self.known, self.circuits)


def _accepts(estimator: AbstractEstimator | None) -> TypeGuard[MaximumLikelihood]:
    """Whether an estimator accepts circuits that leave more than noise."""
    return isinstance(estimator, MaximumLikelihood) and not isinstance(estimator, OutputError)


def _accepted(told: float | None, estimator: AbstractEstimator | None) -> float:
    """What a circuit may leave: as the caller or the requested estimator says, else `ACCEPT`."""
    if told is None:
        return estimator.accept if _accepts(estimator) else ACCEPT
    if estimator is not None and not _accepts(estimator):
        raise ValueError(
            f"method {str(estimator)!r} accepts nothing beyond the noise; use the method "
            "maximum_likelihood, or remove accept"
        )
    if not 0 <= (accept := number_of("accept", told)) < 1:
        raise ValueError(
            f"accept is {accept:g}; give the part of the signal that a circuit may leave, from 0 "
            "to less than 1, such as 0.02"
        )
    return accept


def candidates_of(value: Circuit) -> tuple[AbstractCircuit, ...]:
    """The circuits to choose from: `usual_circuits` for `"auto"`, else one.

    Raises:
        RecordingError: The value is neither a linear circuit nor `"auto"`.
    """
    if isinstance(value, str) and value == AUTO:
        return usual_circuits()
    if value is None:
        return _default()
    circuit = circuit_of(value)
    if _depends_on_current(type(circuit)):
        raise RecordingError(
            f"is {type(circuit).__name__}, which is not linear: it depends on its current",
            field="circuit",
            remedy="Use etid.identify_amplitudes",
        )
    return (circuit,)


@functools.cache
def _default() -> tuple[AbstractCircuit, ...]:
    """`SkinRC`, made once, because most fits ask for it."""
    return (SkinRC(),)


@functools.cache
def _depends_on_current(kind: type[AbstractCircuit]) -> bool:
    """Whether circuits of a class are not linear; kept, because every fit asks."""
    impedance = eqx.filter_eval_shape(lambda: kind().impedance())  # computes nothing
    return current_dependent(impedance) is not None


def check_circuits(estimator: AbstractEstimator, circuits: Sequence[AbstractCircuit]) -> None:
    """Raise ValueError unless an estimator can identify these circuits and choose between them."""
    if len(circuits) > 1 and not estimator.chooses:
        raise ValueError(
            f"method {str(estimator)!r} computes no likelihood, which the choice of a circuit "
            "needs; use the method maximum_likelihood"
        )
    for circuit in circuits:
        estimator.check_circuit(circuit)


def check_instrument(instrument: Instrument | None, estimator: AbstractEstimator) -> None:
    """Raise ValueError if an estimator has no parameters for the tolerances of an instrument."""
    if instrument is None or isinstance(estimator, MaximumLikelihood) or not instrument.stored():
        return
    raise ValueError(
        "the tolerances of an instrument enter standard errors, and method "
        f"{str(estimator)!r} gives none; use the method maximum_likelihood, or state nothing: "
        "instrument=etid.Instrument() or --tolerance drift=0"
    )


def instrument_of(calibrations: Sequence[Recording | Metadata]) -> Instrument | None:
    """The instrument that the calibrations of a driver state; None if they state none.

    Raises:
        RecordingError: A statement cannot be read, or two of them differ.
    """
    first, told = calibrations[0], [_stated(one) for one in calibrations]
    for other, one in zip(calibrations, told, strict=True):
        if (one and one.stored()) != (told[0] and told[0].stored()):
            raise RecordingError(
                f"is {other.instrument!r}; that of {first.path!r} is {first.instrument!r}",
                path=other.path,
                field="instrument",
                remedy="State the same tolerances in all calibrations of a driver",
            )
    return told[0]


def _stated(calibration: Recording | Metadata) -> Instrument | None:
    if calibration.instrument is None:
        return None
    try:
        return Instrument.read(calibration.instrument)
    except ValueError as error:
        raise RecordingError(
            f"is {calibration.instrument!r}: {error}",
            path=calibration.path,
            field="instrument",
            remedy="Write standard deviations by name, such as 'gain=1e-3 r_load=1e-3'",
        ) from error


def check_order(order: Order, estimator: AbstractEstimator) -> None:
    """Raise ValueError if an estimator cannot choose the order that it is asked to choose."""
    if order == AUTO and not issubclass(estimator.driver, HarmonicDriver):
        raise ValueError(
            f"order 'auto' needs maximum likelihood, but the method is {str(estimator)!r}; give a "
            "number of poles, such as 5"
        )


def unfit(estimator: AbstractEstimator, seen: Inspected) -> str | None:
    """Why the data that an estimator takes of a recording cannot be fitted; None if they can.

    Raises:
        ValueError: The estimator takes no commands that a converter holds.
    """
    kind = estimator.lane_of(seen)
    if seen.is_held and not issubclass(kind, Held):
        raise ValueError(
            f"recording {seen.recording.path!r}: the method {str(estimator)!r} takes no command "
            "that a converter holds; use the method maximum_likelihood"
        )
    if kind.periodic and not seen.is_periodic:
        return "not_periodic"
    aliased = issubclass(kind, Harmonics) and (
        seen.is_aliased if kind.periodic else seen.bins.is_aliased
    )
    return "biased" if aliased else None


def plan(
    options: Options, seen: Inspected, driver: AbstractFeed
) -> tuple[AbstractEstimator, str | None]:
    """The estimator of a load, and the verdict that excludes a fit; None if it can be fitted.

    Raises:
        ValueError: The estimator cannot use this driver.
    """
    of_caller, name = options.estimator, preflight(seen)
    estimator = of_caller or MAXIMUM_LIKELIHOOD
    current = seen.by_current if isinstance(driver, ContinuousDriver) else None
    if name is None and of_caller is None and current is not None and seen.is_whole:
        name = preflight(current, periodic=True)
        if name == "flat":  # v_out is not; without a signal a current contradicts nothing
            name = None
        elif name is not None or seen.has_all:
            estimator = WITH_CURRENT
    if name is None and isinstance(estimator, MaximumLikelihood) and estimator.with_current:
        if not seen.has_all:
            raise ValueError(
                f"recording {seen.recording.path!r}: method {str(estimator)!r} needs a driver and "
                "a current, and no disturbed periods; use the method maximum_likelihood"
            )
        if seen.by_current is not None and seen.by_current.is_aliased:
            name = "biased"
    name = name or unfit(estimator, seen)
    estimator.check_driver(driver, seen.recording.sample_rate)
    if isinstance(driver, ContinuousDriver) and issubclass(estimator.driver, ContinuousDriver):
        check_instrument(driver.instrument, estimator)
    return options.given_to(estimator), name
