"""The same choice by impedance.py: five fits to an impedance spectrum, and the smallest BIC.

It gets `measured` spectra, from the recordings that etid chooses for, by the harmonics, the noise
and the Z_th that etid finds in them: Z = Z_th Y / (X − Y), σ_Z = |Z_th| √(σ_x² |Y|² + σ_y² |X|²) /
|X − Y|², for the coefficients X of V_th and Y of V_out, to first order in their noise. `exact` ones
have the noise of the scene, but no error of Z_th and no trigger delay, which no recording gives;
etid's `identify_impedance` and its rule choose for these, too.
"""

import math
import time
from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Complex, Float

import etid
from benchmarks.rivals import exchange
from benchmarks.rivals.records import ALIASED
from benchmarks.selection_draws import TRUTHS, scene
from etid.estimators.lanes import Harmonics
from etid.recordings.preflight import Inspected
from etid.selection.evidence import best
from etid.selection.search import USUAL, usual_circuits

NAMES = np.array([kind.__name__ for kind in USUAL])


class Spectra(NamedTuple):
    """One impedance spectrum for each truth."""

    f: Float[np.ndarray, " harmonic"]  # frequencies [Hz]
    z: Complex[np.ndarray, "truth harmonic"]  # noisy impedances [ohm]
    sigma: Float[np.ndarray, "truth harmonic"]  # their noise √E|·|² [ohm]
    used: Bool[np.ndarray, "truth harmonic"]  # harmonics that stand out of the noise


class Chosen(NamedTuple):
    """Names of the circuits that were chosen, (truth, spectra), and the time of each choice [s]."""

    names: np.ndarray
    seconds: np.ndarray

    @property
    def right(self) -> np.ndarray:
        """Whether each is the true one, (truth, spectra)."""
        true = np.array([type(load).__name__ for load in TRUTHS.values()])
        return self.names == true[:, None]


def exact(snr_db: float, number: int) -> Spectra:
    """Spectra with the noise of a scene alone."""
    drawn = scene(snr_db, number)
    known = drawn.waveform()
    use = known.f < ALIASED * drawn.sample_rate
    f, x, z_th = known.f[use], known.v_th[use], known.z_th[use]
    sigma = known.sigma / math.sqrt(drawn.samples)
    rng = np.random.default_rng([number, round(snr_db), *b"rival"])
    noisy, spread = [], []
    for load in TRUTHS.values():
        z = np.asarray(load.response(jnp.asarray(f)))
        y = x * z / (z + z_th)
        of = sigma * np.abs(z_th) * np.hypot(np.abs(x), np.abs(y)) / np.abs(x - y) ** 2
        noise = rng.standard_normal((2, f.size)) / math.sqrt(2)
        noisy.append(z + of * (noise[0] + 1j * noise[1]))
        spread.append(of)
    return Spectra(f, np.array(noisy), np.array(spread), np.ones((len(noisy), f.size), bool))


def measured(snr_db: float, number: int) -> Spectra:
    """Spectra from the recordings of `benchmarks.selection_draws.draws`."""
    study = scene(snr_db, number).simulate(number)
    driver = etid.identify_driver(study["calibration"])
    lanes = [Harmonics.of(Inspected.of(study[name])) for name in TRUTHS]
    f = np.asarray(lanes[0].spectrum.frequency)
    z_th = np.asarray(driver.response(jnp.asarray(f)))
    found = []
    for lane in lanes:
        of = lane.spectrum
        x, y = np.asarray(of.x), np.asarray(of.y)
        used = np.asarray(of.selected) & (f < ALIASED * float(np.asarray(lane.sample_rate)))
        rest = np.where(used, x - y, 1.0)
        noise = of.variance_x * np.abs(y) ** 2 + of.variance_y * np.abs(x) ** 2
        sigma = np.abs(z_th) * np.sqrt(np.asarray(noise)) / np.abs(rest) ** 2
        found.append((z_th * y / rest, np.where(used, sigma, 1.0), used))
    z, sigma, used = (np.array(one) for one in zip(*found, strict=True))
    return Spectra(f, z, sigma, used)


def by_etid(every: Sequence[Spectra]) -> Chosen:
    """What `identify_impedance` and the rule of `etid.selection` choose, all candidates fitted."""
    names, seconds, circuits = [], [], usual_circuits()
    for spectra in every:
        for z, sigma, used in zip(*spectra[1:], strict=True):
            begin = time.perf_counter()
            stderr = sigma[used] / math.sqrt(2)  # of each of both parts
            fits = {
                number: etid.identify_impedance(
                    spectra.f[used], z[used], stderr=stderr, circuit=circuit, throw=False
                )
                for number, circuit in enumerate(circuits)
            }
            names.append(NAMES[best(fits)])
            seconds.append(time.perf_counter() - begin)
    return by_truth(names, seconds)


def by_impedance_py(every: Sequence[Spectra]) -> Chosen:
    """What the rival chooses."""
    z, sigma, used = (np.concatenate([one[i] for one in every]) for i in (1, 2, 3))
    worker = "circuits_by_impedance_py"
    found = exchange("common", worker, f=every[0].f, z=z, sigma=sigma, used=used)
    return by_truth(NAMES[np.argmin(found["bic"], axis=1)], found["seconds"])


def by_truth(names: Sequence[str] | np.ndarray, seconds: Sequence[float] | np.ndarray) -> Chosen:
    """Choices in the order of the spectra, all truths of one after the other."""
    shape = -1, len(TRUTHS)
    return Chosen(np.reshape(names, shape).T, np.reshape(seconds, shape).T)
