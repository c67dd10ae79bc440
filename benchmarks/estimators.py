"""Our estimators, the drivers that they share, and what their answers are: wrong, silent, refused.

An element is *wrong* if it is off by more than five standard deviations of its Cramer-Rao bound,
or by more than 20 %. It is wrong *silently* if its verdict is one of `USABLE` and five of its own
standard errors do not cover the truth either; a method that gives none covers nothing. What a fit
says counts, not what its driver said: a batch has the fits only. Nothing is asked of an element
whose bound exceeds 10 %. Those of skin that is not one RC are a matter of words to a few per cent:
they are wrong by 20 % only.
"""

import dataclasses
import time
import zlib
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Bool, Float

import etid
from benchmarks.rates import Rate, rate
from etid.circuits.circuit import AbstractCircuit, SkinRC
from etid.estimators.lanes import Harmonics
from etid.estimators.maximum_likelihood.rows import loads_of, source_of
from etid.estimators.registry import MAXIMUM_LIKELIHOOD, named, names
from etid.identify.fitting import known_of
from etid.likelihood.search import Load
from etid.recordings.preflight import Inspected
from etid.results.driver import Order
from etid.results.verdicts import USABLE, counted

DEFAULT = "default"
OURS = (DEFAULT, *names())
ELEMENTS = SkinRC.names()
FAR = 5.0  # standard deviations of the bound, and own standard errors
OFF = 0.2
DETERMINED = 0.1  # bound of an element for which it must not be wrong silently
NOTHING = np.full(len(ELEMENTS), np.nan)  # an answer without elements

Elements = Float[np.ndarray, " element"]


@dataclasses.dataclass(frozen=True)
class Answer:
    """A method's answer to one recording; arrays are (element,), relative to the true elements."""

    method: str  # its name, or `default`
    seed: int  # of the scene or number of the driver; answers of one seed share a driver
    path: str  # of the trial
    verdict: str  # name of the verdict
    error: Elements  # estimate / truth − 1; NaN without an answer, or where there is no truth
    stderr: Elements  # standard error, NaN where there is none
    bound: Elements  # cramer-Rao bound, NaN where the element is not determined at all
    chi2: float = np.nan  # of the fit
    unstable: bool = False  # whether the driver or the fit is unstable
    unsettled: bool = False  # whether the iteration for the driver or the skin did not converge
    # whether the fitted circuit is the true one: else elements are a matter of words
    exact: bool = True
    perturbation: str = ""  # what was done to the recording
    snr_db: float = np.nan  # of the noise [dB]

    @property
    def usable(self) -> bool:
        """Whether it claims to be right."""
        return self.verdict in USABLE

    @property
    def refused(self) -> bool:
        """Whether there is no answer."""
        return bool(np.isnan(self.error).all())

    @property
    def off(self) -> Bool[np.ndarray, " element"]:
        """Elements that are wrong: far by the bound, or far in per cent."""
        size = np.abs(self.error)
        return np.asarray((size > OFF) | ((size > FAR * self.bound) & self.exact))

    @property
    def silent_elements(self) -> Bool[np.ndarray, " element"]:
        """Wrong, called usable, and not covered by the standard errors."""
        return self.off & ~(np.abs(self.error) <= FAR * self.stderr) & self.usable

    @property
    def determined(self) -> Bool[np.ndarray, " element"]:
        """Elements that must not be wrong silently."""
        return self.bound <= DETERMINED

    @property
    def wrong(self) -> bool:
        """Whether an element is wrong."""
        return bool(self.off.any())

    @property
    def silent(self) -> bool:
        """Whether an element is wrong silently."""
        return bool(self.silent_elements.any())

    @property
    def target(self) -> bool:
        """Whether an element must not be wrong silently."""
        return bool(self.determined.any())

    @property
    def missed(self) -> bool:
        """Whether an element is that must not be."""
        return bool((self.silent_elements & self.determined).any())


def rate_of(answers: Sequence[Answer], event: Callable[[Answer], bool]) -> Rate:
    """Rate of an event, with the interval of answers that share drivers."""
    return rate([event(one) for one in answers], [one.seed for one in answers])


def verdicts(answers: Sequence[Answer]) -> str:
    """How often each verdict occurs, as text."""
    return counted(np.array([one.verdict for one in answers]))


class Drivers:
    """Drivers from calibrations; each is identified once for all methods that use the same."""

    def __init__(self, order: Order = 5):
        self.order: Order = order
        self.known: dict[tuple, etid.Driver | None] = {}
        self.times: dict[str, list[float]] = {}

    def kind(self, name: str) -> str:
        """The method that identifies the driver."""
        return str(MAXIMUM_LIKELIHOOD if name == DEFAULT else named(name))

    def of(self, calibrations: Sequence[etid.Recording], name: str) -> etid.Driver | None:
        """The driver for a method, whatever its verdict; None if a calibration is refused."""
        kind = self.kind(name)
        samples = (of for record in calibrations for of in record.samples.values())
        sums = (zlib.crc32(of.stored.tobytes()) for of in samples)
        key = kind, *sums, *(record.metadata for record in calibrations)
        if key not in self.known:
            begin, asked = time.perf_counter(), {"order": self.order, "method": kind}
            try:
                self.known[key] = etid.identify_driver(calibrations, **asked, throw=False)
            except etid.IdentificationError:
                self.known[key] = None
            self.times.setdefault(kind, []).append(time.perf_counter() - begin)
        return self.known[key]


def load_behind(recording: etid.Recording, driver: etid.Driver) -> Load:
    """The likelihood of one skin, as the default method has it."""
    lane = Harmonics.of(Inspected.of(recording))
    known = known_of(lane, driver, False, MAXIMUM_LIKELIHOOD)
    return loads_of([lane], source_of(known), SkinRC(), None, None)


def method_of(name: str) -> str | None:
    """A method as `identify_skin` takes it."""
    return None if name == DEFAULT else name


def fits(
    records: Sequence[etid.Recording],
    driver: etid.Driver | None,
    name: str,
    circuit: AbstractCircuit | None = None,
) -> list[etid.Fit | None]:
    """What a method makes of recordings behind one driver; nothing without a driver."""
    if driver is None:
        return [None] * len(records)
    found = etid.identify_skins(records, driver, method=method_of(name), circuit=circuit)
    return [found[number] for number in range(len(found))]


def found_by(fit: etid.Fit | None, size: int = len(ELEMENTS)) -> tuple[Elements, Elements, str]:
    """Elements, standard errors and verdict of a fit; without one its driver failed."""
    if fit is None:
        return np.full(size, np.nan), np.full(size, np.nan), "driver_failed"
    return np.asarray(fit.circuit.values()), np.asarray(fit.stderr.values()), fit.verdict
