"""What a source and the rest of a circuit are for the resistor that depends on its current.

To this resistor, all the rest is a Norton source, of a current that is proportional to that of the
source. The voltage at the terminals is a linear function of its voltage and its current.
"""

from typing import NamedTuple

from jaxtyping import Complex

from etid.circuits.current_dependent import CurrentDependentResistance, current_dependent
from etid.circuits.impedance import AbstractImpedance, Parallel, Series
from etid.precision import namespace
from etid.signals.transfer import AnyArray, reciprocal

_Numbers = Complex[AnyArray, "*#row frequency"]


class Port(NamedTuple):
    """The source of a resistor that depends on its current, and what its signals do outside.

    Attributes:
        element: The resistor.
        share: Part of the short-circuit current of the source that acts on it.
        admittance: Y of its source [S].
        voltage: V = `voltage`[0] u + `voltage`[1] i at the terminals of the circuit.
        current: The same for the current into the terminals.
    """

    element: CurrentDependentResistance
    share: _Numbers
    admittance: _Numbers
    voltage: tuple[_Numbers, _Numbers]
    current: tuple[_Numbers, _Numbers]


def port(impedance: AbstractImpedance, admittance: _Numbers, s: _Numbers) -> Port:
    """The port of a circuit behind a source with this admittance [S], at each s [rad/s]."""
    one, zero = (namespace(s).full(s.shape, number, complex) for number in (1.0, 0.0))
    if isinstance(impedance, CurrentDependentResistance):
        return Port(impedance, one, admittance, (one, zero), (zero, one))
    assert isinstance(impedance, Series | Parallel)
    inner = [part for part in impedance.parts if current_dependent(part) is not None]
    others = [part for part in impedance.parts if part is not inner[0]]
    if isinstance(impedance, Series):
        z = sum((part(s) for part in others), zero)
        loss = reciprocal(1 + admittance * z)
        of = port(inner[0], admittance * loss, s)
        voltage = of.voltage[0] + z * of.current[0], of.voltage[1] + z * of.current[1]
        return of._replace(share=of.share * loss, voltage=voltage)
    y = sum((part.admittance(s) for part in others), zero)
    of = port(inner[0], admittance + y, s)
    current = of.current[0] + y * of.voltage[0], of.current[1] + y * of.voltage[1]
    return of._replace(current=current)
