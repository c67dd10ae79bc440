"""What trigger delays cost, and why a single fit must not take them for zero.

From the Fisher information of one recording with one calibration of 98.8 kΩ, with Z_th free
at every harmonic: the bounds of the elements with the delays of both records open, with one delay
for both, and with none. Below each, why a single fit leaves its delay open: a rule drops the delays
if they are below two of their standard errors. For delays that scatter by so much, 2 000 draws show
how many 95 % intervals then contain the truth.
"""

import argparse
import itertools

import numpy as np
from jaxtyping import Float

from benchmarks.ladder import LOADS
from benchmarks.rates import NORMAL_95
from benchmarks.runner import option
from benchmarks.visibility import information

NYQUIST = 0.5  # of the sample rate
OPEN = 2.5  # [µs] width of the prior of a delay: half a sample at 200 kHz
DROPPED = 2.0  # standard errors below which the rule of the second table drops the delays
DRAWS = 2_000
SCATTER = (0.0, 3e-9, 10e-9, 20e-9, 100e-9)

OPTIONS = (
    option("--snr-db", default=(60.0, 40.0)),
    option("--scatter", default=SCATTER, help="[s]"),
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


def main(arguments: argparse.Namespace) -> bool:
    rng = np.random.default_rng(0)
    print("bounds of R_s, R_p, C_p in %: delays open, one for both records, none")
    print("intervals that contain the truth after dropping small delays, and part dropped")
    for snr_db, (name, load) in itertools.product(arguments.snr_db, LOADS.items()):
        known = information(load, snr_db, NYQUIST)
        rows = [with_prior(known, *widths) for widths in ((0.0, OPEN), (OPEN, 1e-5), (0, 1e-5))]
        texts = [_percent(np.sqrt(np.diag(cov)[:3])) for cov in rows]
        print(f"{snr_db:g} dB {name}: {'; '.join(texts)}")
        for scatter in arguments.scatter:
            inside, dropped = covered_after_dropping(known, 1e6 * scatter, rng)
            part = f"dropped {100 * dropped:.0f} %"
            print(f"  {1e9 * scatter:4g} ns: {_percent(inside, 0)}, {part}")
    return True


def _percent(values: Float[np.ndarray, " element"], digits: int = 2) -> str:
    return ", ".join(f"{100 * value:.{digits}f}" for value in values)
