"""The gains of a load: each output per input, with its delay, and their derivatives.

The parameters q of a fit are the logarithms of the elements, the delay of each output [samples],
the errors of the corners of known filters (`etid.signals.low_pass`), and z of
`etid.likelihood.source`. All act on a frequency through Z_L, the phase factors of the delays, the
factor F of the corners, and W.

Errors of the instrument that act on loads change them as `DIRECTIONS` says,

    V_out / V_th = (1 + g) Z' / (Z' + Z_th) + κ,      Z' = Z_L ‖ C.

Behind a command that a converter holds, each output has what the images of the hold add
(`etid.signals.hold`).

What no circuit explains multiplies each output by e^δ, where δ is smooth in frequency
(`etid.likelihood.discrepancy`); its coefficients are parameters after the corners.

Another kind of data is another class of outputs.
"""

import abc
import dataclasses
import functools
from typing import ClassVar, NamedTuple

import jax
import numpy as np
from jaxtyping import Complex, Float

from etid.circuits.circuit import AbstractCircuit, impedance_at, with_slopes
from etid.circuits.directions import DIRECTIONS, ON_LOADS, At, Direction
from etid.likelihood.discrepancy import Discrepancy
from etid.likelihood.profile import along_outputs
from etid.likelihood.source import Source
from etid.precision import Module, namespace
from etid.signals.hold import added
from etid.signals.low_pass import Filters
from etid.signals.transfer import AnyArray, as_complex, frequency_variable, reciprocal, turns

FAULTS = len(ON_LOADS)  # errors of the instrument that act on a load

_Numbers = Complex[AnyArray, "*row bin"]


class AbstractOutputs(Module):
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
        by_source: Derivatives with respect to Z_th.
        by_q: Derivatives with respect to the parameters.
    """

    z: Complex[AnyArray, "*row bin"]
    gains: Complex[AnyArray, "*row output bin"]
    by_z: Complex[AnyArray, "*row output bin"]
    by_source: Complex[AnyArray, "*row output bin"]
    by_q: Complex[AnyArray, "*row q output bin"]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Gains:
    """The gains of loads behind one driver.

    Attributes:
        source: The driver at the frequencies.
        circuit: Structure of the load.
        frequency: The frequencies [Hz].
        sample_rate: Sampling rate [Hz].
        outputs: The outputs.
        discrepancy: δ; None where the model is exact.
        filters: The known filters of V_out and of a current that causes it; None without any.
        images: What the images of a held command add (`etid.signals.hold.images`); None if none is
            held.
        nodes: The same loads at the nodes of `images`.
    """

    source: Source
    circuit: AbstractCircuit
    frequency: Float[AnyArray, "*row bin"]
    sample_rate: Float[AnyArray, ""] | float
    outputs: AbstractOutputs = dataclasses.field(default_factory=Voltage)
    discrepancy: Discrepancy | None = None
    filters: Filters | None = None
    images: Complex[AnyArray, "part bin"] | None = None
    nodes: "Gains | None" = None

    @property
    def elements(self) -> int:
        """Number of elements."""
        return len(self.circuit.names())

    @property
    def exact(self) -> int:
        """Number of parameters of an exact model: elements, delays and corners."""
        return self.delays.stop + (0 if self.filters is None else 2)

    @property
    def delays(self) -> slice:
        """The places of the delays among the parameters."""
        return slice(self.elements, self.elements + self.outputs.count)

    @property
    def owned(self) -> int:
        """Number of own parameters: elements, delays, corners, and coefficients of δ."""
        return self.exact + (
            0 if self.discrepancy is None else self.discrepancy.count(self.outputs.count)
        )

    def split(self, q: Float[AnyArray, "*row q"]) -> tuple[AnyArray, ...]:
        """Logarithms of the elements, delays [samples], and z."""
        return q[..., : self.elements], q[..., self.delays], q[..., self.owned :]

    def of(self, rows: np.ndarray) -> "Gains":
        """The gains of some of the rows."""
        delta = self.discrepancy and self.discrepancy.rows(rows)
        filters = self.filters and self.filters.rows(rows)
        of = {"frequency": self.frequency[rows], "discrepancy": delta, "filters": filters}
        return dataclasses.replace(self, **of, nodes=self.nodes and self.nodes.of(rows))

    def at(self, index: np.ndarray) -> "Gains":
        """The same at some of the frequencies."""
        source, frequency = self.source.at(index), self.frequency[..., index]
        delta = self.discrepancy and self.discrepancy.at(index)
        images = None if self.images is None else self.images[:, index]
        of = {"source": source, "frequency": frequency, "discrepancy": delta, "images": images}
        return dataclasses.replace(self, **of)

    def _departed(self, q: Float[AnyArray, "*row q"]) -> Complex[AnyArray, "*row output bin"]:
        """e^δ."""
        assert self.discrepancy is not None
        return namespace(q).exp(self.discrepancy(q[..., self.exact : self.owned]))

    def of_states(self, q: Float[AnyArray, "*row q"], turn: AnyArray) -> AnyArray:
        """What the channel of V_out makes of a state of the load, with these e^(−jωτ).

        δ is an error of the channel, so that all of V_out has it.
        """
        first = turn[..., 0, :]
        return first if self.discrepancy is None else first * self._departed(q)[..., 0, :]

    def _corners(self, q: Float[AnyArray, "*row q"]) -> Float[AnyArray, "*row channel"]:
        """Errors of the corners of the filters."""
        return q[..., self.delays.stop : self.exact]

    def impedance(self, q: Float[AnyArray, "*row q"]) -> _Numbers:
        """Z_L [Ω]."""
        return impedance_at(self.circuit, self.split(q)[0], self.frequency)

    def w(self, z: Float[AnyArray, "*row z"]) -> _Numbers:
        """W − W₀, at the frequencies of each row."""
        xp = namespace(z)
        off = xp.log(self.frequency[..., :1] / self.source.frequency[0])
        return self.source.w(z, off)

    def _faults(self, z: Float[AnyArray, "*row z"]) -> list[tuple[Direction, _Numbers]]:
        """Errors of the instrument that act on a load, and their sizes; none without tolerances."""
        of = self.source.tolerances
        if of is None:
            return []
        sizes = as_complex(of.faults + z @ of.faults_by_z)
        return [(DIRECTIONS[name], sizes[..., i, None]) for i, name in enumerate(ON_LOADS)]

    def turn_at_few(
        self, delays: Float[AnyArray, "*row output"]
    ) -> Complex[AnyArray, "*row output bin"]:
        """e^(−jωτ) of each output at frequencies that are no multiples of the first one."""
        cycles = -delays[..., None] * (self.frequency[..., None, :] / self.sample_rate)
        angle = 2 * np.pi * cycles
        return namespace(angle).cos(angle) + 1j * namespace(angle).sin(angle)

    def departing(self, q: Float[AnyArray, "*row q"], slopes: Slopes) -> At:
        """The loads, from which a recording may depart in any of `DIRECTIONS`."""
        logs, delays, _ = self.split(q)
        each = slopes.gains, slopes.by_z, slopes.by_source, self.turn_at_few(delays)
        impedance = functools.partial(impedance_at, self.circuit, logs)
        return At(self.frequency, slopes.z, *each, impedance, bool(self.circuit.exponents()))

    def __call__(self, q: Float[AnyArray, "*row q"]) -> Complex[AnyArray, "*row output bin"]:
        """The gains at all harmonics."""
        return self.undelayed(q) * self.turn(q)

    def turn(self, q: Float[AnyArray, "*row q"]) -> Complex[AnyArray, "*row output bin"]:
        """e^(−jωτ) of each output at all harmonics."""
        cycles = -self.split(q)[1] * (self.frequency[..., :1] / self.sample_rate)
        return turns(cycles, self.frequency.shape[-1])

    def at_few(self, q: Float[AnyArray, "*row q"]) -> Complex[AnyArray, "*row output bin"]:
        """The same at frequencies that are no multiples of the first one."""
        return self.undelayed(q) * self.turn_at_few(self.split(q)[1])

    def undelayed(self, q: Float[AnyArray, "*row q"]) -> Complex[AnyArray, "*row output bin"]:
        """The same without the delays."""
        at, z = self.impedance(q), self.split(q)[2]
        faults, place = self._faults(z), At(self.frequency, at)
        for of, size in faults:
            place = place._replace(z=of.of_load(place, size)[0])
        at = place.z
        if self.source.loaded is None:
            current = namespace(q).ones_like(at)
        else:
            total = at + self.source.z_loaded(self.w(z))
            current = reciprocal(total - as_complex(self.source.resistance))
        values = [value for value, *_ in self.outputs(at, current)]
        for of, size in faults:
            values[0] = values[0] * of.factor(place, size) + of.offset(place, size)
        if self.filters is not None:
            values[0] = values[0] * self.filters.error(self.frequency, self._corners(q))
        gains = along_outputs(values)
        if self.images is not None and self.nodes is not None:
            gains = gains + added(self.nodes.undelayed(self._at_nodes(q)), self.images)
        return gains if self.discrepancy is None else gains * self._departed(q)

    def _at_nodes(self, q: Float[AnyArray, "*row q"]) -> Float[AnyArray, "*row q"]:
        """The parameters without delays, and without δ."""
        logs, delays, z = self.split(q)
        return namespace(q).concatenate([logs, 0 * delays, z], -1)

    def slopes(self, q: Float[AnyArray, "*row q"]) -> Slopes:
        """The gains and their derivatives, at a few frequencies."""
        xp, (logs, delays, z) = namespace(q), self.split(q)
        z_load, by_element = with_slopes(self.circuit, logs, self.frequency)
        faults, place, share = self._faults(z), At(self.frequency, z_load), 1.0
        for of, size in faults:
            changed, slope = of.of_load(place, size)
            place, share = place._replace(z=changed), share * slope
        at, turn = place.z, self.turn_at_few(delays)
        if self.source.loaded is None:
            current = xp.ones_like(at)
            loaded = by_total = xp.zeros_like(at)
        else:
            loaded = self.source.z_loaded(self.w(z))
            current = reciprocal(at + loaded - as_complex(self.source.resistance))
            by_total = -current * current
        each = self.outputs(at, current)
        values = along_outputs([value for value, *_ in each]) * turn
        by_at = along_outputs([own + of_current * by_total for _, own, of_current in each]) * turn
        by_source = along_outputs([of_current * by_total for *_, of_current in each]) * turn
        of_faults = None
        if faults:
            first = np.eye(self.outputs.count)[0][:, None]
            factor, offset = xp.ones_like(at), xp.zeros_like(at)
            for of, size in faults:
                factor = factor * of.factor(place, size)
                offset = offset + of.offset(place, size)
            scale = 1 + first * (factor - 1)[..., None, :]
            by_at, by_source = by_at * scale, by_source * scale
            place = place._replace(gains=values, by_z=by_at, by_source=by_source, turn=turn)
            of_faults = xp.concatenate([of.change(place) for of, _ in faults], -3)
            values = values * scale + first * offset[..., None, :] * turn
            by_at = by_at * (share * xp.ones_like(at))[..., None, :]
        unit, s = np.eye(self.outputs.count)[:, :, None], frequency_variable(self.frequency)
        s = (s / self.sample_rate)[..., None, :]
        by_delay = unit * (-s * values)[..., None, :, :]
        of_w = by_source * loaded[..., None, :]
        by_z = self.source.w_by_z(z)[..., None, :] * of_w[..., None, :, :]
        if of_faults is not None and self.source.tolerances is not None:
            sizes = self.source.tolerances.faults_by_z[:, :, None, None]
            by_z = by_z + (sizes * of_faults[..., None, :, :, :]).sum(-3)
        by_element = by_element[..., None, :] * by_at[..., None, :, :]
        if self.images is not None and self.nodes is not None:
            of = self.nodes.slopes(self._at_nodes(q))
            late = added(of.gains, self.images) * turn
            values, by_delay = values + late, by_delay - unit * (s * late)[..., None, :, :]
            every = added(of.by_q, self.images) * turn[..., None, :, :]
            by_element = by_element + every[..., : self.elements, :, :]
            by_z = by_z + every[..., self.exact :, :, :]
        own = [by_element, by_delay]
        if self.filters is not None:  # V_out is the only output of a current
            corners = self._corners(q)
            by = self.filters.error(self.frequency, corners)[..., None, :]
            of_corners = self.filters.slopes(self.frequency, corners)[..., None, :]
            values, by_at = values * by, by_at * by
            own = [*(of * by[..., None, :, :] for of in own), values[..., None, :, :] * of_corners]
        if self.discrepancy is not None:
            by = self._departed(q)
            values, by_at, by_source = values * by, by_at * by, by_source * by
            own = [of * by[..., None, :, :] for of in own]
            of = self.discrepancy.by_coefficient(self.outputs.count)
            own += [values[..., None, :, :] * of]
            by_z = by_z * by[..., None, :, :]
        by_q = xp.concatenate([*own, by_z], -3)
        return Slopes(z_load, values, by_at, by_source, by_q)
