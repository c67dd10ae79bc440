"""What speed is measured on: trials behind one driver, and the residual that all solvers get."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import etid
from etid import estimation
from etid.circuits import SkinRC
from etid.identify import arrays, window
from etid.likelihood import residual
from etid.maximum_likelihood import Joint
from etid.scenes import Scene, Trial
from etid.spectra import Spectrum
from etid.transformer import ResistorLoad, SkinLoad

SAMPLES = 33_330  # ten pulse periods at 200 kHz
LOAD = SkinLoad(r_s=33.4e3, r_p=186e3, c_p=0.12e-9)
# Logarithms of typical values, a factor of two from the truth, and no delay.
START = np.append(np.log([20e3, 100e3, 0.3e-9]), 0.0)


class Problem(NamedTuple):
    """Trials of one load with their driver.

    Attributes:
        study: All recordings.
        driver: As identified from the calibration.
        lanes: Samples of the trials, stacked.
        window: What their harmonics are made with.
        model: The likelihood of a trial.
    """

    study: etid.Study
    driver: etid.Driver
    lanes: Any
    window: estimation.Window
    model: Joint

    def terms(self) -> Callable[[Float[Array, " own"], Spectrum], Float[Array, " term"]]:
        """Residuals of elements and delay, with Z_th known."""
        common, rate = self.model.start(), jnp.asarray(self.driver.sample_rate)
        return lambda own, spectrum: residual(
            spectrum, self.model.gain(own, common, spectrum, rate)
        )


def problem(samples: int, lanes: int, sample_rate: float = 200e3) -> Problem:
    """Simulate `lanes` trials of `samples` samples and identify their driver."""
    scene = Scene(
        tuple(Trial(f"loaded/{i}", LOAD) for i in range(lanes)),
        (Trial("calibration/0", ResistorLoad(98.8e3)),),
        samples=samples,
        sample_rate=sample_rate,
        trigger_jitter_rms=50e-9,
    )
    study = scene.simulate(seed=3)
    driver = etid.identify_driver(study["calibration/0"], method="maximum_likelihood", throw=False)
    records = list(study.loaded.recordings())
    part = window(records[0], "maximum_likelihood", driver)
    assert part is not None
    assert driver.source is not None
    assert driver.calibration is not None
    samples_of = tuple(
        jnp.asarray(np.stack(column)) for column in zip(*map(arrays, records), strict=True)
    )
    rate = jnp.asarray(driver.sample_rate)
    model = Joint(SkinRC(), driver.source, driver.calibration, rate, part.shared)
    return Problem(study, driver, samples_of, part, model)
