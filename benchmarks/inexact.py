"""Loads that are no circuit, and channels that are not equal: what are elements and ± worth?

The gain of each loaded record of `benchmarks.perturbed_study.undisturbed` has a smooth random
relative error δ, a Gaussian process in ln f. The default method is compared with generalised least
squares that knows the covariance of δ, which nobody does. Coverage is that of 1.96 ±.

Then the same for drivers that are no few poles: Z_th has such an error, which is common to the
calibrations and to exact skin. Their order is 5, or 7 where 5 is too low.
"""

import argparse
import dataclasses
import itertools
from collections.abc import Callable, Iterable

import jax
import numpy as np

import etid
from benchmarks import perturbed_study as lab
from benchmarks.estimators import load_behind
from benchmarks.rates import NORMAL_95
from benchmarks.runner import WORKERS, Target, each, option, report
from etid.likelihood.approximate import extended, with_delta
from etid.likelihood.approximate_driver import nearest, with_departure
from etid.likelihood.calibrations import Calibrations
from etid.likelihood.discrepancy import nodes
from etid.likelihood.driver import minimum as minimum_of_driver
from etid.likelihood.search import minimum
from etid.likelihood.starts import starts
from etid.results.driver import HarmonicDriver
from etid.simulation.transformer import Impedance, ResistorLoad, TransformerDriver

SIZES, LENGTHS = (5e-4, 2e-3, 1e-2, 3e-2), (0.5, 1.0, 2.0, 3.0)
DRIVER_SIZES = 2e-3, 1e-2
RESISTORS = 98.8e3, 21.62e3, 216.6e3, 55.2e3  # [ohm]
ORDERS = 5, 7
BAND = 30.0, 1e5  # [Hz] of δ; it is constant beyond
POINTS = 100  # of δ between its ends
X = np.linspace(np.log(BAND[0]), np.log(BAND[1]), POINTS)  # ln f of δ
FIRST = 7000  # number of the first driver

MOST_ERROR = 1.3  # rms error, relative to that of a fit that knows the covariance of δ
COVERED = 0.90, 0.97  # of 1.96 ±

OPTIONS = (
    WORKERS,
    option("--snr-db", default=(40.0, 60.0, 80.0), metavar="DB"),
    option("--sizes", default=SIZES, nargs="*"),
    option("--lengths", default=LENGTHS),
    option("--drivers", default=40),
    option("--driver-sizes", default=DRIVER_SIZES, nargs="*", help="of the error of Z_th"),
    option("--resistors", default=2, help="number of known resistors behind such a driver"),
    option("--parts", default=lab.PARTS, help="spread of the parts of the drivers"),
)


def covariance(x: np.ndarray, size: float, length: float) -> np.ndarray:
    """That of δ between values of ln f."""
    return size**2 * np.exp(-0.5 * ((x[:, None] - x) / length) ** 2)


def drawn(rng: np.random.Generator, length: float) -> np.ndarray:
    """δ of size 1 at `X`."""
    root = np.linalg.cholesky(covariance(X, 1.0, length) + 1e-10 * np.eye(POINTS))
    real, imaginary = root @ rng.standard_normal((2, POINTS, 1))
    return (real + 1j * imaginary)[:, 0]


@dataclasses.dataclass(frozen=True)
class Inexact:
    """A load behind a driver whose gain is wrong by e^δ, as an impedance.

    Attributes:
        load: The load.
        driver: The driver.
        x: ln f.
        delta: δ there.
    """

    load: Impedance
    driver: TransformerDriver
    x: np.ndarray
    delta: np.ndarray

    def __call__(self, f: np.ndarray) -> np.ndarray:
        """The impedance that makes this gain."""
        delta = np.interp(np.log(np.maximum(f, 1e-9)), self.x, self.delta)
        z, z_th = self.load(f), self.driver.z_th(f)
        gain = z / (z + z_th) * np.exp(delta)
        return z_th * gain / (1 - gain)


def inexact(study: lab.Study, size: float, length: float) -> lab.Study:
    """The study with a δ of its own for each loaded record."""
    rng = np.random.default_rng([study.number, *b"inexact"])

    def change(of: lab.Record) -> lab.Record:
        (load,), delta = of.out.loads, size * drawn(rng, length)
        return lab.out(loads=(Inexact(load, of.out.driver, X, delta),))(of)

    return lab.trials(change)(study)


@dataclasses.dataclass(frozen=True)
class InexactDriver(TransformerDriver):
    """A driver whose Z_th is wrong by e^δ.

    Attributes:
        x: ln f.
        delta: δ there.
    """

    x: tuple[float, ...] = ()
    delta: tuple[complex, ...] = ()

    def z_th(self, f: np.ndarray) -> np.ndarray:
        """The impedance [ohm] at frequencies [Hz]."""
        return super().z_th(f) * np.exp(np.interp(np.log(np.maximum(f, 1e-9)), self.x, self.delta))


def inexact_driver(study: lab.Study, size: float, length: float, resistors: int = 2) -> lab.Study:
    """The study with a Z_th that has one δ in all its records, and with so many calibrations."""
    rng = np.random.default_rng([study.number, *b"inexact driver"])
    delta = drawn(rng, length)
    [first] = study.calibrations
    every = [first]
    for r_load in RESISTORS[1:resistors]:
        late = lab.DELAY * rng.standard_normal(2)
        one = lab.record(path=f"calibration/{r_load:g}", r_load=r_load)(first)
        one = lab.th(delay=late[0])(one)
        every.append(lab.out(delay=late[1], loads=(ResistorLoad(r_load),))(one))
    usual = first.out.driver
    parts = {of.name: getattr(usual, of.name) for of in dataclasses.fields(usual)}
    driver = InexactDriver(**parts, x=tuple(X), delta=tuple(size * delta))
    return lab.all_records(lab.both(driver=driver))(
        dataclasses.replace(study, calibrations=tuple(every))
    )


def identified(calibrations: list[etid.Recording]) -> HarmonicDriver:
    """The driver of the first order that is not too low."""
    first, higher = ORDERS
    found = etid.identify_driver(calibrations, order=first, throw=False)
    if found.verdict == "order_too_low":
        found = etid.identify_driver(calibrations, order=higher, throw=False)
    assert isinstance(found, HarmonicDriver)
    return found


def knowing(driver: HarmonicDriver, size: float, length: float) -> HarmonicDriver:
    """The driver by a fit that knows the covariance of δ."""
    driver = jax.tree.map(np.asarray, driver)
    model = Calibrations.of(driver)
    start = model.start()
    if driver.inexact:
        source = dataclasses.replace(model.source, departure=None)
        of = model.source.modes, model.parameters(start).size
        start = np.concatenate([start[: of[0]], start[of[1] :]])
        model = dataclasses.replace(model, source=source)
    x = nodes(driver.spectra.x.shape[-1])
    every = with_departure(model, covariance(x, size, length))
    q = minimum_of_driver(every, nearest(every, model, start)[None]).q[0]
    every = every.at(q)
    kept = every.parameters(q).size
    cov = every.linear(every.near(q)).first(every.unknowns).covariance()[:kept, :kept]
    return dataclasses.replace(driver, source=every.source, calibration=every.calibration, cov=cov)


def behind(
    number: int, snr_db: float, size: float, length: float, parts: float, resistors: int
) -> list[tuple[np.ndarray, ...]]:
    """Errors and ± of each skin behind a driver that is inexact, and errors behind two others.

    One of the drivers knows the covariance of δ, the other is that of the same circuit without δ.
    """
    usual = lab.undisturbed(number, snr_db, parts)
    studies = [inexact_driver(usual, of, length, resistors).recordings() for of in (size, 0.0)]
    of, exact = studies
    driver, without = (identified(list(one.calibrations.recordings())) for one in studies)
    best, found = knowing(driver, size, length), []
    for path in of.loaded:
        pairs = (of[path], driver), (of[path], best), (exact[path], without)
        fit, *others = (etid.identify_skin(*pair, throw=False) for pair in pairs)
        logs = [np.log(np.asarray(one.circuit.values())) for one in others]
        found.append(errors(fit, usual.truths[path], logs))
    return found


def answers(
    number: int, snr_db: float, size: float, length: float, parts: float
) -> list[tuple[np.ndarray, ...]]:
    """Errors and ± of each skin, and errors of two other fits.

    One knows the covariance of δ, the other has the weights of the noise. They are those of the
    logarithms of the elements; ± is NaN if the fit cannot be used.
    """
    study = inexact(lab.undisturbed(number, snr_db, parts), size, length)
    of = study.recordings()
    driver = etid.identify_driver(list(of.calibrations.recordings()), throw=False)
    found = []
    for path, one in of.loaded.items():
        fit = etid.identify_skin(one, driver, throw=False)
        found.append(errors(fit, study.truths[path], _others(one, driver, fit, size, length)))
    return found


def errors(fit: etid.Fit, truth: lab.Truth, others: Iterable[np.ndarray]) -> tuple[np.ndarray, ...]:
    """Error and ± of a fit, NaN if it cannot be used, and errors of the logarithms of others."""
    values, true = np.asarray(fit.circuit.values()), np.log(truth.low)
    stderr = np.asarray(fit.stderr.values()) / values if fit.usable else np.full(3, np.nan)
    return np.log(values) - true, stderr, *(of - true for of in others)


def _others(
    one: etid.Recording, driver: etid.Driver, fit: etid.Fit, size: float, length: float
) -> tuple[np.ndarray, np.ndarray]:
    """Logarithms of the elements, by a fit that knows the covariance of δ, and by the noise."""
    load = load_behind(one, driver)
    start, by_noise = starts(load)[0], minimum(load, starts(load)).q[0, :3]
    start[:, :3] = np.log(np.asarray(fit.circuit.values()))  # its own minimum is near
    load = with_delta(load, covariance(nodes(load.records.x.shape[-1]), size, length)[None])
    return minimum(load, extended(load, start)[None]).q[0, :3], by_noise


def main(arguments: argparse.Namespace) -> bool:
    asked, levels = [], arguments.snr_db
    for snr_db, size, length in itertools.product(levels, arguments.sizes, arguments.lengths):
        of = snr_db, size, length, arguments.parts
        asked += _asked(arguments, answers, of, "by weights of the noise")
    for snr_db, size, length in itertools.product(
        levels, arguments.driver_sizes, arguments.lengths
    ):
        of = snr_db, size, length, arguments.parts, arguments.resistors
        asked += _asked(arguments, behind, of, "behind an exact driver", " of Z_th")
    return report(asked)


def _asked(
    arguments: argparse.Namespace,
    answer: Callable[..., list[tuple[np.ndarray, ...]]],
    of: tuple[float, ...],
    other: str,
    kind: str = "",
) -> list[Target]:
    """What is asked of one size and length of δ; prints what is found."""
    asked, (snr_db, size, length, *_) = [], of
    tasks = [(number, *of) for number in range(FIRST, FIRST + arguments.drivers)]
    done = dict(each(answer, tasks, arguments.workers, "driver", "inexact"))
    for path, rows in zip(lab.LOADS, zip(*done.values(), strict=True), strict=True):
        error, stderr, best, compared = np.moveaxis(np.array(rows), 1, 0)
        used = np.isfinite(stderr).all(-1)
        name = f"{snr_db:g} dB, δ{kind} {size:.2%}, length {length:g}, {path}"
        ratio = np.sqrt(np.mean(error[used] ** 2, 0) / np.mean(best[used] ** 2, 0))
        covered = np.mean(np.abs(error[used]) < NORMAL_95 * stderr[used], 0)
        print(f"{name}: {used.mean():.0%} usable; rms error "
              f"{', '.join(f'{one:.2%}' for one in np.sqrt(np.mean(error[used] ** 2, 0)))}, "
              f"{other} {', '.join(f'{one:.2%}' for one in np.sqrt(np.mean(compared ** 2, 0)))}; "
              f"± {', '.join(f'{one:.2%}' for one in np.median(stderr[used], 0))}; within "
              f"{', '.join(f'{one:.2f}' for one in covered)}", flush=True)  # fmt: skip
        asked += [
            Target(f"{name}: error relative to that of a fit that knows δ", float(ratio.max()),
                   most=MOST_ERROR),
            Target(f"{name}: within 1.96 ±", float(covered.mean()), *COVERED),
        ]  # fmt: skip
    return asked
