"""The response of a load at several amplitudes, and what changes of it do.

The load need not be linear. If it has a resistor that depends on its current, harmonic balance
gives its response to X.

**The anti-alias filter** H of a converter shapes both records. A linear load does not notice: H is
in X and in Y. A load that depends on its current does. It acts on what the filter has not changed
yet, so that Y = H V(X/H). Without H, C_p is up to 1 % wrong at 200 kHz, and 15 standard errors at
60 dB. The filter is not known. So its logarithm is a sum of those of usual filters H_m, with
unknown weights that all records share,

    log H = Σ_m s tanh(ε_m/s) log H_m,      ε_m ~ N(0, 1).

ε = 0 is a converter that changes nothing below half its sample rate. The ε are further z, which
change no Z_th (`etid.likelihood.source`). No weight exceeds s: a misfit of another cause would
raise X/H beyond all bounds.
"""

import abc
import dataclasses
import functools
import math
from typing import Any, NamedTuple

import numpy as np
import scipy.fft
from jaxtyping import Complex, Float

from etid.circuits.circuit import AbstractCircuit, impedance_tree
from etid.circuits.current_dependent import CurrentDependentResistance, current_dependent
from etid.likelihood.gains import Gains
from etid.likelihood.source import Source
from etid.nonlinear.balance import Balance, steady_state, to_harmonics, to_time
from etid.nonlinear.port import port
from etid.results.driver import HarmonicDriver
from etid.results.feed import MeasuredCurrent
from etid.signals.transfer import delayed, frequency_variable, reciprocal

BEYOND = 2  # harmonics of the balance, as a multiple of those of the records
STILL = 1e-6  # of the pulse rate; stands for 0 Hz, where a series capacitor has no impedance
# Corners of usual anti-alias filters, Butterworth's of fourth order, relative to the sample rate.
CORNERS = (0.4, 0.3)
STRONGEST = 1.2  # s, so that either filter alone is possible
STEP = 1e-5  # of an unknown, for central differences of the network: right to 1e-8 of a record

_Own = Float[np.ndarray, "*row own"]
_Numbers = Complex[np.ndarray, "*#row harmonic"]
_Wide = Complex[np.ndarray, "*#row wide"]
_Waves = Float[np.ndarray, "*#row time"]


class AbstractResponse(abc.ABC):
    """The response of recordings to their X at some unknowns, whose rows it has."""

    @property
    @abc.abstractmethod
    def predicted(self) -> _Numbers:
        """Fourier coefficients of V_out [V]."""

    @abc.abstractmethod
    def slopes(self) -> Complex[np.ndarray, "own *row harmonic"]:
        """Derivatives by the unknowns."""

    @abc.abstractmethod
    def along(self, x: _Numbers) -> _Numbers:
        """Change of V_out by a small change of X."""

    @abc.abstractmethod
    def back(self, v_out: _Numbers) -> _Numbers:
        """The transpose of `along`; real and imaginary parts are numbers of their own."""


@dataclasses.dataclass(frozen=True)
class Recorded:
    """The feed of recordings of one load, along an axis of records.

    The unknowns of each record are those of `Gains`: the logarithms of the elements, the delay, z.

    Attributes:
        source: What is given of their feed at the harmonics, `with_filter`.
        feed: Their feed, for other frequencies.
        circuit: Structure of the load and its typical values.
        frequency: The harmonics [Hz].
        sample_rate: Sampling rate [Hz].
    """

    source: Source
    feed: HarmonicDriver | MeasuredCurrent
    circuit: AbstractCircuit
    frequency: Float[np.ndarray, "record harmonic"]
    sample_rate: float

    @property
    def gains(self) -> Gains:
        """Linear gains at small currents."""
        return Gains(self.source, self.circuit, self.frequency, self.sample_rate)

    @functools.cached_property
    def wide(self) -> Float[np.ndarray, "record wide"]:
        """Frequencies of the balance [Hz]: from 0 on, a number for which transforms are fast."""
        last: Any = scipy.fft.next_fast_len(BEYOND * self.frequency.shape[-1], real=True)
        number = np.arange(last + 1.0)
        number[0] = STILL
        return self.frequency[:, :1] * number

    @functools.cached_property
    def admittance(self) -> Complex[np.ndarray, "record wide"]:
        """Y of the source at these frequencies [S], for z = 0."""
        if isinstance(self.feed, MeasuredCurrent):
            return np.zeros(self.wide.shape, complex)
        return reciprocal(np.asarray(self.feed.response(self.wide)))

    @property
    def is_linear(self) -> bool:
        """Whether no resistor depends on its current."""
        return current_dependent(self.circuit.impedance()) is None

    def at(self, own: _Own, x: _Numbers) -> AbstractResponse:
        """The response to X [V] at these unknowns."""
        return Linear(self.gains, own, x) if self.is_linear else Balanced.of(self, own, x)


@dataclasses.dataclass(frozen=True)
class Linear(AbstractResponse):
    """That of a load which does not depend on its current."""

    gains: Gains
    own: _Own
    x: _Numbers

    @functools.cached_property
    def gain(self) -> _Numbers:
        """V_out per X."""
        return self.gains(self.own)[..., 0, :]

    @property
    def predicted(self) -> _Numbers:
        """Fourier coefficients of V_out [V]."""
        return self.gain * self.x

    def slopes(self) -> Complex[np.ndarray, "own *row harmonic"]:
        """Derivatives by the unknowns."""
        return np.moveaxis(self.gains.slopes(self.own).by_q[..., 0, :], -2, 0) * self.x

    def along(self, x: _Numbers) -> _Numbers:
        """Change of V_out by a small change of X."""
        return self.gain * x

    def back(self, v_out: _Numbers) -> _Numbers:
        """The transpose."""
        return self.gain.conj() * v_out


class Network(NamedTuple):
    """What is around the resistor that depends on its current.

    Attributes:
        element: The resistor.
        towards: J of its source per X, at the harmonics of the record [S].
        admittance: Y of its source at those of the balance [S].
        by_voltage: V_out per voltage of the resistor, at the harmonics of the record.
        by_current: V_out per current through it [Ω].
    """

    element: CurrentDependentResistance
    towards: _Numbers
    admittance: _Wide
    by_voltage: _Numbers
    by_current: _Numbers

    @classmethod
    def of(cls, recorded: Recorded, own: _Own) -> "Network":
        """The network at these unknowns; their last axes are those of records and unknowns."""
        known, frequency = recorded.frequency.shape[-1], recorded.frequency
        here, (logs, delay, z) = slice(1, known + 1), recorded.gains.split(own)
        behind = np.broadcast_to(recorded.admittance, (*own.shape[:-1], recorded.wide.shape[-1]))
        into = 1.0
        if not isinstance(recorded.feed, MeasuredCurrent):
            near = recorded.source.z_loaded(recorded.gains.w(z)) - recorded.source.resistance
            into, behind = reciprocal(near), behind.copy()
            behind[..., here] = into
        tree = impedance_tree(recorded.circuit, logs)
        at = port(tree, behind, frequency_variable(recorded.wide))
        filters = _log_filters(frequency / recorded.sample_rate)
        strength = STRONGEST * np.tanh(z[..., -len(CORNERS) :] / STRONGEST)
        passed = np.exp((strength[..., None] * filters).sum(-2))
        out = delayed(passed, frequency, delay[..., 0], recorded.sample_rate)
        voltage, current = (out * of[..., here] for of in at.voltage)
        towards = into * at.share[..., here] * reciprocal(passed)
        return cls(at.element, towards, at.admittance, voltage, current)

    def source(self, x: _Numbers) -> _Wide:
        """J of the source [A]."""
        return _widened(self.towards * x, self.admittance.shape[-1])

    def outside(self, voltage: _Wide, current: _Wide) -> _Numbers:
        """V_out of the signals of the resistor."""
        here = slice(1, self.by_voltage.shape[-1] + 1)
        return self.by_voltage * voltage[..., here] + self.by_current * current[..., here]


@dataclasses.dataclass(frozen=True)
class Balanced(AbstractResponse):
    """That of a load with a resistor that depends on its current."""

    recorded: Recorded
    own: _Own
    x: _Numbers
    network: Network
    balance: Balance

    @classmethod
    def of(cls, recorded: Recorded, own: _Own, x: _Numbers) -> "Balanced":
        """The steady state at these unknowns."""
        network = Network.of(recorded, own)
        source, points = network.source(x), 2 * (recorded.wide.shape[-1] - 1)
        # The largest current [A], if the resistance were that at small currents.
        small = source * reciprocal(1 + network.admittance * network.element.r)
        size = np.abs(to_time(small, points)).max(-1, keepdims=True)
        resistance = network.element.typical_slope(2 * size)
        balance = steady_state(network.element, resistance, source, network.admittance)
        return cls(recorded, own, x, network, balance)

    @property
    def predicted(self) -> _Numbers:
        """Fourier coefficients of V_out [V]."""
        return self.network.outside(*self.balance.signals())

    def moved(self, arriving: _Waves, current: _Waves | float = 0.0) -> _Numbers:
        """Change of V_out by a wave that arrives in addition.

        Args:
            arriving: The wave [V]; several changes have an axis before those of the unknowns.
            current: Change of the current of the resistor at the same wave [A].
        """
        wave, resistance = self.balance.moved(arriving), self.balance.resistance
        current = current + self.balance.flow * wave
        signals = wave - resistance * current, current
        return self.network.outside(*map(to_harmonics, signals))

    def slopes(self) -> Complex[np.ndarray, "own *row harmonic"]:
        """Derivatives by the unknowns: central differences of the network at the same wave."""
        recorded, delay = self.recorded, self.recorded.gains.elements
        steps = np.delete(STEP * np.eye(self.own.shape[-1]), delay, 0)
        steps = steps.reshape(len(steps), *[1] * (self.own.ndim - 1), -1)
        ends = [self._beside(self.own + sign * steps) for sign in (1, -1)]
        arriving, v_out = ((more - less) / (2 * STEP) for more, less in zip(*ends, strict=True))
        found = v_out + self.moved(-arriving)
        by_delay = -frequency_variable(recorded.frequency) / recorded.sample_rate * self.predicted
        return np.insert(found, delay, by_delay, 0)

    def _beside(self, own: _Own) -> tuple[_Waves, _Numbers]:
        """What the wave lacks to be the steady state at other unknowns, and its V_out."""
        network, at = Network.of(self.recorded, own), self.balance
        mirror = reciprocal(1 + network.admittance * at.resistance)
        at = at._replace(element=network.element, mirror=mirror).at(at.wave)
        arriving = 2 * at.resistance * network.source(self.x) * mirror
        return at.off(to_time(arriving, at.wave.shape[-1])), network.outside(*at.signals())

    def along(self, x: _Numbers) -> _Numbers:
        """Change of V_out by a small change of X."""
        at = self.balance
        arriving = 2 * at.resistance * self.network.source(x) * at.mirror
        return self.moved(to_time(arriving, at.wave.shape[-1]))

    def back(self, v_out: _Numbers) -> _Numbers:
        """The transpose."""
        at, network, here = self.balance, self.network, slice(1, v_out.shape[-1] + 1)

        def wave(of: _Numbers) -> _Waves:
            wide = _widened(of.conj() * v_out, at.mirror.shape[-1])
            return to_time(wide, at.wave.shape[-1])

        voltage, current = wave(network.by_voltage), wave(network.by_current)
        pulled = at.pulled(voltage + at.flow * (current - at.resistance * voltage))
        into = 2 * at.resistance * network.towards * at.mirror[..., here]
        return into.conj() * to_harmonics(pulled)[..., here]


def _widened(values: _Numbers, size: int) -> _Wide:
    """Values at the harmonics of a record, at those of the balance."""
    found = np.zeros((*values.shape[:-1], size), complex)
    found[..., 1 : values.shape[-1] + 1] = values
    return found


def with_filter(given: Source) -> Source:
    """The same with the weights ε of the anti-alias filters as the last z."""
    of, more, count = given.tolerances, len(CORNERS), given.mean.size
    if of is not None:
        faults, bending = (
            np.pad(of.faults_by_z, ((0, more), (0, 0))),
            np.pad(of.bending_by_z, (0, more)),
        )
        of = of._replace(faults_by_z=faults, bending_by_z=bending)
    cov = np.eye(count + more)
    cov[:count, :count] = given.cov
    return given._replace(
        by_z=np.pad(given.by_z, ((0, more), (0, 0))),
        mean=np.pad(given.mean, (0, more)),
        cov=cov,
        tolerances=of,
        errors=None,
    )


def _log_filters(
    position: Float[np.ndarray, "*row harmonic"],
) -> Complex[np.ndarray, "*row corner harmonic"]:
    """Logarithms of the filters H at frequencies relative to the sample rate."""
    u = position[..., None, :] / np.array(CORNERS)[:, None]
    first, second = (np.log(1 - u * u + 2j * math.sin(math.pi * odd / 8) * u) for odd in (1, 3))
    return -first - second
