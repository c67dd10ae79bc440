"""Circuits from strings, and the Kramers-Kronig test of a measured impedance."""

import copy
import pickle

import jax.numpy as jnp
import numpy as np
import pytest

import etid
from etid.circuits.lookup import circuit_class, class_path, imported

F = jnp.geomspace(10.0, 1e5, 40)


def test_a_string_has_the_impedance_of_its_elements():
    kind = type(etid.circuit("R0-p(R1,C1)"))
    assert kind.names() == ("r_0", "r_1", "c_1")
    written = kind(**{"r_0": 33.4e3, "r_1": 186e3, "c_1": 0.12e-9})
    skin = etid.SkinRC(33.4e3, 186e3, 0.12e-9)
    np.testing.assert_allclose(written.response(F), skin.response(F), rtol=1e-12)
    assert type(etid.circuit(" R0 - p(R1, C1)")) is kind
    assert etid.circuit_string(written) == ("R0-p(R1,C1)", [33.4e3, 186e3, 0.12e-9])


def test_strings_nest_and_know_constant_phases():
    nested = etid.circuit("R0-p(R1-p(R2,CPE2),C1)-C3")
    s = 2j * np.pi * np.asarray(F)
    of = {name: float(getattr(nested, name)) for name in nested.names()}
    inner = of["r_1"] + 1 / (1 / of["r_2"] + of["q_2"] * s ** of["alpha_2"])
    whole = of["r_0"] + 1 / (1 / inner + s * of["c_1"]) + 1 / (s * of["c_3"])
    np.testing.assert_allclose(nested.response(F), whole, rtol=1e-10)


def test_an_inductor_is_s_l_and_is_fitted():
    """A cable of 5 µH before an electrode, up to 10 MHz: half of |Z| at the end."""
    frequency = np.geomspace(100.0, 10e6, 60)
    written = etid.circuit("L0-R0-p(R1,C1)")
    assert written.units()["l_0"] == "henry"
    truth = dict(zip(written.names(), (5e-6, 200.0, 2e3, 20e-9), strict=True))
    s = 2j * np.pi * frequency
    z = s * 5e-6 + 200.0 + 2e3 / (1 + s * 2e3 * 20e-9)
    exact = type(written)(**truth)
    np.testing.assert_allclose(exact.response(frequency), z, rtol=1e-12)
    np.testing.assert_allclose(1 / exact.impedance().admittance(jnp.asarray(s)), z, rtol=1e-12)
    rng = np.random.default_rng(3)
    noise = rng.normal(size=60) + 1j * rng.normal(size=60)
    fit = etid.identify_impedance(
        frequency, z + 0.01 * abs(z) * noise, stderr=0.01 * abs(z), circuit=written
    )
    error = np.asarray(fit.circuit.values()) - np.array(list(truth.values()))
    assert (np.abs(error) < 4 * np.sqrt(np.diagonal(fit.cov))).all()  # 1 of 4 000 seeds exceeds it
    assert "µH" in str(fit)


def test_an_inductor_in_series_has_no_response_in_time_and_one_with_a_resistor_across_has():
    with pytest.raises(ValueError, match="an inductor in series"):
        etid.circuit("L0-R0").impedance().state_space(1e5, 100)
    rational = etid.circuit("p(L0,R1)-R2").impedance().rational()
    s = 2j * np.pi * np.asarray(F)
    z = s * 1e-3 * 100e3 / (s * 1e-3 + 100e3) + 20e3
    np.testing.assert_allclose(rational(jnp.asarray(s)), z, rtol=1e-9)


@pytest.mark.parametrize(
    "string", ["", "R0-", "R0--C1", "p(R1)", "p(R1,C1", "R0-p(R1,C1))", "X0", "R", "R0 C1", "R0+C1"]
)
def test_what_is_no_circuit_is_refused(string):
    with pytest.raises(ValueError, match=r"is no circuit: (cannot read|it ends too early)"):
        etid.circuit(string)


def test_a_written_circuit_is_found_by_its_name_and_copied():
    one = etid.circuit("R0-p(R1,C1)")
    assert class_path(type(one)) == "etid:R0-p(R1,C1)"
    assert circuit_class("etid:R0-p(R1,C1)") is type(one) is imported("R0-p(R1,C1)")
    with pytest.raises(LookupError, match="is no circuit"):
        circuit_class("etid:R0-p(R1,C1")
    for again in (pickle.loads(pickle.dumps(one)), copy.deepcopy(one)):
        assert type(again) is type(one)
        np.testing.assert_array_equal(again.values(), one.values())
    assert "r_0" in str(one)


def test_passive_circuits_pass_kramers_and_kronig_and_a_drift_does_not():
    for circuit in (etid.SkinRC(33.4e3, 186e3, 0.12e-9), etid.SkinCole(), etid.SkinLayers()):
        z = np.asarray(circuit.response(F))
        found = etid.kramers_kronig(F, z)
        assert found.passed, circuit
    rng = np.random.default_rng(0)
    noise = 0.001 * np.abs(z) * (rng.normal(size=40) + 1j * rng.normal(size=40))
    noisy = etid.kramers_kronig(F, z + noise)
    assert noisy.passed
    assert noisy.relaxations < 40  # it does not describe the noise
    # The imaginary part of one circuit and the real part of another are no circuit.
    other = np.asarray(etid.SkinRC(10e3, 300e3, 1e-9).response(F))
    mixed = etid.kramers_kronig(F, np.real(other) + 1j * np.imag(z))
    assert not mixed.passed
    assert "not passed" in str(mixed)


@pytest.mark.parametrize("relative", [0.0005, 0.05])
def test_known_noise_decides_the_test_of_kramers_and_kronig(relative):
    z = np.asarray(etid.SkinRC(33.4e3, 186e3, 0.12e-9).response(F))
    rng = np.random.default_rng(1)
    sigma = relative * np.abs(z)
    noisy = z + sigma * (rng.normal(size=40) + 1j * rng.normal(size=40))
    found = etid.kramers_kronig(F, noisy, stderr=sigma)
    assert found.passed
    assert "standard errors" in str(found)
    # A gain that wanders by 0.3 % during the sweep is hidden by 5 % of noise, not by 0.05 %, of
    # which it makes three times the largest sum of squares that passes.
    wandering = 0.003 * np.sin(np.log(np.asarray(F)))
    swept = noisy + wandering * z
    assert etid.kramers_kronig(F, swept, stderr=sigma).passed == (relative > 0.01)
    # Without standard errors the limit is 1 %, and the test says so.
    blind = etid.kramers_kronig(F, noisy)
    assert blind.passed == (relative < 0.01)
    assert "no residual may exceed 1 %" in str(blind)
    with pytest.raises(ValueError, match="stderr must be"):
        etid.kramers_kronig(F, z, stderr=0.0)


def test_right_measurements_with_right_errors_pass():
    rng = np.random.default_rng(2)
    f = F[::3]  # so few that a chain of fewer relaxations than frequencies describes no circuit
    z = np.asarray(etid.SkinRC(33.4e3, 186e3, 0.12e-9).response(f))
    noise = 300.0 * (rng.normal(size=(300, f.size)) + 1j * rng.normal(size=(300, f.size)))
    failed = sum(not etid.kramers_kronig(f, z + one, stderr=300.0).passed for one in noise)
    assert failed <= 3  # 1 in 1000 by chance; more than 3 of 300 in 1 of 3 000 runs


def test_wrong_arguments_of_the_test_are_refused():
    with pytest.raises(ValueError, match="both must be"):
        etid.kramers_kronig([1.0, 2.0], [1.0, 2.0])
    with pytest.raises(ValueError, match="frequency must be finite and > 0"):
        etid.kramers_kronig(np.arange(6.0), np.ones(6))
    with pytest.raises(ValueError, match="6 frequencies in 3 decades; the test needs at least 3"):
        etid.kramers_kronig(np.geomspace(1.0, 1e3, 6), np.ones(6))
