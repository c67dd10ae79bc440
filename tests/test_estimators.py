"""An estimator is a class: one of one's own is a class and a line, options are fields."""

import dataclasses
import html

import jax.numpy as jnp
import numpy as np
import pytest

import etid
from etid.circuits.circuit import Resistor
from etid.estimators import registry
from etid.estimators.estimator import AbstractEstimator, Description
from etid.estimators.lanes import AlignedSamples
from etid.identify.options import Options
from etid.report.methods import methods_section
from etid.results.driver import DiscreteDriver, Driver
from etid.results.fit import Fit
from etid.results.study_fits import StudyFits
from etid.results.verdicts import verdict
from etid.simulation.scenes import Scene, Trial
from etid.simulation.transformer import ResistorLoad, SkinLoad

R_LOAD = 98.8e3


@dataclasses.dataclass(frozen=True)
class Proportion(AbstractEstimator):
    """V_out in proportion to V_th, as if Z_th and the load were resistors."""

    name = "proportion"
    lane = AlignedSamples
    driver = Driver

    offset: bool = True

    def ratio(self, m):
        x, y = (v - v.mean(-1, keepdims=True) if self.offset else v for v in (m.v_th, m.v_out))
        return jnp.sum(x * y, -1) / jnp.sum(x * x, -1)

    def fit_driver(self, records, r_load, order, instrument):
        r_th = jnp.mean(r_load * (1 / self.ratio(records) - 1))
        nothing, one = jnp.asarray(0.0), jnp.asarray(1.0)
        return DiscreteDriver(
            b=r_th[None], a=one[None], sample_rate=records.sample_rate[0], rrse=nothing, chi2=one,
            result=verdict("successful"),
            steps=jnp.asarray(0), method=str(self),
        )  # fmt: skip

    def fit_load(self, lane, driver, known, circuit):
        gain = self.ratio(lane.measure())
        found = circuit.with_log_values(jnp.log(driver.b * gain / (1 - gain)))
        variance = 1e-4 * found.values()[:, None] ** 2
        zero, one = jnp.asarray(0.0), jnp.asarray(1.0)
        return Fit(
            circuit=found, cov=variance, shared_cov=zero * variance, rrse=zero, chi2=one,
            result=verdict("successful"), steps=jnp.asarray(1), method=str(self),
        )  # fmt: skip

    def describe(self):
        kept = "taken out" if self.offset else "kept"
        return Description(
            words="proportion",
            text=f"The load was estimated by the proportion of both voltages, the mean {kept}.",
            errors="are one per cent",
        )


@pytest.fixture
def _registered(monkeypatch):
    monkeypatch.setattr(registry, "_ESTIMATORS", dict(registry._ESTIMATORS))
    etid.register(Proportion())


@pytest.fixture(scope="module")
def study():
    trials = tuple(Trial(f"loaded/{i}", SkinLoad(33.4e3, 186e3, 0.12e-9)) for i in range(3))
    known = (Trial("calibration/0", ResistorLoad(R_LOAD)),)
    return Scene(trials, known, samples=3334, snr_db=60.0).simulate(seed=1)


@pytest.mark.usefixtures("_registered")
def test_an_estimator_of_ones_own_goes_all_the_way(study, tmp_path):
    options = {"circuit": Resistor(), "method": "proportion"}
    driver = etid.identify_driver(study["calibration/0"], method="proportion")
    fit = etid.identify_skin(study["loaded/0"], driver, **options)
    known, loaded = (
        np.polyfit(study[path].v_th, study[path].v_out, 1)[0]
        for path in ("calibration/0", "loaded/0")
    )
    expected = R_LOAD * (1 / known - 1) / (1 / loaded - 1)
    np.testing.assert_allclose(fit.circuit.values()[0], expected, rtol=1e-9)
    fits = etid.identify_skins(study.loaded, driver, **options)
    assert fits.fit.method == "proportion"
    assert fits.counts() == {"successful": 3}
    np.testing.assert_allclose(fits.circuit.r[0], expected, rtol=1e-9)
    study.write(tmp_path / "study.h5")
    found = etid.fit_file(tmp_path / "study.h5", tmp_path / "fits.h5", **options)
    np.testing.assert_allclose(found.fits.circuit.r[0], expected, rtol=1e-9)
    etid.write_report(tmp_path / "fits.h5", tmp_path / "page.html")
    page = html.unescape((tmp_path / "page.html").read_text("utf-8"))
    assert "identified as Resistor by proportion." in page
    assert "The load was estimated by the proportion of both voltages, the mean taken out." in page
    assert "at the minimum, and are one per cent." in page


@pytest.mark.usefixtures("_registered")
def test_options_are_fields_which_fits_and_their_methods_section_keep(study):
    """Two with other options are two methods, also in the name that a file holds."""
    asked = Proportion(offset=False)
    driver = etid.identify_driver(study["calibration/0"], method=asked)
    fits = etid.identify_skins(study.loaded, driver, circuit=Resistor(), method=asked)
    assert fits.fit.method == "proportion(offset=False)"
    assert registry.named(fits.fit.method) == asked
    assert "the mean kept" in methods_section(StudyFits(fits, {}, {})).details
    usual = etid.identify_skins(study.loaded, driver, circuit=Resistor(), method="proportion")
    both = etid.Fits.concatenate([fits, usual])
    assert both.fit.method == "proportion + proportion(offset=False)"
    text = methods_section(StudyFits(both, {}, {})).details
    assert "the mean kept" in text
    assert "the mean taken out" in text


def test_the_instance_of_a_name_is_the_same_method(study):
    assert Options.of(method="steiglitz_mcbride").estimator == etid.SteiglitzMcBride()
    first = etid.SteiglitzMcBride(iterations=1)
    driver = etid.identify_driver(study["calibration/0"], method=first, throw=False)
    assert driver.method == str(first) == "steiglitz_mcbride(iterations=1)"
    records = [study[path] for path in study.loaded]
    few = etid.SteiglitzMcBride(iterations=3)
    fits = etid.identify_skins(records, driver, method=few)
    assert fits.fit.method == str(few) == "steiglitz_mcbride(iterations=3)"
    assert int(np.max(fits.fit.steps)) < 3
    assert "by at most 3 iterations" in methods_section(StudyFits(fits, {}, {})).details
