"""Branches that can be exchanged: which they are, and that names never swap between fits."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import etid
from etid.circuits.branches import exchangeable, in_order
from etid.simulation.scenes import Scene, Trial
from etid.simulation.transformer import ResistorLoad

LAYERS = etid.SkinLayers(6.1e3, 12e3, 0.94e-9, 5.4e3, 22e-9)
WRITTEN = "R0-p(R1,C1)-p(R2,C2)"


class Own(etid.AbstractCircuit):
    """A user's circuit: nested connections, capacitor and resistor in either order, slow first."""

    r_slow: float = etid.parameter("ohm", typical=30e3)
    c_slow: float = etid.parameter("farad", typical=4e-9)
    c_fast: float = etid.parameter("farad", typical=0.3e-9)
    r_fast: float = etid.parameter("ohm", typical=70e3)
    r: float = etid.parameter("ohm", typical=20e3)

    def impedance(self):
        slow = etid.parallel(etid.resistor(self.r_slow), etid.capacitor(self.c_slow))
        fast = etid.parallel(etid.capacitor(self.c_fast), etid.resistor(self.r_fast))
        return etid.series(etid.series(slow, etid.resistor(self.r)), fast)


class Alike(etid.AbstractCircuit):
    """Two relaxations that share their exponent."""

    r_1: float = etid.parameter("ohm", typical=70e3)
    tau_1: float = etid.parameter("second", typical=20e-6)
    r_2: float = etid.parameter("ohm", typical=30e3)
    tau_2: float = etid.parameter("second", typical=0.1e-3)
    alpha: float = etid.parameter("1", typical=0.8)

    def impedance(self):
        first = etid.cole(self.r_1, self.tau_1, self.alpha)
        return etid.series(first, etid.cole(self.r_2, self.tau_2, self.alpha))


def named(circuit):
    names = circuit.names()
    return [
        [" ".join(names[place] for place in branch) for branch in branches]
        for branches in exchangeable(type(circuit))
    ]


@pytest.mark.parametrize(
    ("circuit", "expected"),
    [
        (etid.SkinLayers(), [["r_1 c_1", "r_2 c_2"]]),
        (Own(), [["r_fast c_fast", "r_slow c_slow"]]),
        (Alike(), [["r_1 tau_1", "r_2 tau_2"]]),
        (etid.circuit(WRITTEN), [["r_1 c_1", "r_2 c_2"]]),
        (
            etid.circuit("p(R1,C1)-p(C2,R2)-p(R3,C3)-R4"),
            [["r_1 c_1", "r_2 c_2", "r_3 c_3"]],
        ),
        (etid.circuit("p(R1,CPE1)-p(R2,CPE2)"), [["r_1 q_1 alpha_1", "r_2 q_2 alpha_2"]]),
        (etid.circuit("p(R1-C1,R2-C2)"), [["r_1 c_1", "r_2 c_2"]]),
        (etid.circuit("p(R1,L1)-p(R2,L2)"), [["r_1 l_1", "r_2 l_2"]]),
        (
            etid.circuit("p(R0,p(R1,C1)-p(R2,C2))-p(R3,p(R4,C4)-p(R5,C5))"),
            [
                ["r_1 c_1", "r_2 c_2"],
                ["r_4 c_4", "r_5 c_5"],
                ["r_0 r_1 c_1 r_2 c_2", "r_3 r_4 c_4 r_5 c_5"],
            ],
        ),
        (etid.circuit("R0-p(R1,C1)-p(R2,CPE2)"), []),
        (etid.circuit("p(R1,C1-p(R2,C2))"), []),
        *((of(), []) for of in (etid.SkinRC, etid.SkinCole, etid.SkinWarburg, etid.ParallelRC)),
        (etid.SkinCurrent(), []),
    ],
)
def test_branches_are_found_from_the_structure(circuit, expected):
    found = named(circuit)
    assert [[set(of.split()) for of in each] for each in found] == [
        [set(of.split()) for of in each] for each in expected
    ]


@pytest.mark.parametrize(
    "circuit",
    [Own(), Alike(), etid.circuit("p(R1,C1)-p(C2,R2)-p(R3,C3)-R4"),
     etid.circuit("p(R1,CPE1)-p(R2,CPE2)"), etid.circuit("p(R1,L1)-p(R2,L2)")],
)  # fmt: skip
def test_the_order_is_that_of_the_typical_values_whatever_was_found(circuit):
    """Each exchange of the typical branches comes back; the impedance is the same throughout."""
    logs = np.asarray(circuit.log_values())
    (branches,) = exchangeable(type(circuit))
    z = np.asarray(circuit.response(np.geomspace(10.0, 1e6, 20)))
    for order in itertools.permutations(branches):
        moved = logs.copy()
        for here, there in zip(branches, order, strict=True):
            moved[list(here)] = logs[list(there)]
        again = circuit.with_log_values(jnp.asarray(moved))
        np.testing.assert_allclose(again.response(np.geomspace(10.0, 1e6, 20)), z, rtol=1e-9)
        for places in (in_order(circuit, moved), jax.jit(lambda of: in_order(circuit, of))(moved)):
            np.testing.assert_array_equal(moved[np.asarray(places)], logs)


def test_branches_of_which_other_things_are_known_are_not_exchanged():
    slow_first = LAYERS.with_values(np.asarray(LAYERS.values())[[0, 3, 4, 1, 2]])
    logs = np.asarray(slow_first.log_values())
    assert in_order(LAYERS, logs).tolist() == [0, 3, 4, 1, 2]
    same, other = np.array([5.0, 1.0, 2.0, 1.0, 2.0]), np.array([0.0, 1.0, 0.0, 0.0, 0.0])
    assert in_order(LAYERS, logs, same).tolist() == [0, 3, 4, 1, 2]
    assert in_order(LAYERS, logs, same, other).tolist() == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("circuit", [etid.SkinLayers(), etid.circuit(WRITTEN), Own()])
def test_spectra_of_one_circuit_get_one_order(circuit):
    """Close time constants and starts at all corners: names swapped in a third of the fits."""
    f = np.geomspace(10, 1e6, 60)
    truth = etid.SkinLayers(500.0, 1000.0, 10e-9, 1000.0, 20e-9)
    z, units = np.asarray(truth.response(f)), circuit.units()
    sigma = 0.002 * np.abs(z)
    slow, fast = (("r_slow", "c_slow"), ("r_fast", "c_fast")) if "r_slow" in units else (
        ("r_2", "c_2"), ("r_1", "c_1"))  # fmt: skip
    for seed in range(8):
        noise = np.random.default_rng(seed).standard_normal((2, f.size))
        noisy = z + sigma * (noise[0] + 1j * noise[1])
        fit = etid.identify_impedance(f, noisy, stderr=sigma, circuit=circuit)
        found = {name: float(getattr(fit.circuit, name)) for name in units}
        errors = {name: float(getattr(fit.stderr, name)) for name in units}
        assert found[fast[0]] * found[fast[1]] < found[slow[0]] * found[slow[1]], seed
        # The covariance moves too: of 16 numbers one exceeds four errors in a thousand tests.
        for name, expected in zip((*fast, *slow), (1e3, 10e-9, 1e3, 20e-9), strict=True):
            assert abs(found[name] - expected) < 4 * errors[name], (seed, name)


@pytest.fixture(scope="module")
def study():
    known = (Trial("c", ResistorLoad(98.8e3)),)
    return Scene((Trial("a", LAYERS), Trial("b", LAYERS)), known, snr_db=60.0).simulate(seed=1)


@pytest.fixture(scope="module")
def driver(study):
    return etid.identify_driver(study["c"], order=5)


# A start from which the search finds the branches the other way round.
SLOW_FIRST = etid.SkinLayers(6.1e3, 5.4e3, 22e-9, 12e3, 0.94e-9)


def same(one, other):
    """Whether two fits are one minimum, to the accuracy of the search."""
    errors = np.asarray(one.stderr.values())
    moved = np.abs(np.asarray(one.circuit.values()) - np.asarray(other.circuit.values()))
    assert (moved < 0.05 * errors).all()
    for name in ("cov", "shared_cov"):
        a, b = (np.asarray(getattr(of, name)) / np.outer(errors, errors) for of in (one, other))
        np.testing.assert_allclose(a, b, atol=0.05)
    np.testing.assert_allclose(
        np.asarray(one.change_stderr), np.asarray(other.change_stderr), rtol=0.05
    )


def test_recordings_get_one_order_from_every_start(study, driver):
    fit = etid.identify_skin(study["a"], driver, circuit=etid.SkinLayers())
    assert float(fit.circuit.c_1) == pytest.approx(LAYERS.c_1, rel=0.2)
    assert float(fit.circuit.c_2) == pytest.approx(LAYERS.c_2, rel=0.2)
    same(fit, etid.identify_skin(study["a"], driver, circuit=SLOW_FIRST))
    same(fit, etid.identify_skins([study["a"], study["b"]], driver, circuit=SLOW_FIRST)[0])
    written = etid.circuit(WRITTEN).with_values(np.asarray(SLOW_FIRST.values()))
    same(fit, etid.identify_skin(study["a"], driver, circuit=written))


def test_what_is_known_of_a_branch_keeps_its_name(study, driver):
    """A fixed slow branch stays the first one; equal bounds and priors of both do not count."""
    fixed = {"c_1": 22e-9}
    fit = etid.identify_skin(study["a"], driver, circuit=SLOW_FIRST, fixed=fixed)
    assert float(fit.circuit.c_1) == 22e-9
    assert float(fit.circuit.c_2) == pytest.approx(0.94e-9, rel=0.2)
    assert float(fit.stderr.c_1) < 1e-6 * float(fit.circuit.c_1)
    every = {name: (1e-10, 1e-7) for name in ("c_1", "c_2")}
    fit = etid.identify_skin(study["a"], driver, circuit=SLOW_FIRST, bounds=every)
    assert float(fit.circuit.c_1) == pytest.approx(0.94e-9, rel=0.2)
    unequal = {"c_1": (1e-9, 1e-7)}
    fit = etid.identify_skin(study["a"], driver, circuit=SLOW_FIRST, bounds=unequal)
    assert float(fit.circuit.c_1) == pytest.approx(22e-9, rel=0.2)
    assert fit.outside == ""


@pytest.mark.slow
def test_joint_fits_and_their_files_get_one_order(study, tmp_path):
    """With an instrument, so that what its tolerances do moves with the elements."""
    usual, other = (
        etid.identify_jointly(study, circuit=start, instrument=etid.Instrument())
        for start in (etid.SkinLayers(), SLOW_FIRST)
    )
    other.write(tmp_path / "fits.h5")
    for row in range(2):
        same(usual.fits[row], other.fits[row])
        same(usual.fits[row], etid.Fits.read(tmp_path / "fits.h5")[row])
        a, b = (fits.fits[row].by_tolerance for fits in (usual, other))
        assert a is not None
        assert b is not None
        np.testing.assert_allclose(a.moved, b.moved, rtol=0.05, atol=1e-6)
