"""The programs of batches are lowered for GPUs too: no operation of theirs is missing there."""

import jax
import pytest

import etid
from etid.estimators.lanes import stacked
from etid.estimators.registry import named
from etid.identify.fitting import known_of
from etid.recordings.preflight import Inspected
from etid.simulation import scenes

# The estimators of batches, and those that identify their drivers.
DRIVERS = {
    "maximum_likelihood": "maximum_likelihood",
    "output_error": "maximum_likelihood",
    "steiglitz_mcbride": "steiglitz_mcbride",
}


@pytest.fixture(scope="module")
def study():
    return scenes.paper_dry(snr_db=60.0).simulate(seed=1)


@pytest.fixture(scope="module")
def drivers(study):
    records = list(study.calibrations.values())
    # Steiglitz-McBride does not settle here; its driver serves as well.
    return {
        kind: etid.identify_driver(records, method=kind, throw=False)
        for kind in sorted(set(DRIVERS.values()))
    }


@pytest.mark.slow
@pytest.mark.parametrize("method", DRIVERS)
def test_a_batch_is_lowered_for_cuda(study, drivers, method):
    driver, estimator, circuit = drivers[DRIVERS[method]], named(method), etid.SkinRC()
    seen = [Inspected.of(one) for one in list(study.loaded.recordings())[:2]]
    lanes = [estimator.lane_of(one).of(one) for one in seen]
    known = known_of(lanes[0], driver, False, estimator)

    def fits(lanes):
        fit = jax.vmap(lambda lane: estimator.fit_load(lane, driver, known, circuit))(lanes)
        return fit.circuit, fit.cov, fit.chi2

    traced = jax.jit(fits).trace(jax.tree.map(jax.device_put, stacked(lanes)))
    assert "func" in traced.lower(lowering_platforms=("cuda",)).as_text()
