"""Every verdict is produced here, and none is silent."""

from collections import Counter
from typing import Any

import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

import etid
from etid.circuits.elements import Ohm
from etid.results.verdicts import RESULTS, message, own_part, verdict, verdict_names, verdicts_of
from etid.simulation.scenes import Scene, Trial
from etid.simulation.transformer import ResistorLoad, SkinLoad

LENGTH = 10_000
DRY = SkinLoad(r_s=33.4e3, r_p=186e3, c_p=0.12e-9)


def simulate(load: Any = DRY, seed=0, samples=LENGTH, **options):
    scene = Scene(
        trials=(Trial("loaded/0", load),),
        calibration=(Trial("calibration/98k8", ResistorLoad(98.8e3)),),
        samples=samples,
        **options,
    )
    return scene.simulate(seed=seed)


@pytest.fixture(scope="module")
def study():
    return simulate(seed=21)


@pytest.fixture(scope="module")
def driver(study):
    return etid.identify_driver(study["calibration/98k8"])


def verdict_of(recording, driver, **options):
    fit = etid.identify_skin(recording, driver, throw=False, **options)
    if fit.verdict != "successful":
        with pytest.raises(etid.IdentificationError, match=fit.verdict) as raised:
            etid.identify_skin(recording, driver, **options)
        assert raised.value.outcome.verdict == fit.verdict
    return fit.verdict


def test_successful(study, driver):
    assert verdict_of(study["loaded/0"], driver) == "successful"
    assert message("successful") == ""


def part(recording, size):
    return {"v_th": recording.v_th[:size], "v_out": recording.v_out[:size]}


@pytest.mark.parametrize(
    ("change", "verdict"),
    [
        (lambda one: {"v_out": np.zeros(LENGTH)}, "flat"),
        (lambda one: {"v_out": np.minimum(one.v_out, 40.0), "adc_range": None}, "saturated"),
        (lambda one: {"v_th": np.append(one.v_th[1:], np.inf)}, "nonfinite_samples"),
        (lambda one: part(one, 150), "too_short"),
        (lambda one: {"v_th": one.v_out, "v_out": one.v_th}, "misaligned"),
    ],
)
def test_samples_that_are_broken(study, driver, change, verdict):
    """What else breaks them is in `test_preflight`."""
    recording = study["loaded/0"]
    assert verdict_of(recording.replace(**change(recording)), driver) == verdict


def test_saturated_at_the_end_of_the_range_of_the_converter(driver):
    assert verdict_of(simulate(full_scale=2.6)["loaded/0"], driver) == "saturated"


def test_insensitive(driver):
    """A resistor has no R_p and no C_p to find."""
    for seed in range(3):
        resistor = simulate(ResistorLoad(328.9e3), seed=seed)["loaded/0"]
        assert verdict_of(resistor, driver) == "insensitive"


def test_misfit(driver):
    """Two relaxations a decade and a half apart are no single one."""

    def two_layers(f):
        s = 2j * np.pi * f
        return 10e3 + 60e3 / (1 + s * 60e3 * 0.2e-9) + 80e3 / (1 + s * 80e3 * 3e-9)

    assert verdict_of(simulate(two_layers)["loaded/0"], driver) == "misfit"


def test_nonphysical_and_driver_failed(study):
    """More at the load than without it, by half a per cent, is the work of no passive driver."""
    calibration = study["calibration/98k8"]
    v = calibration.v_out * np.std(calibration.v_th) / np.std(calibration.v_out)
    more = calibration.replace(v_out=1.004 * v, adc_range=None)
    with pytest.raises(etid.IdentificationError, match="driver: nonphysical") as raised:
        etid.identify_driver(more)
    driver = raised.value.outcome
    assert isinstance(driver, etid.Driver)
    assert driver.verdict == "nonphysical"
    assert verdict_of(study["loaded/0"], driver) in ("driver_failed", "inconsistent", "misfit")


def test_unreadable_without_a_calibration(study):
    other = study["calibration/98k8"].replace(path="calibration/other")
    lost = study["loaded/0"].replace(calibration=())
    result = etid.identify_study(
        etid.Study.from_recordings([study["calibration/98k8"], other, lost])
    )
    assert result.fits.counts() == {"unreadable": 1}
    assert "names no calibration" in result.fits.notes[0]
    alone = etid.identify_study(etid.Study.from_recordings([lost]))
    assert "etid import --calibration FILE OHM" in alone.fits.notes[0]


@pytest.fixture(scope="module")
def baselines():
    """The paper's method from quiet to noisy: how often its drivers and skins end how."""
    found = Counter()
    for snr_db in (None, 60.0, 40.0, 30.0):
        for seed in range(1):
            study = simulate(snr_db=snr_db, seed=seed)
            driver = etid.identify_driver(
                study["calibration/98k8"], method="steiglitz_mcbride", throw=False
            )
            found[driver.verdict] += 1
            for method in ("steiglitz_mcbride", "equation_error"):
                found[verdict_of(study["loaded/0"], driver, method=method)] += 1
    return found


@pytest.mark.parametrize("name", ["max_steps_reached", "unstable", "biased", "misfit"])
def test_the_papers_method_says_how_it_fails(baselines, name):
    assert baselines[name] > 0


def test_the_papers_method_is_never_successful_here(baselines):
    """Without noise its loop is unstable, with noise its R_s is far off."""
    assert baselines["successful"] == 0
    assert baselines.total() == 12


class Wall(etid.AbstractCircuit):
    """No model of anything: below `LEVEL` it jumps, so that every step down is a wrong one."""

    r: Ohm = etid.parameter("ohm", typical=100e3)

    def impedance(self):
        return etid.resistor(jnp.where(self.r >= LEVEL, self.r, 1e9))


LEVEL = 100e3 * (1 - 1e-14)  # where its fit starts, less what logarithm and exponential round


@pytest.mark.slow
def test_a_solver_that_cannot_move_reports_no_success(driver):
    """The slope says down, and no step is small enough: that is no convergence."""
    recording = simulate(ResistorLoad(50e3))["loaded/0"]
    assert verdict_of(recording, driver, circuit=Wall()) == "max_steps_reached"


def test_names_and_values_are_inverse():
    names = np.array([["flat", "successful"], ["misfit", "biased"]])
    np.testing.assert_array_equal(verdict_names(verdicts_of(names)), names)
    assert verdict_names(verdict("unstable")).item() == "unstable"


@pytest.mark.parametrize("name", sorted(RESULTS._name_to_item))
def test_every_failure_says_what_it_is(name):
    assert (name == "successful") == (message(name) == "")


def test_a_verdict_is_said_in_forty_words():
    own = set(vars(RESULTS)["_name_to_item"]) - set(vars(optx.RESULTS)["_name_to_item"])
    assert {name for name in own if len(message(name).split()) > 40} == set()


def test_a_note_beyond_the_message_of_its_verdict():
    changed = message("changed")
    assert own_part("changed", f"{changed} During the record: r_p -20 ± 1 %") == (
        "During the record: r_p -20 ± 1 %"
    )
    assert own_part("unconnected", message("unconnected")) == ""
    assert own_part("successful", "aligned by 3 samples") == "aligned by 3 samples"
