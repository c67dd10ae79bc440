"""Monte Carlo: do the intervals contain the truth as often as they say, and how far is the bound?

Each repetition draws fresh noise, quantisation and trigger delays for the calibrations, a dry and a
damp trial, and identifies a driver of its own: trials that share a driver share its error, and
would not be independent draws.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from tqdm import tqdm

import etid
from etid.identify import Method
from etid.scenes import Scene, Trial
from etid.transformer import ResistorLoad, SkinLoad

LOADS = {
    "dry": SkinLoad(r_s=33.4e3, r_p=186e3, c_p=0.12e-9),
    "damp": SkinLoad(r_s=6.1e3, r_p=17.4e3, c_p=0.66e-9),
}
NORMAL_95 = 1.959964  # half-width of a 95 % interval in standard errors


@dataclasses.dataclass(frozen=True)
class Draws:
    """One row per repetition.

    Attributes:
        error: Relative errors of the elements.
        stderr: Relative standard errors, as the fit reports them.
        verdicts: Names of the verdicts.
    """

    error: np.ndarray
    stderr: np.ndarray
    verdicts: np.ndarray

    @property
    def z(self) -> np.ndarray:
        """Errors of the successful fits in standard errors."""
        return (self.error / self.stderr)[self.verdicts == "successful"]

    @property
    def covered(self) -> np.ndarray:
        """Part of the 95 % intervals that hold the truth."""
        return (np.abs(self.z) < NORMAL_95).mean(0)


def monte_carlo(
    snr_db: float,
    samples: int,
    repetitions: int,
    resistors: Sequence[float] = (98.8e3,),
    jitter: float = 50e-9,
    method: Method = "output_error",
    progress: bool = False,
) -> dict[str, Draws]:
    """Identify fresh recordings of each of `LOADS`."""
    known = [Trial(f"calibration/{i}", ResistorLoad(r)) for i, r in enumerate(resistors)]
    scene = Scene(
        tuple(Trial(name, load) for name, load in LOADS.items()),
        tuple(known),
        samples=samples,
        snr_db=snr_db,
        trigger_jitter_rms=jitter,
    )
    rows: dict[str, list] = {name: [] for name in LOADS}
    for seed in tqdm(range(repetitions), disable=not progress):
        study = scene.simulate(seed=seed)
        driver = etid.identify_driver(
            [study[trial.path] for trial in known], method=method, throw=False
        )
        for name, load in LOADS.items():
            fit = etid.identify_skin(study[name], driver, method=method, throw=False)
            truth = np.array(dataclasses.astuple(load))
            error = np.asarray(fit.circuit.values()) / truth - 1
            rows[name].append((error, np.asarray(fit.stderr.values()) / truth, fit.verdict))
    return {
        name: Draws(*(np.array(column) for column in zip(*found, strict=True)))
        for name, found in rows.items()
    }


def run(
    snr_db: float,
    samples: int,
    repetitions: int,
    resistors: Sequence[float],
    jitter: float,
    method: Method,
) -> None:
    """Print one line per load and element."""
    draws = monte_carlo(snr_db, samples, repetitions, resistors, jitter, method, progress=True)
    print(f"{snr_db:g} dB, {samples} samples, {len(resistors)} calibrations, {method}")
    print("load  element     bias % spread %     sd %  covered  mean z  max |z|")
    for name, of in draws.items():
        for i, element in enumerate(("r_s", "r_p", "c_p")):
            good = of.verdicts == "successful"
            print(
                f"{name:<6}{element:<9}{100 * of.error[good, i].mean():9.3f}"
                f"{100 * of.error[good, i].std(ddof=1):9.3f}"
                f"{100 * np.median(of.stderr[good, i]):9.3f}"
                f"{of.covered[i]:9.3f}{of.z[:, i].mean():8.2f}{np.abs(of.z[:, i]).max():9.1f}"
            )
        names, counts = np.unique(of.verdicts, return_counts=True)
        print(" ", ", ".join(f"{c} {n}" for n, c in zip(names, counts, strict=True)))
