"""What do trigger delays cost, and when may a fit take them for zero?

First, from the Fisher information of one recording with one calibration of 98.8 kΩ, with Z_th free
at every harmonic: the bounds of the elements with the delays of both records open, with one delay
for both, and with none. Below each, why a single fit leaves its delay open: a rule drops the delays
if they are below two of their standard errors. For delays that scatter by so much, 2 000 draws show
how many 95 % intervals then contain the truth. Last, joint fits of studies of 20 recordings, whose
delays `identify_jointly` limits by their scatter.
"""

import argparse
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from tqdm import tqdm

import etid
from benchmarks.coverage import MORE, compared, scene, with_driver
from benchmarks.ladder import LOADS
from benchmarks.perturbed_study import PARTS
from benchmarks.rates import COVERED, NORMAL_95, covered
from benchmarks.runner import Target, option, report
from benchmarks.visibility import information
from etid.recordings.remarks import Remark

NYQUIST = 0.5  # of the sample rate
OPEN = 2.5  # [µs] width of the prior of a delay: half a sample at 200 kHz
DROPPED = 2.0  # standard errors below which the rule of the second table drops the delays
DRAWS = 2_000
SCATTER = (0.0, 3e-9, 10e-9, 20e-9, 100e-9)
EACH = 10  # dry and as many damp recordings of a study

OPTIONS = (
    option("--snr-db", default=(60.0, 40.0)),
    option("--scatter", default=SCATTER, help="[s]"),
    option("--studies", default=30, help="joint fits for each scatter"),
)


def with_prior(
    known: Float[np.ndarray, "5 5"], common: float, own: float
) -> Float[np.ndarray, "5 5"]:
    """Covariance if the delays have a common part and own parts of these deviations [µs]."""
    precision = known.copy()
    precision[3:, 3:] += np.linalg.inv(common**2 * np.ones((2, 2)) + own**2 * np.eye(2))
    return np.linalg.inv(precision)


def covered_after_dropping(
    known: Float[np.ndarray, "5 5"], scatter: float, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "3"], float]:
    """Part of the intervals that contain the truth, and part of the draws that drop the delays."""
    whole, without = with_prior(known, 0.0, OPEN), np.linalg.inv(known[:3, :3])
    true = np.pad(scatter * rng.standard_normal((DRAWS, 2)), ((0, 0), (3, 0)))
    found = true + rng.multivariate_normal(np.zeros(5), whole, DRAWS)
    apart = whole[3, 3] + whole[4, 4] - 2 * whole[3, 4]
    dropped = (np.abs(found[:, 3:]) < DROPPED * np.sqrt(np.diag(whole)[3:])).all(1)
    dropped &= np.abs(found[:, 3] - found[:, 4]) < DROPPED * np.sqrt(apart)
    # The elements at delays of zero, from the normal equations.
    zero = found[:, :3] + found[:, 3:] @ (without @ known[:3, 3:]).T
    z = np.where(
        dropped[:, None],
        zero / np.sqrt(np.diag(without)),
        found[:, :3] / np.sqrt(np.diag(whole)[:3]),
    )
    return (np.abs(z) < NORMAL_95).mean(0), float(dropped.mean())


class Study(NamedTuple):
    """Joint fits of a study: errors in standard errors and these, (trial, element); if limited."""

    z: np.ndarray
    stderr: np.ndarray
    limited: bool


def joint(seed: int, snr_db: float, scatter: float) -> Study:
    """Fits of a dry and a damp recording of 20 of a study whose delays scatter by so many s."""
    drawn = with_driver(scene(snr_db, 10_000, jitter=scatter, more=EACH - 1), seed, PARTS)
    fits, truth = etid.identify_jointly(drawn.simulate(seed)).fits, drawn.truth()
    counted = {p: fits[i] for i, p in enumerate(fits.labels["path"]) if not p.startswith(MORE)}
    rows = [compared(counted[path], list(truth[path].values())) for path in sorted(counted)]
    error, stderr = (np.array([row[i] for row in rows]) for i in (0, 1))
    limited = all(int(fit.remarks) & Remark.small_delays for fit in counted.values())
    return Study(error / stderr, stderr, limited)


def by_information(snr_db: float, scatters: list[float], rng: np.random.Generator) -> None:
    """Print the bounds, and what dropping small delays would cost."""
    for name, load in LOADS.items():
        known = information(load, snr_db, NYQUIST)
        rows = [with_prior(known, *widths) for widths in ((0.0, OPEN), (OPEN, 1e-5), (0, 1e-5))]
        texts = [_percent(np.sqrt(np.diag(cov)[:3])) for cov in rows]
        print(f"{snr_db:g} dB {name}: {'; '.join(texts)}")
        for scatter in scatters:
            inside, dropped = covered_after_dropping(known, 1e6 * scatter, rng)
            part = f"dropped {100 * dropped:.0f} %"
            print(f"  {1e9 * scatter:4g} ns: {_percent(inside, 0)}, {part}")


def main(arguments: argparse.Namespace) -> bool:
    """Print the tables; whether the intervals of the studies are right in 93 to 97 %."""
    rng, asked = np.random.default_rng(0), list[Target]()
    print("bounds of R_s, R_p, C_p in %: delays open, one for both records, none")
    print("intervals that contain the truth after dropping small delays, and part dropped")
    for snr_db in arguments.snr_db:
        by_information(snr_db, arguments.scatter, rng)
    print("studies of 20 recordings, damp and dry: covered, median standard error in %, limited")
    for snr_db, scatter in ((a, b) for a in arguments.snr_db for b in arguments.scatter):
        seeds = range(arguments.studies)
        found = [joint(seed, snr_db, scatter) for seed in tqdm(seeds, disable=None)]
        z = np.array([one.z for one in found])
        of = covered(z, seeds)  # intervals of one study share the error of its driver
        asked.append(Target.of(f"{snr_db:g} dB {1e9 * scatter:g} ns: covered", of, COVERED))
        errors = np.median([one.stderr for one in found], axis=0)
        parts = zip((np.abs(z) < NORMAL_95).mean(0), errors, strict=True)
        both = "; ".join(f"{_percent(c, 0)} ({_percent(e)})" for c, e in parts)
        limited = f"{100 * np.mean([one.limited for one in found]):.0f} %"
        print(f"{snr_db:g} dB {1e9 * scatter:4g} ns: {both}; {limited}", flush=True)
    return report(asked)


def _percent(values: Float[np.ndarray, " element"], digits: int = 2) -> str:
    return ", ".join(f"{100 * value:.{digits}f}" for value in values)
