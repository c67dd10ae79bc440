"""What feeds a load: the recorded input, and the gain from it to V_out.

A load is identified from an input and from V_out = H · input. There are two kinds of input. A
driver is a Thévenin source: its input is V_th, with H = Z_L / (Z_L + Z_th). A measured current is
the input itself, with H = Z_L. Estimators ask the feed for H and need not know its kind.
"""

import abc
import dataclasses
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from etid.circuits.overview import Overview
from etid.results.verdicts import RESULTS, Judged, verdict
from etid.signals.filtering import StateSpace


class AbstractFeed(Judged):
    """What feeds a load.

    Attributes:
        recorded: Name of the record that is its input.
    """

    recorded: ClassVar[str]

    @abc.abstractmethod
    def gain(
        self, load: Complex[Array, "*lane frequency"], frequency: Float[Array, " frequency"]
    ) -> Complex[Array, "*lane frequency"]:
        """H: V_out per input.

        Args:
            load: Z_L [Ω] at these frequencies.
            frequency: Real frequencies [Hz].
        """

    @abc.abstractmethod
    def sensitivity(
        self, load: Complex[Array, "*lane frequency"], frequency: Float[Array, " frequency"]
    ) -> Complex[Array, "*lane frequency"]:
        """∂ ln H / ∂ ln Z_L.

        Args:
            load: Z_L [Ω] at these frequencies.
            frequency: Real frequencies [Hz].
        """


class CurrentSource(eqx.Module):
    """The source of a measured current in continuous time: nothing but the load follows it.

    Attributes:
        parameters: Its parameters, none; they give a vector of parameters its precision.
    """

    parameters: Float[Array | np.ndarray, "0"] = dataclasses.field(
        default_factory=lambda: np.zeros(0)
    )

    def connected(self, load: StateSpace) -> StateSpace:
        """The system current → V_out: the impedance of the load."""
        return load


class MeasuredCurrent(AbstractFeed):
    """The feed of recordings that measure the current through the load, H = Z_L.

    It has no unknowns and needs no calibration. An error of the scale of the current causes the
    same relative error in every impedance.
    """

    recorded: ClassVar[str] = "current"
    source: CurrentSource = dataclasses.field(default_factory=CurrentSource)
    result: RESULTS = dataclasses.field(default_factory=lambda: verdict("successful"))

    def gain(
        self, load: Complex[Array, "*lane frequency"], frequency: Float[Array, " frequency"]
    ) -> Complex[Array, "*lane frequency"]:
        """H = Z_L [Ω]."""
        del frequency
        return load

    def sensitivity(
        self, load: Complex[Array, "*lane frequency"], frequency: Float[Array, " frequency"]
    ) -> Complex[Array, "*lane frequency"]:
        """1: the voltage is proportional to the impedance."""
        del frequency
        return jnp.ones_like(load)

    @property
    def r_known(self) -> Float[Array, ""]:
        """Resistor of the calibration [Ω]; there is none."""
        return jnp.array(jnp.nan)

    def later_cov(self) -> Float[Array, "0 0"]:
        """Covariance of the parameters of the source, of which there are none."""
        return jnp.zeros((0, 0))

    def late_std(self, sample_rate: Float[Array, ""]) -> Float[Array, ""]:
        """Standard deviation of the delay of the calibration [samples]: almost 0, it is known."""
        return jnp.full_like(sample_rate, 1e-9)

    def _overview(self) -> Overview:
        return Overview("Measured current", [])


MEASURED_CURRENT = MeasuredCurrent()
