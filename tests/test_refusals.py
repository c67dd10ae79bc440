"""Calls that are refused, each with the words that name the argument and the remedy.

A row is a call and words of its message, below the error that it raises. Files have tables of
their own, beside what is read from them.
"""

import dataclasses
import types
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import etid
from etid import IdentificationError, RecordingError
from etid.circuits.impedance import realise
from etid.plotting import figure_of
from etid.plotting.style import new_figure, save
from etid.results.driver import ContinuousDriver
from etid.results.verdicts import verdict
from etid.signals.transfer import Rational
from etid.simulation.scenes import Scene, Trial
from etid.simulation.transformer import ResistorLoad, SkinLoad
from tests import pictures

RATE = 200e3
WITH_CURRENT = "maximum_likelihood(with_current=True)"
GUESS: Any = "guess"


@pytest.fixture(scope="module")
def of():
    """One scene and what is made from it, and results made by hand."""
    trials = (Trial("loaded/0", SkinLoad(r_s=33.4e3, r_p=186e3, c_p=0.12e-9)),)
    known = (Trial("calibration/0", ResistorLoad(98.8e3)),)
    study = Scene(trials, known, current_snr_db=40.0).simulate(seed=2)
    both, calibration = study["loaded/0"], study["calibration/0"]
    driver = etid.identify_driver(calibration, order=5)
    tracker = etid.Tracker.of(driver, calibration, electrodes=2)
    made = jax.tree.map(np.asarray, pictures.fit())
    return types.SimpleNamespace(
        study=study,
        calibration=calibration,
        both=both,  # V_th, V_out and the current
        skin=both.replace(current=None),
        alone=both.without_v_th(),
        driver=driver,
        discrete=etid.identify_driver(calibration, method="equation_error", throw=False),
        fit=etid.identify_skin(both.replace(current=None), driver),
        tracker=tracker,
        state=tracker.start(),
        controller=etid.Controller.of(tracker),
        window=np.zeros((2, tracker.model.bands.samples)),
        batch=jax.tree.map(lambda *leaves: np.stack(leaves), made, made),
    )


def cut(recording, size):
    return recording.replace(v_th=recording.v_th[:size], v_out=recording.v_out[:size])


def skin(of, **options):
    return etid.identify_skin(of.alone, **options)


ONE_OF = "must be a whole number from 2 to 20"
IDENTIFICATION = {
    ValueError: [
        (
            lambda of: etid.identify_driver(of.calibration.replace(r_load=None)),
            "has no r_load; a calibration needs its resistor",
        ),
        (
            lambda of: etid.identify_driver([of.calibration, cut(of.calibration, 2000)]),
            r"differ in \(samples, sample rate, pulse rate\)",
        ),
        (lambda of: etid.identify_driver([]), "no calibration given"),
        (lambda of: etid.identify_driver(of.calibration, order=1), ONE_OF),
        (lambda of: etid.identify_driver(of.calibration, order=0), ONE_OF),
        (lambda of: etid.identify_driver(of.calibration, order=-1), ONE_OF),
        (lambda of: etid.identify_skins([], of.driver), "no recording"),
        (
            lambda of: etid.identify_study(etid.Study.from_recordings([of.calibration])),
            "no loaded recording",
        ),
        (lambda of: etid.identify_skin(of.skin, of.discrete), "no continuous source"),
        (
            lambda of: etid.identify_skin(
                of.skin.replace(sample_rate=2 * RATE, pulse_rate=120.0),
                of.driver,
                method="steiglitz_mcbride",
            ),
            "the same sample rate",
        ),
        (
            lambda of: etid.identify_skin(
                of.skin, of.driver, circuit=etid.Resistor(), method="equation_error"
            ),
            "identifies SkinRC only",
        ),
        (lambda of: etid.predict(of.skin, of.driver), "give the circuit"),
        (
            lambda of: skin(of, method="steiglitz_mcbride"),
            "steiglitz_mcbride.*from a measured current",
        ),
        (lambda of: skin(of, method="non_parametric"), "non_parametric.*from a measured current"),
        (
            lambda of: etid.identify_skin(of.skin, of.driver, method=WITH_CURRENT),
            "needs a driver and a current",
        ),
        (
            lambda of: etid.identify_skin(of.both, method=WITH_CURRENT),
            "needs a driver and a current",
        ),
        (
            lambda of: etid.identify_samples(
                jnp.asarray(of.skin.v_th),
                jnp.asarray(of.skin.v_out),
                of.driver,
                method=WITH_CURRENT,
                sample_rate=RATE,
                pulse_rate=60.0,
            ),
            "arrays have no current",
        ),
        # Known elements and bounds
        (
            lambda of: skin(of, fixed={"r_x": 1.0}),
            "'r_x' is no element of SkinRC; its elements are r_s, r_p, c_p",
        ),
        (
            lambda of: etid.identify_skins([of.alone], fixed={"r_x": 1.0}),
            "'r_x' is no element of SkinRC",
        ),
        (lambda of: skin(of, fixed={"r_s": -1.0}), "must be positive"),
        (
            lambda of: skin(of, prior={"r_s": (5e2, 5e1)}, fixed={"r_s": 5e2}),
            "r_s is fixed and has a prior",
        ),
        (
            lambda of: etid.identify_skin(of.alone, circuit="auto", fixed={"r_s": 33e3}),
            "r_s is known, but ParallelRC and Resistor have no",
        ),
        (
            lambda of: etid.select_circuit(of.alone, fixed={"r_s": 33e3}),
            "r_s is known, but ParallelRC and Resistor have no",
        ),
        (lambda of: skin(of, bounds={"r_s": (2e3, 1e3)}), "bounds of r_s are 2000 and 1000"),
        (lambda of: skin(of, bounds={"r_s": (1e3, 1e3)}), "the upper one must be larger"),
        (lambda of: skin(of, bounds={"r_s": (-1.0, 1e3)}), "must not be negative"),
        (lambda of: skin(of, bounds={"r_s": (np.nan, 1e3)}), "bounds of r_s are nan"),
        (lambda of: skin(of, bounds={"r_s": (0.0, 0.0)}), "bounds of r_s are 0 and 0"),
        (lambda of: skin(of, bounds={"r_x": (1.0, 2.0)}), "'r_x' is no element of SkinRC"),
        (
            lambda of: skin(of, bounds={"r_x": (1.0, 1e3)}, circuit="auto"),
            "'r_x' is no element of SkinRC",
        ),
        (
            lambda of: skin(of, bounds={"r_s": (1.0, 1e3)}, fixed={"r_s": 5.0}),
            "r_s is fixed and has bounds",
        ),
        (
            lambda of: skin(of, bounds={"r_s": (1.0, 1e3)}, method="non_parametric"),
            "'non_parametric' takes no known elements and no bounds",
        ),
        # An impedance
        (lambda of: etid.identify_impedance([1.0, 2.0, 3.0], [1.0, 2.0]), "shape"),
        (lambda of: etid.identify_impedance([0.0, 2.0, 3.0], [1.0, 2.0, 3.0]), "frequency must be"),
        (
            lambda of: etid.identify_impedance([1.0, 2.0, 3.0], [1.0, np.nan, 3.0]),
            "1 impedances are not finite",
        ),
        (lambda of: etid.identify_impedance([1.0], [1.0]), "cannot determine 3 elements"),
        (lambda of: etid.identify_impedance([1.0, 2.0, 3.0], [1.0, 0.0, 3.0]), "impedance is 0"),
    ],
    IdentificationError: [
        (
            lambda of: etid.identify_driver(
                of.calibration.replace(v_th=np.zeros(of.calibration.v_th.size))
            ),
            "flat",
        ),
        (
            lambda of: etid.identify_driver(of.calibration.replace(v_out=of.calibration.v_th)),
            "unconnected",
        ),
        (
            lambda of: etid.identify_skin(
                of.both.replace(current=1e3 * of.both.current), of.driver
            ),
            r"current .* A, .* ohm",
        ),
    ],
    Exception: [
        # The type checker of the tests comes first.
        (lambda of: etid.identify_driver(of.calibration, method=GUESS), "guess"),
        (lambda of: etid.identify_skin(of.skin, of.driver, method=GUESS), "guess"),
        (lambda of: etid.identify_skins([of.skin], of.driver, method=GUESS), "guess"),
        (lambda of: etid.identify_study(of.study, method=GUESS), "guess"),
    ],
    RecordingError: [
        # A current
        (lambda of: etid.identify_skin(of.skin), "current: was not recorded"),
        (lambda of: of.alone.v_th, "v_th: was not recorded"),
        (lambda of: of.alone.replace(current=None), "v_th: is not given.*or current"),
        (lambda of: of.alone.replace(r_load=1e5), "v_th: is not given"),
        (lambda of: of.alone.replace(v_out=None), "v_out: is not given"),
    ],
}

RESULTS = {
    ValueError: [
        (
            lambda of: dataclasses.replace(of.fit, method="output_error").posterior(
                of.skin, of.driver
            ),
            "method='maximum_likelihood'",
        ),
        (lambda of: of.fit.profile("cp"), "'cp' is no element of SkinRC"),
        (lambda of: of.fit.posterior(draws=0), "at least 1"),
        (
            lambda of: dataclasses.replace(of.fit, cov=jnp.full((3, 3), jnp.nan)).posterior(
                of.skin, of.driver
            ),
            "does not determine",
        ),
        (
            lambda of: dataclasses.replace(of.fit).posterior(),
            r"fit\.posterior\(recording, driver\)",
        ),
        (lambda of: of.fit.intervals(0.0), "between 0 and 1"),
        (lambda of: of.fit.intervals(1.0), "between 0 and 1"),
        (lambda of: of.fit.intervals(95.0), "between 0 and 1"),
        (lambda of: of.fit.intervals(np.nan), "between 0 and 1"),
        (lambda of: of.batch.intervals(), "take one of them"),
        (lambda of: of.batch.write("fit.h5"), "take one of them"),
        (lambda of: etid.Fits.read("missing.h5"), "no such file"),
        (
            lambda of: realise(Rational(jnp.array([0.0, 1e-3]), jnp.ones(1)), RATE),
            "grows without bound",
        ),
        (
            lambda of: figure_of(of.driver, show="residual"),
            "it is for fits, and one of 'pulse', 'impedance'",
        ),
        (
            lambda of: etid.plot(of.driver, axes=new_figure(2, 2, (6.0, 5.0))[1][:1, 0]),
            "1 Axes; this picture takes 2",
        ),
        (lambda of: save(figure_of(of.driver), "figure.pdf"), r"\.png or \.svg"),
    ],
    TypeError: [
        (lambda of: dataclasses.replace(of.fit).plot(), r"plot\(fit, recording, driver\)"),
        # Pictures
        (lambda of: figure_of(pictures.fit()), r"plot\(fit, recording, driver\)"),
        (lambda of: figure_of(pictures.selection()), r"plot\(selection, recording, driver\)"),
        (lambda of: figure_of(of.driver, of.skin), "no r_load"),
        (lambda of: figure_of("recording"), "cannot draw str"),
        (lambda of: figure_of({}), "a dictionary of nothing"),
    ],
}


def of_others(of):
    """A state of one electrode."""
    one = jax.tree.map(lambda leaf: leaf[:1], of.state.electrodes)
    return dataclasses.replace(of.state, electrodes=one)


def limited(of, **limits):
    return etid.Controller.of(of.tracker, **limits)


OTHER = "1 electrodes of 3 elements, the tracker 2 of 3"
WANTED = "is wanted; current_cap carries"
ONLINE = {
    ValueError: [
        (
            lambda of: of.tracker.update(of.state, np.zeros((2, 3334))),
            r"shape \(2, 3334\).* \(2, 3333\)",
        ),
        (lambda of: of.tracker.update(of.state, of.window, -1.0), "finite and not negative"),
        (lambda of: of.tracker.update(of.state, of.window, np.nan), "finite and not negative"),
        (lambda of: of.tracker.update(of.state, of.window, np.ones(3)), r"shape \(3,\)"),
        (lambda of: etid.Tracker.of(of.driver, of.calibration, electrodes=0), "electrodes is 0"),
        (
            lambda of: etid.Tracker.of(of.driver, of.calibration, electrodes=1, change=-1.0),
            "change is -1",
        ),
        (
            lambda of: etid.Tracker.of(
                pictures.as_kind(of.driver, ContinuousDriver), of.calibration, electrodes=1
            ),
            "harmonics",
        ),
        (lambda of: of.tracker.update(of_others(of), of.window), OTHER),
        (lambda of: of.tracker.read(of_others(of)), OTHER),
        (lambda of: of.controller.command(of_others(of), charge=80e-9), OTHER),
        (lambda of: limited(of, current_cap=0.0), "current_cap is 0"),
        (lambda of: limited(of, charge_cap=0.0), "charge_cap is 0"),
        (lambda of: limited(of, voltage_cap=0.0), "voltage_cap is 0"),
        (lambda of: limited(of, slew=0.0), "slew is 0"),
        (lambda of: limited(of, fallback=0.0), "fallback is 0"),
        (lambda of: limited(of, probability=1.0), "probability is 1"),
        # 5 A in place of 5 mA would raise every limit a thousandfold; 200 C would never act.
        (lambda of: limited(of, current_cap=5.0), "ampere"),
        (lambda of: limited(of, current_cap=np.inf), "ampere"),
        (lambda of: limited(of, charge_cap=200.0), "never act"),
        (lambda of: limited(of, fallback=np.inf), "infinite"),
        (
            lambda of: etid.Controller.of(
                dataclasses.replace(
                    of.tracker, driver_result=jax.tree.map(jnp.asarray, verdict("misfit"))
                )
            ),
            "driver of the tracker was not identified",
        ),
        (lambda of: of.controller.command(of.state), "either charge or current"),
        (lambda of: of.controller.command(of.state, charge=-1e-9), "finite and not negative"),
        (lambda of: of.controller.command(of.state, current=np.ones(3)), r"shape \(3,\)"),
        (lambda of: of.controller.command(of.state, charge=80.0), WANTED),
        (lambda of: of.controller.command(of.state, current=1.0), WANTED),
        (lambda of: of.controller.command(of.state, current=np.array([1e-4, 6e-3])), WANTED),
    ],
    IdentificationError: [
        (
            lambda of: etid.Tracker.of(of.driver, cut(of.calibration, 1500), electrodes=1),
            "not_periodic",
        ),
    ],
}


def rows():
    for table in (IDENTIFICATION, RESULTS, ONLINE):
        for error, refused in table.items():
            for call, words in refused:
                yield pytest.param(call, error, words, id=words)


@pytest.mark.parametrize(("call", "error", "words"), list(rows()))
def test_a_call_that_cannot_be_right_is_refused(of, call, error, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(error, match=words):
        call(of)
    assert list(tmp_path.iterdir()) == []


def test_an_impedance_has_no_draws_and_no_residual_in_time():
    frequency = jnp.geomspace(60.0, 1e5, 20)
    fit = etid.identify_impedance(frequency, np.asarray(pictures.SKIN.response(frequency)))
    with pytest.raises(ValueError, match="a measured impedance has no draws and no profiles"):
        fit.posterior()
    with pytest.raises(ValueError, match="no residual in time"):
        fit.plot(show="residual")
