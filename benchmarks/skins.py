"""Skin that is not one RC, as circuits: two layers, and a relaxation that is spread."""

from etid import AbstractCircuit, capacitor, cole, parallel, parameter, resistor, series
from etid.circuits.elements import Exponent, Farad, Ohm, Second


class SkinTwoLayer(AbstractCircuit):
    """Stratum corneum and viable epidermis in series, R(RC)(RC)."""

    r_s: Ohm = parameter("ohm", typical=20e3)
    r_1: Ohm = parameter("ohm", typical=80e3)
    c_1: Farad = parameter("farad", typical=0.2e-9)
    r_2: Ohm = parameter("ohm", typical=40e3)
    c_2: Farad = parameter("farad", typical=2e-9)

    def impedance(self):
        """Impedance of both layers."""
        first = parallel(resistor(self.r_1), capacitor(self.c_1))
        second = parallel(resistor(self.r_2), capacitor(self.c_2))
        return series(resistor(self.r_s), first, second)


class SkinCole(AbstractCircuit):
    """Skin with Cole's relaxation, Z = R_s + R_p / (1 + (s τ)^α)."""

    r_s: Ohm = parameter("ohm", typical=20e3)
    r_p: Ohm = parameter("ohm", typical=100e3)
    tau: Second = parameter("second", typical=30e-6)
    alpha: Exponent = parameter("1", typical=0.9)

    def impedance(self):
        """Impedance of Cole's formula."""
        return series(resistor(self.r_s), cole(self.r_p, self.tau, self.alpha))
