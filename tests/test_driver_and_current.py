"""Loads identified from V_th, V_out and the current at once, with a driver."""

import numpy as np
import pytest

import etid
from etid.recordings.remarks import Remark
from etid.simulation.scenes import Scene, Trial
from etid.simulation.transformer import ResistorLoad
from tests.skins import DAMP, DRY, off, relative

METHOD = "maximum_likelihood(with_current=True)"
WITHIN = 4.0  # standard errors; by chance one estimate of 16 000 is not


def scene(
    circuit: etid.AbstractCircuit = DRY, snr_db=60.0, current_snr_db: float | None = 40.0, **fields
):
    known = (Trial("calibration/0", ResistorLoad(98.8e3)),)
    return Scene(
        (Trial("loaded/0", circuit), Trial("loaded/1", circuit)),
        known,
        snr_db=snr_db,
        current_snr_db=current_snr_db,
        trigger_jitter_rms=50e-9,
        **fields,
    )


@pytest.fixture(scope="module")
def study():
    return scene().simulate(seed=2)


@pytest.fixture(scope="module")
def driver(study):
    return etid.identify_driver(study["calibration/0"], order=5)


@pytest.fixture(scope="module")
def recording(study):
    return study["loaded/0"]


@pytest.fixture(scope="module")
def both(recording, driver):
    return etid.identify_skin(recording, driver)


def test_driver_and_current_together_reach_the_bound(recording, driver, both):
    assert (both.verdict, both.method) == ("successful", METHOD)
    assert np.abs(off(both)).max() < WITHIN
    bound = np.array(list(etid.bound(scene())["loaded/0"].relative.values()))
    # 1.01 to 1.02 in 60 draws: the calibration has fewer parameters than the bound, but noise.
    np.testing.assert_allclose(relative(both), bound, rtol=0.05)
    by_current = etid.identify_skin(recording)
    assert (relative(both) < 0.97 * relative(by_current)).all()


def test_the_current_is_left_out_on_request(recording, driver, both):
    alone = etid.identify_skin(recording, driver, method="maximum_likelihood")
    without = etid.identify_skin(recording.replace(current=None), driver)
    np.testing.assert_array_equal(alone.circuit.values(), without.circuit.values())
    assert (relative(both) < 0.5 * relative(alone)).all()
    said = [int(fit.remarks) & Remark.current_unused for fit in (both, alone, without)]
    assert said == [0, Remark.current_unused, 0]
    assert "does not use it" in str(alone)


@pytest.mark.parametrize(
    ("change", "verdicts"),
    [
        (lambda one: {"current": 1.05 * one.current}, ("misfit", "inconsistent")),
        (lambda one: {"current": 0.98 * one.current}, ("misfit", "inconsistent")),
        (lambda one: {"current": 1.003 * one.current}, ("inconsistent",)),
        (lambda one: {"current": one.current + one.v_out / 2e6}, ("misfit", "inconsistent")),
        (lambda one: {"v_out": 1.02 * one.v_out}, ("misfit", "inconsistent")),
        # Out of reach of the search for a lag; three samples are found and taken off.
        (lambda one: {"current": np.roll(one.current, 60)}, ("misfit", "max_steps_reached")),
        (lambda one: {"current": -one.current}, ("misaligned",)),
        (lambda one: {"current": 1e3 * one.current}, ("wrong_unit",)),
        # By 1 % over the record. At 40 dB, R_p was seven standard errors off, and successful.
        (
            lambda one: {"current": (1 + 0.01 * one.time / one.duration) * one.current},
            ("changed",),
        ),
        (
            lambda one: {"current": np.where(np.arange(one.v_out.size) == 5, np.nan, one.current)},
            ("nonfinite_samples",),
        ),
    ],
)
def test_a_current_that_contradicts_the_driver_is_never_averaged(
    recording, driver, both, change, verdicts
):
    fit = etid.identify_skin(recording.replace(**change(recording)), driver, throw=False)
    assert fit.verdict in verdicts


@pytest.mark.parametrize("level", [0.0, 2e-3])  # [A]
@pytest.mark.parametrize("noise", [0.0, 1e-6])  # [A]
def test_a_current_without_a_signal_is_left_out(recording, driver, level, noise):
    """It refused a good recording as `flat`, or as `misaligned` where noise spans more."""
    without = etid.identify_skin(recording.replace(current=None), driver)
    rng = np.random.default_rng(0)
    dead = [
        recording.replace(current=level + noise * rng.standard_normal(recording.v_out.size))
        for _ in range(2)
    ]
    fits = [etid.identify_skin(dead[0], driver), *etid.identify_skins(dead, driver)]
    for fit in fits:
        assert (fit.verdict, fit.method) == ("successful", "maximum_likelihood")
        assert int(fit.remarks) & Remark.current_unused
        # A batch differs by the order of sums: far less than a standard error.
        np.testing.assert_allclose(fit.circuit.values(), without.circuit.values(), rtol=1e-6)
    assert etid.identify_skin(dead[0], throw=False).verdict == "flat"


def test_an_offset_and_a_common_delay_are_no_contradiction(recording, driver):
    shifted = {name: np.roll(getattr(recording, name), 3) for name in ("v_out", "current")}
    late = recording.replace(v_out=shifted["v_out"], current=shifted["current"] + 1e-4)
    fit = etid.identify_skin(late, driver)
    assert int(fit.remarks) == Remark.aligned
    assert np.abs(off(fit)).max() < WITHIN


LATE = (1.0, 2.3, 3.0)  # samples


def late_record(name: str, late: float, circuit=DRY, seed=2, **fields) -> etid.Recording:
    """A recording, one record of which is late by so many samples."""
    of = [scene(circuit, start=0.01 - by, **fields) for by in (0.0, late / 200e3)]
    early, other = (one.simulate(seed)["loaded/0"] for one in of)
    return early.replace(**{name: other.samples[name]})


@pytest.mark.parametrize("name", ["current", "v_out"])
def test_a_single_fit_takes_a_lag_off_as_a_batch_does(driver, name):
    late = late_record(name, 2.3)
    fit = etid.identify_skin(late, driver)
    (other,) = etid.identify_skins([late], driver)
    assert int(fit.remarks) == int(other.remarks) == Remark.aligned
    assert "were aligned" in str(fit)
    # The same minimum, by two programs.
    np.testing.assert_allclose(fit.circuit.values(), other.circuit.values(), rtol=1e-6)


def test_a_file_and_its_report_use_both_where_both_were_recorded(study, both, tmp_path):
    of = [study["calibration/0"], study["loaded/0"], study["loaded/1"].replace(current=None)]
    etid.Study.from_recordings(of).write(tmp_path / "study.h5")
    fits = etid.fit_file(tmp_path / "study.h5", tmp_path / "fits.h5").fits
    assert (fits.verdicts == "successful").all()
    assert fits.fit.method == f"maximum_likelihood + {METHOD}"
    # The driver of the file was identified again; its last digits differ.
    np.testing.assert_allclose(fits[0].circuit.values(), both.circuit.values(), rtol=1e-6)
    assert (relative(fits[0]) < 0.5 * relative(fits[1])).all()
    etid.write_report(tmp_path / "fits.h5", tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text("utf-8")
    assert "The measured current I = X / (Z_L + Z_th)" in page


@pytest.mark.slow
def test_estimates_are_efficient_and_their_intervals_true():
    """48 draws, each with its own calibration; the bound knows no more than the fits."""
    squares, covered = [], []
    for circuit, current_snr_db in ((DRY, 40.0), (DAMP, 30.0)):
        of = scene(circuit, current_snr_db=current_snr_db)
        bound = np.array(list(etid.bound(of)["loaded/0"].relative.values()))
        for seed in range(24):
            drawn = of.simulate(seed + 1000)
            driver = etid.identify_driver(drawn["calibration/0"], order=5, throw=False)
            fit = etid.identify_skin(drawn["loaded/0"], driver, throw=False)
            assert fit.verdict in ("successful", "inconsistent", "changed"), seed
            if fit.verdict == "successful":
                error = np.asarray(fit.circuit.values()) / np.asarray(circuit.values()) - 1
                squares.append((error / bound) ** 2)
                covered.append(np.abs(error) < 1.96 * relative(fit))
    assert len(squares) >= 46
    # 48 squares of normal errors have a mean that is known to 20 %, and 144 intervals, of which
    # a third is independent, hold 95 % to 3.1 %: limits at three of these.
    assert (np.mean(squares, axis=0) < 1.6).all(), np.mean(squares, axis=0)
    assert 0.86 < np.mean(covered), np.mean(covered)
