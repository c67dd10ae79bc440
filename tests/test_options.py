"""Options of a fit: the same at every public function, checked at the call, kept in files."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import etid
from etid import cli
from etid.estimators.maximum_likelihood.estimator import MaximumLikelihood
from etid.identify.options import Options
from etid.results.study_fits import StudyFits
from etid.simulation.scenes import Scene, Trial
from etid.simulation.transformer import ResistorLoad, SkinLoad

STRING = "R0-p(R1,C1)"
DRY = SkinLoad(r_s=33.4e3, r_p=186e3, c_p=0.12e-9)
KNOWN: dict[str, Any] = {
    "fixed": {"r_0": 33.4},
    "prior": {"c_1": (0.12e-6, 0.02e-6)},
    "bounds": {"r_1": (100.0, None)},
    "accept": 0.01,
}
OF_STUDY: dict[str, Any] = {"order": 4, "circuit": STRING, "plausible": (0.0, np.inf), **KNOWN}
ON_COMMAND_LINE = (
    *("--order", "4", "--circuit", STRING, "--plausible", "0:inf"),
    *("--fix", "r_0=33.4", "--prior", "c_1=1.2e-7,2e-8", "--bound", "r_1=100:"),
    *("--accept", "0.01"),
)


@pytest.fixture(scope="module")
def study():
    """Two recordings of skin, and a calibration whose resistor is given in kΩ."""
    trials = tuple(Trial(f"loaded/{number}", DRY) for number in range(2))
    scene = Scene(trials, (Trial("calibration", ResistorLoad(98.8e3)),), samples=10_000)
    recordings = [
        one.replace(r_load=98.8) if one.r_load else one
        for one in scene.simulate(seed=4).recordings()
    ]
    return etid.Study.from_recordings(recordings)


@pytest.fixture(scope="module")
def source(study, tmp_path_factory):
    path = tmp_path_factory.mktemp("options") / "study.h5"
    study.write(path)
    return path


@pytest.fixture(scope="module")
def fitted(source):
    target = source.with_name("fits.h5")
    etid.fit_file(source, target, method="maximum_likelihood", **OF_STUDY)
    return target


def stored(path):
    """The settings in a file of fits."""
    settings = StudyFits.read(path).settings
    assert settings is not None
    return settings


def test_all_functions_of_skin_take_the_same_options(study):
    """The circuit is that of the string, and each option reaches the fit."""
    driver = etid.identify_driver(study["calibration"], plausible=(0.0, np.inf))
    recording = study["loaded/0"]
    options = {"method": "maximum_likelihood", **KNOWN}
    fit = etid.identify_skin(recording, driver, circuit=STRING, **options)
    many = etid.identify_skins([recording], driver, circuit=STRING, **options)[0]
    chosen = etid.select_circuit(recording, driver, candidates=[STRING], **options).fit
    for one in (fit, many, chosen):
        assert type(one.circuit) is type(etid.circuit(STRING))
        assert one.circuit.values()[0] == pytest.approx(33.4, rel=1e-6)
        assert one.limits is not None
        assert "accept=0.01" in one.method
    np.testing.assert_array_equal(many.circuit.values(), fit.circuit.values())
    np.testing.assert_array_equal(chosen.circuit.values(), fit.circuit.values())


def test_a_circuit_string_is_its_circuit_wherever_a_circuit_is_taken(study):
    driver = etid.identify_driver(study["calibration"], plausible=(0.0, np.inf))
    recording, circuit = study["loaded/0"], etid.circuit(STRING)
    frequency = np.geomspace(1e2, 1e5, 20)
    z = np.asarray(circuit.response(jnp.asarray(frequency)))
    for of in (
        lambda one: etid.identify_impedance(frequency, z, circuit=one).circuit.values(),
        lambda one: etid.predict(recording, driver, one),
    ):
        np.testing.assert_array_equal(of("R0 - p(R1, C1)"), of(circuit))


def test_all_functions_of_studies_take_the_same_options(study, source, fitted):
    """By default no driver is accepted; each function stores what it was asked for."""
    asked = vars(stored(fitted)) | {"source": "", "source_sha256": ""}
    for found, method in (
        (etid.identify_study(study, method="maximum_likelihood", **OF_STUDY), "maximum_likelihood"),
        (etid.identify_jointly(study, **OF_STUDY), "joint"),
    ):
        assert vars(found.settings) == {**asked, "asked_method": method}
        assert found.drivers["calibration",].verdict == "successful"
    other = source.with_name("other.h5")
    command = ["fit", str(source), "-o", str(other), "--method", "maximum_likelihood"]
    assert cli.main([*command, *ON_COMMAND_LINE]) == 0
    assert vars(stored(other)) == vars(stored(fitted))
    assert not etid.identify_study(study, order=4).fits.counts().get("successful")


def test_a_tolerance_that_no_fit_would_contain_is_refused(source, tmp_path, capsys):
    target = tmp_path / "fits.h5"
    command = ["fit", str(source), "-o", str(target), "--method", "steiglitz_mcbride"]
    assert cli.main([*command, "--tolerance", "r_load=0.01"]) == 1
    assert "enter standard errors" in capsys.readouterr().err
    assert not target.exists()


def test_files_of_fits_store_the_options(fitted):
    settings = stored(fitted)
    assert settings.plausible == (0.0, np.inf)
    assert settings.accept == 0.01
    assert (settings.fixed, settings.bounds) == (("r_0 33.4",), ("r_1 above 100.0",))


@pytest.mark.parametrize("accept", [-0.01, 1.0, np.nan])
def test_a_part_of_the_signal_is_from_0_to_less_than_1(study, accept):
    with pytest.raises(ValueError, match=f"accept is {accept:g}; give the part of the signal"):
        etid.identify_study(study, accept=accept)


def test_what_a_circuit_may_leave_is_an_option_of_maximum_likelihood(study):
    """As a keyword or of the estimator; others accept nothing beyond the noise."""
    of = MaximumLikelihood(accept=0.3)
    assert Options.of(method=of).given_to(of) == of
    assert Options.of(method=of, accept=0.1).given_to(of) == MaximumLikelihood(accept=0.1)
    assert Options.of().given_to(MaximumLikelihood()) == MaximumLikelihood(accept=0.02)
    with pytest.raises(ValueError, match="'output_error' accepts nothing beyond the noise"):
        etid.identify_study(study, accept=0.1, method="output_error")
