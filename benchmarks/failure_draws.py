"""Draws of a cell: what each method answers, and what that is: wrong, silent, unstable.

An element is *wrong* if it is off by more than five standard deviations of its Cramer-Rao bound,
or by more than 20 %. It is wrong *silently* if the verdict is `successful` and five of its own
standard errors do not cover the truth either; a method that gives none covers nothing. Any other
verdict of the fit, and a calibration or record that pre-flight refuses, is a method that says so.
What a fit says counts, not what its driver said: a batch has the fits only.

Where the bound of an element exceeds 4 %, five sd are more than 20 %: it is wrong sometimes in any
answer, and silent only if its own standard errors are wrong too. Where it exceeds 10 % nothing is
asked of it.

For skin that is not one RC the truth is the limits of its impedance at low and high frequency, and
the bound that of one RC with them. What its elements are is a matter of words to a few per cent: it
is wrong by 20 % only. So is a resistor that is fitted to skin, by R_s + R_p, in the place of R_p.
"""

import dataclasses
import zlib
from collections.abc import Iterator, Sequence

import jax
import numpy as np
from jaxtyping import Bool, Float

import etid
from benchmarks.estimators import DEFAULT, FAR, driver_of, is_off, shared
from benchmarks.failure_axes import Cell, Cole, TwoLayers
from benchmarks.mappings import make_room
from etid.circuits.circuit import AbstractCircuit, Resistor, SkinRC
from etid.estimators.registry import named
from etid.identify.arguments import for_calibrations
from etid.recordings.preflight import Inspected
from etid.results.driver import DiscreteDriver
from etid.signals.transfer import is_stable
from etid.simulation.scenes import Scene
from etid.simulation.transformer import Impedance, SkinLoad

ELEMENTS = SkinRC.names()
DETERMINED = 0.1  # bound of an element for which it must not be wrong silently
NOT_CONVERGED = ("max_steps_reached", "nonfinite")


@dataclasses.dataclass(frozen=True)
class Effort:
    """How much is drawn of a cell.

    Attributes:
        drivers: Calibrations, each with trials of its own.
        trials: Behind each.
    """

    drivers: int
    trials: int


@dataclasses.dataclass(frozen=True)
class Answer:
    """One method's answer to one trial; arrays are (element,), relative to the true elements.

    Attributes:
        method: Its name, or `default`.
        seed: Of the scene.
        path: Of the trial.
        verdict: Name of the verdict.
        error: Estimate / truth − 1; NaN without an answer, or where there is no truth.
        stderr: Standard error, NaN where there is none.
        bound: Cramer-Rao bound, NaN where the element is not determined at all.
        chi2: Of the fit.
        unstable: Whether a filter of the driver has a pole outside the unit circle, or the verdict
            is `unstable`.
        unsettled: Whether the iteration for the driver or the skin did not converge.
        exact: Whether the circuit that is fitted is the one that was simulated.
    """

    method: str
    seed: int
    path: str
    verdict: str
    error: Float[np.ndarray, " element"]
    stderr: Float[np.ndarray, " element"]
    bound: Float[np.ndarray, " element"]
    chi2: float = np.nan
    unstable: bool = False
    unsettled: bool = False
    exact: bool = True

    @property
    def successful(self) -> bool:
        """Whether it claims to be right."""
        return self.verdict == "successful"

    @property
    def refused(self) -> bool:
        """Whether there is no answer."""
        return bool(np.isnan(self.error).all())

    @property
    def wrong_elements(self) -> Bool[np.ndarray, " element"]:
        """More than five sd of the bound or 20 % off."""
        bound = self.bound if self.exact else np.full_like(self.bound, np.inf)
        return is_off(np.abs(self.error), bound)

    @property
    def silent_elements(self) -> Bool[np.ndarray, " element"]:
        """Wrong, called successful, and not covered by the standard errors."""
        covered = np.abs(self.error) <= FAR * self.stderr
        return self.wrong_elements & ~covered & self.successful

    @property
    def wrong(self) -> bool:
        """Whether an element is wrong."""
        return bool(self.wrong_elements.any())

    @property
    def silent(self) -> bool:
        """Whether an element is wrong silently."""
        return bool(self.silent_elements.any())

    @property
    def target(self) -> bool:
        """Whether an element must not be wrong silently."""
        return bool((self.bound <= DETERMINED).any())

    @property
    def missed(self) -> bool:
        """Whether an element is that must not be."""
        return bool((self.silent_elements & (self.bound <= DETERMINED)).any())


def elements(load: Impedance | AbstractCircuit) -> SkinLoad:
    """The true elements of a load of these scenes."""
    if isinstance(load, TwoLayers | Cole):
        return load.elements
    assert isinstance(load, SkinLoad)
    return load


def fitted_values(circuit: AbstractCircuit) -> Float[np.ndarray, " element"]:
    """Elements that are fitted; a resistor is in the place of R_p."""
    if isinstance(circuit, Resistor):
        return np.array([np.nan, float(circuit.r), np.nan])
    return np.asarray(circuit.values())


def true_values(skin: SkinLoad, circuit: AbstractCircuit) -> Float[np.ndarray, " element"]:
    """What they should be."""
    if isinstance(circuit, Resistor):
        return np.array([np.nan, skin.r_s + skin.r_p, np.nan])
    return np.array(dataclasses.astuple(skin))


def bounds(scene: Scene) -> dict[str, Float[np.ndarray, " element"]]:
    """Relative bounds of the elements by path; NaN where an element does not exist."""

    def one_rc(load: Impedance | AbstractCircuit) -> SkinLoad:
        return load.skin if isinstance(load, Cole) else elements(load)

    trials = tuple(dataclasses.replace(t, load=one_rc(t.load)) for t in scene.trials)
    found = etid.bound(dataclasses.replace(scene, trials=trials))
    exist = {t.path: np.array(dataclasses.astuple(elements(t.load))) for t in scene.trials}
    return {
        path: np.where(np.isnan(exist[path]), np.nan, list(of.relative.values()))
        for path, of in found.items()
    }


class Draw:
    """The recordings of one seed, and drivers from their calibrations, each identified once."""

    def __init__(self, cell: Cell, seed: int):
        self.cell = cell
        self.seed = seed
        study = cell.scene.simulate(seed)
        change = cell.change
        rng = np.random.default_rng([seed, *b"change"])
        records = study.recordings()
        every = list(records if change is None else (change(r, rng) for r in records))
        self.calibrations = [r for r in every if r.is_calibration]
        self.trials = [r for r in every if not r.is_calibration]
        self._drivers: dict[str | None, etid.Driver | None] = {}

    def driver(self, method: str | None) -> etid.Driver | None:
        """The driver for a method; None if pre-flight refuses the calibration.

        All methods on the harmonics use that of maximum likelihood, and the default method is one
        of the others.
        """
        seen = [Inspected(record) for record in self.calibrations]
        chosen = method or str(for_calibrations(None, seen))
        kind = shared(chosen)
        if kind not in self._drivers:
            self._drivers[kind] = driver_of(self.calibrations, kind, self.cell.order)
        return self._drivers[kind]

    def answers(
        self, name: str, trials: int, limits: dict[str, Float[np.ndarray, " element"]]
    ) -> Iterator[Answer]:
        """What a method says of the first trials."""
        method = None if name == DEFAULT else name
        records, driver = self.trials[:trials], self.driver(method)
        nothing = np.full(len(ELEMENTS), np.nan)
        if driver is None:
            for record in records:
                bound = limits[record.path]
                yield Answer(name, self.seed, record.path, "driver_failed", nothing, nothing, bound)
            return
        loads = {t.path: t.load for t in self.cell.scene.trials}
        discrete = isinstance(driver, DiscreteDriver) and not bool(is_stable(driver.a))
        fits = etid.identify_skins(records, driver, method=method, circuit=self.cell.circuit)
        for number, record in enumerate(records):
            fit, path = fits[number], record.path
            truth = true_values(elements(loads[path]), fit.circuit)
            said = (fit.verdict, driver.verdict)
            yield Answer(
                name,
                self.seed,
                path,
                fit.verdict,
                fitted_values(fit.circuit) / truth - 1,
                fitted_values(fit.stderr) / truth,
                limits[path],
                float(fit.chi2),
                discrete or "unstable" in said,
                any(word in NOT_CONVERGED for word in said),
                isinstance(loads[path], SkinLoad) and self.cell.circuit is None,
            )


def seeds(cell: Cell, count: int) -> Iterator[int]:
    """Seeds of a cell, which no other cell has: their draws are to be independent."""
    first = zlib.crc32(f"{cell.chart}/{cell.row}/{cell.column}".encode())
    return (first + number for number in range(count))


def answers(cell: Cell, efforts: dict[str, Effort]) -> list[Answer]:
    """All answers in a cell, by the methods of `efforts`."""
    with jax.enable_x64(True):  # of a worker process
        limits = bounds(cell.scene)
        found: list[Answer] = []
        for number, seed in enumerate(seeds(cell, max(e.drivers for e in efforts.values()))):
            drawn = Draw(cell, seed)
            for name, effort in efforts.items():
                able = cell.circuit is None or name == DEFAULT or named(name).any_circuit
                if able and number < effort.drivers:
                    found += drawn.answers(name, effort.trials, limits)
    return found


def chunk(cells: Sequence[Cell], efforts: Sequence[dict[str, Effort]]) -> list[list[Answer]]:
    """The same for several cells."""
    found = []
    for cell, effort in zip(cells, efforts, strict=True):
        found.append(answers(cell, effort))
        make_room()
    return found
