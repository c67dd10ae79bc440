"""The programs of batches are lowered for GPUs too: no operation of theirs is missing there."""

import contextlib

import jax
import jax.export
import pytest

import etid
from etid.simulation import scenes

# The estimators of batches, and those that identify their drivers.
DRIVERS = {
    "maximum_likelihood": "maximum_likelihood",
    "non_parametric": "maximum_likelihood",
    "output_error": "output_error",
    "steiglitz_mcbride": "steiglitz_mcbride",
    "equation_error": "steiglitz_mcbride",
}


# JAX has eigenvalues on GPUs, but does not promise that their files stay readable.
UNSTABLE = [jax.export.DisabledSafetyCheck.custom_call("cuhybrid_eig_real")]


class _Missing(BaseException):
    """An operation of a program is not there."""


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
def lowered(tmp_path, monkeypatch):
    """Runs code until it has lowered a program with this name, for CUDA."""
    for_here, awaited = jax.export.export, []

    def export(function, **options):
        def on(*shapes):
            if function.__name__ in awaited:
                lower = for_here(function, platforms=("cuda",), disabled_checks=UNSTABLE)
                try:
                    lower(*shapes)
                except Exception as error:  # the store would go on without a file
                    raise _Missing(str(error)) from error
                raise _Lowered
            return for_here(function, **options)(*shapes)

        return on

    @contextlib.contextmanager
    def until(name):
        awaited.append(name)
        with pytest.raises(_Lowered):
            yield

    monkeypatch.setattr(jax.export, "export", export)  # by which the store of programs makes files
    before = getattr(jax.config, "jax_compilation_cache_dir")  # noqa: B009 - made at run time
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    jax.clear_caches()
    yield until
    jax.config.update("jax_compilation_cache_dir", before)


@pytest.mark.slow
@pytest.mark.parametrize("method", DRIVERS)
def test_a_batch_is_lowered_for_cuda(lowered, study, drivers, method):
    driver = drivers[DRIVERS[method]]
    with lowered("_chunk"):
        etid.identify_skins(study.loaded, driver, method=method)


@pytest.mark.slow
@pytest.mark.parametrize("program", ["_alone", "_together"])
def test_a_joint_fit_is_lowered_for_cuda(lowered, study, program):
    with lowered(program):
        etid.identify_jointly(study)
