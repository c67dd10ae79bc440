"""A kind of element that etid does not have: one class of at most 30 lines, nothing else."""

import dataclasses
import functools
import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_netlist import FREQUENCY, impedance_of

import etid
from benchmarks.ladder import CALIBRATION, rung
from etid.circuits.circuit import too_steep
from etid.circuits.elements import Capacitance, Exponent, Ohm, Second, ladder
from etid.circuits.impedance import AbstractElement, AbstractIrrational
from etid.signals.transfer import as_complex, reciprocal
from etid.simulation.scenes import Trial

SIGMAS = 5.0  # one in 2e6; with a fixed seed a test passes always or never
LADDER = 1e-3  # relative: what the netlist of a circuit may differ by in its band


class DavidsonCole(AbstractIrrational):
    """Z = R / (1 + s τ)^β = 1 / (Q (s + 1/τ)^β), Q = τ^β / R   (Davidson and Cole 1951)."""

    r: Ohm
    tau: Second
    beta: Exponent

    def __call__(self, s):
        log = jnp.log(1 + s * as_complex(jnp.asarray(self.tau)))
        power = jnp.exp(jax.lax.complex(-self.beta * log.real, -self.beta * log.imag))
        return as_complex(jnp.asarray(self.r)) * power

    def admittance(self, s):
        return reciprocal(self(s))

    def exponents(self):
        return (self.beta,)

    def connect(self, netlist, plus, minus):
        """The ladder of a constant phase, each capacitor with a resistor that makes s s + 1/τ."""

        def leaking(part):
            leaks = isinstance(part, Capacitance)
            return etid.parallel(part, etid.resistor(self.tau / part.c)) if leaks else part

        steps = ladder(float(self.tau**self.beta / self.r), float(self.beta), netlist.band)
        jax.tree.map(
            leaking, steps, is_leaf=lambda part: isinstance(part, AbstractElement)
        ).connect(netlist, plus, minus)


class SkinDavidsonCole(etid.AbstractCircuit):
    """Skin whose relaxation is spread to one side."""

    r_s: Ohm = etid.parameter("ohm", typical=20e3)
    r_p: Ohm = etid.parameter("ohm", typical=100e3)
    tau: Second = etid.parameter("second", typical=30e-6)
    beta: Exponent = etid.parameter("1", typical=0.9)

    def impedance(self):
        return etid.series(etid.resistor(self.r_s), DavidsonCole(self.r_p, self.tau, self.beta))


TRUTH = SkinDavidsonCole(33.4e3, 186e3, 40e-6, 0.7)


@functools.cache
def fitted():
    """A recording, its driver, and the circuit that was found in its impedance."""
    trials = (Trial("skin", TRUTH),)
    study = dataclasses.replace(rung("dry"), trials=trials).simulate(3)
    driver = etid.identify_driver(study[CALIBRATION])
    rng, sigma, f = np.random.default_rng(1), 100.0, np.geomspace(10, 1e6, 60)
    noise = sigma * (rng.normal(size=60) + 1j * rng.normal(size=60))
    z = np.asarray(TRUTH.response(jnp.asarray(f))) + noise
    fit = etid.identify_impedance(f, z, stderr=sigma, circuit=SkinDavidsonCole())
    return study["skin"], driver, fit


def test_an_element_is_thirty_lines():
    assert len(inspect.getsource(DavidsonCole).splitlines()) <= 30


def test_it_is_fitted():
    is_found(fitted()[2])


@pytest.mark.slow
def test_it_is_fitted_at_the_harmonics():
    recording, driver, _ = fitted()
    is_found(etid.identify_skin(recording, driver, circuit=SkinDavidsonCole()))


def is_found(fit):
    assert fit.verdict == "successful"
    error = np.asarray(fit.circuit.values() - TRUTH.values())
    assert (np.abs(error) < SIGMAS * np.asarray(fit.stderr.values())).all()
    assert (np.asarray(fit.stderr.values() / fit.circuit.values()) < 0.05).all()


def test_its_netlist_is_a_ladder():
    expected = np.asarray(TRUTH.response(jnp.asarray(FREQUENCY)))
    found = impedance_of(etid.netlist(TRUTH), FREQUENCY)
    np.testing.assert_allclose(found, expected, rtol=LADDER)


def test_it_is_found_in_a_single_period():
    """Nobody needs to know its response in time."""
    recording, driver, _ = fitted()
    v_th, v_out = recording.v_th[:3_334], recording.v_out[:3_334]
    single, circuit = recording.replace(v_th=v_th, v_out=v_out), SkinDavidsonCole()
    for method in (None, "output_error"):
        fit = etid.identify_skin(single, driver, circuit=circuit, method=method)
        error = np.asarray(fit.circuit.values() - TRUTH.values())
        assert (np.abs(error) < SIGMAS * np.asarray(fit.stderr.values())).all()
    short = recording.replace(v_th=v_th[:3_000], v_out=v_out[:3_000])
    with pytest.raises(ValueError, match="holds no whole pulse period"):
        etid.predict(short, driver, TRUTH)


def test_what_it_cannot_do_is_said():
    circuit = SkinDavidsonCole()
    assert not circuit.is_rational
    with pytest.raises(ValueError, match=r"impedance\.py has no element for DavidsonCole"):
        etid.circuit_string(circuit)
    with pytest.raises(ValueError, match=r"an exponent is 1\.02; no passive network"):
        etid.netlist(SkinDavidsonCole(33e3, 186e3, 40e-6, 1.02))
    steep = SkinDavidsonCole(33e3, 186e3, 40e-6, 1.1)
    assert too_steep(steep, steep.log_values(), 1e-6 * np.eye(4))
