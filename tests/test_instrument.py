"""Tolerances of the instrument: in the standard errors, in a budget, and in files."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

import etid
from etid import cli
from etid.circuits.circuit import AbstractCircuit, Farad, Ohm, SkinRC, parameter
from etid.circuits.elements import capacitor, resistor
from etid.circuits.impedance import parallel, series
from etid.estimators.maximum_likelihood.calibrations import Calibrations
from etid.estimators.maximum_likelihood.gains import Gains
from etid.estimators.maximum_likelihood.given_driver import given
from etid.online.current import CurrentModel
from etid.results.driver import ContinuousDriver, HarmonicDriver
from etid.results.instrument import TOLERANCES
from etid.simulation.scenes import Scene, Trial
from etid.simulation.transformer import ResistorLoad

R_LOAD = 98.8e3
DRY = SkinRC(r_s=33.4e3, r_p=186e3, c_p=0.12e-9)
DAMP = SkinRC(r_s=6.1e3, r_p=17.4e3, c_p=0.66e-9)
GAIN = etid.Instrument(gain=1e-3)
ALL = etid.Instrument(gain=2e-3, r_load=2e-3, crosstalk=2e-3, capacitance=2e-12)
DRAWS = 40
STUDIES = 16  # of ten fits each
CHARGE = 1e-7  # [C] of the size of a phase
NORMAL_95 = scipy.stats.norm.ppf(0.975)


class BesideCable(AbstractCircuit):
    """Skin with the capacitance of a cable across it."""

    formula = "(R_s + R_p / (1 + s R_p C_p)) ‖ C"
    r_s: Ohm = parameter("ohm", typical=20e3)
    r_p: Ohm = parameter("ohm", typical=100e3)
    c_p: Farad = parameter("farad", typical=0.3e-9)
    cable: Farad = parameter("farad", typical=1e-12)

    def impedance(self):
        skin = series(resistor(self.r_s), parallel(resistor(self.r_p), capacitor(self.c_p)))
        return parallel(skin, capacitor(self.cable))


def records(skin=DRY, *, gain=0.0, r_load=0.0, crosstalk=0.0, capacitance=0.0, seed=0, snr_db=60.0):
    """A calibration and a skin, recorded with an instrument that has these errors."""
    if capacitance:
        skin = BesideCable(skin.r_s, skin.r_p, skin.c_p, capacitance)
    calibration = Trial("calibration", ResistorLoad(R_LOAD))
    scene = Scene((Trial("skin", skin),), (calibration,), samples=20_000, snr_db=snr_db)
    of = scene.simulate(seed=seed)
    calibration, skin = (
        one.replace(v_out=(1 + gain) * one.v_out + crosstalk * one.v_th)
        for one in (of["calibration"], of["skin"])
    )
    return calibration.replace(r_load=R_LOAD / (1 + r_load)), skin


def trials(loads, *, seed=0, gain=0.0, r_load=0.0, crosstalk=0.0, capacitance=0.0, **options):
    """A calibration and recordings of these loads by path, all with the same errors."""
    disturbed = []
    for path, of in loads.items():
        beside = BesideCable(of.r_s, of.r_p, of.c_p, capacitance) if capacitance else of
        disturbed.append(Trial(path, beside))
    known = Trial("calibration", ResistorLoad(R_LOAD))
    scene = Scene(tuple(disturbed), (known,), samples=10_000, snr_db=60.0, **options)
    found = []
    for one in scene.simulate(seed).recordings():
        wrong = one.replace(v_out=(1 + gain) * one.v_out + crosstalk * one.v_th)
        found.append(wrong if one.r_load is None else wrong.replace(r_load=R_LOAD / (1 + r_load)))
    return etid.Study.from_recordings(found)


def together(study, instrument=None):
    """Joint fits of all trials by path."""
    fits = etid.identify_jointly(study, instrument=instrument).fits
    return {path: fits[i] for i, path in enumerate(fits.labels["path"])}


def fitted(calibration, skin, instrument=None):
    driver = etid.identify_driver(calibration, instrument=instrument)
    return etid.identify_skin(skin, driver, throw=False)


def errors(fit, skin):
    """Errors of the elements in standard errors."""
    off = np.asarray(fit.circuit.values()) - np.asarray(skin.values())
    return off / np.sqrt(np.diagonal(np.asarray(fit.cov)))


@pytest.mark.parametrize("skin", [DRY, DAMP], ids=["dry", "damp"])
def test_an_error_within_its_tolerance_is_in_the_standard_errors(skin):
    disturbed = records(skin, gain=1e-3)
    assert np.abs(errors(fitted(*disturbed), skin)).max() > 8
    fit = fitted(*disturbed, GAIN)
    assert fit.verdict == "successful"
    assert np.abs(errors(fit, skin)).max() < 4


def test_two_records_of_one_resistor_have_one_error_of_it():
    """It passes one to one into all elements; those of two resistors would partly cancel."""
    (first, skin), (second, _) = records(), records(seed=1)
    both = [first, second.replace(path="again")]
    variances = []
    for instrument in (None, etid.Instrument(r_load=1e-2)):
        driver = etid.identify_driver(both, instrument=instrument)
        fit = etid.identify_skin(skin, driver)
        variances.append(np.diagonal(fit.cov) / np.square(fit.circuit.values()))
    # The record tells a little of the resistor, too: of the variance, less than 2 %.
    np.testing.assert_allclose(variances[1] - variances[0], 1e-4, rtol=0.02)


def test_an_error_far_beyond_its_tolerance_is_inconsistent():
    # A record of dry skin shows a gain to 0.025 %: 0.2 % are eight standard errors.
    assert fitted(*records(gain=-2e-3), etid.Instrument(gain=2e-4)).verdict == "inconsistent"
    assert fitted(*records(gain=-2e-3), etid.Instrument(gain=2e-3)).verdict == "successful"


@pytest.mark.parametrize("source", TOLERANCES)
def test_a_budget_says_what_an_error_that_nobody_stated_does(source):
    size = TOLERANCES[source][1]
    errors: dict[str, Any] = {source: size}
    right, wrong = fitted(*records()), fitted(*records(**errors))
    before, after = (np.log(np.asarray(fit.circuit.values())) for fit in (right, wrong))
    told = right.budget().unstated[source]
    # Both fits have the same noise; what is left is the curvature of the model and, for a
    # capacitance, that its simulation goes through other filters.
    np.testing.assert_allclose(np.abs(after - before), told, rtol=0.1, atol=0.05 * told.max())


def test_the_parts_of_a_budget_are_the_variances_of_the_fit():
    fit = fitted(*records(), ALL)
    budget = fit.budget()
    values = np.asarray(fit.circuit.values())
    relative = np.sqrt(np.diagonal(np.asarray(fit.cov))) / values
    np.testing.assert_allclose(budget.together, relative, rtol=1e-6)
    assert {"recording", "driver", *TOLERANCES} == set(budget.parts)
    # Of a known resistor nothing is seen: its tolerance passes 1:1.
    np.testing.assert_allclose(budget.parts["r_load"], 2e-3, rtol=0.05)
    text = str(budget)
    assert "gain 0.2 %" in text
    assert "capacitance 2 pF" in text
    assert "together" in text


def test_the_derivatives_of_the_gains_by_the_errors_are_those_of_jax():
    calibration, skin = records()
    driver = etid.identify_driver(calibration, instrument=ALL)
    assert isinstance(driver, HarmonicDriver)
    frequency = driver.spectra.frequency[0]
    with jax.enable_x64(True):
        gains = Gains(
            given(driver, frequency, False), DRY, frequency, jnp.asarray(skin.sample_rate)
        )
        at = 0.1 * jnp.arange(1.0, 1 + gains.owned + gains.driver.mean.size) / gains.owned
        q = at.at[: gains.elements].set(DRY.log_values())
        found = jnp.moveaxis(jax.jit(lambda q: gains.slopes(q).by_unknown)(q), 0, -1)
        wanted = jax.jit(jax.jacfwd(lambda q: gains(q)))(q)
        # Z_th is a Padé approximant of an exponential, whose derivative the slopes take instead.
        np.testing.assert_allclose(found, wanted, rtol=1e-9, atol=1e-9 * np.abs(wanted).max())


def test_the_derivatives_of_the_calibrations_by_the_errors_are_those_of_jax():
    driver = etid.identify_driver(records()[0], instrument=ALL)
    assert isinstance(driver, HarmonicDriver)
    with jax.enable_x64(True):
        of = Calibrations.of(driver)
        common = of.start() + jnp.linspace(0.1, 1.0, of.start().size)
        found = jnp.moveaxis(jax.jit(lambda c: of.slopes(c).by_unknown)(common), 0, -1)
        wanted = jax.jit(jax.jacfwd(of.gains))(common)
        found, wanted = np.asarray(found), np.asarray(wanted)
        size = np.abs(wanted).max(axis=(0, 1)) + (wanted == 0).all(axis=(0, 1))
        # Rounding, times the condition of a sum over the poles of Z_th.
        np.testing.assert_allclose(found / size, wanted / size, atol=1e-9)


@pytest.mark.parametrize("shared", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_joint_fit_has_the_errors_of_the_instrument(shared):
    loads = {"dry/0": DRY, "dry/1": DRY, "damp/0": DAMP}
    study = trials(loads, gain=1e-3, shared_v_th=shared)
    without = together(study)
    assert np.abs(errors(without["dry/0"], DRY)).max() > 5
    found = etid.identify_jointly(study, instrument=ALL)
    (driver,) = found.drivers.values()
    for number, (path, skin) in enumerate(loads.items()):
        fit = found.fits[number]
        assert fit.verdict == "successful"
        assert np.abs(errors(fit, skin)).max() < 4
        budget = fit.budget(study[path], driver)
        relative = np.sqrt(np.diagonal(np.asarray(fit.cov))) / np.asarray(fit.circuit.values())
        np.testing.assert_allclose(budget.together, relative, rtol=1e-6)
        assert {"recording", "driver", *TOLERANCES} == set(budget.parts)
        np.testing.assert_allclose(budget.parts["r_load"], 2e-3, rtol=0.05)
    narrow = together(study, etid.Instrument(gain=1e-4))
    assert {fit.verdict for fit in narrow.values()} == {"inconsistent"}


def test_a_joint_fit_finds_a_gain_that_moves_r_p_by_a_third():
    loads = {"dry": DRY, "damp": DAMP}
    study = trials(loads, gain=-2e-2, trigger_jitter_rms=50e-9)
    for path, fit in together(study, etid.Instrument(gain=2e-2)).items():
        assert fit.verdict == "successful"
        assert np.abs(errors(fit, loads[path])).max() < 4


# 1 pF moves the driver of a joint fit along its curved valley: its effect is not linear.
@pytest.mark.parametrize("source", sorted({*TOLERANCES} - {"capacitance"}))
def test_a_budget_of_a_joint_fit_says_what_an_error_that_nobody_stated_does(source):
    size, loads = TOLERANCES[source][1], {"0": DRY, "1": DRY}
    error: dict[str, Any] = {source: size}
    # Without jitter each study would limit its delays by another width.
    right, wrong = (trials(loads, trigger_jitter_rms=50e-9, **of) for of in ({}, error))
    found = etid.identify_jointly(right, instrument=etid.Instrument())
    fits = found.fits[0], together(wrong)["0"]
    before, after = (np.log(np.asarray(fit.circuit.values())) for fit in fits)
    (driver,) = found.drivers.values()
    told = found.fits[0].budget(right["0"], driver).unstated[source]
    # As for single fits.
    np.testing.assert_allclose(np.abs(after - before), told, rtol=0.1, atol=0.05 * told.max())
    with pytest.raises(ValueError, match=r"pass instrument=etid.Instrument\(\)"):
        together(wrong)["0"].budget(wrong["0"], driver)


def test_tolerances_are_kept_in_files_of_fits(tmp_path):
    calibration, skin = records()
    study = etid.Study.from_recordings([calibration, skin])
    fits = etid.identify_study(study, instrument=ALL)
    fits.write(tmp_path / "fits.h5")
    again = etid.StudyFits.read(tmp_path / "fits.h5")
    assert again.settings == fits.settings
    assert again.settings is not None
    assert "crosstalk 0.002" in again.settings.instrument
    (driver,) = again.drivers.values()
    assert isinstance(driver, ContinuousDriver)
    assert driver.instrument is not None
    assert driver.instrument.stored() == ALL.stored()
    study.write(tmp_path / "study.h5")
    command = ["fit", str(tmp_path / "study.h5"), "-o", str(tmp_path / "joint.h5"), "--joint"]
    assert cli.main([*command, "--tolerance", "crosstalk=0.002"]) == 0
    settings = etid.StudyFits.read(tmp_path / "joint.h5").settings
    assert settings is not None
    assert settings.instrument == ("crosstalk 0.002",)


def tracked(calibration, skin, instrument=None):
    """Logarithms of the elements and charge after the pulses of a record, and their variances."""
    tracker = etid.Tracker.of(
        etid.identify_driver(calibration, instrument=instrument), calibration, electrodes=1
    )
    state = tracker.start()
    for v_out in tracker.pulses(skin.v_out[None]):
        state = tracker.update(state, v_out)
    fit = tracker.read(state)[0]
    values, logs = np.asarray(fit.circuit.values()), fit.circuit.log_values()
    with jax.enable_x64(True):
        of = CurrentModel.of(tracker.model).current(fit.circuit, logs, jnp.zeros((3, 3)))
    variances = np.diagonal(np.asarray(fit.cov)) / values**2
    found = np.append(np.log(values), of.charge / CHARGE)
    return fit, found, np.append(variances, (of.charge_stderr / CHARGE) ** 2)


@pytest.mark.parametrize("skin", [DRY, pytest.param(DAMP, marks=pytest.mark.slow)])
@pytest.mark.parametrize("source", TOLERANCES)
def test_a_tracker_has_the_errors_of_the_instrument(source, skin):
    size = TOLERANCES[source][1]
    error: dict[str, Any] = {source: size}
    _, before, without = tracked(*records(skin))
    *_, stated = tracked(*records(skin), etid.Instrument(**error))
    fit, after, _ = tracked(*records(skin, **error), etid.Instrument(**error))
    assert fit.verdict == "successful"
    added, moved = np.sqrt(stated - without), np.abs(after - before)
    if source == "capacitance":  # more current flows, but not through the skin
        added, moved = added[:-1], moved[:-1]
    # What a tolerance adds is what an error of its size does, as in the budget of a fit.
    np.testing.assert_allclose(added, moved, rtol=0.1, atol=0.05 * moved.max())


REFUSED = {
    "etid.Instrument(gain=-1e-3)": "gain",
    "etid.Instrument(capacitance=5.0)": r"\[F\]",
    "etid.Instrument(r_load=5.0)": "relative",
    "etid.identify_driver(calibration, instrument=1e-3)": "instrument",
    "etid.identify_driver(calibration, instrument=ALL, method='output_error')": "output_error",
    "etid.identify_skin(skin, driver, method='output_error')": "output_error",
}


@pytest.mark.parametrize("call", REFUSED)
def test_tolerances_are_refused_where_they_would_not_be_used(call, recorded):
    calibration, skin, driver = recorded
    names = {"etid": etid, "ALL": ALL, "calibration": calibration, "skin": skin, "driver": driver}
    with pytest.raises((ValueError, TypeError), match=REFUSED[call]):
        eval(call, names)


@pytest.fixture(scope="module")
def recorded():
    calibration, skin = records()
    return calibration, skin, etid.identify_driver(calibration, instrument=ALL)


@pytest.mark.slow
@pytest.mark.parametrize("skin", [DRY, DAMP], ids=["dry", "damp"])
def test_intervals_hold_errors_that_are_drawn_from_their_tolerances(skin):
    inside, refused = 0, 0
    for number in range(DRAWS):
        draw = np.random.default_rng([number, 5])
        drawn = {name: size * draw.standard_normal() for name, size in ALL.stored().items()}
        drawn["capacitance"] = abs(drawn["capacitance"])
        fit = fitted(*records(skin, seed=number, **drawn), ALL)
        refused += fit.verdict != "successful"
        inside += int(np.sum(np.abs(errors(fit, skin)) < NORMAL_95))
    assert refused <= 1  # of 40: one of a thousand is refused by chance
    # Three elements of a fit are not independent, so that the count is one of 40 in the worst case.
    low, high = scipy.stats.binom.interval(0.999, DRAWS, 0.95)
    assert low <= inside / 3 <= high


@pytest.mark.slow
def test_intervals_of_joint_fits_hold_errors_that_are_drawn_from_their_tolerances():
    loads = {f"{kind}/{i}": skin for kind, skin in (("dry", DRY), ("damp", DAMP)) for i in range(5)}
    inside, refused = {"dry": 0, "damp": 0}, 0
    for number in range(STUDIES):
        draw = np.random.default_rng([number, 5])
        drawn = {name: size * draw.standard_normal() for name, size in ALL.stored().items()}
        drawn["capacitance"] = abs(drawn["capacitance"])
        study = trials(loads, seed=number, trigger_jitter_rms=50e-9, **drawn)
        for path, fit in together(study, ALL).items():
            refused += fit.verdict != "successful"
            kind, _, _ = path.partition("/")
            inside[kind] += int(np.sum(np.abs(errors(fit, loads[path])) < NORMAL_95))
    assert refused <= 3  # of 160: one of a thousand is refused by chance
    # The fits of a study share most of their errors: the count is one of 16 in the worst case.
    low, high = scipy.stats.binom.interval(0.999, STUDIES, 0.95)
    assert low <= inside["dry"] / 15 <= high
    assert low <= inside["damp"] / 15 <= high
