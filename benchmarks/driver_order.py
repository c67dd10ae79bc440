"""Does `order="auto"` choose the order of a driver that identifies elements best?

For each SNR, drivers with six poles are drawn anew (parts differ by 3 %), each with a calibration
of 98.8 kΩ and a dry and a damp fingertip. `order="auto"` sees the calibration only. The table shows
the orders that it chose, the root mean square of the errors of the elements in units of the
Cramer-Rao bound, for it and for every fixed order, and how many of its 95 % intervals contain the
truth. Fits of all verdicts count: a verdict must not flatter the numbers.

A choice is right if the fixed order of this number has an error of at most `AS_GOOD` times that of
the best fixed order. It is right too if the elements differ by at most `NEAR` bounds from those of
the best fixed order (root mean square): some drivers show a pole less than the others. The orders
chosen for the SPICE recordings are shown too, where they are present: their driver shows three to
four poles at 60 dB, and five without noise.
"""

import argparse
import collections
import pathlib
import tempfile
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from tqdm import tqdm

import etid
from benchmarks.coverage import compared, scene, with_driver
from benchmarks.perturbed_study import PARTS
from benchmarks.rates import NORMAL_95
from benchmarks.runner import Target, at_least, option, report
from benchmarks.spice import DATA, FOLDER
from etid.results.driver import AUTO, Order

AS_GOOD = 1.1  # of 20 drivers with two skins, a root mean square is known to about 10 %
NEAR = 0.5  # bounds
# Orders that a driver of these SPICE recordings shows.
VISIBLE = {
    **dict.fromkeys(("lab_dry", "lab_damp", "jitter_dry", "jitter_damp"), (3, 4)),
    **dict.fromkeys(("clean_dry", "clean_damp"), (5, 5)),
}

TARGETS = {
    "right choices": at_least(0.98),
    **{f"order, {name}": limits for name, limits in VISIBLE.items()},
}
OPTIONS = (
    DATA,
    option("--snr-db", default=(40.0, 60.0, 80.0)),
    option("--orders", default=(3, 4, 5, 6)),
    option("--drivers", default=20, help="drawn for each SNR"),
    option("--samples", default=10_000),
)


class Draw(NamedTuple):
    """The fits behind one driver of a drawn scene."""

    order: int  # poles of this driver
    error: Float[np.ndarray, "trial element"]  # errors of the elements in units of their bounds
    z: Float[np.ndarray, "trial element"]  # the same in units of the standard errors


def draw(seed: int, snr_db: float, orders: Sequence[Order], samples: int) -> dict[Order, Draw]:
    """Fits of one drawn scene by orders of the driver.

    Args:
        seed: Of driver, noise and delays.
        snr_db: Of every record [dB].
        orders: Orders to identify the driver with.
        samples: Length of a record [samples].
    """
    drawn = with_driver(scene(snr_db, samples), seed, PARTS)
    study, bounds, truth, found = drawn.simulate(seed), etid.bound(drawn), drawn.truth(), {}
    for order in orders:
        calibrations = list(study.calibrations.recordings())
        driver, rows = etid.identify_driver(calibrations, order=order, throw=False), []
        for path in (trial.path for trial in drawn.trials):
            fit = etid.identify_skin(study[path], driver, throw=False)
            error, stderr, _ = compared(fit, list(truth[path].values()))
            rows.append((error / list(bounds[path].relative.values()), error / stderr))
        found[order] = Draw(driver.order, *map(np.array, zip(*rows, strict=True)))
    return found


def rms(draws: Sequence[dict[Order, Draw]], order: Order) -> float:
    """Root mean square of the errors in units of the bound; infinite if an error is no number."""
    squares = np.mean([one[order].error ** 2 for one in draws])
    return float(np.sqrt(squares)) if np.isfinite(squares) else np.inf


def right(draws: Sequence[dict[Order, Draw]], orders: Sequence[int]) -> list[bool]:
    """Whether each choice is the best fixed order, or as good."""
    errors = {order: rms(draws, order) for order in orders}
    best = min(orders, key=lambda order: errors[order])
    good = [errors.get(one[AUTO].order, np.inf) <= AS_GOOD * errors[best] for one in draws]
    apart = [np.sqrt(np.mean((one[AUTO].error - one[best].error) ** 2)) for one in draws]
    return [by_order or off <= NEAR for by_order, off in zip(good, apart, strict=True)]


def spice_orders(folder: pathlib.Path, names: Iterable[str]) -> dict[str, int]:
    """The orders chosen for the calibrations of SPICE recordings, by name."""
    found = {}
    for name in names:
        with tempfile.TemporaryDirectory() as work:
            file = pathlib.Path(work, "study.h5")
            etid.import_file(folder / f"{name}.npz", file)
            with etid.read(file) as study:
                calibrations = list(study.calibrations.recordings())
                found[name] = etid.identify_driver(calibrations, order=AUTO, throw=False).order
    return found


def main(arguments: argparse.Namespace) -> bool:
    """Print the table; whether enough choices are right."""
    orders, verdicts = tuple(arguments.orders), list[bool]()
    for snr_db in arguments.snr_db:
        draws = [
            draw(seed, snr_db, (AUTO, *orders), arguments.samples)
            for seed in tqdm(range(arguments.drivers), disable=None)
        ]
        good = right(draws, orders)
        covered = np.mean([np.abs(one[AUTO].z) < NORMAL_95 for one in draws])
        errors = ", ".join(f"{order} {rms(draws, order):.2f}" for order in (AUTO, *orders))
        chosen = collections.Counter(one[AUTO].order for one in draws)
        counts = ", ".join(f"{count} of order {order}" for order, count in sorted(chosen.items()))
        print(
            f"{snr_db:g} dB: error in bounds: {errors}; {100 * covered:.1f} % covered, "
            f"{100 * np.mean(good):.0f} % right, {counts}",
            flush=True,
        )
        verdicts += good
    found = {"right choices": float(np.mean(verdicts))}
    folder = arguments.data / FOLDER
    if folder.exists():
        orders_of = spice_orders(folder, VISIBLE)
        found |= {f"order, {name}": order for name, order in orders_of.items()}
    else:
        print(f"no SPICE recordings at {folder}; pass their parent folder with --data")
    return report(Target(name, value, *TARGETS[name]) for name, value in found.items())
