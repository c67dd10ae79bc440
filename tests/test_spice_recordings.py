"""Recordings made by ngspice, another program, from a transformer that is no rational filter.

Import, driver, skins, verdicts: the way a laboratory's file takes. The truth is in `truth.json`.
All scenes here have one length, so that every function compiles once.
"""

import functools
import json

import numpy as np
import pytest

import etid
from benchmarks.spice import mapping_of
from etid.estimators.registry import Method

ELEMENTS = {"r_s": "Rs", "r_p": "Rp", "c_p": "Cp", "r": "R"}
# DESIGN's; discretisation by Tustin's rule would cost 8.8 % of C_p.
SKIN_BIAS = {"maximum_likelihood": 5e-4, "output_error": 2e-3}
RESISTOR_BIAS = 1e-3  # DESIGN: Table I, where the paper reaches 0.25 to 12.2 %
SIGMAS = 5.0  # one in 2 million for one normal error, of which there are about 200 below
MEAN_SIGMAS = 3.0  # the means are 4 numbers per scene: one in 100 that any exceeds it by chance


@pytest.fixture(scope="module")
def spice(reference_data, tmp_path_factory):
    """Fits a scene by its name; returns the result and the true elements (fit, element)."""
    folder = reference_data("spice_recordings")
    truth = json.loads((folder / "truth.json").read_text())["scenes"]
    work = tmp_path_factory.mktemp("spice")

    @functools.cache
    def fitted(name, method: Method | None = None):
        file = work / f"{name}.h5"
        if not file.exists():
            source = folder / f"{name}.npz"
            etid.import_file(source, file, mapping_of(source))
        trials = [trial["elements"] for trial in truth[name]["trials"]]
        circuit = etid.Resistor() if "R" in trials[0] else etid.SkinRC()
        with etid.read(file) as study:
            result = etid.identify_study(study, circuit=circuit, method=method)
        numbers = [int(path.rsplit("/", 1)[1]) for path in result.fits.labels["path"]]
        assert numbers == list(range(len(trials)))
        true = [[trial[ELEMENTS[element]] for element in circuit.names()] for trial in trials]
        return result, np.array(true)

    return fitted


def errors(result, true):
    """Errors, their standard errors and the part of these that all trials share, relative."""
    fits = result.fits
    shared = np.diagonal(np.asarray(fits.fit.shared_cov), axis1=1, axis2=2)
    return (
        np.asarray(fits.circuit.values()) / true - 1,
        np.asarray(fits.stderr.values()) / true,
        np.sqrt(shared) / true,
    )


@pytest.mark.parametrize(
    ("name", "method"),
    [
        ("clean_dry", "maximum_likelihood"),
        ("clean_damp", "maximum_likelihood"),
        # A circuit and lengths of their own, which compile for long.
        pytest.param("clean_resistors", "maximum_likelihood", marks=pytest.mark.slow),
        # One pulse, below, is by output error too; these compile for a minute.
        pytest.param("clean_dry", "output_error", marks=pytest.mark.slow),
        pytest.param("clean_damp", "output_error", marks=pytest.mark.slow),
        pytest.param("clean_resistors", "output_error", marks=pytest.mark.slow),
    ],
)
def test_without_noise_the_elements_are_those_of_the_netlist(spice, reference_data, name, method):
    result, true = spice(name, method)
    assert set(result.fits.verdicts) == {"successful"}, (result.failures, result.fits.counts())
    limit = RESISTOR_BIAS
    if name != "clean_resistors":
        # What is left is rounding to 16 bits, of which a record is one draw: it scatters by the
        # bound, up to 0.06 %.
        folder = reference_data("spice_recordings")
        of_scene = json.loads((folder / "truth.json").read_text())["scenes"][name]
        limit = SKIN_BIAS[method] + np.array(
            [trial["crb_rel_with_delays"] for trial in of_scene["trials"]]
        )
    assert (np.abs(errors(result, true)[0]) < limit).all()


@pytest.mark.parametrize("name", ["lab_built", "paper_noise_built", "jitter_dry", "jitter_damp"])
def test_trials_and_their_mean_are_within_their_errors(spice, name):
    """23 trials at 60 and at 30 dB; 12 whose two records were triggered 50 ns rms apart."""
    result, true = spice(name)
    assert set(result.fits.verdicts) == {"successful"}, (result.failures, result.fits.counts())
    error, stderr, shared = errors(result, true)
    assert (np.abs(error) < SIGMAS * stderr).all()
    # The driver's error does not average out, and no spread between trials shows it.
    own = stderr**2 - shared**2
    assert (own > 0).all()
    of_mean = np.sqrt(own.mean(0) / len(own) + (shared**2).mean(0))
    assert (np.abs(error.mean(0)) < MEAN_SIGMAS * of_mean).all()
    if name == "lab_built":
        # The ratio of 22 degrees of freedom scatters by 1/sqrt(44); 4 of these on either side.
        scatter = error.std(0, ddof=1) / np.sqrt(own.mean(0))
        assert (np.abs(scatter - 1) < 4 / np.sqrt(2 * (len(error) - 1))).all()


def test_a_clipped_calibration_is_refused_and_costs_its_trials(spice):
    result, _ = spice("clipped_dry")
    assert list(result.failures) == [("calibration/0",)]
    assert "saturated" in result.failures["calibration/0",]
    assert result.fits.counts() == {"driver_failed": 2}
    assert all("saturated" in note for note in result.fits.notes)
    assert np.isnan(np.asarray(result.fits.circuit.values())).all()
