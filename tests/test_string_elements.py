"""The elements of circuit strings: their formulas, those of impedance.py, fits, and refusals."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from impedance.models.circuits.fitting import wrapCircuit
from test_netlist import LADDER_ERROR, impedance_of

import etid
from etid.circuits.circuit import with_slopes
from etid.circuits.lookup import circuit_class, class_path, imported, is_circuit_string

SIGMAS = 4.0  # one of 16 000 for a normal error; with a fixed seed a test passes always or never
ROUNDING = 1e-12  # of 1 − e^(−2x) at x = 0.01, and of powers
SLOPES = 1e-8  # of central differences of 1e-5, relative to |Z|
F = np.geomspace(0.1, 1e5, 40)
S = 2j * np.pi * F


def porous(a, b, reaction, tau):
    beta = np.sqrt(reaction + S * tau)
    return a / (beta * np.tanh(beta)) + b / (beta * np.sinh(beta))


# By string: values, names of the parameters, and the formula.
ELEMENTS = {
    "W0": ((20.0,), "w_0", lambda a: a * (1 - 1j) / np.sqrt(2 * np.pi * F)),
    "Wo0": (
        (30.0, 1e-3),
        "r_wo0 tau_wo0",
        lambda r, tau: r / (np.sqrt(S * tau) * np.tanh(np.sqrt(S * tau))),
    ),
    "Ws0": (
        (30.0, 1e-3),
        "r_ws0 tau_ws0",
        lambda r, tau: r * np.tanh(np.sqrt(S * tau)) / np.sqrt(S * tau),
    ),
    "G0": ((30.0, 1e-3), "r_g0 tau_g0", lambda r, tau: r / np.sqrt(1 + S * tau)),
    "La0": ((2e-6, 0.8), "l_la0 alpha_la0", lambda henry, alpha: (S * henry) ** alpha),
    "K0": ((50.0, 1e-3), "r_k0 tau_k0", lambda r, tau: r / (1 + S * tau)),
    "T0": ((20.0, 8.0, 0.5, 1e-3), "r_a_t0 r_b_t0 reaction_t0 tau_t0", porous),
}
every = pytest.mark.parametrize("string", ELEMENTS)


def circuit_of(string, values):
    return type(etid.circuit(string))(
        **dict(zip(etid.circuit(string).names(), values, strict=True))
    )


def by_impedance_py(circuit):
    string, values = etid.circuit_string(circuit)
    return wrapCircuit(string, {})(F, *values).reshape(2, -1).T @ [1, 1j]


@every
def test_an_element_has_its_formula_in_etid_and_in_impedance_py(string):
    values, names, formula = ELEMENTS[string]
    circuit = circuit_of(string, values)
    assert circuit.names() == tuple(names.split())
    expected = formula(*values)
    for found in (
        circuit.response(F),
        jax.jit(type(circuit).response)(circuit, jnp.asarray(F)),
        by_impedance_py(circuit),
    ):
        np.testing.assert_allclose(found, expected, rtol=ROUNDING)


@every
def test_a_string_is_written_as_it_was_read(string):
    circuit = circuit_of(f"R0-{string}", (5.0, *ELEMENTS[string][0]))
    written, values = etid.circuit_string(circuit)
    again = circuit_of(written, values)
    assert values == [5.0, *ELEMENTS[string][0]]
    assert etid.circuit_string(again) == (written, values)
    np.testing.assert_allclose(by_impedance_py(again), circuit.response(F), rtol=ROUNDING)
    assert circuit_class(class_path(type(circuit))) is type(circuit)


@every
def test_slopes_are_those_of_differences_and_of_jax(string):
    circuit = circuit_of(f"R1-p(R2,{string})", (5.0, 100.0, *ELEMENTS[string][0]))
    logs = circuit.log_values()

    @jax.jit
    def of_jax(logs, f):
        def size(logs):
            return jnp.abs(circuit.with_log_values(logs).response(f)).sum()

        return with_slopes(circuit, logs, f)[1], jax.grad(size)(logs)

    _, found = with_slopes(circuit, logs, F)
    by_jax, gradient = of_jax(jnp.asarray(logs), jnp.asarray(F))
    assert np.isfinite(gradient).all()
    for row, way in enumerate(1e-5 * np.eye(logs.size)):
        up, down = (circuit.with_log_values(logs + one).response(F) for one in (way, -way))
        size = np.abs(circuit.response(F)).max()
        np.testing.assert_allclose(found[row], (up - down) / 2e-5, rtol=0, atol=SLOPES * size)
        np.testing.assert_allclose(by_jax[row], found[row], rtol=0, atol=ROUNDING * size)


@every
def test_elements_scale_with_impedance_and_time(string):
    circuit, (level, time) = etid.circuit(string), etid.circuit(string).scaling()
    scaled = circuit.with_values(circuit.values() * 3.0**level * 7.0**time)
    np.testing.assert_allclose(scaled.response(F / 7), 3 * circuit.response(F), rtol=ROUNDING)


@pytest.mark.parametrize("tau", [1e-8, 1e-4, 10.0])
@pytest.mark.parametrize("string", ["W0", "Wo0", "Ws0", "G0", "K0"])
def test_a_netlist_is_its_element(string, tau):
    circuit = circuit_of(string, (30.0, tau)[: len(ELEMENTS[string][0])])
    text = etid.netlist(circuit, band=(F[0], F[-1]))
    assert len(text.splitlines()) < 150  # 5 000 relaxations of a slow layer are few pairs
    np.testing.assert_allclose(impedance_of(text, F), circuit.response(F), rtol=LADDER_ERROR)


@pytest.mark.parametrize("string", ["La0", "T0"])
def test_an_element_without_netlist_says_so(string):
    with pytest.raises(ValueError, match="cannot be written as resistors, capacitors and induc"):
        etid.netlist(etid.circuit(string))


@pytest.mark.parametrize("string", ["W0", "Wo0", "K0"])
def test_states_have_the_impedance_of_their_element(string):
    impedance = circuit_of(string, ELEMENTS[string][0]).impedance()
    system = impedance.state_space(2 * F[-1], 2_000_000)
    each = S[:, None, None] * np.eye(len(system.A)) - system.A
    z = (system.C @ np.linalg.solve(each, np.tile(system.B, (F.size, 1, 1))))[:, 0] + system.D
    np.testing.assert_allclose(z, impedance(S), rtol=LADDER_ERROR)


@pytest.mark.parametrize("string", ["G0", "La0", "T0"])
def test_an_element_without_response_in_time_says_so(string):
    impedance = etid.circuit(string).impedance()
    assert not impedance.has_response
    with pytest.raises(ValueError, match="has no known response in time"):
        impedance.in_time(1e5, 100)


@pytest.mark.parametrize(
    ("string", "truth"),
    [
        ("R0-p(R1,C1)-Wo1", (10.0, 50.0, 20e-6, 30.0, 1.0)),
        ("R0-p(R1,C1)-Ws1", (10.0, 50.0, 20e-6, 30.0, 1.0)),
        ("R0-p(CPE1,R1-W1)", (10.0, 50e-6, 0.85, 40.0, 60.0)),
        ("L0-R0-p(R1-Wo1,CPE1)", (10e-6, 10.0, 40.0, 30.0, 1.0, 50e-6, 0.85)),
        ("R0-G1", (5.0, 30.0, 0.1)),
        ("La0-R0-p(R1,CPE1)", (5e-5, 0.85, 10.0, 40.0, 50e-6, 0.85)),
        ("R0-K1-K2", (0.01, 0.05, 1e-3, 0.03, 0.1)),  # of a battery
        ("R0-T1", (5.0, 20.0, 8.0, 0.5, 1.0)),
    ],
)
def test_elements_are_found_in_a_spectrum(string, truth):
    circuit = circuit_of(string, truth)
    z, rng = np.asarray(circuit.response(F)), np.random.default_rng(0)
    sigma = 0.002 * np.abs(z)
    noisy = z + sigma * (rng.normal(size=F.size) + 1j * rng.normal(size=F.size))
    fit = etid.identify_impedance(F, noisy, stderr=sigma, circuit=string)
    assert fit.verdict == "successful"
    error = np.abs(np.asarray(fit.circuit.values()) - truth)
    assert (error < SIGMAS * np.sqrt(np.diagonal(fit.cov))).all()


def test_an_underscore_before_the_number_changes_nothing():
    kind = type(etid.circuit("R_0-p(R_1,C_1)-Wo_2"))
    assert kind is type(etid.circuit("R0-p(R1,C1)-Wo2")) is imported("R_0-p(R_1,C1)-Wo2")
    assert kind.names() == ("r_0", "r_1", "c_1", "r_wo2", "tau_wo2")
    for twice in ("R_0-R0", "Wo1-p(R0,Wo_1)"):
        with pytest.raises(ValueError, match="twice; give each element its own number"):
            etid.circuit(twice)
    for wrong in ("R__0", "R0_1", "_R0", "R_", "Wo"):
        with pytest.raises(ValueError, match="write R, C, L, CPE, W, Wo, Ws, G, La, K or T with"):
            etid.circuit(wrong)


def test_a_string_of_elements_is_a_circuit_string_and_any_other_name_is_none():
    right = ("R0", "R_0-La1", "p(T0,K12)", "Wo1-Ws1-W1", "R0-p(R1,C1")
    wrong = ("SkinRC", "Gs1", "W", "Wo", "os:R0", "R0()x", "R٣", "p()", "")
    assert list(filter(is_circuit_string, (*wrong, *right))) == list(right)


def test_a_string_of_a_file_cannot_exceed_the_stack():
    with pytest.raises(LookupError, match="more than 100 parallel connections"):
        circuit_class("etid:" + "p(" * 10_000 + "R0")


def test_units_are_printed_with_a_prefix():
    shown = str(circuit_of("La0-p(CPE1,W2)", (3e-9, 0.9, 0.5, 0.8, 2e-3)))
    for text in ("3  ns·Ω^(1/alpha)", "500  mS·s^alpha", "2  mΩ·s^-1/2"):
        assert text in shown
