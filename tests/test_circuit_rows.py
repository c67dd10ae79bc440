"""Circuits as rows: what NumPy computes at once equals JAX row by row, and nothing is traced."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import etid
from etid.circuits import lookup
from etid.circuits.circuit import impedance_at, with_slopes
from etid.circuits.current_dependent import SkinCurrent
from etid.circuits.elements import Exponent, Farad, Ohm, Second, constant_phase
from etid.circuits.impedance import AbstractIrrational
from etid.precision import namespace
from etid.signals.transfer import as_complex


class Tied(etid.AbstractCircuit):
    """Two equal electrodes, and a constant phase whose Q follows from τ and R."""

    r_s: Ohm = etid.parameter("ohm", typical=20e3)
    r_e: Ohm = etid.parameter("ohm", typical=60e3)
    c_e: Farad = etid.parameter("farad", typical=0.5e-9)
    tau: Second = etid.parameter("second", typical=30e-6)
    alpha: Exponent = etid.parameter("1", typical=0.8)

    def impedance(self):
        electrode = etid.parallel(etid.resistor(self.r_e), etid.capacitor(self.c_e))
        phase = constant_phase(self.tau**self.alpha / (2 * self.r_s), self.alpha)
        return etid.series(electrode, etid.resistor(50.0), electrode, phase)


class OfJax(etid.AbstractCircuit):
    """A circuit that calls JAX itself."""

    r_s: Ohm = etid.parameter("ohm", typical=20e3)
    r_p: Ohm = etid.parameter("ohm", typical=100e3)
    tau: Second = etid.parameter("second", typical=30e-6)

    def impedance(self):
        relaxation = etid.parallel(etid.resistor(self.r_p), etid.capacitor(self.tau / self.r_p))
        return etid.series(etid.resistor(jnp.sqrt(self.r_s) ** 2), relaxation)


class Spread(AbstractIrrational):
    """An element without exact slopes, Z = R / (1 + s τ)^½."""

    r: Ohm
    tau: Second

    def __call__(self, s):
        xp = namespace(s, self.r, self.tau)
        log = xp.log(1 + s * as_complex(xp.asarray(self.tau)))
        return as_complex(xp.asarray(self.r)) * xp.exp(-0.5 * log)

    def exponents(self):
        return ()

    def connect(self, netlist, plus, minus):
        raise NotImplementedError


class OwnElement(etid.AbstractCircuit):
    """A circuit with it, and a resistor parallel to it."""

    r: Ohm = etid.parameter("ohm", typical=100e3)
    r_l: Ohm = etid.parameter("ohm", typical=300e3)
    tau: Second = etid.parameter("second", typical=30e-6)

    def impedance(self):
        return etid.parallel(Spread(self.r, self.tau), etid.resistor(self.r_l))


STRING = type(etid.circuit("R0-p(R1,CPE1)-L2-p(R3,C3)"))
KINDS = [*lookup.built_in().values(), SkinCurrent, STRING, Tied, OfJax, OwnElement]
FREQUENCY = np.geomspace(60.0, 1e5, 7)
EXACT = 1e-12  # relative; both round each operation once
SLOPES = 1e-8  # of the largest slope of a row; differences in the map to the fields leave 1e-10


def logs_of(kind, *rows):
    typical = np.log(kind().values())
    return typical + 0.4 * np.random.default_rng(3).standard_normal((*rows, typical.size))


@functools.cache
def by_jax(kind):
    """Impedance and its slopes of one row, and the response."""

    def both(logs, frequency):
        response = kind().with_log_values(logs).response(frequency)
        return *with_slopes(kind(), logs, frequency), response

    return jax.jit(both)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_rows_of_numpy_equal_jax_row_by_row(kind):
    logs = logs_of(kind, 2, 3)
    z, by_element = with_slopes(kind(), logs, FREQUENCY)
    assert isinstance(z, np.ndarray)
    assert isinstance(by_element, np.ndarray)
    assert (z.shape, by_element.shape) == ((2, 3, 7), (2, 3, logs.shape[-1], 7))
    value = impedance_at(kind(), logs, FREQUENCY)
    assert isinstance(value, np.ndarray)
    np.testing.assert_allclose(value, z, rtol=EXACT)
    for row in np.ndindex(2, 3):
        expected, slopes, _ = map(np.asarray, by_jax(kind)(logs[row], FREQUENCY))
        np.testing.assert_allclose(z[row], expected, rtol=EXACT)
        largest = np.abs(slopes).max()
        np.testing.assert_allclose(by_element[row], slopes, rtol=0, atol=SLOPES * largest)
        one, of_one = with_slopes(kind(), logs[row], FREQUENCY)
        np.testing.assert_allclose(one, expected, rtol=EXACT)
        np.testing.assert_allclose(of_one, by_element[row], rtol=0, atol=1e-15 * largest)


@pytest.mark.parametrize("kind", [etid.SkinRC, etid.SkinCole, etid.Resistor])
def test_jax_has_rows_too(kind):
    def level(logs):
        return jnp.sum(jnp.abs(impedance_at(kind(), logs, FREQUENCY)) ** 2)

    @jax.jit
    def found(logs):
        def both(logs):
            return with_slopes(kind(), logs, FREQUENCY)

        each = jax.vmap(jax.vmap(both))(logs)
        return both(logs), impedance_at(kind(), logs, FREQUENCY), each, jax.grad(level)(logs)

    logs = jnp.asarray(logs_of(kind, 2, 3))
    (z, by_element), value, (expected, slopes), gradient = found(logs)
    np.testing.assert_allclose(z, expected, rtol=EXACT)
    np.testing.assert_allclose(value, expected, rtol=EXACT)
    largest = np.abs(slopes).max()
    np.testing.assert_allclose(by_element, slopes, rtol=0, atol=EXACT * largest)
    by_hand = 2 * np.real(np.conj(z)[..., None, :] * by_element).sum(-1)
    np.testing.assert_allclose(gradient, by_hand, rtol=1e-9, atol=1e-12 * np.abs(by_hand).max())


@pytest.mark.parametrize("kind", [etid.SkinRC, etid.SkinCole])
def test_each_row_may_have_frequencies_of_its_own(kind):
    logs = logs_of(kind, 3)
    frequency = FREQUENCY * np.array([1.0, 1.1, 0.7])[:, None]
    z, by_element = with_slopes(kind(), logs, frequency)
    for row in range(3):
        expected, slopes = with_slopes(kind(), logs[row], frequency[row])
        np.testing.assert_allclose(z[row], expected, rtol=1e-15)
        np.testing.assert_allclose(by_element[row], slopes, rtol=0, atol=1e-15 * abs(slopes).max())


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
@pytest.mark.parametrize("broken", [np.nan, np.inf, -np.inf, -800.0])
def test_a_broken_row_spoils_no_other(kind, broken):
    logs = logs_of(kind, 3)
    expected = with_slopes(kind(), logs, FREQUENCY)
    logs[1] = broken
    for before, after in zip(expected, with_slopes(kind(), logs, FREQUENCY), strict=True):
        np.testing.assert_array_equal(before[[0, 2]], after[[0, 2]])
    value = impedance_at(kind(), logs, FREQUENCY)
    np.testing.assert_array_equal(value[[0, 2]], impedance_at(kind(), logs[[0, 2]], FREQUENCY))


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind is not OfJax])
def test_numpy_needs_no_operation_of_jax(kind, monkeypatch):
    def refused(*_, **__):
        raise AssertionError("an operation of JAX ran")

    logs = logs_of(kind, 4)
    with_slopes(kind(), logs, FREQUENCY)  # what is known of a class is found once
    for module in (jnp, jax.lax):
        for name in dir(module):
            if callable(getattr(module, name)) and not isinstance(getattr(module, name), type):
                monkeypatch.setattr(module, name, refused)
    with_slopes(kind(), logs, FREQUENCY)
    impedance_at(kind(), logs, FREQUENCY)
    kind().response(FREQUENCY)


def test_the_limit_of_diffusion_at_no_frequency_is_its_resistor():
    logs = logs_of(etid.SkinWarburg, 3)
    low = np.array([0.0, 1e-6])
    z, by_element = with_slopes(etid.SkinWarburg(), logs, low)
    total = np.exp(logs[:, 0]) + np.exp(logs[:, 1])
    # s τ is at most 1e-9, and its third is the relative change of Z.
    np.testing.assert_allclose(z, np.broadcast_to(total[:, None], z.shape), rtol=1e-9)
    np.testing.assert_allclose(by_element[:, 2], 0.0, atol=1e-9 * total.max())
    expected, slopes, _ = by_jax(etid.SkinWarburg)(logs[0], low)
    np.testing.assert_allclose(z[0], expected, rtol=1e-11)  # 1 − e^(−2x) loses digits there
    np.testing.assert_allclose(by_element[0], slopes, rtol=0, atol=SLOPES * total.max())


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_a_response_is_that_of_jax(kind):
    circuit = kind()
    found = circuit.response(FREQUENCY)
    assert isinstance(found, np.ndarray)
    *_, traced = by_jax(kind)(circuit.log_values(), FREQUENCY)
    np.testing.assert_allclose(found, traced, rtol=EXACT)
    np.testing.assert_array_equal(circuit.response(jnp.asarray(FREQUENCY)), found)
    of_jax = kind.of_fit(map(jnp.asarray, circuit.values()))
    assert isinstance(of_jax.values(), np.ndarray)
    np.testing.assert_array_equal(of_jax.response(FREQUENCY), found)


def test_a_circuit_that_calls_jax_keeps_its_digits_in_a_process_of_float32():
    expected = OfJax().response(FREQUENCY)
    with jax.enable_x64(False):
        found = OfJax().response(FREQUENCY)
    assert found.dtype == complex
    np.testing.assert_allclose(found, expected, rtol=EXACT)


def test_a_response_at_failed_elements_warns_of_nothing():
    failed = etid.SkinRC.of_fit(map(np.asarray, (0.0, 0.0, np.nan)))
    assert np.isnan(failed.response(FREQUENCY)).all()
