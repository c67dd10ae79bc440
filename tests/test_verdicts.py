"""Every verdict is produced here, and none is silent."""

import ast
import pathlib
import re
from typing import Any

import numpy as np
import optimistix as optx
import pytest

import etid
from etid.results.verdicts import RESULTS, message
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


def part(recording, size):
    return {"v_th": recording.v_th[:size], "v_out": recording.v_out[:size]}


@pytest.mark.parametrize(
    ("change", "verdict"),
    [
        (lambda one: {}, "successful"),
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


def test_insensitive(driver):
    """A resistor has no R_p and no C_p to find."""
    resistor = simulate(ResistorLoad(328.9e3))["loaded/0"]
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
        etid.identify_driver(more, order=3)
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


def test_the_papers_method_says_how_it_fails():
    """Without noise its loop is unstable, with noise its R_s is far off."""
    found = set()
    for snr_db in (None, 60.0, 40.0, 30.0):
        of = simulate(snr_db=snr_db)
        driver = etid.identify_driver(
            of["calibration/98k8"], method="steiglitz_mcbride", throw=False
        )
        found.add(driver.verdict)
        for method in ("steiglitz_mcbride", etid.SteiglitzMcBride(iterations=1)):
            found.add(verdict_of(of["loaded/0"], driver, method=method))
    assert found >= {"max_steps_reached", "unstable", "biased", "misfit"}
    assert "successful" not in found


@pytest.mark.parametrize("name", sorted(RESULTS._name_to_item))
def test_every_failure_says_what_it_is(name):
    assert (name == "successful") == (message(name) == "")


def test_a_verdict_is_said_in_forty_words():
    own = set(vars(RESULTS)["_name_to_item"]) - set(vars(optx.RESULTS)["_name_to_item"])
    assert {name for name in own if len(message(name).split()) > 40} == set()


def test_a_test_produces_every_verdict_of_etid():
    """Expected of a real fit: what is only given to a result made by hand does not count."""
    own = set(vars(RESULTS)["_name_to_item"]) - set(vars(optx.RESULTS)["_name_to_item"])
    expected = set()
    for path in pathlib.Path(__file__).parent.rglob("test_*.py"):
        text = path.read_text("utf-8")
        if re.search(r"identify_|preflight\(|Tracker|fit_file\(", text):
            expected |= _texts(ast.parse(text))
    # The name alone, or before the text of the verdict.
    every = "\n".join(expected)
    forms = [re.compile(rf"(^|\W){name}($|[\\.:])", re.MULTILINE) for name in sorted(own)]
    assert [form.pattern for form in forms if not form.search(every)] == []


def _texts(tree):
    """Texts of a module, without those from which results are made by hand."""
    if isinstance(tree, ast.Constant):
        return {tree.value} if isinstance(tree.value, str) else set()
    if isinstance(tree, ast.Call) and ast.unparse(tree.func).endswith(("verdict", "verdicts_of")):
        return set()
    return set().union(*map(_texts, ast.iter_child_nodes(tree)))
