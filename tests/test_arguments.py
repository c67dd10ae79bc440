"""Arguments of wrong types: one error of etid's own, which names the argument and the remedy."""

import subprocess
import sys

import numpy as np
import pytest

import etid
import etid.display
from benchmarks.specimens import study_fits
from etid.identify import arguments

# The tests' own type checker would come first; a process of its own has none.
CALLS = """
import jax; jax.config.update("jax_enable_x64", True)
import numpy as np, etid.display
from benchmarks.specimens import study_fits
v = np.ones(1000)
rec = etid.Recording(v, v, sample_rate=2e5, pulse_rate=60.0)
cal = rec.replace(r_load=1e5)
of_current = etid.Recording(v_out=v, current=v, sample_rate=2e5, pulse_rate=60.0)
study = etid.Study.from_recordings([cal, rec])
fits = study_fits()
d = fits.drivers["calibration/0",]
calls = {
    'etid.identify_driver(cal, order="5")': "order",
    "etid.identify_driver(cal, order=2.5)": "order",
    "etid.identify_driver(cal, order=True)": "order",
    "etid.identify_driver(cal, order=10**6)": "order",
    "etid.identify_driver(v)": "calibrations[0]",
    "etid.identify_driver(None)": "calibrations",
    "etid.identify_driver('study.h5')": "calibrations",
    "etid.identify_driver(cal, method=3)": "method",
    "etid.identify_skin(rec, None)": "current",
    "etid.identify_skin(v, d)": "recording",
    "etid.identify_skin('study.h5', d)": "recording",
    "etid.identify_skin(rec, etid.Driver)": "driver",
    "etid.identify_skin(rec, d, circuit=etid.SkinRC)": "circuit",
    "etid.identify_skin(rec, d, circuit='SkinRC')": "circuit",
    "etid.identify_skins(v, d)": "recordings[0]",
    "etid.identify_skins(rec, d)": "recordings",
    "etid.identify_skins([rec, None], d)": "recordings[1]",
    "etid.identify_skins([rec], None)": "current",
    "etid.identify_study('study.h5')": "study",
    "etid.identify_study(study, order=None)": "order",
    "etid.identify_study(study, circuit=etid.Resistor)": "circuit",
    "etid.identify_jointly(None)": "study",
    "etid.identify_jointly(study, order='5')": "order",
    "etid.fit_file('study.h5', 'fits.h5', order='5')": "order",
    "etid.fit_file('study.h5', 'fits.h5', circuit=etid.SkinRC)": "circuit",
    "etid.select_circuit(rec, None)": "current",
    "etid.select_circuit(v, d)": "recording",
    "etid.select_circuit(rec, d, candidates=[])": "candidates",
    "etid.select_circuit(rec, d, candidates='auto')": "candidates",
    "etid.select_circuit(rec, d, candidates=etid.SkinRC())": "candidates",
    "etid.select_circuit(rec, d, candidates=[etid.SkinRC(), 3])": "candidates[1]",
    "etid.select_circuit(rec, d, candidates=[etid.SkinRC])": "candidates[0]",
    "etid.select_circuit(rec, d, candidates=[etid.SkinRC(), etid.SkinRC()])": "candidates",
    "etid.bound(study)": "scene",
    "etid.compare(fits.fits[0], fits.fits[0])": "recordings",
    "etid.bound(None)": "scene",
    "etid.predict(v, d)": "recording",
    "etid.predict(rec, None, etid.SkinRC())": "current",
    "etid.predict(rec, d, etid.SkinRC)": "circuit",
    "etid.identify_samples(v, v, None, sample_rate=2e5, pulse_rate=60.0)": "driver",
    "etid.identify_skin(rec, d, fixed=['r_s'])": "fixed",
    "etid.identify_skin(rec, d, prior='r_s=1')": "prior",
    "etid.identify_skin(rec, d, fixed={'r_s': '5k'}, prior={'r_p': (1e5, 1e4)})": "fixed['r_s']",
    "etid.identify_skin(rec, d, fixed={'r_s': 500.0}, prior={'r_p': 1e5})": "prior['r_p']",
    "etid.identify_skin(rec, d, prior={'r_s': (1e3, 'a'), 'r_p': (1e5, 1e4)})": "prior['r_s']",
    "etid.identify_impedance([1.0, 2.0], [1.0, 1.0], fixed={'r_s': '5k'})": "fixed['r_s']",
    "etid.identify_skin(rec, d, circuit='R_0-p(R_1,X_1)')": "circuit",
    "etid.identify_skin(rec, d, circuit='SkinCole')": "circuit",
    "etid.identify_impedances([(v, v)])": "spectra",
    "etid.identify_driver([cal, cal])": "calibrations[1]",
    "etid.identify_amplitudes([of_current, of_current])": "recordings[1]",
    "etid.display.Tracker.of(None, cal, electrodes=2)": "driver",
    "etid.display.Tracker.of(d, v, electrodes=2)": "unloaded",
    "etid.display.Tracker.of(d, of_current, electrodes=2)": "v_th",
    "etid.display.Tracker.of(d, cal, electrodes='98')": "electrodes",
    "etid.display.Tracker.of(d, cal, electrodes=2, change='slow')": "change",
    "etid.display.Controller.of(d)": "tracker",
    "study.where(subject=1.5)": "subject",
    "study[0]": "path",
    "fits.fits.where(subjct='s01')": "subjct",
    "fits.fits.where(subject=['s01'])": "subject",
}
for call, field in calls.items():
    try:
        eval(call)
    except Exception as error:
        print(call, type(error).__name__, getattr(error, "field", ""), error, sep="\\t")
        assert isinstance(error, ValueError), call
        assert getattr(error, "field", "method") == field, call
        assert "\\n" not in str(error) and len(str(error)) < 300, call
    else:
        raise AssertionError(call)
"""


def test_wrong_types_are_errors_of_our_own_that_name_the_argument():
    done = subprocess.run(
        [sys.executable, "-c", CALLS], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_a_class_in_place_of_its_instance_is_told_apart():
    with pytest.raises(etid.RecordingError) as caught:
        arguments.require("circuit", etid.SkinRC, etid.AbstractCircuit)
    assert str(caught.value) == (
        "circuit: is the class SkinRC, must be of type AbstractCircuit. Pass an instance, SkinRC()."
    )


@pytest.mark.parametrize("value", ["5 mA", None, [1.0, 2.0], 1j])
def test_what_is_no_number_is_refused(value):
    with pytest.raises(etid.RecordingError, match=r"current_cap: is .*, must be a number\. Give"):
        arguments.number_of("current_cap", value)
    assert arguments.number_of("current_cap", np.float32(0.5)) == 0.5


def test_labels_choose_fits_as_text_or_integer():
    fits = study_fits().fits
    assert len(fits.where(trial=3)) == len(fits.where(trial="3")) == 1
    with pytest.raises(etid.RecordingError, match="subjct: is no label, did you mean subject"):
        fits.where(subjct="s01")
