"""The rivals of the benchmarks: what they do with a record, and that each runs or says why not."""

import pathlib
import sys

import numpy as np
import pytest
import scipy.signal

from benchmarks import referee, rivals
from benchmarks.ladder import START, rung
from benchmarks.rivals import problem, table
from benchmarks.rivals.roster import RIVALS, SCENES

R_S, R_P, C_P = TRUTH = np.array([33.4e3, 186e3, 0.12e-9])
HERE = pathlib.Path(sys.executable)
TUSTIN = 0.01  # 0.35 % of C_p at 1 MHz, of which a delay that is fitted too makes R_s


@pytest.fixture(scope="module")
def easy():
    """Two draws without noise and delays."""
    scene = rung("dry", snr_db=None, bits=None, trigger_jitter_rms=0.0)
    return problem(table.pairs(scene, 2), START)


def test_a_rival_recovers_a_skin_and_a_draw_that_fails_costs_itself_alone(easy):
    broken = {**easy, "v_out": easy["v_out"].copy()}
    broken["v_out"][0, 5] = np.nan
    outcome = rivals.run("scipy_lfilter", broken, 1, 120.0, python=HERE)
    assert outcome.missing == ""
    assert [bool(error) for error in outcome.errors] == [True, False]
    assert np.isnan(outcome.elements[0]).all()
    assert outcome.ok.tolist() == [False, True]
    np.testing.assert_allclose(outcome.elements[1], TRUTH, rtol=TUSTIN)
    assert min(outcome.seconds[1], outcome.first_seconds, *outcome.driver_seconds) > 0
    assert outcome.versions["scipy"] == scipy.__version__


@pytest.mark.parametrize("name", RIVALS)
def test_every_rival_has_a_module_an_environment_and_a_scene(name):
    folder, rival = pathlib.Path(rivals.__file__).parent, RIVALS[name]
    assert (folder / f"{name.removesuffix(f'_{rival.estimator}')}.py").exists()
    assert (folder / f"{rival.environment}.txt").exists()
    assert rival.works in SCENES


@pytest.mark.slow
@pytest.mark.parametrize("name", RIVALS)
def test_every_rival_works_somewhere(name):
    if not rivals.installed(RIVALS[name].environment):
        pytest.skip(f"its environment is not made: python -m benchmarks rivals {name}")
    scene = rung("dry", **SCENES[RIVALS[name].works])
    outcome = rivals.run(name, problem(table.pairs(scene, 2), START), 1, 600.0)
    line, works = table.line(name, outcome, TRUTH)
    assert works, line


@pytest.mark.slow
def test_the_referee_agrees_with_the_posterior_of_a_fit():
    if not rivals.installed(referee.ENVIRONMENT):
        pytest.skip("its environment is not made: python -m benchmarks referee")
    found = referee.compared(40.0, 1)
    assert found["worth"].min() > referee.ENDED
    # 2000 effective draws of each know a mean to 0.03 standard deviations, a deviation to 2 %.
    assert np.abs(found["shift"]).max() < 0.15
    assert np.abs(found["ratio"] - 1).max() < 0.1
