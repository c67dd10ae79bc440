"""A resistor that falls with its current.

Skin conducts better the more current flows. Kaczmarek and Webster (1989, "Voltage-current
characteristics of the electrotactile skin-electrode interface", Proc. IEEE EMBS 11) measured a
fall of the resistance to a thirtieth up to 25 mA:

    R(i) = 895 Ω + 60.1 kΩ ‖ (60.1 kΩ · 0.585 mA / |i|) = R_s + R_p / (1 + |i| / I_0).
"""

from typing import ClassVar

from jaxtyping import Complex, Float, Inexact

from etid.circuits.circuit import AbstractCircuit, parameter
from etid.circuits.elements import Farad, Ohm, Resistance, capacitor, resistor
from etid.circuits.impedance import (
    AbstractImpedance,
    Netlist,
    Quantity,
    Slopes,
    parallel,
    series,
)
from etid.precision import namespace
from etid.signals.transfer import AnyArray

Ampere = Quantity


class CurrentDependentResistance(Resistance):
    """A resistor R / (1 + |i| / I_0); its impedance is that at small currents, R."""

    symbol: ClassVar[str] = ""
    i_0: Ampere

    def current(
        self, wave: Float[AnyArray, "..."], resistance: Float[AnyArray, "..."]
    ) -> Float[AnyArray, "..."]:
        """The current i [A] at which u(i) + R′ i is the given wave, with the voltage u(i) [V]."""
        xp, i_0 = namespace(wave, self.r, self.i_0, resistance), self.i_0
        size = xp.abs(wave)
        half = self.r + resistance - size / i_0
        root = xp.sqrt(half**2 + 4 * resistance * size / i_0)
        rising = half > 0  # of the two forms of the root of a quadratic, the one without a loss
        small = 2 * size / (xp.where(rising, half, 0.0) + root)
        return xp.sign(wave) * xp.where(rising, small, (root - half) * i_0 / (2 * resistance))

    def slope(self, current: Float[AnyArray, "..."]) -> Float[AnyArray, "..."]:
        """u′ [Ω] at a current [A]."""
        return self.r / (1 + namespace(current).abs(current) / self.i_0) ** 2

    def typical_slope(self, size: Float[AnyArray, "..."]) -> Float[AnyArray, "..."]:
        """Geometric mean of the smallest and the largest slope u′ [Ω] for currents up to `size`."""
        return self.r / (1 + size / self.i_0)

    def slopes(self, s: Complex[AnyArray, "..."]) -> Slopes:
        """Those at small currents, where I_0 has no effect."""
        return _without_effect(*super().slopes(s))

    def admittance_slopes(self, s: Complex[AnyArray, "..."]) -> Slopes:
        """Those at small currents, where I_0 has no effect."""
        return _without_effect(*super().admittance_slopes(s))

    def connect(self, netlist: Netlist, plus: str, minus: str) -> None:
        """Raise ValueError: a netlist of resistors and capacitors has no such part."""
        raise ValueError(
            "a resistor that depends on its current cannot be written as resistors and capacitors"
        )


def _without_effect(
    value: Complex[AnyArray, "..."], slopes: list[Inexact[AnyArray, "..."]]
) -> Slopes:
    return value, [*slopes, 0 * value]


def current_dependent_resistor(r: Ohm, i_0: Ampere) -> CurrentDependentResistance:
    """A resistor that falls with its own current, R / (1 + |i| / I_0) [Ω].

    Source: Kaczmarek and Webster 1989, with R = 60.1 kΩ and I_0 = 0.585 mA for skin under a
    stimulation electrode.

    Args:
        r: R [Ω], at small currents.
        i_0: I_0 [A], the current at which the resistance has fallen to a half.

    Returns:
        An impedance, to be connected with others. A circuit has at most one such element.
    """
    return CurrentDependentResistance(r, i_0)


class SkinCurrent(AbstractCircuit):
    """Skin whose parallel resistance falls with its current, R_s + (R_p / (1 + |i|/I_0)) ‖ C_p.

    The typical I_0 is that of Kaczmarek and Webster (1989); the other typical values are those of
    `SkinRC`.
    """

    formula = "R_s + R_p / (1 + |i| / I_0 + s R_p C_p)"
    r_s: Ohm = parameter("ohm", typical=20e3)
    r_p: Ohm = parameter("ohm", typical=100e3)
    c_p: Farad = parameter("farad", typical=0.3e-9)
    i_0: Ampere = parameter("ampere", typical=0.585e-3)

    def impedance(self) -> AbstractImpedance:
        """The circuit; as a function of s it is the impedance at small currents."""
        return series(
            resistor(self.r_s),
            parallel(current_dependent_resistor(self.r_p, self.i_0), capacitor(self.c_p)),
        )


def current_dependent(impedance: AbstractImpedance) -> CurrentDependentResistance | None:
    """The resistor of a circuit that depends on its current; None if there is none."""
    found = [one for one in impedance.elements() if isinstance(one, CurrentDependentResistance)]
    if len(found) > 1:
        raise ValueError(
            f"a circuit has {len(found)} resistors that depend on their current; use one"
        )
    return found[0] if found else None
