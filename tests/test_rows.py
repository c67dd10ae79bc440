"""The likelihood of rows: one text for NumPy and JAX, whose rows do not depend on each other."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import etid
from etid.circuits.circuit import SkinLayers, SkinRC
from etid.estimators.lanes import Harmonics
from etid.estimators.maximum_likelihood.rows import loads_of, source_of
from etid.estimators.registry import MAXIMUM_LIKELIHOOD
from etid.identify.fitting import known_of
from etid.likelihood.fit import fit
from etid.likelihood.gains import Gains
from etid.likelihood.linear import DIFFERENCE, LevenbergMarquardt, NormalEquations, bend
from etid.likelihood.load import Near
from etid.likelihood.profile import Profile, Records
from etid.likelihood.search import decided, minimum
from etid.likelihood.starts import starts
from etid.precision import array_function
from etid.recordings.preflight import Inspected
from etid.simulation.scenes import Trial

SAME = 1e-9  # standard errors and relative errors: rounding, and the order of sums


@pytest.fixture(scope="module")
def study():
    skins = (SkinRC(33.4e3, 186e3, 0.12e-9), SkinRC(6.1e3, 17.4e3, 0.66e-9))
    skins += (SkinRC(20e3, 400e3, 60e-12),)
    trials = tuple(Trial(f"skin/{number}", one) for number, one in enumerate(skins))
    return dataclasses.replace(etid.scenes.paper_dry(snr_db=50.0), trials=trials).simulate(seed=3)


@pytest.fixture(scope="module")
def driver(study):
    return etid.identify_driver(study["calibration/98k8"])


def lanes(study):
    return [Harmonics.of(Inspected.of(one)) for one in study.loaded.recordings()]


def loads(study, driver, circuit=None, rows=slice(None)):
    every = lanes(study)
    known = known_of(every[0], driver, False, MAXIMUM_LIKELIHOOD)
    return loads_of(every[rows], source_of(known), circuit or SkinRC(), None, None)


def in_jax(load):
    """The same in the namespace of JAX."""
    gains = dataclasses.replace(load.gains, frequency=jnp.asarray(load.gains.frequency))
    return dataclasses.replace(load, gains=gains, records=Records(*map(jnp.asarray, load.records)))


def same(one, other, error=SAME):
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        b = np.asarray(b)
        size = 0.0 if b.dtype == bool else np.max(np.abs(b[np.isfinite(b)]), initial=0.0)
        np.testing.assert_allclose(np.asarray(a), b, rtol=0, atol=error * size)


def row(of, number):
    return jax.tree.map(lambda leaf: np.asarray(leaf)[number], of)


def test_a_row_does_not_depend_on_the_others(study, driver):
    load = loads(study, driver)
    together = fit(load, starts(load))
    for number in range(len(load.records.x)):
        alone = loads(study, driver, rows=slice(number, number + 1))
        same(row(fit(alone, starts(alone)), 0), row(together, number))


def test_a_row_that_is_not_a_number_spoils_no_other(study, driver):
    load = loads(study, driver)
    expected = fit(load, starts(load))
    x = load.records.x.copy()
    x[1] = np.nan
    spoilt = dataclasses.replace(load, records=load.records._replace(x=x))
    found = fit(spoilt, starts(spoilt))
    for number in (0, 2):
        same(row(found, number), row(expected, number))
    assert not found.settled[1]
    assert np.isnan(found.chi2[1])


@np.errstate(all="ignore")  # no resistor is like these skins: its fit is a misfit
def test_rows_of_a_resistor_move_one_by_one(study, driver):
    """Its impedance is one number at all frequencies; rows that have settled stay as they are."""
    load = loads(study, driver, etid.Resistor())
    together = minimum(load, starts(load))
    assert len(set(together.points.tolist())) > 1
    for number in range(len(load.records.x)):
        alone = loads(study, driver, etid.Resistor(), slice(number, number + 1))
        same(minimum(alone, starts(alone)).q[0], together.q[number])


def test_jax_runs_the_same_text_to_the_same_iterates(study, driver):
    load = loads(study, driver)
    start = starts(load)
    found = minimum(load, start)
    traced = jax.jit(
        lambda records, start: minimum(dataclasses.replace(in_jax(load), records=records), start)
    )(in_jax(load).records, jnp.asarray(start))
    assert (np.asarray(traced.points) == found.points).all()
    same((traced.q, traced.promised), (found.q, found.promised), 1e-6)  # a promise cancels digits
    same(traced.near.profile, found.near.profile)


@array_function
def test_one_recording_needs_no_axis_of_rows_in_jax(study, driver):
    load = loads(study, driver)
    start = jnp.asarray(starts(load)[0])
    every = in_jax(load)
    one = dataclasses.replace(
        every,
        gains=dataclasses.replace(every.gains, frequency=every.gains.frequency[0]),
        records=Records(*(leaf[0] for leaf in every.records)),
    )
    knots = load.gains.at(load.knots.index)
    expected = row(Near.of(load, knots, np.asarray(start)).condensed, 0)
    same(Near.of(one, one.gains.at(one.knots.index), start[0]).condensed, expected)


@pytest.mark.parametrize("circuit", [SkinRC(), SkinLayers()], ids=["rc", "layers"])
def test_slopes_of_gains_are_those_of_differences(study, driver, circuit):
    load = loads(study, driver, circuit)
    gains, rng = load.gains.at(load.knots.index), np.random.default_rng(0)
    count = load.centre.size
    q = np.concatenate([np.log(np.asarray(circuit.values())), [0.3], load.gains.source.mean])
    q = q + 0.1 * rng.standard_normal((len(load.records.x), count))
    slopes = gains.slopes(q)
    step = 1e-5
    for number, way in enumerate(np.eye(count)):
        difference = (_value(gains, q + step * way) - _value(gains, q - step * way)) / (2 * step)
        # The Padé approximant of e^w is right to w⁵/720, and w is 0.1 or so.
        error = np.abs(slopes.by_q[:, number] - difference).max()
        assert error < 1e-4 * np.abs(difference).max() + 1e-9


def _value(gains: Gains, q):
    return gains.slopes(q).gains


def test_condensed_terms_have_the_slope_of_all_harmonics(study, driver):
    """Next to the point the condensed objective falls as that of all harmonics does."""
    load = loads(study, driver)
    found = minimum(load, starts(load))
    rng = np.random.default_rng(1)
    errors = np.sqrt(np.diagonal(fit(load, found.q[None]).cov, axis1=1, axis2=2))
    q = found.q.copy()
    q[:, :3] += errors * rng.standard_normal((len(q), 3))
    near = Near.of(load, load.gains.at(load.knots.index), q)
    rest = load.rest(q) / load.width
    gradient = (near.jacobian @ near.condensed.part[..., None])[..., 0] + rest
    for number in range(4):
        step = np.zeros(q.shape[-1])
        step[number] = 1e-5
        up, down = load.objective(q + step), load.objective(q - step)
        # X̂ in place of X: the slope is that of the terms' expectation, to a part of itself.
        np.testing.assert_allclose(gradient[:, number], (up - down) / 2e-5, rtol=0.05, atol=5.0)


class Valley:
    """Rosenbrock's valley."""

    def terms(self, q):
        return np.stack([10 * (q[..., 1] - q[..., 0] ** 2), 1 - q[..., 0]], -1)

    def equations(self, q):
        x, one = q[..., 0], np.ones_like(q[..., 0])
        rows = np.stack([np.stack([-20 * x, -one], -1), np.stack([10 * one, 0 * x], -1)], -2)
        return NormalEquations.of(self.terms(q), rows)

    def bend(self, q, at, move):
        return bend(at, self.terms(q + DIFFERENCE * move), move)

    def of(self, rows):
        del rows
        return self


@pytest.mark.parametrize("curved", [False, True])
def test_levenberg_marquardt_finds_the_minimum_of_each_row(curved):
    """From several starts each row ends where it would end alone."""
    first, valley = np.array([[-1.2, 1.0], [3.0, -2.0], [0.5, 0.5], [np.nan, 1.0]]), Valley()
    search = LevenbergMarquardt(1e-2, 200, curved=curved)
    with np.errstate(invalid="ignore"):
        found = search(valley, first, valley.equations(first), np.full(4, 1e-24))
        np.testing.assert_allclose(found.q[:3], 1.0, atol=1e-9)
        assert not found.moves.any()
        for number in range(3):
            start = first[number : number + 1]
            alone = search(valley, start, valley.equations(start), np.array([1e-24]))
            np.testing.assert_allclose(alone.q[0], found.q[number], atol=1e-12)
            assert alone.steps[0] == found.steps[number]


def test_a_point_that_is_no_better_is_replaced_by_the_middle_between_it_and_the_best():
    """So that points that fail one after another come nearer."""
    best, one, no = np.zeros((1, 2)), np.ones(1), np.array([False])
    trial, promised = np.full((1, 2), 8.0), np.array([4.0])
    for side in (4.0, 2.0, 1.0):
        found = (np.full((1, 2), 8.0), promised)
        decision = decided(best, 100 * one, one, found, trial, no, -one, np.zeros(1, int))
        trial = decision.trial
        np.testing.assert_array_equal(trial, np.full((1, 2), side))
        assert not decision.settled[0]


def test_two_outputs_condense_to_the_exact_normal_equations():
    """Where gains are linear in frequency between knots, nothing is lost."""
    rng = np.random.default_rng(2)
    bins, rows = 40, 3
    frequency = np.tile(60.0 * np.arange(1.0, bins + 1), (rows, 1))

    def drawn(*shape):
        return rng.standard_normal(shape) + 1j * rng.standard_normal(shape)

    of = drawn(rows, bins), 0.01 + rng.random((rows, bins)), drawn(rows, 2, bins)
    records = Records(
        frequency, *of, 0.01 + rng.random((rows, 2, bins)), np.ones((rows, 2, bins), bool)
    )
    gains = drawn(rows, 2, bins)
    profile = Profile.of(records, gains)
    for number in range(rows):
        for at in range(0, bins, 7):
            g = gains[number, :, at]
            cov = np.diag(records.variance_y[number, :, at]) + records.variance_x[
                number, at
            ] * np.outer(g, g.conj())
            e = records.y[number, :, at] - g * records.x[number, at]
            expected = (e.conj() @ np.linalg.solve(cov, e)).real
            assert profile.squares[number, :, at].sum() == pytest.approx(expected, rel=1e-9)
            p = profile.information()
            full = 2 * np.linalg.inv(cov)
            assert p[1][1][number, at] == pytest.approx(full[1, 1].real, rel=1e-9)
            assert p[1][0][number, at] == pytest.approx(full[1, 0], rel=1e-9)
