"""One study with much that can be wrong in it: each mistake costs its own recording.

Every rule of the schema is broken in `test_hdf5`, every verdict is produced in `test_verdicts`.
"""

import h5py
import numpy as np
import pytest

import etid
from etid.simulation.scenes import Scene, Trial
from etid.simulation.transformer import ResistorLoad, SkinLoad

DRY = SkinLoad(r_s=33.4e3, r_p=186e3, c_p=0.12e-9)


def _misnamed(group):
    group.move("v_out", "vout")


def _nan(group):
    volts = group["v_out"][()] * 1e-4
    volts[100] = np.nan
    _replace(group, "v_out", volts)


def _flat(group):
    group["v_out"][...] = 12


def _short(group):
    for name in ("v_th", "v_out"):
        _replace(group, name, group[name][:100])


def _replace(group, name, values):
    attributes = dict(group[name].attrs)
    del group[name]
    group[name] = values
    group[name].attrs.update(attributes)


CHANGES = {
    "misnamed": (_misnamed, "unreadable"),
    "nan": (_nan, "nonfinite_samples"),
    "flat": (_flat, "flat"),
    "short": (_short, "too_short"),
}
VERDICTS = {name: verdict for name, (_, verdict) in CHANGES.items()}
VERDICTS |= {"good": "successful", "damaged": "unreadable"}


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    path = tmp_path_factory.mktemp("bad") / "study.h5"
    trials = tuple(Trial(f"s01/{name}", DRY) for name in VERDICTS)
    Scene(trials, (Trial("calibration/98k8", ResistorLoad(98.8e3)),)).simulate(seed=31).write(path)
    with h5py.File(path, "r+") as content:
        for name, (change, _) in CHANGES.items():
            change(content[f"s01/{name}"])
        _damage(content["s01/damaged"], path)
    with etid.read(path) as study:
        yield study


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
def fits(study):
    return etid.identify_study(study).fits


def test_every_recording_of_the_file_has_its_verdict_and_a_note(study, fits):
    paths = fits.labels["path"].tolist()
    found = dict(zip(paths, fits.verdicts.tolist(), strict=True))
    assert found == {f"s01/{name}": verdict for name, verdict in VERDICTS.items()}
    for path, note, circuit in zip(paths, fits.notes, np.asarray(fits.circuit.r_p), strict=True):
        assert bool(note) == np.isnan(circuit) == (path != "s01/good")
    assert list(study.problems) == ["s01/misnamed"]  # the damage is seen when the samples are read
    note = fits.notes[paths.index("s01/damaged")]
    assert "s01/damaged" in note
    assert "v_out" in note


def test_the_good_recording_is_not_touched_by_its_neighbours(study, fits):
    """Bit for bit what it is alone with its calibration in the same call."""
    alone = etid.Study.from_recordings([study["calibration/98k8"], study["s01/good"]])
    expected = etid.identify_study(alone).fits
    fit = fits.take(fits.labels["path"] == "s01/good")
    np.testing.assert_array_equal(fit.circuit.values(), expected.circuit.values())
    np.testing.assert_array_equal(fit.cov, expected.cov)
