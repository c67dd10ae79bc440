"""The terms of one driver and its many loads.

All loads share Z_th and the delays of the calibrations, `common`. The elements and the delays of a
load, `own`, appear only in the terms of this load. A load whose current was measured has two
outputs.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Complex, Float, Int

from etid.circuits.circuit import AbstractCircuit
from etid.estimators.element_limits import Limits
from etid.estimators.element_prior import ElementPrior
from etid.estimators.maximum_likelihood.given_driver import GivenDriver, around
from etid.estimators.maximum_likelihood.load import Load
from etid.estimators.maximum_likelihood.profile import Records
from etid.estimators.unknowns import LoadUnknowns
from etid.likelihood.calibrations import Calibrations
from etid.signals.harmonics import Spectrum

SIDE_BY_SIDE = 8  # loads in one vectorised step

Current = tuple[Complex[Array, "*load harmonic"], Float[Array, "*load harmonic"]]


class Joint(eqx.Module):
    """The likelihood of loads and of the calibrations of their driver.

    Attributes:
        circuit: Structure of the loads.
        calibrations: Calibrations of the driver of the loads.
        shared: Whether the unloaded record of a load may be that of a calibration.
        prior: Prior of the elements of every load; None without one.
        bounds: Bounds of the elements of every load, which do not affect Z_th.
    """

    circuit: AbstractCircuit
    calibrations: Calibrations
    shared: bool = eqx.field(static=True)
    prior: ElementPrior | None = None
    bounds: Limits = eqx.field(static=True, default=())

    def shares(self, harmonics: int) -> bool:
        """Whether the unloaded record of a load of this length may be that of a calibration."""
        return self.shared and harmonics == self.calibrations.spectra.x.shape[-1]

    def around(
        self,
        common: Float[Array, " common"],
        frequency: Float[Array, " harmonic"],
        slopes: bool = True,
    ) -> GivenDriver:
        """The driver with these parameters; with `slopes`, their changes are its z."""
        unit = jnp.eye(common.size)[:, : common.size if slopes else 0]
        zero = jnp.zeros(unit.shape[1])
        return around(self.calibrations, common, unit, frequency, self.shared, zero, jnp.diag(zero))

    def lane(
        self,
        driver: GivenDriver,
        spectrum: Spectrum,
        sample_rate: Float[Array, ""],
        current: Current | None,
    ) -> Load:
        """One load behind this driver."""
        records = Records.of(spectrum, *([] if current is None else [current]))
        return Load.behind(driver, self.circuit, records, sample_rate, self.prior)


class Loads(eqx.Module):
    """Recordings of one length with one driver, stacked along a leading axis.

    Attributes:
        spectrum: Harmonics of the recordings.
        sample_rate: Sampling rates of the recordings [Hz].
        own: Unknowns of each load, identified alone.
        errors: Errors of the instrument that each load alone shows [their standard deviations].
        used: Whether the recording takes part. The others are fitted, but do not affect Z_th.
        unloaded: Index of the unloaded record among those that several loads share; −1 if no other
            load has it.
        current: Harmonics of the measured currents [A], and their variances [A²]; None without.
    """

    spectrum: Spectrum
    sample_rate: Float[Array, "*load"]
    own: LoadUnknowns
    errors: Float[Array, "*load error"]
    used: Bool[Array, "*load"]
    unloaded: Int[Array, "*load"]
    current: Current | None = None

    @property
    def frequency(self) -> Float[Array, "*load harmonic"]:
        """Harmonics [Hz]."""
        return self.spectrum.frequency

    @property
    def terms(self) -> int:
        """Number of terms of all recordings."""
        return 2 * self.spectrum.x.size

    def behind(self, driver: GivenDriver, model: Joint) -> Load:
        """One of the loads behind this driver."""
        return model.lane(driver, self.spectrum, self.sample_rate, self.current)


def in_turn(one: Callable, *lanes: Any) -> Any:
    """`one` over the leading axis of `lanes`; on a CPU one after the other, as `Load` expects."""
    count = jax.tree.leaves(lanes)[0].shape[0]
    together = None if jax.default_backend() == "cpu" else min(SIDE_BY_SIDE, count)
    return jax.lax.map(lambda lane: one(*lane), lanes, batch_size=together)
