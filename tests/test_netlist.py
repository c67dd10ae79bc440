"""Netlists and strings of circuits: read back, solved by other programs, and refused."""

import re

import jax.numpy as jnp
import numpy as np
import pytest

import etid
from etid.circuits.elements import Exponent, Farad, Ohm, ladder

SPREAD = etid.SkinCole(33.4e3, 186e3, 22e-6, 0.85)
BAND = (1.0, 10e6)  # [Hz] default of `netlist`
LADDER_ERROR = 1e-4  # its docstring states it
FREQUENCY = np.geomspace(*BAND, 300)


class Nested(etid.AbstractCircuit):
    """Everything in everything, a capacitor before its resistor."""

    r: Ohm = etid.parameter("ohm", typical=10e3)
    c: Farad = etid.parameter("farad", typical=1e-9)
    alpha: Exponent = etid.parameter("1", typical=0.7)

    def impedance(self):
        r, c = etid.resistor(self.r), etid.capacitor(self.c)
        phase = etid.constant_phase(3e-8, self.alpha)
        inner = etid.parallel(c, etid.series(r, etid.parallel(phase, r)), c)
        return etid.series(etid.parallel(inner, r), r)


DIFFUSION = etid.SkinWarburg(10e3, 186e3, 0.2e-6)
# [H], 6 ohm at 1 Hz at least
INDUCTIVE = type(etid.circuit("L0-p(L1,R1)-R0-p(R2,C2)"))(**{"l_0": 1.0, "l_1": 2.0})
CIRCUITS = [etid.Resistor(98.8e3), etid.SkinRC(), etid.SkinLayers(), INDUCTIVE]
CIRCUITS += [SPREAD, Nested(), DIFFUSION]
every = pytest.mark.parametrize("circuit", CIRCUITS, ids=lambda c: type(c).__name__)


def impedance_of(text, f):
    """Voltage between the terminals at one ampere, by nodal analysis of the text alone."""
    head, *rest = [line.split() for line in text.splitlines() if line[0] != "*"]
    assert head == [".subckt", "load", "plus", "minus"]
    assert rest[-1] == [".ends", "load"]
    parts = rest[:-1]
    assert len({name for name, *_ in parts}) == len(parts)
    nodes = sorted({node for _, *ends, _ in parts for node in ends} - {"minus"})
    index = {node: i for i, node in enumerate(nodes)}
    matrix = np.zeros((f.size, len(index), len(index)), complex)
    for name, plus, minus, value in parts:
        s, x = 2j * np.pi * f, float(value)
        y = {"R": 1 / x, "C": s * x, "L": 1 / (s * x)}[name[0]]
        for one, other in ((plus, minus), (minus, plus)):
            if one in index:
                matrix[:, index[one], index[one]] += y
                if other in index:
                    matrix[:, index[one], index[other]] -= y
    drive = np.zeros((len(index), 1))
    drive[index["plus"]] = 1.0
    return np.linalg.solve(matrix, drive)[:, index["plus"], 0]


@every
def test_a_netlist_is_its_circuit(circuit):
    expected = np.asarray(circuit.response(jnp.asarray(FREQUENCY)))
    found = impedance_of(etid.netlist(circuit), FREQUENCY)
    # A chain of 34 pairs is solved with a condition of 1e10 of its nodes.
    tolerance = 1e-9 if circuit.is_rational else LADDER_ERROR
    np.testing.assert_allclose(found, expected, rtol=tolerance)


@pytest.mark.parametrize("band", [BAND, (1e-3, 1e3)])
@pytest.mark.parametrize("alpha", [0.05, 0.3, 0.5, 0.7, 0.9, 0.99, 1.0])
def test_a_ladder_is_a_constant_phase_in_its_band(alpha, band):
    low, high = band
    s = 2j * np.pi * np.geomspace(low, high, 1000)
    expected = 1 / (2e-9 * s**alpha)
    found = np.asarray(ladder(2e-9, alpha, band)(jnp.asarray(s)))
    assert np.abs(found / expected - 1).max() < LADDER_ERROR


def test_a_netlist_says_what_it_is():
    text = etid.netlist(SPREAD, name="skin_3", band=(10.0, 1e5))
    lines = text.splitlines()
    assert lines[0].startswith("* SkinCole")
    assert "* tau = 2.2e-05" in lines
    remark = "* constant-phase element as RC pairs, error below 0.01 % from 10 Hz to 100000 Hz"
    assert remark in lines
    assert ".subckt skin_3 plus minus" in lines
    assert lines[-1] == ".ends skin_3"


def evaluated(string, values, f):
    """The notation of impedance.py by Python itself: series are sums, p() is parallel."""
    s, left = 2j * np.pi * f, iter(values)
    kinds = {
        "R": lambda r: r + 0 * s,
        "C": lambda c: 1 / (s * c),
        "L": lambda inductance: s * inductance,
        "CPE": lambda q, alpha: 1 / (q * s**alpha),
        "Ws": lambda r, tau: r * np.tanh(np.sqrt(s * tau)) / np.sqrt(s * tau),
    }
    elements = {}
    for name in re.findall(r"[A-Z]+s?\d+", string):
        assert name not in elements
        kind = kinds[name.rstrip("0123456789")]
        elements[name] = kind(*(next(left) for _ in range(kind.__code__.co_argcount)))
    assert next(left, None) is None
    names = elements | {"p": lambda *z: 1 / sum(1 / one for one in z)}
    return eval(string.replace("-", "+"), names)


@every
def test_a_string_is_its_circuit(circuit):
    expected = np.asarray(circuit.response(jnp.asarray(FREQUENCY)))
    found = evaluated(*etid.circuit_string(circuit), FREQUENCY)
    np.testing.assert_allclose(found, expected, rtol=1e-12)


BATCH = etid.SkinRC(np.ones(3), np.ones(3), np.ones(3))


@pytest.mark.parametrize(
    ("write", "message"),
    [
        *(
            (lambda name=name: etid.netlist(SPREAD, name=name), "cannot be the name of a")
            for name in ("", "two words", "1st", "a.b", "ä")
        ),
        *(
            (lambda band=band: etid.netlist(SPREAD, band=band), "two increasing frequencies")
            for band in ((0.0, 1.0), (10.0, 1.0), (1.0, np.inf))
        ),
        (lambda: etid.netlist(etid.SkinCole(alpha=1.02)), r"exponent is 1\.02; no passive network"),
        (lambda: etid.netlist(etid.SkinRC(1.0, 1.0, np.nan)), "c_p is nan"),
        (lambda: etid.circuit_string(etid.SkinRC.of_fit([-1.0, 1.0, 1.0])), "r_s is -1"),
        (lambda: etid.netlist(BATCH), r"is a batch; give one circuit, such as fits\[0\]"),
        (lambda: etid.circuit_string(BATCH), r"is a batch; give one circuit, such as fits\[0\]"),
    ],
)
def test_what_cannot_be_written_is_refused(write, message):
    with pytest.raises(ValueError, match=message):
        write()
