"""Batches: chunks, lengths, rates and drivers mixed; every recording gets its own answer."""

import dataclasses
import pickle
from typing import Any

import equinox as eqx
import h5py
import jax
import numpy as np
import pytest

import etid
from etid.identify import fitting
from etid.identify.options import Options
from etid.recordings.hdf5 import read_with_driver
from etid.recordings.preflight import Inspected
from etid.results.fit import Limited
from etid.results.instrument import BUDGETED, Effects
from etid.simulation.scenes import Scene, Trial
from etid.simulation.transformer import ResistorLoad
from tests.skins import DRY, off

LENGTH = 10_000
SIGMAS = 5.0  # one in 2 million for a normal error, which the coverage test measures
FEW = 16  # lanes of a call, so that few recordings need several calls
MANY = FEW + 2


def simulate(count=1, calibrations=1, seed=0, samples=LENGTH, **options):
    scene = Scene(
        tuple(Trial(f"s01/dry/{i}", DRY, subject="s01", condition="dry") for i in range(count)),
        tuple(Trial(f"calibration/{i}", ResistorLoad(98.8e3)) for i in range(calibrations)),
        samples=samples,
        **options,
    )
    return scene.simulate(seed=seed)


@pytest.fixture(scope="module", autouse=True)
def several_calls():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fitting, "LANES", FEW)
        yield


@pytest.fixture(scope="module")
def study():
    return simulate(MANY, seed=41)


@pytest.fixture(scope="module")
def driver(study):
    return etid.identify_driver(study["calibration/0"])


@pytest.fixture(scope="module")
def fits(study, driver):
    return etid.identify_skins(study.loaded, driver)


def rows(fits, paths):
    order = fits.labels["path"].tolist()
    return fits.take(np.array([order.index(path) for path in paths]))


def assert_same(one, other, error=0.0):
    for a, b in zip(jax.tree.leaves(one.fit), jax.tree.leaves(other.fit), strict=True):
        np.testing.assert_allclose(a, b, rtol=error, atol=0)


def test_more_than_a_chunk_keeps_the_order_and_no_row_depends_on_its_neighbours(
    study, driver, fits
):
    """Reversed, every recording is another row of another chunk, next to other rows."""
    assert fits.labels["path"].tolist() == list(study.loaded)
    assert fits.counts() == {"successful": MANY}
    assert (np.abs(off(fits)) < SIGMAS).all()
    paths = list(study.loaded)[::-1]
    again = etid.identify_skins([study[path] for path in paths], driver)
    # Sums of a matrix product are in another order in chunks of other sizes. A difference of the
    # last digit is larger in numbers that nearly cancel, such as scores.
    assert_same(again, rows(fits, paths), 1e-8)


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e30])
def test_a_bad_recording_changes_nothing_of_its_neighbours(study, driver, fits, bad):
    paths = list(study.loaded)[:6]
    records = [study[path] for path in paths]
    volts = records[2].v_out.copy()
    volts[1000::3333] = bad  # in every period, or it would be left out
    records[2] = records[2].replace(v_out=volts, adc_range=None)
    broken = etid.identify_skins(records, driver)
    assert broken.verdicts[2] != "successful"
    others = np.arange(6) != 2
    expected = rows(fits, np.array(paths)[others].tolist())
    assert_same(broken.take(others), expected, 1e-8)  # as above


def test_a_failed_driver_costs_its_own_recordings():
    """Also one whose calibration does not exist, or has no known resistor."""
    study = simulate(4, calibrations=2, seed=6)
    named = ("calibration/0", "calibration/1", "nowhere", "s01/dry/0")
    records = [
        study["calibration/0"],
        study["calibration/1"].replace(v_out=np.zeros(LENGTH)),
        *(
            study[path].replace(calibration=of)
            for path, of in zip(study.loaded, named, strict=True)
        ),
    ]
    result = etid.identify_study(etid.Study.from_recordings(records))
    assert result.fits.verdicts.tolist() == ["successful", *["driver_failed"] * 3]
    assert list(result.drivers) == [("calibration/0",)]
    assert ("calibration/1",) in result.failures
    good, flat, *none = result.fits.notes
    assert good == ""
    assert "'calibration/1': flat" in flat
    assert all(name in note for name, note in zip(named[2:], none, strict=True))


def test_a_study_shows_its_progress_only_on_request(capsys):
    study = simulate(samples=LENGTH // 2)
    records = [one.replace(v_out=np.zeros(LENGTH // 2)) for one in study.recordings()]
    asked: tuple[tuple[dict[str, Any], str], ...] = (({}, ""), ({"progress": True}, "1/1"))
    for options, shown in asked:
        etid.identify_study(etid.Study.from_recordings(records), **options)
        assert shown in (printed := capsys.readouterr().err)
        assert options or printed == ""


def test_long_recordings_are_fitted_in_calls_of_fewer_lanes(study, monkeypatch):
    monkeypatch.setattr(fitting, "LANES", 2 * MANY)
    monkeypatch.setattr(fitting, "HELD", MANY * LENGTH)
    nothing: Any = None
    batch = fitting.Batch(fitting.Prepared(*[nothing] * len(fitting.Prepared._fields)))
    for row, recording in enumerate(study.loaded.recordings()):
        assert not batch.full
        batch.add(row, batch.like._replace(seen=Inspected.of(recording)))
    assert batch.full


def test_a_driver_without_success_is_kept_and_marks_its_fits(study):
    """Not refused before the fit, so there are numbers; but none of them may be trusted."""
    calibration = study["calibration/0"]
    v = calibration.v_out * np.std(calibration.v_th) / np.std(calibration.v_out)
    more = calibration.replace(v_out=1.004 * v, adc_range=None)  # than without a load
    records = [more, *(study[path] for path in list(study.loaded)[:2])]
    result = etid.identify_study(etid.Study.from_recordings(records))
    assert next(iter(result.drivers.values())).verdict != "successful"
    assert "successful" not in result.fits.counts()
    assert all(result.fits.notes)


# The table of fits


@pytest.fixture(scope="module")
def mixed(study, driver):
    """Two fits and two failures of two subjects."""
    records = [study[f"s01/dry/{i}"] for i in range(4)]
    records[1] = records[1].replace(v_out=np.zeros(LENGTH))
    records[3] = records[3].replace(v_out=np.zeros(LENGTH), subject="s02")
    return etid.identify_skins(iter(records), driver)


def test_failures_are_rows_without_numbers_and_progress_is_shown_only_on_request(
    study, driver, mixed, capsys
):
    table = mixed.table()
    assert {len(column) for column in table.values()} == {4}
    failed = table["verdict"] == "flat"
    assert failed.tolist() == [False, True, False, True]
    for name in ("r_s", "r_p", "c_p", "r_s_stderr", "rrse", "chi2"):
        assert (np.isnan(table[name]) == failed).all()
    assert all(table["note"][failed])
    assert not any(table["note"][~failed])
    assert mixed.counts() == {"flat": 2, "successful": 2}
    assert len(mixed.usable()) == 2
    records = [study["s01/dry/0"], study["s01/dry/1"].replace(v_out=np.zeros(LENGTH))]
    for progress, shown in ((False, ""), (True, "2/2")):
        etid.identify_skins(records, driver, progress=progress)
        printed = capsys.readouterr()
        assert printed.out == ""
        assert shown in printed.err
        assert progress or printed.err == ""


def test_a_group_without_success_is_counted_and_has_no_median(mixed):
    first, second = mixed.summary("subject")
    assert (first["subject"], first["fits"], first["usable"]) == ("s01", 3, 2)
    assert (second["subject"], second["fits"], second["usable"]) == ("s02", 1, 0)
    assert np.isnan(second["r_p"])
    good = mixed.usable()
    np.testing.assert_allclose(first["r_p"], np.mean(np.asarray(good.circuit.r_p)))
    np.testing.assert_allclose(first["r_p_spread"], np.std(np.asarray(good.circuit.r_p), ddof=1))
    np.testing.assert_allclose(first["r_p_stderr"], np.mean(np.asarray(good.stderr.r_p)))
    assert "2 successful" in str(mixed)
    assert "0/1" in str(mixed)


def test_what_varies_is_the_spread_less_the_noise_of_all_recordings(mixed):
    """Two thirds have 1 % of noise, one third has 10 %, which the median does not show."""
    rng, count, varies = np.random.default_rng(3), 6000, 0.05
    noise = np.where(np.arange(count) % 3 < 2, 0.01, 0.1)
    many = mixed.usable().take(np.zeros(count, int))
    r_p = 1 + varies * rng.standard_normal(count) + noise * rng.standard_normal(count)
    cov, shared = np.zeros((2, count, 3, 3))
    shared[:, 1, 1] = 0.02**2
    cov[:, 1, 1] = noise**2 + shared[:, 1, 1]
    fit = eqx.tree_at(lambda f: (f.circuit.r_p, f.cov, f.shared_cov), many.fit, (r_p, cov, shared))
    [row] = dataclasses.replace(many, fit=fit).summary()
    assert row["r_p_own"] == pytest.approx(0.01)
    assert row["r_p_shared"] == pytest.approx(0.02)
    # The variance of the spread is known to 2 %, three times what varies.
    assert row["r_p_between"] == pytest.approx(varies, rel=0.15)


def test_failures_survive_a_file_with_units_and_another_circuit_is_refused(mixed, tmp_path):
    file = tmp_path / "fits.h5"
    mixed.write(file)
    again = etid.Fits.read(file)
    assert again.verdicts.tolist() == mixed.verdicts.tolist()
    for name, column in mixed.table().items():
        np.testing.assert_array_equal(again.table()[name], column)
    np.testing.assert_array_equal(again.fit.shared_cov, mixed.fit.shared_cov)
    with h5py.File(file) as content:
        assert content["c_p"].attrs["unit"] == "farad"
        assert content["r_s_stderr"].attrs["unit"] == "ohm"
        assert content.attrs["method"] == "maximum_likelihood"
        assert content.attrs["etid_version"] == etid.__version__
    with pytest.raises(ValueError, match=r"is 'etid:SkinRC'\. .* passed is Resistor"):
        etid.Fits.read(file, circuit=etid.Resistor)
    with h5py.File(file, "r+") as content:
        content.attrs["schema"] = "etid/recording"
    with pytest.raises(ValueError, match="is 'etid/recording', not 'etid/fits'"):
        etid.Fits.read(file)


def test_a_fit_is_taken_by_the_path_of_its_recording(fits):
    path = "s01/dry/3"
    for found in (fits[path], fits[f"/{path}/"]):
        assert float(found.circuit.r_p) == float(fits[3].circuit.r_p)
    with pytest.raises(
        KeyError, match=r"no fit 's01/dry/x'; this table has 18 fits, such as 's01/"
    ):
        fits["s01/dry/x"]
    twice = etid.Fits.concatenate([fits.take(np.array([0, 3])), fits.take(np.array([3]))])
    with pytest.raises(KeyError, match=r"2 fits have the path 's01/dry/3'; .*\[1, 2\]"):
        twice[path]


def test_one_fit_is_written_with_its_path_and_labels(study, driver, fits, tmp_path):
    path = "s01/dry/3"
    for one in (fits[path], etid.identify_skin(study[path], driver)):
        one.write(tmp_path / "fit.h5")
        again = etid.Fits.read(tmp_path / "fit.h5")
        for name in ("path", "subject", "condition"):
            assert again.labels[name].tolist() == [fits.labels[name][3]], name
        assert float(again[path].circuit.r_p) == float(fits[path].circuit.r_p)
    bare = dataclasses.replace(one)  # it knows no recording
    bare.write(tmp_path / "fit.h5")
    assert etid.Fits.read(tmp_path / "fit.h5").labels["path"].tolist() == [""]


def test_fits_of_a_file_and_fresh_ones_are_one_table(fits, driver, tmp_path):
    """A file keeps no support; bounds, changes and tolerances may be known of some only."""
    part = fits.take(np.array([1]))
    part.write(tmp_path / "fits.h5")
    read = etid.Fits.read(tmp_path / "fits.h5")
    nothing = {"change": None, "change_stderr": None}
    bare = dataclasses.replace(part, fit=dataclasses.replace(part.fit, **nothing))
    tolerances = Effects(
        np.ones((1, len(BUDGETED), 3)), np.zeros((1, len(BUDGETED))), np.zeros((1, 3))
    )
    joint = dataclasses.replace(part, fit=dataclasses.replace(part.fit, by_tolerance=tolerances))
    limits = Limited(np.zeros((1, 3)), np.full((1, 3), 1e6), np.zeros((1, 3)))
    bounded = dataclasses.replace(part, fit=dataclasses.replace(part.fit, limits=limits))
    for other in (part, bare, joint, bounded):
        for parts in ([read, other], [other, read]):
            both = etid.Fits.concatenate(parts)
            assert both.counts() == {"successful": 2}
            for row, one in enumerate(parts):
                np.testing.assert_array_equal(both[row].cov, one[0].cov)
                np.testing.assert_array_equal(both[row].known_changes[0], one[0].known_changes[0])
                for name in ("limits", "support", "by_tolerance"):
                    if (known := getattr(one[0], name)) is not None:
                        found = jax.tree.leaves(getattr(both[row], name))
                        np.testing.assert_equal(found, jax.tree.leaves(known))
            assert "r_p" in str(both)
            both.write(tmp_path / "both.h5")
            assert len(etid.Fits.read(tmp_path / "both.h5")) == 2
    other = dataclasses.replace(part, fit=dataclasses.replace(part.fit, circuit=etid.SkinCole()))
    with pytest.raises(ValueError, match="etid:SkinCole and etid:SkinRC cannot be in one table"):
        etid.Fits.concatenate([part, other])


def test_results_of_the_parts_of_a_study_keep_the_failures_of_each(fits, driver):
    """So do their drivers and fits; the settings are those of all parts."""
    parts = [
        etid.StudyFits(fits.take(np.array([row])), {(f"c{row}",): driver}, {(f"bad{row}",): why})
        for row, why in enumerate(("too short", "flat", "saturated"))
    ]
    whole = etid.StudyFits.concatenate(parts)
    assert whole.failures == {("bad0",): "too short", ("bad1",): "flat", ("bad2",): "saturated"}
    assert list(whole.drivers) == [("c0",), ("c1",), ("c2",)]
    assert whole.fits.labels["path"].tolist() == [f"s01/dry/{row}" for row in range(3)]


@pytest.mark.parametrize(
    "missing", [("plausible",), ("driver", "bounds", "recordings"), ("order",)]
)
def test_a_file_that_lacks_a_newer_setting_keeps_the_others(study, driver, fits, tmp_path, missing):
    options = Options.of((etid.SkinRC(),), bounds={"r_s": (1e3, 1e6)})
    settings = options.settings(study, len(fits))
    found = etid.StudyFits(fits, {("calibration/0",): driver}, {}, settings)
    found.write(tmp_path / "fits.h5")
    assert etid.StudyFits.read(tmp_path / "fits.h5").settings == settings
    with h5py.File(tmp_path / "fits.h5", "r+") as file:
        for name in missing:
            del file.attrs[name]
    again = etid.StudyFits.read(tmp_path / "fits.h5").settings
    empty = {"recordings": len(fits), "order": 0, "driver": ""}
    expected = {name: empty.get(name, ()) for name in missing}
    assert again == dataclasses.replace(settings, **expected)
    fits.write(tmp_path / "fits.h5")
    assert etid.StudyFits.read(tmp_path / "fits.h5").settings is None


@pytest.fixture(scope="module")
def conditions(tmp_path_factory):
    """A file of two conditions, whose recordings name their calibration; one is damaged."""
    trials = [
        Trial(f"s01/{condition}/{i}", DRY, subject="s01", condition=condition)
        for condition in ("dry", "damp")
        for i in range(2)
    ]
    scene = Scene(tuple(trials), (Trial("calibration/0", ResistorLoad(98.8e3)),))
    named = [
        one.replace(calibration=("calibration/0",)) if one.r_load is None else one
        for one in scene.simulate(seed=41).values()
    ]
    odd = named[1].replace(path="odd", condition="dry")
    path = tmp_path_factory.mktemp("conditions") / "study.h5"
    etid.Study.from_recordings([*named, odd]).write(path)
    with h5py.File(path, "r+") as file:
        file["odd/v_out"].attrs["unit"] = "furlong"
    return path


def copied(part):
    return pickle.loads(pickle.dumps(part))


@pytest.mark.parametrize("again", [lambda part: part, copied], ids=["itself", "pickle"])
def test_a_part_of_a_study_finds_the_calibrations_that_it_names(conditions, again, tmp_path):
    with etid.read(conditions) as study, again(study.where(condition="dry")) as dry:
        assert list(study.problems) == ["odd"]
        assert list(dry) == ["s01/dry/0", "s01/dry/1"]
        assert dry.problems == {}  # it has no label: it is in no selection
        found = etid.identify_study(dry)
        assert found.fits.counts() == {"successful": 2}
        assert list(found.drivers) == [("calibration/0",)]
        dry.where(subject="s01").write(tmp_path / "dry.h5")
        assert list(again(study.loaded).problems) == ["odd"]
    with etid.read(tmp_path / "dry.h5") as alone:
        assert list(alone) == ["calibration/0", "s01/dry/0", "s01/dry/1"]


def test_a_part_in_memory_uses_the_only_calibration_of_the_whole(study):
    part = copied(study.loaded)
    assert len(part.calibrations) == 0
    assert list(part.named.calibrations) == ["calibration/0"]
    few = etid.Study.from_recordings([study["calibration/0"], study["s01/dry/2"]])
    assert etid.identify_study(few.where(condition="dry")).fits.counts() == {"successful": 1}


def test_recordings_with_the_driver_of_another_file_survive_a_pickle(conditions, study, tmp_path):
    """The calibrations come from the other file then, too."""
    study.calibrations.write(tmp_path / "driver.h5")
    with (
        read_with_driver(conditions, tmp_path / "driver.h5") as whole,
        copied(whole) as again,
        copied(whole.where(condition="damp")) as damp,
    ):
        assert list(again) == list(whole)
        path = "driver.h5/calibration/0"
        assert again["s01/dry/0"].calibration == (path,)
        np.testing.assert_array_equal(again[path].v_out, study["calibration/0"].v_out)
        assert list(damp) == ["s01/damp/0", "s01/damp/1"]
        np.testing.assert_array_equal(damp.named[path].v_out, study["calibration/0"].v_out)
