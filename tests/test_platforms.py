"""The programs of batches are lowered for GPUs too: no operation of theirs is missing there."""

import contextlib

import pytest

import etid
from etid.identify import fitting
from etid.numpy_tier import tiers
from etid.simulation import scenes

# The estimators of batches, and those that identify their drivers.
DRIVERS = {
    "maximum_likelihood": "maximum_likelihood",
    "output_error": "output_error",
    "steiglitz_mcbride": "steiglitz_mcbride",
    "equation_error": "steiglitz_mcbride",
}


class _Lowered(BaseException):
    """A program was lowered. It need not be compiled and run: that takes ten times as long."""


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


@pytest.fixture
def lowered(monkeypatch):
    """Runs code until it has lowered a program with this name, for CUDA."""
    compiled, awaited = tiers._by_xla, []

    def by_xla(run, *args):
        if run.__name__ in awaited:
            run.trace(*args).lower(lowering_platforms=("cuda",))
            raise _Lowered
        return compiled(run, *args)

    @contextlib.contextmanager
    def until(name):
        awaited.append(name)
        with pytest.raises(_Lowered):
            yield

    monkeypatch.setattr(tiers, "_by_xla", by_xla)
    return until


@pytest.mark.slow
@pytest.mark.parametrize("method", DRIVERS)
def test_a_batch_is_lowered_for_cuda(lowered, study, drivers, method, monkeypatch):
    monkeypatch.setattr(fitting, "ROWS", False)  # accelerators run programs of JAX
    driver = drivers[DRIVERS[method]]
    with lowered("_chunk"):
        etid.identify_skins(study.loaded, driver, method=method)
