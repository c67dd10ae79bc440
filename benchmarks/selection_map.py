"""The failure map with `circuit="auto"`: what is silently wrong, and what is right.

Cells, drivers and trials are those of `benchmarks.failure_map`, and so is what *wrong* and *silent*
mean. An answer is *right* if it is successful and no element is wrong.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from benchmarks.estimators import Answer
from benchmarks.failure_axes import Cell, cells
from benchmarks.rates import Rate, rate

OTHER_SKIN = "SNR and skin that is not one RC"
RIGHT_SNR = ("40 dB", "60 dB", "80 dB")


def chosen_cells() -> list[Cell]:
    """Cells of the map in which the circuit is not given, and the records are as usual.

    Another length, rate or order would compile all candidates anew, a minute for each.
    """
    every = [cell for cell in cells() if cell.circuit is None]
    [usual] = {cell.shape for cell in every if cell.chart == OTHER_SKIN}
    return [cell for cell in every if cell.shape == usual]


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
