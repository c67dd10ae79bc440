"""The same choice by impedance.py, from the exact impedance spectrum with the scene's own noise.

It is given more than a recording holds: Z_th without error, and no trigger delay. Its spectrum is

    Z + noise,   σ_Z = σ |Z_th| √(|X|² + |Y|²) / |X − Y|²,

for coefficients X of V_th and Y of V_out with noise σ, to first order. It fits all five circuits;
the one with the smallest BIC is taken.
"""

import dataclasses
import math
import os
import pathlib
import subprocess
import tempfile
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from benchmarks.rivals import ONE_THREAD, ROOT, install, python_of
from benchmarks.rivals.records import ALIASED
from benchmarks.selection_draws import TRUTHS, scene
from etid.selection.search import CANDIDATES

ENVIRONMENT_OF = "impedance_py"  # of `benchmarks.rivals.roster`
WORKER = "benchmarks.rivals.circuits_by_impedance_py"


@dataclasses.dataclass(frozen=True)
class Chosen:
    """What the rival chose.

    Attributes:
        names: Names of the chosen circuits, (truth, driver).
        seconds: Of each choice, (truth, driver).
    """

    names: np.ndarray
    seconds: np.ndarray


def spectra(snr_db: float, driver: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Frequencies [Hz], and for each truth the noisy impedances and their noise √E|·|² [ohm]."""
    drawn = scene(snr_db, driver)
    known = drawn.waveform()
    use = known.f < ALIASED * drawn.sample_rate
    f, x, z_th = known.f[use], known.v_th[use], known.z_th[use]
    sigma = known.sigma / math.sqrt(drawn.samples)
    rng = np.random.default_rng([driver, round(snr_db), *b"rival"])
    noisy, spread = [], []
    for load in TRUTHS.values():
        z = np.asarray(load.response(jnp.asarray(f)))
        y = x * z / (z + z_th)
        of = sigma * np.abs(z_th) * np.hypot(np.abs(x), np.abs(y)) / np.abs(x - y) ** 2
        noise = rng.standard_normal((2, f.size)) / math.sqrt(2)
        noisy.append(z + of * (noise[0] + 1j * noise[1]))
        spread.append(of)
    return f, np.array(noisy), np.array(spread)


def choices(snr_db: float, drivers: Sequence[int]) -> Chosen | str:
    """What the rival chooses at one SNR, or why it does not."""
    failed = install([ENVIRONMENT_OF])
    if failed:
        return next(iter(failed.values()))
    every = [spectra(snr_db, number) for number in drivers]
    with tempfile.TemporaryDirectory() as folder:
        given, found = pathlib.Path(folder, "problem.npz"), pathlib.Path(folder, "result.npz")
        np.savez(
            given,
            f=every[0][0],
            z=np.concatenate([z for _, z, _ in every]),
            sigma=np.concatenate([sigma for _, _, sigma in every]),
        )
        done = subprocess.run(
            [python_of("common"), "-m", WORKER, given, found],
            cwd=ROOT,
            env={**os.environ, **ONE_THREAD},
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode:
            return (done.stderr.strip().splitlines() or ["no message"])[-1]
        with np.load(found) as file:
            bic, seconds = file["bic"], file["seconds"]
    names = np.array([type(one).__name__ for one in CANDIDATES])
    shape = len(drivers), len(TRUTHS)
    return Chosen(names[np.argmin(bic, axis=1)].reshape(shape).T, seconds.reshape(shape).T)
