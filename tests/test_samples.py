"""`identify_samples` runs one text in NumPy and in JAX, and in programs for accelerators."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import export

import etid
from etid.circuits.circuit import SkinRC
from etid.simulation.scenes import Scene, Trial
from etid.simulation.transformer import ResistorLoad

RATES: dict[str, Any] = {"sample_rate": 200e3, "pulse_rate": 60.0}
SAME = 1e-6  # standard errors: rounding on the way to a minimum
ROWS = 4096  # of a call that is worth an accelerator
SKINS = SkinRC(33.4e3, 186e3, 0.12e-9), SkinRC(6.1e3, 17.4e3, 0.66e-9), SkinRC(20e3, 400e3, 60e-12)


@pytest.fixture(scope="module")
def study():
    trials = tuple(Trial(f"skin/{number}", one) for number, one in enumerate(SKINS))
    return Scene(trials, (Trial("c", ResistorLoad(98.8e3)),), snr_db=50.0).simulate(seed=2)


@pytest.fixture(scope="module")
def driver(study):
    return etid.identify_driver(study["c"])


@pytest.fixture(scope="module")
def records(study):
    each = [study[f"skin/{number}"] for number in range(len(SKINS))]
    return np.stack([[one.v_th, one.v_out] for one in each])


def of_fit(fit):
    """Elements, standard errors, covariance, χ², verdict and number of points."""
    values = fit.circuit.values()
    of = jnp.sqrt(jnp.diagonal(fit.cov))
    return values, of, fit.cov, fit.chi2, fit.result._value, fit.steps


def identified(records, driver):
    return of_fit(etid.identify_samples(records[0], records[1], driver, **RATES))


@pytest.fixture(scope="module")
def in_numpy(records, driver):
    each = [identified(one, driver) for one in records]
    return [np.stack(of) for of in zip(*each, strict=True)]


def transformed(how, records, driver):
    if how == "vmap":
        return jax.jit(jax.vmap(lambda one: identified(one, driver)))(records)
    each = [jax.jit(identified)(one, driver) for one in records]
    return [jnp.stack(of) for of in zip(*each, strict=True)]


@pytest.mark.parametrize("how", [pytest.param("jit", marks=pytest.mark.slow), "vmap"])
def test_transformed_fits_are_those_of_numpy(how, records, driver, in_numpy):
    """Those of `jit` also compute by JAX what the calibrations tell of the driver."""
    values, errors, cov, chi2, result, points = in_numpy
    found = transformed(how, jnp.asarray(records), jax.tree.map(jnp.asarray, driver))
    assert np.max(np.abs(found[0] - values) / errors) < SAME
    size = errors[:, :, None] * errors[:, None, :]
    np.testing.assert_allclose(found[2] / size, cov / size, atol=SAME)
    np.testing.assert_allclose(found[3], chi2, rtol=SAME)
    np.testing.assert_array_equal(found[4], result)
    np.testing.assert_array_equal(found[5], points)


def test_arrays_without_a_transformation_are_fitted_by_numpy(records, driver, monkeypatch):
    def traced(*_):
        raise AssertionError("JAX traces the fit")

    monkeypatch.setattr(jax.lax, "while_loop", traced)
    v_th, v_out = jnp.asarray(records[0])
    fit = etid.identify_samples(v_th, v_out, driver, **RATES)
    assert fit.verdict == "successful"
    assert isinstance(fit.chi2, np.ndarray)


def test_fits_of_samples_are_those_of_recordings(study, driver, in_numpy):
    found = etid.identify_skins([study[f"skin/{n}"] for n in range(len(SKINS))], driver)
    # A recording tests its samples for periods that are louder than others; arrays do not.
    assert np.max(np.abs(np.asarray(found.circuit.values()) - in_numpy[0]) / in_numpy[1]) < 0.05
    assert (found.verdicts == "successful").all()


@pytest.mark.parametrize("of", ["fit", "gradient"])
def test_many_rows_are_exported_for_accelerators(of, records, driver):
    """The program holds no call of a function of this machine."""

    def elements(v_out):
        return jnp.log(identified((records[0, 0], v_out), driver)[0])

    every = jax.vmap(lambda v_out: identified((records[0, 0], v_out), driver))
    if of == "gradient":
        every = jax.vmap(jax.grad(lambda v_out: elements(v_out)[0]))
    shape = jax.ShapeDtypeStruct((ROWS, records.shape[-1]), float)
    program = export.export(jax.jit(every), platforms=["cuda", "tpu"])(shape)
    assert program.platforms == ("cuda", "tpu")
    assert "callback" not in program.mlir_module()


def test_arrays_with_the_unloaded_record_of_a_calibration_tell_of_it_twice():
    """Without that, the error of R_p would be a fifth larger."""
    trials, known = (Trial("a", SKINS[0]),), (Trial("c", ResistorLoad(98.8e3)),)
    study = Scene(trials, known, snr_db=60.0, shared_v_th=True).simulate(seed=2)
    driver, one = etid.identify_driver(study["c"]), study["a"]
    fit = etid.identify_samples(np.asarray(one.v_th), np.asarray(one.v_out), driver, **RATES)
    expected = etid.identify_skin(one, driver)
    np.testing.assert_allclose(fit.stderr.values(), expected.stderr.values(), rtol=0.01)
