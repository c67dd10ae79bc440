"""What speed is measured on: trials behind one driver, and the residual that all solvers get."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import etid
from etid.circuits.circuit import SkinRC
from etid.estimators.lanes import Harmonics, stacked
from etid.estimators.maximum_likelihood.gains import Gains
from etid.estimators.maximum_likelihood.given_driver import GivenDriver
from etid.estimators.maximum_likelihood.load import Load
from etid.estimators.maximum_likelihood.profile import Records
from etid.estimators.registry import MAXIMUM_LIKELIHOOD
from etid.identify.fitting import known_of
from etid.recordings.preflight import Inspected
from etid.simulation.published import REFERENCE, TYPICAL
from etid.simulation.scenes import Scene, Trial
from etid.simulation.transformer import ResistorLoad

SAMPLES = 33_330  # ten pulse periods at 200 kHz
LOAD = TYPICAL["dry"]
# Logarithms of typical values, a factor of two from the truth, and no delay.
START = np.append(np.log([20e3, 100e3, 0.3e-9]), 0.0)


class Problem(NamedTuple):
    """Trials of one load with their driver."""

    study: etid.Study  # all recordings
    driver: etid.Driver  # as identified from the calibration
    records: list[etid.Recording]  # the trials
    lanes: Harmonics  # their harmonics, stacked
    known: GivenDriver  # what the calibration tells at these

    def samples(self) -> tuple[np.ndarray, np.ndarray]:
        """Both voltages of all trials, stacked."""
        voltages = [(record.v_th, record.v_out) for record in self.records]
        v_th, v_out = (np.stack(column) for column in zip(*voltages, strict=True))
        return v_th, v_out

    def load(self, one: Any) -> Load:
        """A lane with Z_th as it is; calling it gives the terms of elements and delay."""
        rate = jnp.asarray(one.sample_rate)
        gains = Gains(self.known, SkinRC(), one.spectrum.frequency, rate)
        return Load(gains, Records.of(one.spectrum))


def terms(own: Float[Array, " own"], load: Load) -> Float[Array, " term"]:
    """What all solvers minimise the squares of."""
    return load(own)


def harmonics(record: etid.Recording) -> Harmonics:
    """The lane of a trial: harmonics and noise."""
    return Harmonics.of(Inspected(record))


def problem_of(study: etid.Study, driver: etid.Driver) -> Problem:
    """The same for given recordings."""
    records = list(study.loaded.recordings())
    lanes = [harmonics(record) for record in records]
    known = known_of(lanes[0], driver, False, MAXIMUM_LIKELIHOOD)
    assert isinstance(known, GivenDriver)
    return Problem(study, driver, records, stacked(lanes), known)


def problem(samples: int, lanes: int, sample_rate: float = 200e3) -> Problem:
    """Simulate `lanes` trials of `samples` samples and identify their driver."""
    scene = Scene(
        tuple(Trial(f"loaded/{i}", LOAD) for i in range(lanes)),
        (Trial("calibration/0", ResistorLoad(REFERENCE)),),
        samples=samples,
        sample_rate=sample_rate,
        trigger_jitter_rms=50e-9,
    )
    study = scene.simulate(seed=3)
    driver = etid.identify_driver(study["calibration/0"], method="maximum_likelihood", throw=False)
    return problem_of(study, driver)


class ByNumPy:
    """The same terms and their Jacobian as one would write them with NumPy.

    e = w (Y − G X), w = √(2 / (σ_y² + |G|² σ_x²)), G = Z_L / (Z_L + Z_th) e^(−jωτ), and a weak
    prior of the delay.
    """

    def __init__(self, load: Load):
        spectrum = load.records
        used = np.asarray(spectrum.selected[0])
        self.x, self.y = np.asarray(spectrum.x)[used], np.asarray(spectrum.y[0])[used]
        self.of_x = np.asarray(spectrum.variance_x)[used]
        self.of_y = np.asarray(spectrum.variance_y[0])[used]
        self.s = 2j * np.pi * np.asarray(spectrum.frequency)[used]
        driver = load.gains.driver
        assert isinstance(driver, GivenDriver)
        self.z_th = np.asarray(driver.z_th(load.gains.w(driver.mean)))[used]
        self.rate = float(load.gains.sample_rate)
        self.width = float(load.gains.widths(jnp.zeros(4))[-1])

    def _parts(self, q: np.ndarray):
        r_s, r_p, c_p = np.exp(q[:3])
        one = 1 / (1 + self.s * r_p * c_p)
        z = r_s + r_p * one
        turn = np.exp(-self.s * q[3] / self.rate)
        total = 1 / (z + self.z_th)
        g = z * total * turn
        weight = np.sqrt(2 / (self.of_y + np.abs(g) ** 2 * self.of_x))
        return r_s, r_p, c_p, one, turn, total, g, weight, self.y - g * self.x

    def terms(self, q: np.ndarray) -> np.ndarray:
        """Residuals."""
        *_, weight, e = self._parts(q)
        e = e * weight
        return np.concatenate([e.real, e.imag, [q[3] / self.width]])

    def jacobian(self, q: np.ndarray) -> np.ndarray:
        """Their derivatives."""
        r_s, r_p, c_p, one, turn, total, g, weight, e = self._parts(q)
        by_z = self.z_th * total**2 * turn
        slope = r_p * one**2
        of_g = np.stack(
            [by_z * r_s, by_z * slope, -by_z * slope * self.s * r_p * c_p, -g * self.s / self.rate]
        )
        of_weight = -0.5 * weight**3 * self.of_x * (np.conj(g) * of_g).real
        columns = of_weight * e - of_g * self.x * weight
        last = np.array([[0.0, 0.0, 0.0, 1 / self.width]])
        return np.concatenate([columns.real.T, columns.imag.T, last])
