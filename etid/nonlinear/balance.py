"""Periodic steady state of one nonlinear resistor in a linear network: harmonic balance.

The network around the resistor is a Norton source, of current J and admittance Y at each harmonic:
i + Y u = J. The resistor has the voltage u(i) at the current i(t). The unknown is the wave that
travels to the resistor, at the points of a grid over one period:

    a = u + R i,      b = u − R i = B(a),      a = S b + 2 R J / (1 + R Y),
    S = (1 − R Y) / (1 + R Y)

(Fettweis 1986, "Wave digital filters: theory and practice", Proc. IEEE 74; harmonic balance:
Kundert and Sangiovanni-Vincentelli 1986, IEEE Trans. Computer-Aided Design 5). S acts on the
Fourier coefficients, B on the points in time. A passive network has |S| ≤ 1. With R as the
geometric mean of the smallest and the largest slope u′, whose ratio is κ, B has slopes of at most
(√κ − 1) / (√κ + 1). The equation is therefore a contraction: it has one solution, and its linear
systems are well conditioned.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float

from etid.circuits.current_dependent import CurrentDependentResistance
from etid.likelihood.linear import repeated
from etid.nonlinear.iterative import solved
from etid.precision import array_function, held, namespace
from etid.signals.transfer import AnyArray, reciprocal

STEPS = 20
# Of the largest value of the wave. A step of this size leaves an error of 1e-8: that of the linear
# systems, whose solutions have four digits. A record has five.
DIGITS = 1e-4

Wave = Float[AnyArray, "*row time"]


def to_time(
    coefficients: Complex[AnyArray, "*row harmonic"], points: int
) -> Float[AnyArray, "*row time"]:
    """One period of a real signal, from its Fourier coefficients c₀, c₁, …."""
    return namespace(coefficients).fft.irfft(coefficients, points, norm="forward")


def to_harmonics(signal: Float[AnyArray, "*row time"]) -> Complex[AnyArray, "*row harmonic"]:
    """Fourier coefficients c₀, c₁, … of one period of a real signal."""
    return namespace(signal).fft.rfft(signal, norm="forward")


class Balance(NamedTuple):
    """A steady state, and linear changes of it.

    Attributes:
        element: The resistor.
        resistance: R [Ω].
        mirror: 1 / (1 + R Y).
        wave: a [V].
        current: i [A].
        flow: ∂i/∂a = 1 / (u′ + R) [S].
    """

    element: CurrentDependentResistance
    resistance: Float[AnyArray, "..."]
    mirror: Complex[AnyArray, "*row harmonic"]
    wave: Wave
    current: Wave
    flow: Wave

    def reflected(self, b: Wave, back: bool = False) -> Wave:
        """S b, or Sᵀ b."""
        s = 2 * self.mirror - 1
        s = namespace(s).conj(s) if back else s
        return to_time(s * to_harmonics(b), b.shape[-1])

    def moved(self, arriving: Wave) -> Wave:
        """Change of a by a small wave of the network."""
        slope = 1 - 2 * self.resistance * self.flow  # of B
        return solved(lambda a: a - self.reflected(slope * a), arriving)

    def pulled(self, wave: Wave) -> Wave:
        """The transpose of `moved`."""
        slope = 1 - 2 * self.resistance * self.flow
        return solved(lambda a: a - slope * self.reflected(a, back=True), wave)

    def off(self, arriving: Wave) -> Wave:
        """What the wave lacks to be the steady state."""
        return self.wave - self.reflected(self.wave - 2 * self.resistance * self.current) - arriving

    def signals(self) -> tuple[Complex[AnyArray, "*row harmonic"], ...]:
        """Fourier coefficients of the voltage u [V] and the current i [A]."""
        return to_harmonics(self.wave - self.resistance * self.current), to_harmonics(self.current)

    def at(self, wave: Wave) -> "Balance":
        """The same at another wave."""
        current = self.element.current(wave, self.resistance)
        flow = 1 / (self.element.slope(current) + self.resistance)
        return self._replace(wave=wave, current=current, flow=flow)


class _Newton(NamedTuple):
    """Where the search is: the wave, and whether it moves."""

    wave: Wave
    moves: Bool[AnyArray, "*row"]


@array_function
def steady_state(
    element: CurrentDependentResistance,
    resistance: Float[AnyArray, "..."],
    source: Complex[AnyArray, "*#row harmonic"],
    admittance: Complex[AnyArray, "*#row harmonic"],
) -> Balance:
    """The steady state; NaN where it is not found.

    JAX differentiates it by all arguments but R, on which it does not depend.

    Args:
        element: The resistor; its fields have an axis of one for the time.
        resistance: R [Ω], near the geometric mean of the smallest and the largest slope u′.
        source: Fourier coefficients of J [A], from c₀ on; the last ones are small.
        admittance: Y [S] at the same frequencies.
    """
    xp = namespace(source, admittance, resistance)
    mirror = reciprocal(1 + admittance * resistance)
    arriving = to_time(2 * resistance * source * mirror, 2 * (source.shape[-1] - 1))
    first = Balance(element, resistance, mirror, arriving, arriving, arriving)
    found = first.at(_wave(first, arriving))
    if xp is np:
        return found
    return first.at(found.wave - _known(found).moved(found.off(arriving)))


@held
def _known(of: Balance) -> Balance:
    return of


@held
def _wave(of: Balance, arriving: Wave) -> Wave:
    """The wave of the steady state."""
    xp, unit = namespace(arriving), abs(arriving).max(-1)

    def step(state: _Newton) -> _Newton:
        at = of.at(state.wave)
        change = at.moved(at.off(arriving))
        wave = xp.where(state.moves[..., None], state.wave - change, state.wave)
        # A change that is not a number moves no further, and is none that is small.
        return _Newton(wave, state.moves & (abs(change).max(-1) > DIGITS * unit))

    last = repeated(step, _Newton(arriving, unit > 0), STEPS)
    return xp.where(last.moves[..., None], np.nan, last.wave)
