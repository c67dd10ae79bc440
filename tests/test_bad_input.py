"""One study with everything that can be wrong in it: each mistake costs its own recording."""

from typing import Any

import h5py
import numpy as np
import pytest

import etid
from etid.simulation.scenes import Scene, Trial
from etid.simulation.transformer import ResistorLoad, SkinLoad

LENGTH = 10_000
DRY = SkinLoad(r_s=33.4e3, r_p=186e3, c_p=0.12e-9)


def _missing(group):
    del group["v_out"]


def _misnamed(group):
    group.move("v_out", "vout")


def _other_unit(group):
    group["v_th"].attrs["unit"] = "millivolt"


def _other_length(group):
    _replace(group, "v_out", group["v_out"][:-1])


def _external(group):
    del group["v_th"]
    group["v_th"] = h5py.ExternalLink("other.h5", "v_th")


def _rate_of_zero(group):
    group.attrs["sample_rate"] = 0.0


def _no_such_calibration(group):
    group.attrs["calibration"] = "calibration/nowhere"


def _nan(group):
    volts = group["v_out"][()] * 1e-4
    volts[100] = np.nan
    _replace(group, "v_out", volts)


def _flat(group):
    group["v_out"][...] = 12


def _saturated(group):
    codes = group["v_out"][()]
    group["v_out"][...] = np.minimum(codes, codes.max() // 2)
    del group.attrs["adc_range"]


def _swapped(group):
    group.move("v_th", "kept")
    group.move("v_out", "v_th")
    group.move("kept", "v_out")


def _short(group):
    for name in ("v_th", "v_out"):
        _replace(group, name, group[name][:100])


def _replace(group, name, values):
    attributes = dict(group[name].attrs)
    del group[name]
    group[name] = values
    group[name].attrs.update(attributes)


# What breaks the schema is a problem of the file, and names the field.
STRUCTURE = {
    "missing": (_missing, "v_out"),
    "misnamed": (_misnamed, "v_out"),
    "other_unit": (_other_unit, "v_th.unit"),
    "other_length": (_other_length, "v_"),
    "external": (_external, "v_th"),
    "rate_of_zero": (_rate_of_zero, "sample_rate"),
    "no_such_calibration": (_no_such_calibration, "calibration"),
}
# What is wrong with the samples is a verdict.
SAMPLES = {
    "nan": (_nan, "nonfinite_samples"),
    "flat": (_flat, "flat"),
    "saturated": (_saturated, "saturated"),
    "swapped": (_swapped, "misaligned"),
    "short": (_short, "too_short"),
}


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("bad") / "study.h5"
    names = ["good", "damaged", *STRUCTURE, *SAMPLES]
    scene = Scene(
        tuple(Trial(f"s01/{name}", DRY) for name in names),
        (Trial("calibration/98k8", ResistorLoad(98.8e3)),),
        samples=LENGTH,
    )
    scene.simulate(seed=31).write(path)
    with h5py.File(path, "r+") as content:
        for name, (change, _) in (STRUCTURE | SAMPLES).items():
            change(content[f"s01/{name}"])
        _damage(content["s01/damaged"], path)
    return path


def _damage(group, path):
    """A chunk whose checksum no longer fits, as after a bad sector."""
    codes, attributes = group["v_out"][()], dict(group["v_out"].attrs)
    del group["v_out"]
    data = group.create_dataset("v_out", data=codes, chunks=codes.shape, fletcher32=True)
    data.attrs.update(attributes)
    group.file.flush()
    offset = data.id.get_chunk_info(0).byte_offset
    group.file.close()
    with path.open("r+b") as raw:
        raw.seek(offset + 50)
        raw.write(b"\xff\x00\xff")


@pytest.fixture(scope="module")
def study(file):
    with etid.read(file) as study:
        yield study


@pytest.fixture(scope="module")
def result(study):
    return etid.identify_study(study)


def test_the_good_recording_is_not_touched_by_its_neighbours(study, result):
    """Bit for bit what it is alone with its calibration in the same call."""
    alone = etid.Study.from_recordings([study["calibration/98k8"], study["s01/good"]])
    expected = etid.identify_study(alone).fits
    fit = result.fits.take(result.fits.labels["path"] == "s01/good")
    assert fit.verdicts.tolist() == ["successful"]
    np.testing.assert_array_equal(fit.circuit.values(), expected.circuit.values())
    np.testing.assert_array_equal(fit.cov, expected.cov)


@pytest.mark.parametrize("name", STRUCTURE)
def test_what_breaks_the_schema_is_one_error_that_names_the_field(study, name):
    problem = study.problems[f"s01/{name}"]
    assert problem.path == f"s01/{name}"
    assert problem.field.startswith(STRUCTURE[name][1]) or STRUCTURE[name][1] in problem.message
    assert problem.remedy or "must be" in problem.message
    with pytest.raises(etid.RecordingError) as raised:
        study[f"s01/{name}"]
    assert raised.value is problem


@pytest.mark.parametrize("name", SAMPLES)
def test_what_is_wrong_with_samples_is_a_verdict(study, result, name):
    fits = result.fits.take(result.fits.labels["path"] == f"s01/{name}")
    assert fits.verdicts.tolist() == [SAMPLES[name][1]]
    assert fits.notes[0]
    assert np.isnan(fits.circuit.values()).all()
    driver = next(iter(result.drivers.values()))
    with pytest.raises(etid.IdentificationError, match=rf"s01/{name}.*{SAMPLES[name][1]}"):
        etid.identify_skin(study[f"s01/{name}"], driver)


def test_a_damaged_dataset_is_unreadable_and_says_where(result):
    fits = result.fits.take(result.fits.labels["path"] == "s01/damaged")
    assert fits.verdicts.tolist() == ["unreadable"]
    assert "s01/damaged" in fits.notes[0]
    assert "v_out" in fits.notes[0]


def test_every_recording_of_the_file_has_a_verdict(study, result):
    names = ["good", "damaged", *STRUCTURE, *SAMPLES]
    assert sorted(result.fits.labels["path"]) == sorted(f"s01/{name}" for name in names)
    assert sum(result.fits.verdicts == "unreadable") == len(study.problems) + 1  # and the damaged


# Arguments


@pytest.fixture(scope="module")
def calibration(study):
    return study["calibration/98k8"]


@pytest.fixture(scope="module")
def driver(result):
    return next(iter(result.drivers.values()))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"r_load": None}, "has no r_load; a calibration needs its resistor"),
        ({"v_th": np.zeros(LENGTH)}, "flat"),
    ],
)
def test_a_calibration_that_is_none_is_refused(calibration, change, message):
    with pytest.raises((ValueError, etid.IdentificationError), match=message):
        etid.identify_driver(calibration.replace(**change))


def test_calibrations_must_be_alike(calibration):
    shorter = calibration.replace(v_th=calibration.v_th[:2000], v_out=calibration.v_out[:2000])
    with pytest.raises(ValueError, match=r"differ in \(samples, sample rate, pulse rate\)"):
        etid.identify_driver([calibration, shorter])
    with pytest.raises(ValueError, match="no calibration given"):
        etid.identify_driver([])


@pytest.mark.parametrize("order", [1, 0, -1])
def test_an_order_below_two_is_refused(calibration, order):
    with pytest.raises(ValueError, match="must be a whole number from 2 to 20"):
        etid.identify_driver(calibration, order=order)


def test_an_unknown_method_is_refused_everywhere(study, calibration, driver):
    unknown: Any = "guess"
    for call in (
        lambda: etid.identify_driver(calibration, method=unknown),
        lambda: etid.identify_skin(study["s01/good"], driver, method=unknown),
        lambda: etid.identify_skins([study["s01/good"]], driver, method=unknown),
        lambda: etid.identify_study(study, method=unknown),
    ):
        with pytest.raises(Exception, match="guess"):  # the type checker of the tests comes first
            call()


def test_nothing_to_identify_is_said(calibration, driver):
    with pytest.raises(ValueError, match="no recording"):
        etid.identify_skins([], driver)
    with pytest.raises(ValueError, match="no loaded recording"):
        etid.identify_study(etid.Study.from_recordings([calibration]))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"sample_rate": 0.0}, "sample_rate: is 0 hertz, must be > 0"),
        ({"v_out": np.zeros(3)}, "numbers of samples differ"),
        ({"r_load": -1.0}, "r_load"),
    ],
)
def test_a_wrong_recording_cannot_be_made(study, fields, message):
    with pytest.raises(etid.RecordingError, match=message):
        study["s01/good"].replace(**fields)
