"""The likelihood of calibrations, and the search for their driver: one text for NumPy and JAX."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import etid
from etid.estimators.starts import source_starts
from etid.likelihood.calibrations import Calibrations
from etid.likelihood.driver import brought_near, minimum
from etid.likelihood.linear import LevenbergMarquardt
from etid.likelihood.source_prior import SourcePrior
from etid.results.driver import HarmonicDriver
from etid.signals import modal
from etid.signals.knots import banded
from etid.simulation.scenes import Scene, Trial
from etid.simulation.transformer import ResistorLoad

PLACES = 1e-9  # relative; both namespaces round sums in another order


@pytest.fixture(scope="module")
def model():
    """One calibration at 50 dB, of NumPy, with the driver that etid identifies."""
    study = etid.scenes.paper_dry(snr_db=50.0).simulate(seed=3)
    driver = etid.identify_driver(study["calibration/98k8"])
    assert isinstance(driver, HarmonicDriver)
    return jax.tree.map(np.asarray, Calibrations.of(driver))


@pytest.fixture(scope="module")
def starts(model):
    """Four starts far from the minimum."""
    of = np.array([1.0, -1.5, 0.6, 0.1, 0.0, 0.0]), 5, model.rate, model.calibration.r_load.mean()
    found = source_starts(*of).vector()
    return np.concatenate([found, np.zeros((len(found), 1))], -1)


def near(found, wanted, size=PLACES):
    np.testing.assert_allclose(found, wanted, rtol=size, atol=size * np.abs(wanted).max())


def test_slopes_of_an_impedance_in_modal_form_are_those_of_jax():
    rng = np.random.default_rng(0)
    parameters = rng.standard_normal((3, 1 + 4 * 2 + 2 * 2))
    frequency = np.geomspace(1e-3, 1e3, 40) / (2 * np.pi)
    z, slopes = modal.with_slopes(parameters, 2, frequency)
    near(z, modal.impedance(parameters, 2, frequency))
    of_each = jax.vmap(jax.jacfwd(lambda p: modal.impedance(p, 2, jnp.asarray(frequency))))
    near(slopes, np.moveaxis(jax.jit(of_each)(parameters), -1, -2))


def test_slopes_of_the_prior_are_those_of_jax_also_where_z_th_is_not_passive(model):
    prior = SourcePrior.of(model.source, jnp.asarray(model.rate), jnp.asarray(98.8e3))
    q = np.array(model.source.vector())
    q[model.source.gains] *= -1  # Re Z_th is negative at most frequencies
    terms, rows = prior.with_slopes(jnp.asarray(q))
    assert np.count_nonzero(terms[q.size :]) > 20
    near(rows.T, jax.jit(jax.jacfwd(prior))(q))


def test_a_start_does_not_depend_on_the_others_and_one_without_numbers_spoils_none(model, starts):
    bands = banded(model.spectra)
    spoilt = starts.copy()
    spoilt[1] = np.nan
    together, beside = (
        minimum(model, brought_near(model, bands, of)[0]) for of in (starts, spoilt)
    )
    assert not beside.settled[1]
    for number in (0, 2, 3):
        (alone,), _ = brought_near(model, bands, starts[number : number + 1])
        alone = minimum(model, alone[None])
        # Rounding moves an iterate along the valley, whose curvature is 1e-6 of that across.
        assert abs(alone.objective[0] - together.objective[number]) < 1e-4
        assert abs(beside.objective[number] - together.objective[number]) < 1e-4


def test_the_deepest_of_the_minima_is_the_driver(model, starts):
    least = minimum(model, brought_near(model, banded(model.spectra), starts)[0])
    assert np.ptp(least.objective) > 1  # they are not one minimum
    best = minimum(model, model.start())
    assert abs(best.objective - least.objective.min()) < 1e-3  # a twentieth of a standard error


@pytest.mark.slow
def test_jax_runs_the_same_text_to_the_same_minimum(model, starts):
    (start,), _ = brought_near(model, banded(model.spectra), starts[1:2])
    found = minimum(model, start)
    of_jax = jax.tree.map(jnp.asarray, model)
    traced = jax.jit(minimum)(of_jax, jnp.asarray(start))
    assert found.settled
    assert int(traced.points) == found.points
    near(np.asarray(traced.objective), found.objective)
    stderr = np.sqrt(np.diagonal(model.linear(model.near(found.q)).covariance()))
    assert np.all(np.abs(np.asarray(traced.q) - found.q) < 1e-3 * stderr)


def test_steps_that_follow_the_valley_are_fewer_and_end_as_deep(model, starts, monkeypatch):
    (start,), _ = brought_near(model, banded(model.spectra), starts[1:2])
    steps = []

    class Counted(LevenbergMarquardt):
        def __call__(self, *of):
            found = super().__call__(*of)
            steps.append(int(found.steps))
            return found

    class Straight(Counted):
        def __init__(self, damping, most, patience, curved):
            assert curved
            super().__init__(damping, most, patience)

    monkeypatch.setattr("etid.likelihood.driver.LevenbergMarquardt", Counted)
    bent, of_bent = minimum(model, start), sum(steps)
    steps.clear()
    monkeypatch.setattr("etid.likelihood.driver.LevenbergMarquardt", Straight)
    plain = minimum(model, start)
    assert bent.objective < plain.objective + 1e-3  # a twentieth of a standard error
    assert of_bent < 0.5 * sum(steps)


def test_calibrations_of_one_unloaded_record_are_outputs_of_one_input():
    known = {"large": 98.8e3, "small": 21.62e3}
    trials = tuple(Trial(path, ResistorLoad(r)) for path, r in known.items())
    records = Scene(trials, snr_db=60.0, shared_v_th=True).simulate(seed=1).recordings()
    driver = etid.identify_driver([one.replace(r_load=known[one.path]) for one in records])
    assert isinstance(driver, HarmonicDriver)
    of = jax.tree.map(np.asarray, Calibrations.of(driver))
    (record,) = of.records()
    assert record.used.any(-1).tolist() == [True, True]
    own = dataclasses.replace(of.spectra, x=of.spectra.x * np.array([[1.0], [1.001]]))
    assert len(dataclasses.replace(of, spectra=own).records()) == 2
