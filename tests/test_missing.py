"""Samples under the mask of a masked array are missing ones, as NaN is, wherever arrays enter."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import etid
from etid.precision import unmasked
from tests.display.test_online import TEN, quiet, tracker_of

RATES: dict[str, Any] = {"sample_rate": 200e3, "pulse_rate": 60.0}
F = np.geomspace(60.0, 1e5, 40)
Z = etid.SkinRC(33.4e3, 186e3, 0.12e-9).response(F)


@pytest.fixture(scope="module")
def study():
    return etid.scenes.paper_dry(snr_db=60.0).simulate(seed=0)


@pytest.fixture(scope="module")
def recording(study):
    return study["typical/dry/01"]


@pytest.fixture(scope="module")
def driver(study):
    return etid.identify_driver(study["calibration/98k8"], order=5)


def masked(v, at=(500, 501), value=1e3):
    """The record with wrong samples, which its user has masked."""
    mask = np.broadcast_to(np.isin(np.arange(v.shape[-1]), at), v.shape)
    found = np.ma.masked_array(np.array(v), mask=mask)
    found.data[found.mask] = value
    return found


@pytest.mark.parametrize("kind", [float, np.float32, complex, int])
def test_a_masked_value_is_nan_and_all_others_keep_their_bits(kind):
    values = np.arange(6).astype(kind)
    found = unmasked(np.ma.masked_array(values, mask=values == 2))
    assert not np.ma.isMaskedArray(found)
    assert np.flatnonzero(np.isnan(found)).tolist() == [2]
    np.testing.assert_array_equal(np.delete(found, 2), np.delete(values, 2))
    assert unmasked(np.ma.masked_array(values, mask=False)).dtype == values.dtype
    assert unmasked(values) is values
    both = unmasked([np.ma.masked_array(values, mask=values == 2), values])
    assert np.argwhere(np.isnan(both)).tolist() == [[0, 2]]
    assert isinstance(unmasked(jnp.ones(3)), jnp.ndarray)


@pytest.mark.parametrize("name", ["v_th", "v_out"])
def test_a_recording_with_a_masked_sample_is_one_with_a_missing_sample(recording, driver, name):
    """12 samples of +0.05 V were used: successful at chi2 1.7, r_p a standard error off."""
    values = getattr(recording, name)
    found = recording.replace(**{name: masked(values)})
    assert np.flatnonzero(np.isnan(getattr(found, name))).tolist() == [500, 501]
    assert etid.identify_skin(found, driver, throw=False).verdict == "nonfinite_samples"


def test_masked_codes_and_masked_currents_are_missing(recording):
    codes = np.rint(recording.v_out / 1e-3).astype(np.int16)
    stored = etid.Samples(masked(codes, value=7), conversion=1e-3)
    assert np.flatnonzero(np.isnan(stored.values)).tolist() == [500, 501]
    found = etid.Recording(v_out=stored, current=masked(recording.v_th * 1e-6), **RATES)
    assert etid.identify_skin(found, throw=False).verdict == "nonfinite_samples"


def test_calibrations_and_studies_of_masked_arrays_have_missing_samples(study, recording):
    known = study["calibration/98k8"]
    bad = known.replace(v_out=masked(known.v_out))
    with pytest.raises(
        etid.IdentificationError, match=r"nonfinite_samples\. The fault is in v_out"
    ):
        etid.identify_driver(bad, order=5)
    rows = np.ma.stack([np.ma.asarray(recording.v_out), masked(recording.v_out)])
    for given in (rows, list(rows)):
        made = etid.Study.from_arrays(
            recording.v_th,
            given,
            calibrations={98.8e3: (masked(known.v_th), known.v_out)},
            **RATES,
        )
        assert np.isnan(made["calibration/0"].v_th).sum() == 2
        assert np.isnan(made["loaded/1"].v_out).sum() == 2
        assert np.isfinite(made["loaded/0"].v_out).all()


def test_plain_arrays_with_a_mask_have_the_fit_of_nan(recording, driver):
    of = {"driver": driver, **RATES, "method": "maximum_likelihood"}
    hidden = np.ma.masked_array(recording.v_out, mask=np.arange(recording.v_out.size) == 500)
    assert etid.identify_samples(recording.v_th, hidden, **of).verdict != "successful"
    del of["method"]
    fit = etid.Likelihood.of(recording.v_th, hidden, of.pop("driver"), **of).fit()
    assert fit.verdict != "successful"


def test_masked_inputs_of_filters_and_drivers_are_no_numbers():
    u = masked(np.random.default_rng(0).normal(size=40), at=(5,), value=0.0)
    filtered = etid.Filter.of(np.array([1.0]), np.array([1.0, -0.5])).simulate(u)[0]
    assert np.isnan(filtered[5:]).all()
    assert np.isnan(etid.steiglitz_mcbride(u, u, 1).a).any()
    with pytest.raises(etid.RecordingError, match="z_th"):
        etid.driver_of_response(F, masked(Z, at=(5,), value=1e6), sample_rate=2e5)


def test_a_masked_impedance_or_error_is_refused():
    z, few = masked(Z, at=(5,), value=1e6), np.ma.masked_array(np.ones(40), mask=F < 100.0)
    for test in (etid.identify_impedance, etid.kramers_kronig):
        with pytest.raises(ValueError, match="1 impedance of 40 missing or not finite"):
            test(F, z)
        with pytest.raises(ValueError, match="frequency must be finite"):
            test(masked(F, at=(5,), value=1.0), Z)
        with pytest.raises(ValueError, match="stderr must be finite"):
            test(F, Z, stderr=few)


def test_the_tracker_does_not_use_a_masked_sample():
    tracker = tracker_of(TEN)
    record = np.stack([quiet()["dry"].v_out] * TEN)
    windows = tracker.pulses(record)[0]
    hidden = np.ma.masked_array(windows, mask=np.zeros(windows.shape, bool))
    hidden[1, 700] = np.ma.masked
    found = tracker.read(tracker.update(tracker.start(), hidden)).fit.verdict
    assert (np.flatnonzero(found == "nonfinite_samples") == [1]).all()
    assert np.isnan(tracker.pulses(masked(record))[0]).sum() == 2 * TEN
    with pytest.raises(ValueError, match="amplitude"):
        tracker.update(tracker.start(), windows, np.ma.masked_array(np.ones(TEN), mask=True))


def test_a_trigger_an_element_and_a_place_under_a_mask_are_missing():
    r_s: Any = etid.SkinRC(r_s=np.ma.masked_array([1e3, 2e3], mask=[False, True])).r_s
    assert np.isnan(r_s).tolist() == [False, True]
    with pytest.raises(etid.RecordingError, match="finite place"):
        etid.Layout(["E1", "E2"], np.ma.masked_array([0.0, 1.0], mask=[False, True]), np.zeros(2))
