"""Another kind of data is one short file: errors, score tests and verdicts come from etid."""

import inspect

import numpy as np
import pytest

import etid
from etid.circuits.elements import resistor
from etid.circuits.impedance import series
from etid.estimators.lanes import Harmonics
from etid.estimators.maximum_likelihood.rows import source_of
from etid.estimators.registry import MAXIMUM_LIKELIHOOD
from etid.identify.fitting import known_of
from etid.likelihood.gains import Gains
from etid.likelihood.profile import Records
from etid.recordings.preflight import Inspected
from etid.results.driver import HarmonicDriver
from etid.simulation.scenes import Scene, Trial
from etid.simulation.transformer import ResistorLoad
from etid.solvers.matrices import root
from tests import new_data
from tests.new_data import KNOWN, SkinAndKnown


class ColeAndKnown(etid.SkinCole):
    """Another skin in series with the known resistor."""

    def impedance(self):
        return series(resistor(KNOWN), super().impedance())


SKIN = {"r_s": 33.4e3, "r_p": 186e3, "c_p": 0.12e-9}
COLE = {"r_s": 33.4e3, "r_p": 186e3, "tau": 18.9e-6, "alpha": 0.9}
CURRENT_NOISE = 1e-2  # of the root mean square of a current: 40 dB
DRAWS = 100
KINDS = {
    "two currents": (new_data.TwoCurrents(), etid.SkinRC(**SKIN), etid.SkinCole(**COLE)),
    "known in series": (new_data.WithKnown(), SkinAndKnown(**SKIN), ColeAndKnown(**COLE)),
}


@pytest.fixture(scope="module")
def scene():
    """Harmonics and noise of a trial, and its driver."""
    known = (Trial("c", ResistorLoad(98.8e3)),)
    skin = etid.SkinRC(**SKIN)
    study = Scene((Trial("a", skin),), known, samples=10_000, snr_db=60.0).simulate(seed=3)
    lane = Harmonics.of(Inspected.of(study["a"]))
    driver = etid.identify_driver(study["c"])
    assert isinstance(driver, HarmonicDriver)
    return lane, source_of(known_of(lane, driver, False, MAXIMUM_LIKELIHOOD))


@np.errstate(all="ignore")
def fits(scene, kind, seeds, other=False, gains=(1.0, 1.0, 1.0)):
    """Fits with noise, Z_th and delays that are drawn; `gains` are those of the recorders."""
    (lane, source), (outputs, skin, cole) = scene, KINDS[kind]
    count, rows, draws = outputs.count, len(seeds), []
    frequency = np.tile(lane.frequency, (rows, 1))
    circuit, rate = cole if other else skin, float(lane.sample_rate)
    for seed in seeds:
        rng = np.random.default_rng(seed)
        z = source.mean + root(source.cov) @ rng.standard_normal(source.mean.size)
        draws.append(
            np.concatenate([np.log(circuit.values()), 0.1 * rng.standard_normal(count), z])
        )
    clean = Gains(source, circuit, frequency, rate, outputs)(np.array(draws)) * lane.x
    of_voltage, size = float(lane.variance_y.mean()), np.mean(np.abs(clean) ** 2, (0, 2))
    variance = np.array([of_voltage, *(CURRENT_NOISE**2 * size[1:])])
    if kind == "known in series":
        variance[1] = of_voltage
    rng = np.random.default_rng([*seeds, count])

    def noisy(true, variance):
        of = rng.standard_normal((2, *true.shape))
        return true + (of[0] + 1j * of[1]) * np.sqrt(variance / 2)

    variance = np.broadcast_to(variance[:, None], clean.shape)
    y = noisy(np.array(gains)[:count, None] * clean, variance)
    of_x = np.tile(lane.variance_x, (rows, 1))
    x = noisy(np.tile(lane.x, (rows, 1)), of_x)
    used = np.broadcast_to(lane.selected, clean.shape)
    records = Records(frequency, x, of_x, y, variance, used)
    return new_data.fit(Gains(source, skin, frequency, rate, outputs), records)


def test_it_is_one_short_file():
    assert len(inspect.getsource(new_data).splitlines()) <= 65


@pytest.mark.parametrize("kind", KINDS)
def test_its_standard_errors_are_those_of_its_estimates(scene, kind):
    found = fits(scene, kind, range(DRAWS))
    off = np.log(found.circuit.values() / np.array(list(SKIN.values())))
    errors = found.stderr.values() / found.circuit.values()
    squares = np.mean((off / errors) ** 2, axis=0)
    # Four standard deviations of a mean of so many squares.
    np.testing.assert_allclose(squares, 1.0, atol=4 * np.sqrt(2 / DRAWS))
    assert np.mean(found.verdict == "successful") > 0.95


@pytest.mark.parametrize("kind", KINDS)
def test_its_score_tests_see_another_circuit_and_another_scale(scene, kind):
    assert fits(scene, kind, [1], other=True).verdict.tolist() == ["misfit"]
    for number in range(1, KINDS[kind][0].count):
        gains = [1.005 if of == number else 1.0 for of in range(3)]
        assert fits(scene, kind, [1], gains=gains).verdict.tolist() == ["inconsistent"]
