"""What do trigger delays cost, and when may a fit take them for zero?

First, from the Fisher information of one recording with one calibration of 98.8 kΩ, with Z_th free
at every harmonic: the bounds of the elements with the delays of both records open, with one delay
for both, and with none. Below each, why a single fit leaves its delay open: a rule drops the delays
if they are below two of their standard errors. For delays that scatter by so much, 2 000 draws show
how many 95 % intervals then contain the truth. Last, joint fits of studies of 20 recordings, whose
delays `identify_jointly` limits by their scatter.
"""

import argparse
import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from tqdm import tqdm

import etid
from benchmarks.coverage import MORE, NORMAL_95, scene
from benchmarks.failure_counts import rate
from benchmarks.ladder import LOADS
from benchmarks.perturbed_study import PARTS, drawn_driver
from etid.circuits.circuit import AbstractCircuit, Resistor, SkinRC
from etid.recordings.remarks import Remark
from etid.simulation.published import REFERENCE
from etid.simulation.transformer import loading

OPEN = 2.5  # [µs] width of the prior of a delay: half a sample at 200 kHz
DROPPED = 2.0  # standard errors below which the rule of the second table drops the delays
DRAWS = 2_000
SCATTER = (0.0, 3e-9, 10e-9, 20e-9, 100e-9)
EACH = 10  # dry and as many damp recordings of a study
COVERED = (0.93, 0.97)  # part of the 95 % intervals of the studies that is to contain the truth


def information(load: AbstractCircuit, snr_db: float) -> Float[np.ndarray, "5 5"]:
    """Fisher information of three elements, the delay of the load and that of the calibration [µs].

    X of both recordings and Z_th are projected out at every harmonic, as in `etid.bound`.
    """
    of = scene(snr_db, 10_000)
    wave = of.waveform()
    inside = wave.f < of.sample_rate / 2
    f, z_th = wave.f[inside], wave.z_th[inside]
    x = wave.v_th[inside] * math.sqrt(of.samples) / wave.sigma
    at = jnp.asarray(f)
    z = [np.asarray(one.response(at)) for one in (load, Resistor(REFERENCE))]
    slope = jax.jacfwd(lambda logs: load.with_log_values(logs).response(at))(load.log_values())
    a, b = np.zeros((f.size, 4, 5), complex), np.zeros((f.size, 4, 3), complex)
    for i, g in enumerate(loading(one, z_th) for one in z):
        b[:, i, i], b[:, 2 + i, i], b[:, i, 2] = g, 1, -g * x / (z[i] + z_th)
        a[:, i, 3 + i] = -2e-6j * np.pi * f * g * x
    a[:, 0, :3] = (x * z_th / (z[0] + z_th) ** 2)[:, None] * np.asarray(slope)
    q, _ = np.linalg.qr(b)
    rest = (a - q @ (np.conj(np.swapaxes(q, 1, 2)) @ a)).reshape(-1, 5)
    return 2 * np.real(np.conj(rest.T) @ rest)


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


@dataclasses.dataclass(frozen=True)
class Study:
    """Joint fits of one drawn study: a dry and a damp recording of 20.

    Attributes:
        z: Errors of the elements in units of their standard errors.
        stderr: Relative standard errors.
        limited: Whether the fits say that the delays are limited.
    """

    z: Float[np.ndarray, "trial element"]
    stderr: Float[np.ndarray, "trial element"]
    limited: bool


def joint(seed: int, snr_db: float, scatter: float) -> Study:
    """Fits of one study whose delays scatter by so many seconds."""
    drawn = scene(snr_db, 10_000, jitter=scatter, more=EACH - 1)
    drawn = dataclasses.replace(drawn, driver=drawn_driver(seed, PARTS, drawn.driver))
    fits = etid.identify_jointly(drawn.simulate(seed)).fits
    counted = [fits[i] for i, p in enumerate(fits.labels["path"]) if not p.startswith(MORE)]
    paths = [path for path in fits.labels["path"] if not path.startswith(MORE)]
    truth = np.array([list(drawn.truth()[path].values()) for path in paths])
    errors = np.array([np.asarray(fit.circuit.values()) for fit in counted]) - truth
    stderr = np.array([np.asarray(fit.stderr.values()) for fit in counted])
    limited = all(int(fit.remarks) & Remark.small_delays for fit in counted)
    order = np.argsort(paths)  # damp, dry
    return Study((errors / stderr)[order], (stderr / truth)[order], limited)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """How much is drawn."""
    parser.add_argument("--snr-db", type=float, nargs="+", default=(60.0, 40.0))
    parser.add_argument("--scatter", type=float, nargs="+", default=SCATTER, help="[s]")
    parser.add_argument("--studies", type=int, default=30, help="joint fits for each scatter")


def main(arguments: argparse.Namespace) -> bool:
    """Print the tables; whether no coverage of the studies surely lies outside of `COVERED`."""
    rng = np.random.default_rng(0)
    print("bounds of R_s, R_p, C_p in %: delays open, one for both records, none")
    print("intervals that contain the truth after dropping small delays, and part dropped")
    for snr_db in arguments.snr_db:
        for name, load in LOADS.items():
            known = information(SkinRC(*dataclasses.astuple(load)), snr_db)
            rows = [with_prior(known, *widths) for widths in ((0.0, OPEN), (OPEN, 1e-5), (0, 1e-5))]
            texts = [_percent(np.sqrt(np.diag(cov)[:3])) for cov in rows]
            print(f"{snr_db:g} dB {name}: {'; '.join(texts)}")
            for scatter in arguments.scatter:
                covered, dropped = covered_after_dropping(known, 1e6 * scatter, rng)
                part = f"dropped {100 * dropped:.0f} %"
                print(f"  {1e9 * scatter:4g} ns: {_percent(covered, 0)}, {part}")
    print("studies of 20 recordings, damp and dry: covered, median standard error in %, limited")
    good = True
    for snr_db in arguments.snr_db:
        for scatter in arguments.scatter:
            found = [
                joint(seed, snr_db, scatter)
                for seed in tqdm(range(arguments.studies), disable=None)
            ]
            inside = np.array([np.abs(one.z) < NORMAL_95 for one in found])
            covered = inside.mean(axis=0)
            # Intervals of one study share the error of its driver.
            of = rate(inside.ravel().tolist(), np.repeat(range(len(found)), covered.size))
            errors = np.median([one.stderr for one in found], axis=0)
            limited = np.mean([one.limited for one in found])
            good &= of.low <= COVERED[1] and of.high >= COVERED[0]
            both = [
                f"{_percent(c, 0)} ({_percent(e)})" for c, e in zip(covered, errors, strict=True)
            ]
            print(
                f"{snr_db:g} dB {1e9 * scatter:4g} ns: {'; '.join(both)}; {100 * limited:.0f} %"
                f"; all {100 * of.rate:.1f} % ({100 * of.low:.1f} to {100 * of.high:.1f})",
                flush=True,
            )
    return good


def _percent(values: Float[np.ndarray, " element"], digits: int = 2) -> str:
    return ", ".join(f"{100 * value:.{digits}f}" for value in values)
