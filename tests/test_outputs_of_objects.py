"""What `print` and a notebook show of every public object, and what errors say in Python."""

import inspect
import pathlib

import jax.numpy as jnp
import numpy as np
import pytest

import etid
import etid.display
from benchmarks.specimens import study_fits
from tests import pictures, printed

EXAMPLE = pathlib.Path(__file__).parents[1] / "data_schema" / "example.h5"
FREQUENCY = np.geomspace(100.0, 1e5, 25)

# Name of the stored text, whether its numbers come from fits, and the expressions.
OUTPUTS = {
    "study": (False, [
        "study",
        "study['typical/dry/01']",
        "study['calibration/98k8']",
        "study['typical/dry/01'].samples['v_out']",
        "study.where(condition='damp')",
        "study.where(condition='wet')",
        "empty",
    ]),
    "driver": (True, ["driver", "driver.calibration", "driver.result", "failed_driver"]),
    "one_fit": (True, [
        "fit",
        "fit.circuit",
        "fit.stderr",
        "fit.intervals()",
        "fit.verdict",
        "fit.result",
        "misfit",
        "etid.RESULTS",
        "fit.posterior(study['typical/dry/01'], driver, draws=200, seed=1)",
        "fit.profile('r_p', study['typical/dry/01'], driver)",
        "fit.residual()",
        "misfit.residual()",
        "fit.report()",
        "fit.params",
        "etid.compare({'dry': fit}, study.where(condition='dry'))",
        "fit.write",
    ]),
    "fits": (False, [
        "fits",
        "fits[0]",
        "fits.usable",
        "fits.counts()",
        "fits.where(condition='wet')",
        "fits.circuit",
        "fits.stderr",
        "study_fits",
        "etid.variation(fits, 'r_p', by=('subject',))",
    ]),
    "circuits": (False, [
        "etid.SkinRC(33.4e3, 186e3, 0.12e-9)",
        "etid.SkinRC",
        "etid.SkinCole(33.4e3, 186e3, 22e-6, 0.85)",
        "etid.SkinLayers(33.4e3, 186e3, 0.12e-9, 50e3, 2e-9)",
        "etid.SkinWarburg(33.4e3, 186e3, 1e-9)",
        "etid.ParallelRC(186e3, 0.12e-9)",
        "etid.Resistor(98.8e3)",
        "etid.SkinCurrent()",
        "etid.circuit('R0-p(R1,C1)')",
        "etid.circuit_string(etid.SkinRC(33.4e3, 186e3, 0.12e-9))",
        "etid.netlist(etid.SkinRC(33.4e3, 186e3, 0.12e-9))",
        "etid.SkinRC(33.4e3, 186e3, 0.12e-9).response(1e3)",
        "etid.circuit('SkinCoel')",
        "etid.circuit('R0-p(R1,C1')",
        "etid.circuit('R0 + R1')",
    ]),
    "spectrum": (True, [
        "etid.identify_impedance(frequency, z)",
        "etid.identify_impedance(frequency, z, stderr=0.01 * abs(z))",
        "etid.identify_impedance(frequency, spread)",
        "etid.identify_impedance(frequency, spread, circuit='auto')",
        "etid.identify_impedance(frequency, z).residual()",
        "etid.identify_impedance(frequency, z, prior={'r_s': (33e3, 500.0)}).profile('r_s')",
        "etid.identify_impedances({'dry': (frequency, z), 'damp': (frequency[:2], z)})",
        "etid.kramers_kronig(frequency, z)",
        "etid.kramers_kronig(frequency, z, stderr=0.01 * abs(z))",
    ]),
    "selection": (True, ["selection", "selection.candidates[0]"]),
    "calibrated": (True, ["etid.calibrate(study['calibration/98k8'])"]),
    "tolerances": (True, [
        "etid.Instrument(gain=1e-3, drift=0.01)",
        "etid.Instrument()",
        "fit.budget(study['typical/dry/01'], driver)",
    ]),
    "scenes": (False, [
        "etid.scenes.paper_dry()",
        "etid.scenes.paper_dry().trials[0]",
        "layout",
        "etid.bound(etid.scenes.paper_dry())['typical/dry/01']",
        "etid.bound(etid.scenes.paper_dry())",
    ]),
    "display": (True, [
        "tracker",
        "tracker.start()",
        "tracker.read(tracker.start())",
        "controller",
        "controller.command(tracker.start(), charge=80e-9)",
        "after",
        "tracker.changes(after)",
        "controller.command(after, charge=80e-9)",
    ]),
    "arrays": (False, [
        "etid.Filter.of(np.array([0.5, 0.3]), np.array([1.0, -1.5, 0.7]))",
        "etid.Filter.of(np.array([0.5]), np.array([1.0, -1.5]), 2e5)",
        "etid.Filter.bilinear(etid.SkinRC(33.4e3, 186e3, 0.12e-9), 200e3)",
        "likelihood",
        "etid.driver_of_response(frequency, z, sample_rate=2e5, order=1)",
        "etid.driver_of_response(frequency, z[:-1], sample_rate=2e5)",
        "etid.driver_of_response(frequency[:3], z[:3], sample_rate=2e5)",
        "etid.steiglitz_mcbride(quiet, quiet[:-1], 2)",
    ]),
    "estimators": (False, [
        "etid.MaximumLikelihood()",
        "etid.OutputError()",
        "etid.SteiglitzMcBride()",
        "etid.SteiglitzMcBride(iterations=3)",
    ]),
    "errors": (False, [
        "etid.read('absent.h5')",
        "study['typical/dry/1']",
        "study.where(conditon='dry')",
        "etid.identify_driver(study['typical/dry/01'])",
        "etid.identify_driver(study['calibration/98k8'], order=0)",
        "etid.identify_driver(study['calibration/98k8'], method='ml')",
        "etid.identify_skin(study['typical/dry/01'])",
        "etid.identify_skin(study['typical/dry/01'], driver, circuit='SkinCol')",
        "etid.identify_skin(study['typical/dry/01'], driver, fixed={'rs': 1e3})",
        "etid.identify_skin(study['typical/dry/01'], driver, bounds={'r_s': (2.0, 1.0)})",
        "etid.identify_skin(study['typical/dry/01'], failed_driver)",
        "etid.identify_skin(study['typical/dry/01'].replace(v_out=1e-3 * quiet), driver)",
        "etid.identify_skins([], driver)",
        "etid.identify_impedance(frequency, z[:-1])",
        "etid.identify_impedance(frequency, z, stderr=[1.0, 2.0])",
        "etid.identify_study(empty)",
        "etid.Recording(v_th=quiet, v_out=quiet[:-1], sample_rate=2e5, pulse_rate=60.0)",
        "etid.Recording(v_th=quiet, v_out=quiet, sample_rate=-1.0, pulse_rate=60.0)",
        "etid.Recording(v_th=[quiet], v_out=[quiet], sample_rate=2e5, pulse_rate=60.0)",
        "etid.SkinRC(r_s=-1.0, r_p=1e5, c_p=1e-9)",
        "etid.SkinRC(33e3, 186e3)",
        "etid.Instrument(gain=-1e-3)",
        "etid.Instrument(capacitance=5.0)",
        "etid.Fits.read('absent.h5')",
        "etid.variation(fits, 'rp', by=('subject',))",
        "fit.intervals(95.0)",
        "fits.summary('day')",
        "etid.plot(fits, by='day')",
        "etid.display.Controller.of(tracker, charge_cap=-1.0)",
        "tracker.update(tracker.start(), np.zeros((2, 10)))",
        "etid.read_layout('absent.csv')",
    ]),
}  # fmt: skip
# Public classes of which nobody has an object to print, and why.
NOT_SHOWN = {
    "AbstractCircuit": "abstract",
    "AbstractEstimator": "abstract",
    "IdentificationError": "an error, among the others",
    "RecordingError": "an error, among the others",
}


@pytest.fixture(scope="module")
def names():
    """What the expressions use."""
    study = etid.read(EXAMPLE)
    recording, calibration = study["typical/dry/01"], study["calibration/98k8"]
    driver = etid.identify_driver(calibration, order=5)
    z = np.asarray(etid.SkinRC(33.4e3, 186e3, 0.12e-9).response(jnp.asarray(FREQUENCY)))
    spread = np.asarray(etid.SkinCole(33.4e3, 186e3, 22e-6, 0.85).response(jnp.asarray(FREQUENCY)))
    noise = np.random.default_rng(0).normal(size=(2, FREQUENCY.size)).T @ [1.0, 1j]
    tracker = etid.display.Tracker.of(driver, calibration, electrodes=2)
    state = tracker.start()
    pulse = recording.v_out[: tracker.model.bands.samples]
    for _ in range(2):
        state = tracker.update(state, np.stack([pulse, pulse]), np.ones(2))
    by_hand = study_fits()
    return {
        "etid": etid,
        "np": np,
        "study": study,
        "empty": study.where(condition="wet"),
        "driver": driver,
        "failed_driver": etid.identify_driver(
            calibration.replace(r_load=98.8), order=5, throw=False
        ),
        "fit": etid.identify_skin(recording, driver),
        "misfit": etid.identify_skin(
            recording.replace(v_out=0.9 * recording.v_out), driver, throw=False
        ),
        "likelihood": etid.Likelihood.of(
            recording.v_th, recording.v_out, driver, sample_rate=200e3, pulse_rate=60.0
        ),
        "fits": by_hand.fits,
        "study_fits": by_hand,
        "selection": etid.select_circuit(recording, driver),
        "frequency": FREQUENCY,
        "z": z * (1 + 0.01 * noise),
        "spread": spread * (1 + 0.001 * noise),
        "quiet": np.random.default_rng(1).normal(size=10_000),
        "tracker": tracker,
        "controller": etid.display.Controller.of(tracker, charge_cap=120e-9),
        "after": state,
        "layout": pictures.FINGERTIP,
    }


@pytest.mark.parametrize("name", OUTPUTS)
def test_what_print_shows(name, names):
    fitted, expressions = OUTPUTS[name]
    shown = printed.masked(printed.session(expressions, names), EXAMPLE.parent)
    printed.check(name, shown, fitted=fitted)


def test_what_a_notebook_shows(names):
    shown = {
        one: page._repr_html_()
        for _, expressions in OUTPUTS.values()
        for one in expressions
        if hasattr(page := printed.value(one, names), "_repr_html_") and not inspect.isclass(page)
    }
    text = "\n\n".join(f"# {one}\n{printed.of_page(page)}" for one, page in shown.items())
    printed.check("notebook", printed.masked(text, EXAMPLE.parent), fitted=True)


def test_every_public_class_is_among_them(names):
    named = {name: getattr(of, name) for of in (etid, etid.display) for name in of.__all__}
    classes = {name: of for name, of in named.items() if inspect.isclass(of)}
    values = [
        printed.value(one, names) for _, expressions in OUTPUTS.values() for one in expressions
    ]
    shown = {name for name in classes for one in values if isinstance(one, classes[name])}
    assert classes.keys() - shown <= NOT_SHOWN.keys()
