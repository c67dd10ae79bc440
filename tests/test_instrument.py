"""Tolerances of the instrument: in the standard errors, in a budget, and in files."""

import dataclasses
import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

import etid
import etid.display
from etid import cli
from etid.circuits.circuit import AbstractCircuit, Farad, Ohm, parameter
from etid.circuits.elements import capacitor, resistor
from etid.circuits.impedance import parallel, series
from etid.display.current import CurrentModel
from etid.estimators.maximum_likelihood.given_driver import given
from etid.estimators.maximum_likelihood.rows import source_of
from etid.likelihood.calibrations import Calibrations
from etid.likelihood.gains import Gains
from etid.precision import array_function
from etid.recordings.remarks import Remark
from etid.results.driver import ContinuousDriver, HarmonicDriver
from etid.results.instrument import ERRORS
from etid.simulation.scenes import Scene, Trial
from etid.simulation.transformer import ResistorLoad
from tests.skins import DAMP, DRY, off, relative

R_LOAD = 98.8e3
SKINS = {"dry": DRY, "damp": DAMP}
GAIN = etid.Instrument(gain=1e-3)
ALL = etid.Instrument(gain=2e-3, r_load=2e-3, c_load=1e-12, crosstalk=2e-3, capacitance=2e-12)
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


def trials(
    loads,
    *,
    seed=0,
    gain=0.0,
    r_load=0.0,
    c_load=0.0,
    crosstalk=0.0,
    capacitance=0.0,
    known=(R_LOAD,),
    **scene,
):
    """Calibrations and recordings of these loads by path, by an instrument with these errors."""
    paths = ["calibration" if r == R_LOAD else f"other/{r:g}" for r in known]
    off, across = (np.broadcast_to(of, len(known)).tolist() for of in (r_load, c_load))
    every = [
        Trial(path, etid.ParallelRC(r, c) if c else ResistorLoad(r))
        for path, r, c in zip(paths, known, across, strict=True)
    ] + [
        Trial(path, BesideCable(of.r_s, of.r_p, of.c_p, capacitance) if capacitance else of)
        for path, of in loads.items()
    ]
    said = {path: r / (1 + of) for path, r, of in zip(paths, known, off, strict=True)}
    found = []
    for one in Scene(tuple(every), **scene).simulate(seed).recordings():
        wrong = one.replace(v_out=(1 + gain) * one.v_out + crosstalk * one.v_th)
        if one.path in said:
            found.append(wrong.replace(r_load=said[one.path]))
        else:
            found.append(wrong.replace(calibration=tuple(paths)))
    return etid.Study.from_recordings(found)


def records(skin=DRY, **errors):
    """A calibration and a skin."""
    study = trials({"skin": skin}, samples=20_000, **errors)
    return study["calibration"], study["skin"]


@functools.cache
def exact(kind="dry"):
    """Records of an instrument without errors."""
    return records(SKINS[kind])


def together(study, instrument=None):
    """Joint fits of all trials by path."""
    fits = etid.identify_jointly(study, instrument=instrument).fits
    return {path: fits[i] for i, path in enumerate(fits.labels["path"])}


def fitted(calibration, skin, instrument=None):
    driver = etid.identify_driver(calibration, instrument=instrument)
    return etid.identify_skin(skin, driver, throw=False)


def test_an_error_within_its_tolerance_is_in_the_standard_errors_and_no_larger_one():
    for skin in (DRY, DAMP):
        disturbed = records(skin, gain=1e-3)
        alone, fit = fitted(*disturbed), fitted(*disturbed, GAIN)
        assert fit.verdict == "successful"
        assert np.abs(off(fit, skin)).max() < 4
        # A fit that does not know the tolerance can only doubt the gain.
        assert int(alone.remarks) & Remark.gain_doubtful
        assert relative(alone)[1] > 4 * relative(fit)[1]
    # A record of dry skin shows a gain to 0.025 %: 0.2 % are eight standard errors.
    for gain, verdict in ((2e-4, "inconsistent"), (2e-3, "successful")):
        assert fitted(*records(gain=-2e-3), etid.Instrument(gain=gain)).verdict == verdict


def test_two_records_of_one_resistor_have_one_error_of_it():
    """It passes one to one into all elements; those of two resistors would partly cancel."""
    (first, skin), (second, _) = exact(), records(seed=1)
    both = [first, second.replace(path="again")]
    variances = []
    for instrument in (None, etid.Instrument(r_load=1e-2)):
        driver = etid.identify_driver(both, instrument=instrument)
        fit = etid.identify_skin(skin, driver)
        variances.append(np.diagonal(fit.cov) / np.square(fit.circuit.values()))
    # The record tells a little of the resistor, too: of the variance, less than 2 %.
    np.testing.assert_allclose(variances[1] - variances[0], 1e-4, rtol=0.02)


def test_a_budget_says_what_an_error_that_nobody_stated_does():
    right = fitted(*exact())
    for source, size in ERRORS.items():
        error: dict[str, Any] = {source: size}
        before, after = (
            np.log(np.asarray(fit.circuit.values())) for fit in (right, fitted(*records(**error)))
        )
        told = right.budget().unstated[source]
        # Both fits have the same noise; what is left is the curvature of the model and, for a
        # capacitance, that its simulation goes through other filters.
        np.testing.assert_allclose(
            np.abs(after - before), told, rtol=0.1, atol=0.05 * told.max(), err_msg=source
        )


def test_a_fit_names_the_error_that_nobody_stated_and_that_exceeds_its_errors_most():
    calibration, skin = exact()
    driver = etid.identify_driver(calibration)
    fit = etid.identify_skin(skin, driver)
    # A gain that changes after the calibration, as in 0.2 to 0.5 % that passed at 40 dB unsaid.
    wrong = skin.replace(v_out=1.001 * skin.v_out)
    later = etid.identify_skin(wrong, driver, throw=False)
    before, after = (np.log(np.asarray(of.circuit.values())) for of in (fit, later))
    assert fit.by_tolerance is not None
    told = fit.by_tolerance.unstated["later gain"]
    # As for the errors of a budget.
    np.testing.assert_allclose(np.abs(after - before), told, rtol=0.1, atol=0.05 * told.max())
    what = "a gain that changes by 0.1 % after the calibration"
    said = f"Not in ±: {what} would move r_p by {100 * told[1]:.2g} %."
    assert str(fit).splitlines()[-1].strip() == said
    assert said in str(fit._repr_html_())
    assert fit.budget().largest == said
    # A row of a batch knows it, too; a fit with a verdict that forbids its use says nothing.
    fits = etid.identify_skins([skin, skin.replace(v_out=1.2 * skin.v_out)], driver)
    assert str(fits[0]).splitlines()[-1].strip() == said
    assert fits[1].verdict != "successful"
    assert "Not in ±" not in str(fits[1])
    # What is stated is in ±.
    stated = fitted(calibration, skin, dataclasses.replace(ALL, drift=0.01))
    assert stated.by_tolerance is not None
    assert {*stated.by_tolerance.unstated} == {"later gain"}


def test_the_parts_of_a_budget_are_the_variances_of_the_fit():
    fit = fitted(*exact(), ALL)
    budget = fit.budget()
    np.testing.assert_allclose(budget.together, relative(fit), rtol=1e-6)
    assert {"recording", "driver", *ERRORS} == set(budget.parts)
    # Of a known resistor nothing is seen: its tolerance passes 1:1.
    np.testing.assert_allclose(budget.parts["r_load"], 2e-3, rtol=0.05)
    text = str(budget)
    assert "gain 0.2 %" in text
    assert "capacitance 2 pF" in text
    assert "together" in text


def test_the_drift_of_a_budget_is_what_its_tolerance_adds():
    without, stated = (fitted(*exact(), of) for of in (None, etid.Instrument(drift=1e-4)))
    part = stated.budget().parts["drift"]
    np.testing.assert_allclose(stated.budget().together, relative(stated), rtol=1e-6)
    # Of so small a drift the fit estimates a few per cent, and less of a smaller one.
    np.testing.assert_allclose(part, 0.01 * without.budget().unstated["drift"], rtol=0.05)
    added = relative(stated) ** 2 - relative(without) ** 2
    np.testing.assert_allclose(part, np.sqrt(added), rtol=0.05)


def test_a_stated_delay_narrows_the_errors_and_a_larger_one_contradicts_it():
    calibration, skin = trials({"skin": DRY}, trigger_jitter_rms=1e-9).recordings()
    without, stated = (fitted(calibration, skin, of) for of in (None, etid.Instrument(delay=1e-9)))
    assert stated.verdict == "successful"
    assert np.abs(off(stated, DRY)).max() < 4
    c_p = list(DRY.names()).index("c_p")
    # The bounds of `python -m benchmarks delays`: 0.36 and 0.14 %, for six periods less.
    assert relative(stated)[c_p] < 0.5 * relative(without)[c_p]
    known, late = trials({"skin": DRY}, trigger_jitter_rms=100e-9, seed=2).recordings()
    assert fitted(known, late).verdict == "successful"
    assert fitted(known, late, etid.Instrument(delay=1e-9)).verdict != "successful"


def test_an_instrument_is_a_field_of_the_calibrations(tmp_path):
    calibration, skin = exact()
    told = calibration.replace(instrument="gain=1e-3 drift=0.01 delay=2e-9")
    etid.Study.from_recordings([told, skin]).write(tmp_path / "study.h5")
    with etid.read(tmp_path / "study.h5") as study:
        assert study["calibration"].instrument == told.instrument
        fits = etid.identify_study(study)
    (driver,) = fits.drivers.values()
    assert isinstance(driver, ContinuousDriver)
    assert driver.instrument is not None
    assert driver.instrument.stored() == {"gain": 1e-3, "drift": 1e-2, "delay": 2e-9}
    stated = fitted(calibration, skin, etid.Instrument(gain=1e-3, drift=0.01, delay=2e-9))
    np.testing.assert_array_equal(np.asarray(fits.fits.cov[0]), np.asarray(stated.cov))
    # What is passed counts.
    other = etid.identify_driver(told, instrument=GAIN)
    assert isinstance(other, ContinuousDriver)
    assert other.instrument is not None
    assert other.instrument.stored() == {"gain": 1e-3}
    for text, message in (("gain=x", "is no number"), ("gains=1", "is none of gain")):
        with pytest.raises(etid.RecordingError, match=message):
            etid.identify_driver(calibration.replace(instrument=text))
    other = records(seed=1)[0].replace(path="again", instrument="gain=2e-3")
    with pytest.raises(etid.RecordingError, match="same tolerances"):
        etid.identify_driver([told, other])
    with pytest.raises(etid.RecordingError, match="only a calibration"):
        skin.replace(instrument="gain=1e-3")
    with pytest.raises(ValueError, match="no drift between them"):
        etid.identify_jointly(etid.Study.from_recordings([told, skin]))
    # Steiglitz-McBride has no standard errors that a file's statement could enter.
    baseline = etid.identify_driver(told, method="steiglitz_mcbride", throw=False)
    assert baseline.method == "steiglitz_mcbride"
    # A driver keeps in its file what was passed, in other words too.
    passed = etid.identify_driver(told, instrument=etid.Instrument(gain=0.001))
    passed.write(tmp_path / "driver.h5")
    again = etid.read_driver(tmp_path / "driver.h5")
    assert isinstance(again, ContinuousDriver)
    assert again.instrument is not None
    assert again.instrument.stored() == {"gain": 1e-3}


def test_a_file_with_an_instrument_is_checked_and_fitted_otherwise(tmp_path, capsys):
    calibration, skin = exact()
    file = tmp_path / "study.h5"
    etid.Study.from_recordings([calibration.replace(instrument="delay=5ns"), skin]).write(file)
    assert cli.main(["check", str(file)]) == 1
    assert "'delay=5ns' is no number" in capsys.readouterr().out
    told = calibration.replace(instrument="gain=1e-3 drift=0.01")
    etid.Study.from_recordings([told, skin]).write(file)
    assert cli.main(["check", str(file)]) == 0
    with etid.read(file) as study:
        fits = etid.identify_jointly(study, instrument=GAIN)  # what is passed counts
        assert fits.fits.verdicts == ["successful"]


def test_the_derivatives_of_the_gains_by_the_errors_are_those_of_jax():
    *known, skin = trials({"skin": DRY}, known=(R_LOAD, 21.62e3)).recordings()
    driver = etid.identify_driver(known, instrument=ALL)
    assert isinstance(driver, HarmonicDriver)
    frequency = driver.spectra.frequency[0]
    source = source_of(given(driver, np.asarray(frequency), False))
    gains = Gains(source, DRY, np.asarray(frequency), skin.sample_rate)
    at = 0.1 * jnp.arange(1.0, 1 + gains.owned + source.mean.size) / gains.owned
    q = at.at[: gains.elements].set(DRY.log_values())
    found = jnp.moveaxis(jax.jit(array_function(lambda q: gains.slopes(q).by_q))(q), 0, -1)
    wanted = jax.jit(jax.jacfwd(array_function(lambda q: gains(q))))(q)
    # Z_th is a Padé approximant of an exponential, whose derivative the slopes take instead.
    np.testing.assert_allclose(found, wanted, rtol=1e-9, atol=1e-9 * np.abs(wanted).max())
    of = Calibrations.of(driver)
    common = of.start() + jnp.linspace(0.1, 1.0, of.start().size)
    found = np.asarray(jax.jit(lambda c: of.slopes(c).by_q)(common)).transpose(1, 2, 0)
    wanted = np.asarray(jax.jit(jax.jacfwd(of.gains))(common))
    size = np.abs(wanted).max(axis=(0, 1)) + (wanted == 0).all(axis=(0, 1))
    # Rounding, times the condition of a sum over the poles of Z_th.
    np.testing.assert_allclose(found / size, wanted / size, atol=1e-9)


@pytest.mark.parametrize("shared", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_joint_fit_has_the_errors_of_the_instrument(shared):
    loads = {"dry/0": DRY, "dry/1": DRY, "damp/0": DAMP}
    study = trials(loads, gain=1e-3, shared_v_th=shared)
    alone = together(study)["dry/0"]
    found = etid.identify_jointly(study, instrument=ALL)
    (driver,) = found.drivers.values()
    for number, (path, skin) in enumerate(loads.items()):
        fit = found.fits[number]
        assert fit.verdict == "successful"
        assert np.abs(off(fit, skin)).max() < 4
        budget = fit.budget(study[path], driver)
        np.testing.assert_allclose(budget.together, relative(fit), rtol=1e-6)
        assert {"recording", "driver", *ERRORS} == set(budget.parts)
        np.testing.assert_allclose(budget.parts["r_load"], 2e-3, rtol=0.05)
    assert int(alone.remarks) & Remark.gain_doubtful
    # A capacitance of the resistor's carrier would be a further error of R_p.
    without = together(study, dataclasses.replace(ALL, c_load=0.0))["dry/0"]
    assert relative(alone)[1] > 3.5 * relative(without)[1]
    narrow = together(study, etid.Instrument(gain=1e-4))
    assert {fit.verdict for fit in narrow.values()} == {"inconsistent"}


def test_a_joint_fit_finds_a_gain_that_moves_r_p_by_a_third():
    loads = SKINS
    study = trials(loads, gain=-2e-2, trigger_jitter_rms=50e-9)
    for path, fit in together(study, etid.Instrument(gain=2e-2)).items():
        assert fit.verdict == "successful"
        assert np.abs(off(fit, loads[path])).max() < 4


def test_a_budget_of_a_joint_fit_says_what_an_error_that_nobody_stated_does():
    # Without jitter each study would limit its delays by another width.
    loads = {"0": DRY, "1": DRY}
    right = trials(loads, trigger_jitter_rms=50e-9)
    found = etid.identify_jointly(right, instrument=etid.Instrument())
    (driver,) = found.drivers.values()
    budget = found.fits[0].budget(right["0"], driver)
    # 1 pF moves the driver of a joint fit along its curved valley: its effect is not linear.
    for source in sorted({*ERRORS} - {"capacitance", "c_load"}):
        error: dict[str, Any] = {source: ERRORS[source]}
        wrong = trials(loads, trigger_jitter_rms=50e-9, **error)
        other = together(wrong)["0"]
        before, after = (np.log(np.asarray(of.circuit.values())) for of in (found.fits[0], other))
        told = budget.unstated[source]
        # As for single fits.
        np.testing.assert_allclose(
            np.abs(after - before), told, rtol=0.1, atol=0.05 * told.max(), err_msg=source
        )
        with pytest.raises(ValueError, match=r"pass instrument=etid.Instrument\(\)"):
            other.budget(wrong["0"], driver)


def test_tolerances_are_kept_in_files_of_fits(tmp_path):
    study = etid.Study.from_recordings(exact())
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


@eqx.filter_jit
def current(model, circuit):
    return model.current(circuit, circuit.log_values(), jnp.zeros((3, 3)))


def tracked(calibration, skin, instrument):
    """Logarithms of the elements and charge after the pulses of a record, and their variances.

    Ten electrodes, as in other tests: the program for them is compiled.
    """
    driver = etid.identify_driver(calibration, instrument=instrument)
    tracker = etid.display.Tracker.of(driver, calibration, electrodes=10)
    state = tracker.start()
    for v_out in tracker.pulses(np.tile(skin.v_out, (10, 1))):
        state = tracker.update(state, v_out)
    fit = tracker.read(state)[0]
    of = current(CurrentModel.of(tracker.model), fit.circuit)
    found = np.append(np.log(np.asarray(fit.circuit.values())), of.charge / CHARGE)
    return fit, found, np.append(relative(fit) ** 2, (of.charge_stderr / CHARGE) ** 2)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["dry", "damp"])
def test_a_tracker_has_the_errors_of_the_instrument(kind):
    *_, without = tracked(*exact(kind), etid.Instrument())
    for source, size in ERRORS.items():
        error: dict[str, Any] = {source: size}
        _, before, stated = tracked(*exact(kind), etid.Instrument(**error))
        fit, after, _ = tracked(*records(SKINS[kind], **error), etid.Instrument(**error))
        assert fit.verdict == "successful"
        added, moved = np.sqrt(stated - without), np.abs(after - before)
        if source == "capacitance":  # more current flows, but not through the skin
            added, moved = added[:-1], moved[:-1]
        # What a tolerance adds is what an error of its size does, as in the budget of a fit.
        # With another calibration, not all of its noise is the same: then within a standard error.
        noise = np.sqrt(without).max() if source == "c_load" else 0.05 * moved.max()
        np.testing.assert_allclose(added, moved, rtol=0.1, atol=noise, err_msg=source)


@pytest.mark.slow
def test_a_stated_delay_is_no_help_to_a_tracker_whose_windows_begin_between_two_samples():
    calibration, skin = exact()
    found = []
    for instrument in (None, etid.Instrument(delay=5e-9)):
        driver = etid.identify_driver(calibration, instrument=instrument)
        tracker = etid.display.Tracker.of(driver, calibration, electrodes=10)
        state = tracker.start()
        for v_out in tracker.pulses(np.tile(skin.v_out, (10, 1))):
            state = tracker.update(state, v_out)
            assert set(tracker.read(state).verdicts) == {"successful"}
        found.append(np.asarray(tracker.read(state)[0].circuit.values()))
    assert np.abs(np.log(found[1] / found[0])).max() < 0.01  # the driver's delay is another


def drawn(number) -> dict[str, Any]:
    """Errors of an instrument, drawn from their tolerances."""
    draw = np.random.default_rng([number, 5])
    of = {name: size * draw.standard_normal() for name, size in ALL.stored().items()}
    return of | {name: abs(of[name]) for name in ("capacitance", "c_load")}


@pytest.mark.slow
@pytest.mark.parametrize("skin", [DRY, DAMP], ids=[*SKINS])
def test_intervals_hold_errors_that_are_drawn_from_their_tolerances(skin):
    inside, refused = 0, 0
    for number in range(DRAWS):
        fit = fitted(*records(skin, seed=number, **drawn(number)), ALL)
        refused += fit.verdict != "successful"
        inside += int(np.sum(np.abs(off(fit, skin)) < NORMAL_95))
    assert refused <= 1  # of 40: one of a thousand is refused by chance
    # Three elements of a fit are not independent, so that the count is one of 40 in the worst case.
    low, high = scipy.stats.binom.interval(0.999, DRAWS, 0.95)
    assert low <= inside / 3 <= high


@pytest.mark.slow
@pytest.mark.parametrize("skin", [DRY, DAMP], ids=[*SKINS])
def test_intervals_behind_two_resistors_hold_errors_that_are_drawn_from_their_tolerances(skin):
    """With 0.1 %, and more with larger tolerances, the resistors were said to disagree."""
    told = etid.Instrument(r_load=5e-3, c_load=1e-12)
    inside, refused = 0, 0
    for number in range(DRAWS):
        draw = np.random.default_rng([number, 9]).standard_normal((2, 2))
        wrong = {"r_load": 5e-3 * draw[0], "c_load": 1e-12 * abs(draw[1])}
        two = (R_LOAD, 21.62e3)
        *known, one = trials({"skin": skin}, seed=number, known=two, **wrong).recordings()
        driver = etid.identify_driver(known, instrument=told, throw=False)
        fit = etid.identify_skin(one, driver, throw=False)
        refused += fit.verdict != "successful"
        inside += int(np.sum(np.abs(off(fit, skin)) < NORMAL_95))
    assert refused <= 1  # of 40: one of a thousand is refused by chance
    low, high = scipy.stats.binom.interval(0.999, DRAWS, 0.95)
    assert low <= inside / 3 <= high


@pytest.mark.slow
def test_intervals_of_joint_fits_hold_errors_that_are_drawn_from_their_tolerances():
    loads = {f"{kind}/{i}": skin for kind, skin in (("dry", DRY), ("damp", DAMP)) for i in range(5)}
    inside, refused = {"dry": 0, "damp": 0}, 0
    for number in range(STUDIES):
        study = trials(loads, seed=number, trigger_jitter_rms=50e-9, **drawn(number))
        for path, fit in together(study, ALL).items():
            refused += fit.verdict != "successful"
            kind, _, _ = path.partition("/")
            inside[kind] += int(np.sum(np.abs(off(fit, loads[path])) < NORMAL_95))
    assert refused <= 3  # of 160: one of a thousand is refused by chance
    # The fits of a study share most of their errors: the count is one of 16 in the worst case.
    low, high = scipy.stats.binom.interval(0.999, STUDIES, 0.95)
    assert low <= inside["dry"] / 15 <= high
    assert low <= inside["damp"] / 15 <= high
