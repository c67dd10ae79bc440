"""What is recorded of a load: the outputs of its likelihood, per input.

Another kind of data is one more class here, or anywhere else: `Load.behind` takes it.
"""

import abc
from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Complex

Current = Callable[[Complex[Array, " frequency"]], Complex[Array, " frequency"]]
"""Current per input of all that is connected to the source, from its impedance [Ω]."""


class AbstractOutputs(eqx.Module):
    """The outputs as functions of the impedance of the load.

    Attributes:
        count: Number of outputs. Each has a delay, and a gain that is tested. The first is V_out;
            the scales of the others are tested against the driver.
    """

    count: eqx.AbstractClassVar[int]

    @abc.abstractmethod
    def __call__(
        self, z_load: Complex[Array, " frequency"], current: Current
    ) -> Complex[Array, "output frequency"]:
        """The outputs per input."""


class Voltage(AbstractOutputs):
    """V_out."""

    count: ClassVar[int] = 1

    def __call__(
        self, z_load: Complex[Array, " frequency"], current: Current
    ) -> Complex[Array, "1 frequency"]:
        """Z_L I."""
        return (z_load * current(z_load))[None, :]


class VoltageAndCurrent(AbstractOutputs):
    """V_out and the current through the load."""

    count: ClassVar[int] = 2

    def __call__(
        self, z_load: Complex[Array, " frequency"], current: Current
    ) -> Complex[Array, "2 frequency"]:
        """Z_L I and I."""
        i = current(z_load)
        return jnp.stack([z_load * i, i])
