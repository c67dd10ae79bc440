"""Another kind of data is one short file: errors, score tests and verdicts come from etid."""

import dataclasses
import inspect

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import etid
from etid.estimators.lanes import Harmonics
from etid.estimators.maximum_likelihood.given_driver import given
from etid.estimators.maximum_likelihood.load import Load
from etid.estimators.maximum_likelihood.profile import Records
from etid.recordings.preflight import Inspected
from etid.results.driver import HarmonicDriver
from etid.simulation.scenes import Scene, Trial
from etid.simulation.transformer import ResistorLoad
from etid.solvers.matrices import root
from tests import new_data

SKIN = etid.SkinRC(r_s=33.4e3, r_p=186e3, c_p=0.12e-9)
COLE = etid.SkinCole(r_s=33.4e3, r_p=186e3, tau=18.9e-6, alpha=0.9)
CURRENT_NOISE = 1e-2  # of the root mean square of a current: 40 dB
DRAWS = 100
KINDS = {
    "two currents": new_data.TwoCurrents(),
    "known in series": new_data.KnownInSeries(jnp.asarray(47e3)),
}


@pytest.fixture(scope="module")
def scene():
    """Harmonics and noise of a trial, and its driver."""
    known = (Trial("c", ResistorLoad(98.8e3)),)
    study = Scene((Trial("a", SKIN),), known, samples=10_000, snr_db=60.0).simulate(seed=3)
    lane = jax.tree.map(jnp.asarray, Harmonics.of(Inspected(study["a"])))
    driver = etid.identify_driver(study["c"])
    assert isinstance(driver, HarmonicDriver)
    return lane, given(driver, lane.frequency, False)


def fit(scene, kind, seed, circuit: etid.AbstractCircuit = SKIN, gains=(1.0, 1.0, 1.0), last=1.0):
    """A fit with noise, Z_th and delays that are drawn.

    `gains` are those of the recorders, `last` is a factor of the noise of the last one.
    """
    lane, known = scene
    rng, outputs = np.random.default_rng(seed), KINDS[kind]
    spectrum, rate = lane.spectrum, lane.sample_rate
    count = outputs.count
    blank = Records.of(spectrum, *[(spectrum.y, spectrum.variance_y)] * (count - 1))
    load = Load.behind(known, circuit, blank, rate, None, outputs)
    z = known.mean + root(known.cov) @ rng.standard_normal(known.mean.size)
    delays = 0.1 * rng.standard_normal(count)
    gain = np.asarray(predicted(load, jnp.concatenate([circuit.log_values(), delays, z])))
    clean_x, of_voltage = np.asarray(spectrum.x), float(spectrum.variance_y.mean())
    clean = gain * clean_x
    size = np.mean(np.abs(clean) ** 2, axis=1)
    variance = [of_voltage, *([CURRENT_NOISE**2 * of for of in size[1:]])]
    if kind == "known in series":
        variance[1] = of_voltage

    variance[-1] *= last**2

    def noisy(true, variance):
        of = rng.standard_normal((2, true.size))
        return jnp.asarray(true + (of[0] + 1j * of[1]) * np.sqrt(np.asarray(variance) / 2))

    y = [noisy(g * of, v) for g, of, v in zip(gains, clean, variance, strict=False)]
    variances = [jnp.full(clean_x.size, of) for of in variance]
    x = noisy(clean_x, spectrum.variance_x)
    measured = dataclasses.replace(spectrum, x=x, y=y[0], variance_y=variances[0])
    others = list(zip(y[1:], variances[1:], strict=True))
    return new_data.fit(outputs, known, measured, others, rate)


predicted = eqx.filter_jit(Load.predicted)


def test_it_is_one_short_file():
    assert len(inspect.getsource(new_data).splitlines()) <= 60


EACH = pytest.mark.parametrize(
    "kind", [pytest.param("two currents", marks=pytest.mark.slow), "known in series"]
)


@EACH
def test_its_standard_errors_are_those_of_its_estimates(scene, kind):
    fits = [fit(scene, kind, seed) for seed in range(DRAWS)]
    off = [np.log(np.asarray(of.circuit.values()) / np.asarray(SKIN.values())) for of in fits]
    errors = [np.asarray(of.stderr.values()) / np.asarray(of.circuit.values()) for of in fits]
    squares = np.mean((np.array(off) / np.array(errors)) ** 2, axis=0)
    # Four standard deviations of a mean of so many squares.
    np.testing.assert_allclose(squares, 1.0, atol=4 * np.sqrt(2 / DRAWS))
    assert sum(str(of.verdict) == "successful" for of in fits) > 0.95 * DRAWS


@EACH
def test_its_score_tests_see_another_circuit_and_another_scale(scene, kind):
    assert fit(scene, kind, 1, COLE).verdict == "misfit"
    for number in range(1, KINDS[kind].count):
        gains = [1.005 if of == number else 1.0 for of in range(KINDS[kind].count)]
        assert fit(scene, kind, 1, gains=gains).verdict == "inconsistent"
