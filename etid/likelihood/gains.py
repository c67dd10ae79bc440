"""The gains of a load: each output per input, with its delay, and their derivatives.

The parameters q of a fit are the logarithms of the elements, the delay of each output [samples],
and z of `etid.likelihood.source`. All act on a frequency through Z_L, the phase factors of the
delays, and W.

A gain g, a crosstalk κ and a capacitance C of the instrument change the outputs of a load,

    V_out / V_th = (1 + g) Z' / (Z' + Z_th) + κ,      Z' = Z_L ‖ C.

Another kind of data is another class of outputs.
"""

import abc
import dataclasses
from typing import ClassVar, NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from etid.circuits.circuit import AbstractCircuit, impedance_at, with_slopes
from etid.likelihood.arrays import along_outputs
from etid.likelihood.source import Source
from etid.precision import namespace
from etid.signals.transfer import AnyArray, as_complex, frequency_variable, reciprocal, turns

_Numbers = Complex[AnyArray, "*row bin"]


class AbstractOutputs(abc.ABC):
    """The outputs as functions of the impedance of the load and the current through it.

    Attributes:
        count: Number of outputs. Each has a delay, and a gain that is tested. The first is V_out;
            the scales of the others are tested against the driver.
    """

    count: ClassVar[int]

    @abc.abstractmethod
    def __call__(
        self, z_load: _Numbers, current: _Numbers
    ) -> list[tuple[_Numbers, _Numbers | float, _Numbers | float]]:
        """Each output per input, and its derivatives by Z_L and by the current."""


class Voltage(AbstractOutputs):
    """V_out."""

    count: ClassVar[int] = 1

    def __call__(
        self, z_load: _Numbers, current: _Numbers
    ) -> list[tuple[_Numbers, _Numbers | float, _Numbers | float]]:
        """Z_L I."""
        return [(z_load * current, current, z_load)]


class VoltageAndCurrent(AbstractOutputs):
    """V_out and the current through the load."""

    count: ClassVar[int] = 2

    def __call__(
        self, z_load: _Numbers, current: _Numbers
    ) -> list[tuple[_Numbers, _Numbers | float, _Numbers | float]]:
        """Z_L I and I."""
        return [(z_load * current, current, z_load), (current, 0.0, 1.0)]


class Slopes(NamedTuple):
    """Gains and their derivatives.

    Attributes:
        z: Z_L [Ω].
        gains: The gains.
        by_z: Derivatives with respect to Z_L.
        by_q: Derivatives with respect to the parameters.
    """

    z: Complex[AnyArray, "*row bin"]
    gains: Complex[AnyArray, "*row output bin"]
    by_z: Complex[AnyArray, "*row output bin"]
    by_q: Complex[AnyArray, "*row q output bin"]


class Faults(NamedTuple):
    """Errors of the instrument that act on a load.

    Attributes:
        gain: g.
        crosstalk: κ.
        capacitance: C [F].
        by_z: Their derivatives.
    """

    gain: Complex[AnyArray, "*row 1"]
    crosstalk: Complex[AnyArray, "*row 1"]
    capacitance: Complex[AnyArray, "*row 1"]
    by_z: Float[AnyArray, "z 3"]

    def share(self, z_load: _Numbers, s: Complex[AnyArray, "... bin"]) -> _Numbers:
        """Z' / Z_L."""
        return reciprocal(1 + s * self.capacitance * z_load)


@dataclasses.dataclass(frozen=True)
class Gains:
    """The gains of loads behind one driver.

    Attributes:
        source: The driver at the frequencies.
        circuit: Structure of the load.
        frequency: The frequencies [Hz].
        sample_rate: Sampling rate [Hz].
        outputs: The outputs.
    """

    source: Source
    circuit: AbstractCircuit
    frequency: Float[AnyArray, "*row bin"]
    sample_rate: float
    outputs: AbstractOutputs = dataclasses.field(default_factory=Voltage)

    @property
    def elements(self) -> int:
        """Number of elements."""
        return len(self.circuit.names())

    @property
    def owned(self) -> int:
        """Number of own parameters: elements and delays."""
        return self.elements + self.outputs.count

    def split(self, q: Float[AnyArray, "*row q"]) -> tuple[AnyArray, ...]:
        """Logarithms of the elements, delays [samples], and z."""
        own = self.elements, self.owned
        return q[..., : own[0]], q[..., own[0] : own[1]], q[..., own[1] :]

    def of(self, rows: np.ndarray) -> "Gains":
        """The gains of some of the rows."""
        return dataclasses.replace(self, frequency=self.frequency[rows])

    def at(self, index: np.ndarray) -> "Gains":
        """The same at some of the frequencies."""
        source, frequency = self.source.at(index), self.frequency[..., index]
        return dataclasses.replace(self, source=source, frequency=frequency)

    def impedance(self, q: Float[AnyArray, "*row q"]) -> _Numbers:
        """Z_L [Ω]."""
        return impedance_at(self.circuit, self.split(q)[0], self.frequency)

    def w(self, z: Float[AnyArray, "*row z"]) -> _Numbers:
        """W − W₀, at the frequencies of each row."""
        xp = namespace(z)
        off = xp.log(self.frequency[..., :1] / self.source.frequency[0])
        return self.source.w(z, off)

    def _faults(self, z: Float[AnyArray, "*row z"]) -> "Faults | None":
        of = self.source.tolerances
        if of is None:
            return None
        errors = as_complex(of.faults + z @ of.faults_by_z)
        gain, crosstalk, capacitance = (errors[..., i, None] for i in range(3))
        return Faults(gain, crosstalk, capacitance, of.faults_by_z)

    def __call__(self, q: Float[AnyArray, "*row q"]) -> Complex[AnyArray, "*row output bin"]:
        """The gains at all harmonics."""
        at, (_, delays, z) = self.impedance(q), self.split(q)
        faults = self._faults(z)
        if faults is not None:
            at = at * faults.share(at, frequency_variable(self.frequency))
        if self.source.loaded is None:
            current = namespace(q).ones_like(at)
        else:
            total = at + self.source.z_loaded(self.w(z))
            current = reciprocal(total - as_complex(self.source.resistance))
        values = [value for value, *_ in self.outputs(at, current)]
        if faults is not None:
            values[0] = values[0] * (1 + faults.gain) + faults.crosstalk
        cycles = -delays * (self.frequency[..., :1] / self.sample_rate)
        return along_outputs(values) * turns(cycles, self.frequency.shape[-1])

    def slopes(self, q: Float[AnyArray, "*row q"]) -> Slopes:
        """The gains and their derivatives, at a few frequencies."""
        xp, (logs, delays, z) = namespace(q), self.split(q)
        z_load, by_element = with_slopes(self.circuit, logs, self.frequency)
        s, faults, at, share = frequency_variable(self.frequency), self._faults(z), z_load, None
        if faults is not None:
            share = faults.share(z_load, s)
            at = z_load * share
        if self.source.loaded is None:
            current = xp.ones_like(at)
            by_total = by_w = xp.zeros_like(at)
        else:
            loaded = self.source.z_loaded(self.w(z))
            current = reciprocal(at + loaded - as_complex(self.source.resistance))
            by_total = -current * current
            by_w = by_total * loaded
        each = self.outputs(at, current)
        values = along_outputs([value for value, *_ in each])
        by_at = along_outputs([own + of_current * by_total for _, own, of_current in each])
        of_w = along_outputs([of_current * by_w for *_, of_current in each])
        cycles = -delays[..., None] * (self.frequency[..., None, :] / self.sample_rate)
        angle = 2 * np.pi * cycles
        turn = xp.cos(angle) + 1j * xp.sin(angle)
        values, by_at, of_w = values * turn, by_at * turn, of_w * turn
        by_fault = None
        if faults is not None and share is not None:
            first = np.eye(self.outputs.count)[0][:, None]
            of_gain = first * values
            scale = 1 + first * faults.gain[..., None, :]
            values = values * scale + first * faults.crosstalk[..., None, :] * turn
            by_at, of_w = by_at * scale, of_w * scale
            across = (-s * at * at)[..., None, :] * by_at
            by_fault = xp.stack([of_gain, first * turn, across], -3)
            by_at = by_at * (share * share)[..., None, :]
        unit = np.eye(self.outputs.count)[:, :, None]
        by_delay = unit * ((-s / self.sample_rate)[..., None, :] * values)[..., None, :, :]
        by_z = self.source.w_by_z(z)[..., None, :] * of_w[..., None, :, :]
        if faults is not None and by_fault is not None:
            of_errors = faults.by_z[:, :, None, None] * by_fault[..., None, :, :, :]
            by_z = by_z + of_errors.sum(-3)
        own = by_element[..., None, :] * by_at[..., None, :, :]
        return Slopes(z_load, values, by_at, xp.concatenate([own, by_delay, by_z], -3))
