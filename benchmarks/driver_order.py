"""Does `order="auto"` choose the order of a driver that identifies elements well?

For each SNR, drivers with six poles are drawn (parts differ by 3 %), each with a calibration of
98.8 kΩ, which is all that `order="auto"` sees, and a dry and a damp fingertip. Fits of all verdicts
count. A choice is right if the fixed order of this number has an error of at most `AS_GOOD` times
that of the best fixed order, or if the elements differ by at most `NEAR` bounds from those of the
best one (root mean square): some drivers show a pole less than the others. The orders of the SPICE
recordings are shown too, where they are present.
"""

import argparse
import collections
import pathlib
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

import etid
from benchmarks.coverage import identified, scene, with_driver
from benchmarks.estimators import Drivers
from benchmarks.perturbed_study import PARTS
from benchmarks.rates import NORMAL_95
from benchmarks.runner import Target, at_least, option, report
from benchmarks.spice import DATA, FOLDER, imported
from etid.results.driver import AUTO, Order
from etid.selection.driver_order import FIRST
from etid.simulation.scenes import Scene

AS_GOOD = 1.1  # of 20 drivers with two skins, a root mean square is known to about 10 %
NEAR = 0.5  # bounds
# SPICE recordings behind a driver that needs no further pole.
SHOWN = ("lab_dry", "lab_damp", "jitter_dry", "jitter_damp", "clean_dry", "clean_damp")

TARGETS = {
    "right choices": at_least(0.98),
    **{f"order, {name}": (FIRST, FIRST) for name in SHOWN},
}
OPTIONS = (
    DATA,
    option("--snr-db", default=(40.0, 60.0, 80.0)),
    option("--orders", default=(4, 5, 6, 7)),
    option("--drivers", default=20, help="drawn for each SNR"),
)


class Found(NamedTuple):
    """The fits behind drivers of one order."""

    order: np.ndarray  # poles of each driver
    error: Float[np.ndarray, "driver trial element"]  # errors of the elements in their bounds
    z: Float[np.ndarray, "driver trial element"]  # the same in standard errors

    @property
    def rms(self) -> float:
        """Root mean square of the errors; infinite if one is no number."""
        square = np.mean(self.error**2)
        return float(np.sqrt(square)) if np.isfinite(square) else np.inf


def found_with(order: Order, drawn: Sequence[Scene]) -> Found:
    """Fits of drawn scenes, one recording of each trial, by drivers of an order."""
    drivers, truth, bounds = Drivers(order), drawn[0].truth(), [etid.bound(of) for of in drawn]
    studies = [of.simulate(seed) for seed, of in enumerate(drawn)]
    paths = {of.path: list(truth[of.path].values()) for of in drawn[0].trials}
    every = identified(studies, paths, drivers=drivers)
    limits = {p: np.array([list(of[p].relative.values()) for of in bounds]) for p in every}
    return Found(
        np.array([0 if one is None else one.order for one in drivers.known.values()]),
        np.stack([of.error / limits[path] for path, of in every.items()], axis=1),
        np.stack([of.error / of.stderr for of in every.values()], axis=1),
    )


def right(found: Mapping[Order, Found]) -> np.ndarray:
    """Whether each choice is the best fixed order, or as good."""
    chosen = found[AUTO]
    errors = {order: of.rms for order, of in found.items() if order != AUTO}
    best = min(errors, key=lambda order: errors[order])
    as_good = [errors.get(int(order), np.inf) <= AS_GOOD * errors[best] for order in chosen.order]
    apart = np.sqrt(np.mean((chosen.error - found[best].error) ** 2, axis=(1, 2)))
    return np.asarray(as_good) | (apart <= NEAR)


def spice_orders(folder: pathlib.Path, names: Iterable[str]) -> dict[str, int]:
    """The orders chosen for the calibrations of SPICE recordings, by name."""
    found = {}
    for name in names:
        with imported(folder / f"{name}.npz") as study:
            calibrations = list(study.calibrations.recordings())
            found[name] = etid.identify_driver(calibrations, order=AUTO, throw=False).order
    return found


def main(arguments: argparse.Namespace) -> bool:
    verdicts = list[bool]()
    for snr_db in arguments.snr_db:
        usual = scene(snr_db, 10_000)
        drawn = [with_driver(usual, seed, PARTS) for seed in range(arguments.drivers)]
        tried: list[Order] = [AUTO, *arguments.orders]
        by_order: dict[Order, Found] = {order: found_with(order, drawn) for order in tried}
        good, chosen = right(by_order), by_order[AUTO]
        errors = ", ".join(f"{order} {of.rms:.2f}" for order, of in by_order.items())
        counts = collections.Counter(chosen.order.tolist())
        orders = ", ".join(f"{count} of order {order}" for order, count in sorted(counts.items()))
        print(
            f"{snr_db:g} dB: error in bounds: {errors}; "
            f"{100 * np.mean(np.abs(chosen.z) < NORMAL_95):.1f} % covered, "
            f"{100 * np.mean(good):.0f} % right, {orders}",
            flush=True,
        )
        verdicts += good.tolist()
    found = {"right choices": float(np.mean(verdicts))}
    folder = arguments.data / FOLDER
    if folder.exists():
        orders_of = spice_orders(folder, SHOWN)
        found |= {f"order, {name}": order for name, order in orders_of.items()}
    else:
        print(f"no SPICE recordings at {folder}; pass their parent folder with --data")
    return report(Target.of(TARGETS, *of) for of in found.items())
