"""What methods say of the cells of `benchmarks.failure_axes`, and what is true there.

For skin that is not one RC the truth is the limits of its impedance at low and high frequency, and
the bound that of one RC with them. A resistor that is fitted to skin should be R_s + R_p, in the
place of R_p.
"""

import dataclasses
import zlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import etid
from benchmarks.estimators import DEFAULT, NOTHING, Answer, Drivers, fits, found_by
from benchmarks.failure_axes import Cell, Cole
from benchmarks.selection_draws import choices
from etid.circuits.circuit import Resistor, SkinRC
from etid.estimators.registry import named
from etid.results.driver import DiscreteDriver
from etid.results.fit import Fit
from etid.signals.transfer import is_stable
from etid.simulation.scenes import Scene
from etid.simulation.transformer import SkinLoad

AUTO = "auto"  # the name of `circuit="auto"` among the methods
NOT_CONVERGED = ("max_steps_reached", "nonfinite")


class Effort(NamedTuple):
    """How much is drawn of a cell: calibrations, and trials behind each."""

    drivers: int
    trials: int


def elements(load: Any) -> SkinLoad:
    """The true elements of a load of these scenes."""
    return getattr(load, "elements", load)


def bounds(scene: Scene) -> dict[str, np.ndarray]:
    """Relative bounds of the elements by path; NaN where an element does not exist."""
    loads = {t.path: t.load for t in scene.trials}
    one_rc = {p: z.skin if isinstance(z, Cole) else elements(z) for p, z in loads.items()}
    trials = tuple(dataclasses.replace(t, load=one_rc[t.path]) for t in scene.trials)
    found = etid.bound(dataclasses.replace(scene, trials=trials))
    exist = {path: np.isfinite(dataclasses.astuple(elements(z))) for path, z in loads.items()}
    return {p: np.where(exist[p], list(of.relative.values()), np.nan) for p, of in found.items()}


def seeds(cell: Cell, count: int) -> Iterator[int]:
    """Seeds of a cell, which no other cell has: their draws are to be independent."""
    first = zlib.crc32(f"{cell.chart}/{cell.row}/{cell.column}".encode())
    return (first + number for number in range(count))


def recordings(cell: Cell, seed: int) -> tuple[list[etid.Recording], list[etid.Recording]]:
    rng = np.random.default_rng([seed, *b"change"])
    every = list(cell.scene.simulate(seed).recordings())
    every = every if cell.change is None else [cell.change(record, rng) for record in every]
    return [r for r in every if r.is_calibration], [r for r in every if not r.is_calibration]


def limits(fit: Fit) -> tuple[np.ndarray, np.ndarray]:
    """R_s, R_p and C_p of a chosen circuit, as the limits of its impedance; standard errors.

    R_s = Z(∞), R_p = Z(0) − R_s, and 1/C_p = lim |ω (Z − R_s)| at high ω. A circuit without R_s
    says that it is 0, and a resistor that R_p is 0; what has no C_p says nothing of it.
    """
    names = fit.circuit.names()

    def found(values: Array) -> Array:
        of, nothing = dict(zip(names, values, strict=True)), jnp.zeros(())
        parallel = [of[name] for name in ("r_p", "r_1", "r_2") if name in of]
        elastances = [1 / of[name] for name in names if name.startswith("c_")]
        capacitance = 1 / sum(elastances, nothing) if elastances else nothing + jnp.nan
        series = of.get("r_s", of.get("r", nothing))
        return jnp.stack([series, sum(parallel, nothing), capacitance])

    values = jnp.asarray(fit.circuit.values())
    if not np.isfinite(values).all():
        return NOTHING, NOTHING
    slopes = np.asarray(jax.jacfwd(found)(values))
    return np.asarray(found(values)), np.sqrt(np.diagonal(slopes @ np.asarray(fit.cov) @ slopes.T))


def judged(cell: Cell, none: Answer, fit: Fit, driver: etid.Driver) -> Answer:
    """What a fit says of one trial; `none` is the answer without it."""
    load = next(trial.load for trial in cell.scene.trials if trial.path == none.path)
    true, exact = elements(load), isinstance(load, SkinLoad) and cell.circuit is None
    truth = np.array(dataclasses.astuple(true))
    if none.method == AUTO:
        value, stderr = limits(fit)
        exact = exact and isinstance(fit.circuit, SkinRC)
    elif isinstance(fit.circuit, Resistor):
        truth, value, stderr = (
            np.array([np.nan, float(r), np.nan])
            for r in (true.r_s + true.r_p, fit.circuit.r, fit.stderr.r)
        )
    else:
        value, stderr, _ = found_by(fit)
    words = fit.verdict, driver.verdict
    discrete = isinstance(driver, DiscreteDriver) and not bool(is_stable(driver.a))
    return dataclasses.replace(
        none,
        verdict=fit.verdict,
        error=value / truth - 1,
        stderr=stderr / truth,
        chi2=float(fit.chi2),
        exact=exact,
        unstable=discrete or "unstable" in words,
        unsettled=any(word in NOT_CONVERGED for word in words),
    )


def said(
    cell: Cell,
    seed: int,
    name: str,
    records: Sequence[etid.Recording],
    driver: etid.Driver | None,
    bound: Mapping[str, np.ndarray],
) -> Iterator[Answer]:
    """What a method says of some trials of one seed."""
    found: Sequence[Fit | None] = (
        [one.fit for one in choices(records, driver)]
        if name == AUTO and driver is not None
        else fits(records, driver, name, cell.circuit)
    )
    for one, fit in zip(records, found, strict=True):
        none = Answer(name, seed, one.path, "driver_failed", NOTHING, NOTHING, bound[one.path])
        yield none if fit is None or driver is None else judged(cell, none, fit, driver)


def answers(cell: Cell, efforts: Mapping[str, Effort]) -> list[Answer]:
    """All answers in a cell, by the methods of `efforts`."""
    bound, found = bounds(cell.scene), list[Answer]()
    for number, seed in enumerate(seeds(cell, max(e.drivers for e in efforts.values()))):
        (calibrations, trials), drivers = recordings(cell, seed), Drivers(cell.order)
        for name, of in efforts.items():
            able = cell.circuit is None or name == DEFAULT or named(name).any_circuit
            if able and number < of.drivers:
                driver = drivers.of(calibrations, DEFAULT if name == AUTO else name)
                found += said(cell, seed, name, trials[: of.trials], driver, bound)
    return found
