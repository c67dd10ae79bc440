"""Calls that are refused, each with the words that name the argument and the remedy.

A row of the table is a call and words of its message, below the error that it raises. Files have
tables of their own, beside what is read from them.
"""

import dataclasses
import re
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import etid
import etid.display
from etid.circuits.impedance import realise
from etid.identify.options import Options
from etid.plotting import figure_of
from etid.plotting.style import new_figure, save
from etid.results.driver import ContinuousDriver
from etid.results.verdicts import verdict
from etid.signals.transfer import Rational
from etid.simulation.scenes import Scene, Trial
from etid.simulation.transformer import ResistorLoad, SkinLoad
from tests import pictures

RATE = 200e3
GAIN = etid.Instrument(gain=1e-3)
# `GUESS`: the type checker of the tests comes first, so that its error is any.
REFUSED = r"""
[ValueError]
etid.identify_driver(of.calibration.replace(r_load=None))
    -> has no r_load; a calibration needs its resistor
etid.identify_driver([of.calibration, cut(of.calibration, 2000)])
    -> calibrations\[1\]: has 2000 samples, .*; the first has 10000 samples
etid.identify_driver([]) -> no calibration given
etid.identify_driver(of.calibration, order=0) -> must be a whole number from 2 to 20
etid.identify_skins([], of.driver) -> no recording
etid.identify_study(etid.Study.from_recordings([of.calibration])) -> no loaded recording
etid.identify_skin(of.skin, of.discrete) -> no continuous source
etid.identify_skin(faster(of.skin), of.driver, method='steiglitz_mcbride') -> the same sample rate
etid.identify_skin(of.skin, of.driver, circuit=etid.Resistor(), method='steiglitz_mcbride')
    -> identifies SkinRC only
etid.predict(of.skin, of.driver) -> give the circuit
skin(of, method='steiglitz_mcbride') -> steiglitz_mcbride.*from a measured current
etid.identify_skin(of.skin, of.discrete, circuit='auto', method='steiglitz_mcbride')
    -> computes no likelihood
etid.identify_skin(of.skin, of.driver, method=WITH_CURRENT) -> needs a driver and a current
etid.identify_skin(of.both, method=WITH_CURRENT) -> needs a driver and a current
samples(of, method=WITH_CURRENT) -> arrays have no current
skin(of, fixed={'r_x': 1.0}) -> 'r_x' is no element of SkinRC; its elements are r_s, r_p, c_p
skin(of, fixed={'r_s': -1.0}) -> must be positive
skin(of, prior={'r_s': (500.0, 50.0)}, fixed={'r_s': 500.0}) -> r_s is fixed and has a prior
skin(of, circuit='R0-p(R1,CPE1)', fixed={'alpha_1': 2.0}) -> alpha_1 is 2; an exponent is at most 1
skin(of, circuit='R0-p(R1,CPE1)', prior={'alpha_1': (2.0, 0.1)}) -> an exponent is at most 1
etid.identify_skin(of.alone, circuit='auto', fixed={'r_s': 33000.0})
    -> r_s is known, but ParallelRC and Resistor have no
etid.select_circuit(of.alone, fixed={'r_s': 33000.0})
    -> r_s is known, but ParallelRC and Resistor have no
skin(of, bounds={'r_s': (2000.0, 1000.0)}) -> bounds of r_s are 2000 and 1000
skin(of, bounds={'r_s': (1000.0, 1000.0)}) -> the upper one must be larger
skin(of, bounds={'r_s': (-1.0, 1000.0)}) -> must not be negative
skin(of, bounds={'r_s': (np.nan, 1000.0)}) -> bounds of r_s are nan
skin(of, bounds={'r_x': (1.0, 1000.0)}, circuit='auto') -> 'r_x' is no element of SkinRC
skin(of, bounds={'r_s': (1.0, 1000.0)}, fixed={'r_s': 5.0}) -> r_s is fixed and has bounds
skin(of, bounds={'r_s': (1.0, 1000.0)}, method='steiglitz_mcbride')
    -> 'steiglitz_mcbride' takes no known elements and no bounds
of.impedance.budget() -> a measured impedance has no budget
etid.Instrument(gain=-1e-3) -> gain
etid.Instrument(capacitance=5.0) -> \[F\]
etid.Instrument(r_load=5.0) -> relative
etid.Instrument(c_load=5.0) -> \[F\]
etid.identify_driver(of.calibration, instrument=GAIN, method='steiglitz_mcbride') -> gives none
etid.identify_driver(of.calibration, method='steiglitz_mcbride(steps=3)') -> has no such options
etid.identify_driver(of.calibration, method='steiglitz_mcbride(iterations=0)')
    -> has no such options
etid.identify_driver(of.calibration, method='steiglitz_mcbride(iterations=')
    -> has no such options
Options.of(method='proportion') -> not known; use one of maximum_likelihood
etid.register(etid.SteiglitzMcBride(iterations=3)) -> is the name of SteiglitzMcBride
etid.identify_amplitudes([of.alone], circuit=Twice()) -> 2 resistors that depend on their current
etid.identify_impedance([1.0, 2.0, 3.0], [1.0, 2.0]) -> shape
etid.identify_impedance([0.0, 2.0, 3.0], [1.0, 2.0, 3.0]) -> frequency must be
etid.identify_impedance([1.0, 2.0, 3.0], [1.0, np.nan, 3.0])
    -> 1 impedance of 3 missing or not finite
etid.identify_impedance([1.0], [1.0]) -> cannot determine 3 elements
etid.identify_impedance([1.0, 2.0, 3.0], [1.0, 0.0, 3.0]) -> impedance is 0
dataclasses.replace(of.fit, method='output_error').posterior(of.skin, of.driver)
    -> the method maximum_likelihood
of.fit.profile('cp') -> 'cp' is no element of SkinRC
dataclasses.replace(of.fit).profile('c_p') -> in fit\.profile\(recording, driver\)
of.fit.posterior(draws=0) -> at least 1
of.batch.posterior(of.skin, of.driver) -> take one of them
dataclasses.replace(of.fit, cov=np.full((3, 3), np.nan)).posterior(of.skin, of.driver)
    -> does not determine
dataclasses.replace(of.fit).posterior() -> fit\.posterior\(recording, driver\)
of.fit.intervals(1.0) -> between 0 and 1
of.fit.intervals(95.0) -> between 0 and 1
of.fit.intervals(np.nan) -> between 0 and 1
of.batch.intervals() -> take one of them
of.batch.write('fit.h5') -> take one of them
etid.Fits.read('missing.h5') -> no such file
realise(Rational(jnp.array([0.0, 0.001]), jnp.ones(1)), RATE) -> grows without bound
figure_of(of.driver, show='residual') -> it is for fits, and one of 'pulse', 'impedance'
etid.plot(of.driver, axes=new_figure(2, 2, (6.0, 5.0))[1][:1, 0]) -> 1 Axes; this picture takes 2
etid.plot(of.driver, axes=new_figure(2, 1, (6.0, 5.0))[1], size=(3.3, 3.6))
    -> size is that of a new figure
figure_of(pictures.fits(), by='session') -> by is 'session', must be two labels
figure_of(pictures.fits(), by=('session', 'day')) -> day: is no label
save(figure_of(of.driver), 'figure.pdf') -> \.png or \.svg
of.tracker.update(of.state, np.zeros((2, 3334))) -> shape \(2, 3334\).* \(2, 3333\)
of.tracker.update(of.state, of.window, -1.0) -> finite and not negative
of.tracker.update(of.state, of.window, np.nan) -> finite and not negative
of.tracker.update(of.state, of.window, np.ones(3)) -> shape \(3,\)
etid.display.Tracker.of(of.driver, of.calibration, electrodes=0) -> electrodes is 0
etid.display.Tracker.of(of.driver, of.calibration, electrodes=1, change=-1.0) -> change is -1
tracker(of, driver=pictures.as_kind(of.driver, ContinuousDriver)) -> harmonics
of.tracker.update(of_others(of), of.window) -> 1 electrode of 3 elements, the tracker 2 of 3
of.tracker.read(of_others(of)) -> 1 electrode of 3 elements, the tracker 2 of 3
of.controller.command(of_others(of), charge=8e-08) -> 1 electrode of 3 elements, the tracker 2 of 3
limited(of, current_cap=0.0) -> current_cap is 0
limited(of, charge_cap=0.0) -> charge_cap is 0
limited(of, voltage_cap=0.0) -> voltage_cap is 0
limited(of, slew=0.0) -> slew is 0
limited(of, fallback=0.0) -> fallback is 0
limited(of, probability=1.0) -> probability is 1
limited(of, current_cap=5.0) -> ampere
limited(of, current_cap=np.inf) -> ampere
limited(of, charge_cap=200.0) -> never act
limited(of, fallback=np.inf) -> infinite
etid.display.Controller.of(dataclasses.replace(of.tracker, driver_result=verdict('misfit')))
    -> driver of the tracker cannot be used
of.controller.command(of.state) -> either charge or current
of.controller.command(of.state, charge=-1e-09) -> finite and not negative
of.controller.command(of.state, current=np.ones(3)) -> shape \(3,\)
of.controller.command(of.state, charge=80.0) -> is wanted; current_cap carries
of.controller.command(of.state, current=1.0) -> is wanted; current_cap carries
of.controller.command(of.state, current=np.array([0.0001, 0.006])) -> is wanted; current_cap carries
etid.identify_study(of.study, order=1) -> order: is 1, must be
etid.identify_jointly(of.study, order=21) -> order: is 21, must be
etid.fit_file('absent.h5', 'fits.h5', order=1) -> order: is 1, must be
etid.identify_study(of.study, order='auto', method='steiglitz_mcbride')
    -> needs maximum likelihood
etid.identify_driver(of.calibration, plausible=(3e5, 3e2)) -> plausible: is \(300000\.0, 300\.0\),
etid.identify_study(of.study, plausible=(-1.0, 3e2)) -> plausible: is \(\-1\.0, 300\.0\), must be
etid.identify_jointly(of.study, plausible=(1.0, np.nan)) -> plausible: is \(1\.0, nan\), must be
etid.fit_file('absent.h5', 'fits.h5', plausible=(1.0, 1.0)) -> plausible: is \(1\.0, 1\.0\), must
etid.Instrument(drift=1.0) -> drift .* is 1\.0; it is a standard deviation \[relative\], at least
etid.Instrument(delay=1.0) -> delay .* is 1\.0; it is a standard deviation \[s\], above 0
etid.Instrument(delay=0.0) -> delay .* is 0\.0; it is a standard deviation \[s\], above 0
etid.identify_study(of.study, method='steiglitz_mcbride', instrument=GAIN) -> gives none
etid.identify_jointly(of.study, instrument=etid.Instrument(r_load=-0.1)) -> r_load .* is \-0\.1; it
etid.identify_jointly(of.study, instrument=etid.Instrument(r_load=np.nan)) -> r_load .* is nan; it
etid.identify_study(of.study, method='steiglitz_mcbride', fixed={'r_s': 1.0}) -> no known elements
etid.identify_study(of.study, circuit='R0-p(R1') -> 'R0\-p\(R1' is no circuit: it ends too early
etid.identify_skin(of.skin, circuit='R0-R0') -> has R0 twice
etid.identify_skins([of.skin], circuit='SkinRC')
    -> circuit: 'SkinRC' is a class of circuits; pass a circuit, as in etid.SkinRC\(\)
etid.identify_impedance([1.0], [1j], circuit='auto') -> cannot determine 3 elements
samples(of, circuit='R0-') -> 'R0\-' is no circuit
etid.select_circuit(of.skin, candidates=['R0', 'R1']) -> holds R0 and R1, which have the
[IdentificationError]
etid.identify_driver(of.calibration.replace(v_th=np.zeros(10_000))) -> flat
etid.identify_driver(of.calibration.replace(v_out=of.calibration.v_th)) -> unconnected
etid.identify_skin(of.both.replace(current=1000.0 * of.both.current), of.driver)
    -> current .* A, .* ohm
etid.display.Tracker.of(of.driver, cut(of.calibration, 1500), electrodes=1) -> not_periodic
[Exception]
etid.identify_driver(of.calibration, method=GUESS) -> guess
etid.identify_skin(of.skin, of.driver, method=GUESS) -> guess
etid.identify_study(of.study, method=GUESS) -> guess
etid.identify_driver(of.calibration, instrument=1e-3) -> instrument
[RecordingError]
etid.identify_skin(of.alone, circuit=etid.SkinCurrent()) -> identify_amplitudes
etid.identify_amplitudes([]) -> is empty
etid.identify_amplitudes([of.alone]) -> one amplitude.*second
etid.identify_amplitudes([of.alone, of.short]) -> recordings\[1\].*9000 samples
etid.identify_skin(of.skin) -> current: was not recorded
of.alone.v_th -> v_th: was not recorded
of.alone.replace(current=None) -> v_th: is not given.*or current
of.alone.replace(r_load=100000.0) -> v_th: is not given
of.alone.replace(v_out=None) -> v_out: is not given
[TypeError]
dataclasses.replace(of.fit).plot() -> plot\(fit, recording, driver\)
figure_of(pictures.fit()) -> plot\(fit, recording, driver\)
figure_of(pictures.selection()) -> plot\(selection, recording, driver\)
figure_of(of.driver, of.skin) -> no r_load
figure_of('recording') -> cannot draw str
figure_of(of.fit, by=('session', 'subject')) -> by is for Fits without a map
figure_of(of.fit, map='r_p') -> map is for Fits
figure_of({}) -> a dictionary of nothing
"""


@pytest.fixture(scope="module")
def of():
    """One scene and what is made from it, and results made by hand."""
    trials = (Trial("loaded/0", SkinLoad(r_s=33.4e3, r_p=186e3, c_p=0.12e-9)),)
    known = (Trial("calibration/0", ResistorLoad(98.8e3)),)
    study = Scene(trials, known, current_snr_db=40.0).simulate(seed=2)
    both, calibration = study["loaded/0"], study["calibration/0"]
    driver = etid.identify_driver(calibration, order=5)
    tracker = etid.display.Tracker.of(driver, calibration, electrodes=2)
    made = jax.tree.map(np.asarray, pictures.fit())
    alone, frequency = both.without_v_th(), np.geomspace(60.0, 1e5, 20)
    z = np.asarray(pictures.SKIN.response(jnp.asarray(frequency)))
    return types.SimpleNamespace(
        study=study,
        calibration=calibration,
        both=both,  # V_th, V_out and the current
        skin=both.replace(current=None),
        alone=alone,
        short=alone.replace(v_out=alone.v_out[:9_000], current=np.asarray(alone.current)[:9_000]),
        impedance=etid.identify_impedance(frequency, z),
        driver=driver,
        tolerant=etid.identify_driver(calibration, instrument=GAIN),
        discrete=etid.identify_driver(calibration, method="steiglitz_mcbride", throw=False),
        fit=etid.identify_skin(both.replace(current=None), driver),
        tracker=tracker,
        state=tracker.start(),
        controller=etid.display.Controller.of(tracker),
        window=np.zeros((2, tracker.model.bands.samples)),
        batch=jax.tree.map(lambda *leaves: np.stack(leaves), made, made),
    )


def cut(recording, size):
    return recording.replace(v_th=recording.v_th[:size], v_out=recording.v_out[:size])


def faster(recording):
    return recording.replace(sample_rate=2 * RATE, pulse_rate=120.0)


class Twice(etid.AbstractCircuit):
    """Two resistors that depend on their current."""

    r: float = etid.parameter("ohm", typical=1e5)
    i_0: float = etid.parameter("ampere", typical=1e-3)

    def impedance(self):
        part = etid.current_dependent_resistor(self.r, self.i_0)
        return etid.series(part, part)


def skin(of, **options):
    return etid.identify_skin(of.alone, **options)


def samples(of, **options):
    v = jnp.asarray(of.skin.v_th), jnp.asarray(of.skin.v_out)
    return etid.identify_samples(*v, of.driver, sample_rate=RATE, pulse_rate=60.0, **options)


def tracker(of, driver):
    return etid.display.Tracker.of(driver, of.calibration, electrodes=1)


def of_others(of):
    """A state of one electrode."""
    one = jax.tree.map(lambda leaf: leaf[:1], of.state.electrodes)
    return dataclasses.replace(of.state, electrodes=one)


def limited(of, **limits):
    return etid.display.Controller.of(of.tracker, **limits)


USED = cut, faster, skin, samples, tracker, of_others, limited, Twice
TAKEN = realise, figure_of, new_figure, save, ContinuousDriver, verdict, Rational, Options
NAMES = {one.__name__: one for one in (*USED, *TAKEN)} | {
    "etid": etid,
    "np": np,
    "jnp": jnp,
    "dataclasses": dataclasses,
    "pictures": pictures,
    "RATE": RATE,
    "GUESS": "guess",
    "GAIN": GAIN,
    "WITH_CURRENT": "maximum_likelihood(with_current=True)",
}
ERRORS = {
    "ValueError": ValueError,
    "TypeError": TypeError,
    "Exception": Exception,
    "RecordingError": etid.RecordingError,
    "IdentificationError": etid.IdentificationError,
}


def rows():
    error = Exception
    for row in re.sub(r"\n    ->", " ->", REFUSED).strip().splitlines():
        if row.startswith("["):
            error = ERRORS[row.strip("[]")]
            continue
        call, words = row.split(" -> ")
        yield pytest.param(call, error, words, id=call)


@pytest.mark.parametrize(("call", "error", "words"), list(rows()))
def test_a_call_that_cannot_be_right_is_refused(of, call, error, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(error, match=words):
        eval(call, NAMES | {"of": of})
    assert list(tmp_path.iterdir()) == []
