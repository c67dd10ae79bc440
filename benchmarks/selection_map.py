"""The failure map with `circuit="auto"`: what is silently wrong, and what is right.

Cells, drivers and trials are those of `benchmarks.failure_map`, and so is what *wrong* and *silent*
mean. The chosen circuit is judged by the limits of its impedance: R_s = Z(∞), R_p = Z(0) − R_s, and
1/C_p = lim |ω (Z − R_s)| at high ω. A circuit without R_s says that R_s is 0, and a resistor that
R_p is 0. An answer is *right* if it is successful and no element is wrong.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from benchmarks.estimators import DEFAULT, NOTHING, Answer, Drivers
from benchmarks.failure_axes import Cell, cells
from benchmarks.failure_map import bounds, elements, recordings, seeds
from benchmarks.mappings import make_room
from benchmarks.rates import Rate, rate
from benchmarks.selection_draws import choices
from etid.circuits.circuit import AbstractCircuit, SkinRC
from etid.results.fit import Fit
from etid.simulation.transformer import SkinLoad

AUTO = "auto"
OTHER_SKIN = "SNR and skin that is not one RC"
RIGHT_SNR = ("40 dB", "60 dB", "80 dB")


def chosen_cells() -> list[Cell]:
    """Cells of the map in which the circuit is not given, and the records are as usual.

    Another length, rate or order would compile all candidates anew, a minute for each.
    """
    every = [cell for cell in cells() if cell.circuit is None]
    [usual] = {cell.shape for cell in every if cell.chart == OTHER_SKIN}
    return [cell for cell in every if cell.shape == usual]


def limits(circuit: AbstractCircuit) -> tuple[np.ndarray, np.ndarray]:
    """R_s, R_p and C_p of a circuit, and their slopes (limit, element); NaN for a missing C_p."""
    names = circuit.names()

    def found(values: Array) -> Array:
        of, nothing = dict(zip(names, values, strict=True)), jnp.zeros(())
        parallel = [of[name] for name in ("r_p", "r_1", "r_2") if name in of]
        elastances = [1 / of[name] for name in names if name.startswith("c_")]
        capacitance = 1 / sum(elastances, nothing) if elastances else nothing + jnp.nan
        series = of.get("r_s", of.get("r", nothing))
        return jnp.stack([series, sum(parallel, nothing), capacitance])

    values = jnp.asarray(circuit.values())
    return np.asarray(found(values)), np.asarray(jax.jacfwd(found)(values))


def answer(cell: Cell, seed: int, path: str, fit: Fit, bound: np.ndarray) -> Answer:
    """What a chosen circuit says of one trial."""
    load = next(trial.load for trial in cell.scene.trials if trial.path == path)
    truth = np.array(dataclasses.astuple(elements(load)))
    found, slopes = limits(fit.circuit)
    error = np.sqrt(np.diagonal(slopes @ np.asarray(fit.cov) @ slopes.T))
    exact = isinstance(load, SkinLoad) and isinstance(fit.circuit, SkinRC)
    finite = np.isfinite(np.asarray(fit.circuit.values())).all()
    off = found / truth - 1 if finite else NOTHING
    return Answer(AUTO, seed, path, fit.verdict, off, error / truth, bound, exact=exact)


def answers(cell: Cell, drivers: int, trials: int) -> list[Answer]:
    """All answers in a cell."""
    with jax.enable_x64(True):  # of a worker process
        bound, found = bounds(cell.scene), list[Answer]()
        for seed in seeds(cell, drivers):
            calibrations, records = recordings(cell, seed)
            driver, records = Drivers(cell.order).of(calibrations, DEFAULT), records[:trials]
            if driver is None:
                nothing = "driver_failed", NOTHING, NOTHING
                found += [Answer(AUTO, seed, r.path, *nothing, bound[r.path]) for r in records]
                continue
            for record, one in zip(records, choices(records, driver), strict=True):
                found.append(answer(cell, seed, record.path, one.fit, bound[record.path]))
        make_room()
        return found


def is_right(one: Answer) -> bool:
    """Whether an answer is successful and no element is wrong."""
    return one.successful and not one.wrong


def missed_elements(answers: Sequence[Answer]) -> tuple[int, int]:
    """Elements determined to 10 % that are silently wrong, and number of all such elements."""
    missed = [one.silent_elements & one.determined for one in answers]
    return int(np.sum(missed)), int(np.sum([one.determined for one in answers]))


def row(cell: Cell, found: Sequence[Answer]) -> dict[str, Any]:
    """One row of the table."""
    asked = [one for one in found if one.target]
    return {
        **cell.place,
        "drivers": len({one.seed for one in found}),
        "trials": len(found),
        "right": float(np.mean([is_right(one) for one in found])),
        "successful": sum(one.successful for one in found),
        "silent": sum(one.silent for one in found),
        "determined": len(asked),
        "missed": sum(one.missed for one in asked),
        "determined_elements": missed_elements(asked)[1],
    }


def right_from_40_db(every: Sequence[Cell], found: Sequence[Sequence[Answer]]) -> Rate:
    """Right answers for skin that is not one RC, from 40 dB on."""
    asked = [
        one
        for cell, answered in zip(every, found, strict=True)
        for one in answered
        if cell.chart == OTHER_SKIN and cell.row in RIGHT_SNR
    ]
    return rate([is_right(one) for one in asked], [one.seed for one in asked])
