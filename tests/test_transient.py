"""Records of any length: the states at their ends, against filters in time and against truth."""

import dataclasses

import jax
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.signal import lfilter

import etid
from benchmarks.ladder import CALIBRATION, LOADS, TRIAL, rung
from etid.circuits.circuit import with_slopes
from etid.estimators.lanes import Bins
from etid.estimators.maximum_likelihood.rows import loads_of, source_of
from etid.estimators.registry import MAXIMUM_LIKELIHOOD
from etid.identify.fitting import known_of
from etid.likelihood.load import Anew, Near
from etid.likelihood.profile import Profile, Records, States
from etid.likelihood.transient import orders, relaxations
from etid.precision import array_function
from etid.recordings.preflight import Inspected
from etid.signals import modal

# Noise, calibration and load make errors that are normal: 12 of them exceed this once in 1 000.
SIGMAS = 4.0
ZEROS = 4  # coefficients of the numerator


def filtered():
    """A record in the middle of an excitation, through a filter of order 3, with white noise."""
    rng, size = np.random.default_rng(0), 400
    a = np.poly([0.9, 0.5 + 0.4j, 0.5 - 0.4j]).real
    b = np.array([0.3, -0.1, 0.2, -0.25])
    x = rng.standard_normal(size + 100)
    x[:120] += 1.0
    y = lfilter(b, a, x)[100:] + 0.01 * rng.standard_normal(size)
    return x[100:], y, np.concatenate([b, a[1:]])


def in_time(q, x, y):
    """Residual of output error, with the best initial state."""
    b, a = q[:ZEROS], np.append(1.0, q[ZEROS:])
    impulse = np.zeros(x.size)
    impulse[0] = 1.0
    free = np.stack([lfilter(one, a, impulse) for one in np.eye(ZEROS - 1)], 1)
    left = y - lfilter(b, a, x)
    return left - free @ np.linalg.lstsq(free, left)[0]


def test_the_sum_of_squares_over_the_bins_is_that_of_a_filter_with_a_free_initial_state():
    """Bin 0 and the last one, which etid leaves out, are filtered from the samples too."""
    x, y, q = filtered()
    q = q * (1 + 5e-4 * np.random.default_rng(1).standard_normal(q.size))

    @array_function
    def whole(q):
        """All bins: the two real ones have half of the weight."""
        size, b, a = x.size, q[:ZEROS], np.append(1.0, q[ZEROS:])
        both = np.fft.rfft(np.stack([x, y])) / size
        z = np.exp(-2j * np.pi * np.arange(both.shape[1]) / size)
        denominator = np.polyval(a[::-1], z)
        weight = np.full((1, z.size), 1 / size)
        weight[0, [0, -1]] *= 2
        used, none = np.ones((1, z.size), bool), np.zeros(z.size)
        records = Records(np.arange(z.size) + 1.0, both[0], none, both[1:], weight, used)
        ends = np.stack([z**k / denominator for k in range(ZEROS - 1)])[:, None]
        gains = (np.polyval(b[::-1], z) / denominator)[None]
        found = Profile.of(records, gains, States(ends[:0], ends, np.full(ZEROS - 1, 1e9)))
        scaled = found.innovations[0] * np.sqrt(found.weight[0])
        return np.concatenate([scaled.real, scaled.imag])

    np.testing.assert_allclose((whole(q) ** 2).sum(), (in_time(q, x, y) ** 2).sum(), rtol=1e-10)
    exactly = {"jac": "3-point", "x_scale": "jac", "xtol": 1e-15, "ftol": 1e-15, "gtol": 1e-15}
    each = [least_squares(of, q, **exactly).x for of in (whole, lambda q: in_time(q, x, y))]
    np.testing.assert_allclose(each[0], each[1], rtol=1e-6)


def differences(function, at, step=1e-5):
    """Central differences along the last axis of `at`, as a new first axis."""
    return np.stack([
        (function(at + step * way) - function(at - step * way)) / (2 * step)
        for way in np.eye(at.shape[-1])
    ])  # fmt: skip


@pytest.mark.parametrize("circuit", [etid.SkinRC(), etid.SkinLayers(), etid.ParallelRC()])
def test_the_decays_of_a_load_are_those_of_its_poles(circuit):
    """The poles of Z_L, from Z_L at a few frequencies; and their derivatives."""
    few, every = np.geomspace(60.0, 7e4, 40), 60.0 * np.arange(1.0, 1000.0)
    s, logs = 2j * np.pi * every, np.log(np.asarray(circuit.values()))
    times = circuit.r_p * circuit.c_p if hasattr(circuit, "r_p") else None
    times = [times] if times else [circuit.r_1 * circuit.c_1, circuit.r_2 * circuit.c_2]

    def decays(logs):
        z, slopes = with_slopes(circuit, logs, few)
        return relaxations(orders(type(circuit)), few, z, every, slopes)

    found = decays(logs)
    basis = np.concatenate([found.values.real, found.values.imag], -1).T
    for time in times:
        one = 1 / (1 + s * time)
        one = np.concatenate([one.real, one.imag])
        left = one - basis @ np.linalg.lstsq(basis, one)[0]
        assert np.linalg.norm(left) < 1e-7 * np.linalg.norm(one)
    expected = differences(lambda logs: decays(logs).values, logs)
    assert found.by_logs is not None
    found = found.by_logs[:, None] * found.values
    # The equations for two poles have a condition of 1e8.
    np.testing.assert_allclose(found, expected, atol=1e-6 * np.abs(expected).max())


def test_derivatives_of_decays_of_a_source_are_those_of_differences():
    """Two sections and a real pole, with sizes of the states of two records."""
    rng, f = np.random.default_rng(2), np.geomspace(60.0, 7e4, 50)
    at = np.concatenate([[3.0], np.log([3e5, 9e5, 0.4, 1.2]), rng.normal(size=4), [5.0, 0.3]])
    sizes = rng.normal(size=(2, 5))

    def summed(at):
        return sizes @ modal.decays(at, 2, f)

    expected = np.moveaxis(differences(summed, at), 0, 1)
    found = modal.decays_by_parameters(at, 2, sizes, f)
    np.testing.assert_allclose(found, expected, atol=1e-7 * np.abs(expected).max())


def cut(first, samples, seed=0, kind="damp", snr_db=60.0):
    """Samples of a study from `first` on."""
    study = rung(kind, snr_db=snr_db, samples=first + samples).simulate(seed)
    return {
        path: study[path].replace(v_th=study[path].v_th[first:], v_out=study[path].v_out[first:])
        for path in (CALIBRATION, TRIAL)
    }


def test_the_terms_at_the_knots_have_the_gradient_of_all_bins():
    """Also through the states, which are at their minimum at every point."""
    records = cut(60, 2000)
    driver = etid.identify_driver(records[CALIBRATION])
    lane = Bins.of(Inspected.of(records[TRIAL]))
    known = jax.tree.map(np.asarray, known_of(lane, driver, False, MAXIMUM_LIKELIHOOD))
    load = loads_of([lane], source_of(known), etid.SkinRC(), None, None)
    rng, count = np.random.default_rng(1), load.width.size
    q = np.concatenate([np.log(dataclasses.astuple(LOADS["damp"])), np.zeros(count - 3)])
    q = (q + 0.01 * rng.standard_normal(count) * np.minimum(1.0, load.width))[None]

    @array_function
    def equations(q):
        near = Near.of(load, load.gains.at(load.knots.index), q)
        return Anew(load, load.gains.at(load.knots.index)).at(near)

    found = equations(q)
    numeric = differences(lambda q: load.objective(q[None])[0], q[0], 1e-6)
    # Straight lines between knots miss 5e-4 of a function that bends by 1.
    errors = np.sqrt(np.diagonal(found.matrix[0]))
    np.testing.assert_allclose(
        found.gradient[0] / errors, numeric / errors, atol=2e-3 * np.abs(numeric / errors).max()
    )


@pytest.mark.parametrize(
    ("first", "samples"),
    [
        (0, 1400),
        (60, 2000),
        (3200, 3000),
        (3400, 5000),
        pytest.param(50, 9000, marks=pytest.mark.slow),
    ],
)
def test_a_record_may_be_cut_anywhere(first, samples):
    """In a pulse, between pulses, .4 to 2.7 periods; driver and skin from the same cut."""
    for kind, seed in (("dry", 1), ("damp", 2)):
        records = cut(first, samples, seed, kind)
        driver = etid.identify_driver(records[CALIBRATION])
        fit = etid.identify_skin(records[TRIAL], driver)
        off = np.asarray(fit.circuit.values()) - np.array(dataclasses.astuple(LOADS[kind]))
        assert np.abs(off / np.asarray(fit.stderr.values())).max() < SIGMAS
        assert (np.asarray(fit.stderr.values()) < 0.15 * np.asarray(fit.circuit.values())).all()


@pytest.mark.slow
def test_jax_differentiates_the_fit_of_a_single_period():
    """And finds the same elements as NumPy."""
    records = cut(0, 1400)
    driver = etid.identify_driver(records[CALIBRATION])
    one = records[TRIAL]

    def fitted(size):
        return etid.identify_samples(
            one.v_th,
            size * one.v_out,
            driver,
            sample_rate=one.sample_rate,
            pulse_rate=one.pulse_rate,
        )

    def log_r_p(size):
        return jax.numpy.log(fitted(size).circuit.r_p)

    fit = fitted(1.0)
    value, slope = jax.jit(jax.value_and_grad(log_r_p))(1.0)
    error = float(fit.stderr.r_p) / float(fit.circuit.r_p)
    assert abs(float(value) - np.log(float(fit.circuit.r_p))) < 1e-3 * error
    step = 1e-4
    up, down = (float(log_r_p(1 + way * step)) for way in (1, -1))
    assert float(slope) == pytest.approx((up - down) / (2 * step), rel=1e-2)
