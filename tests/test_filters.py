"""Known filters of V_out and of a measured current."""

import dataclasses
from typing import Any

import numpy as np
import pytest
import scipy.signal

import etid
from etid.estimators.lanes import Harmonics
from etid.estimators.maximum_likelihood.rows import loads_of, source_of
from etid.estimators.registry import MAXIMUM_LIKELIHOOD
from etid.identify.fitting import known_of
from etid.recordings.errors import RecordingError
from etid.recordings.preflight import Inspected
from etid.recordings.remarks import Remark
from etid.results.feed import MEASURED_CURRENT
from etid.signals.low_pass import Filters, LowPass
from tests.skins import sampled

RATE, PULSES = 200e3, 60.0
SKIN = etid.SkinRC(33e3, 186e3, 0.12e-9)
TRUTH = np.array(SKIN.values())
START, WHOLE = 1350, 10_000  # [samples]; the first is in a pulse


def response(kind, order, corner, f) -> Any:
    """That of SciPy."""
    if kind == "bessel":
        of: Any = scipy.signal.bessel(order, 2 * np.pi * corner, analog=True, norm="mag")
    else:
        of = scipy.signal.butter(order, 2 * np.pi * corner, analog=True)
    return scipy.signal.freqs(of[0], of[1], 2 * np.pi * f)[1]


def recorded(rng, v_out=None, current=None, samples=None, **fields: Any):
    """Currents of 1 mA into dry skin; V_out and current through filters of SciPy."""
    f = PULSES * np.arange(1, 1600)
    edges = [np.exp(-2j * np.pi * f * t) for t in (7.0e-3, 7.2e-3, 7.4e-3)]
    pulse = 1e-3 * PULSES * (edges[0] - 2 * edges[1] + edges[2]) / (2j * np.pi * f)
    pulse = pulse / (1 + (f / 60e3) ** 8)  # anti-alias filter of both channels
    spectra = [pulse, pulse * np.asarray(SKIN.response(f))]
    for i, one in enumerate((current, v_out)):
        if one is not None:
            spectra[i] = spectra[i] * response(one[0], one[1], one[2], f)
    first, count = (0, WHOLE) if samples is None else (START, samples)
    each = sampled(spectra, first, count)
    size = 1e-3 * np.abs(each).max(-1, keepdims=True)
    i, v = each + size * rng.standard_normal(each.shape)
    return etid.Recording(v_out=v, current=i, sample_rate=RATE, pulse_rate=PULSES, **fields)


def errors(fit):
    """Errors of the elements in ±."""
    return (np.asarray(fit.circuit.values()) - TRUTH) / np.asarray(fit.stderr.values())


@pytest.mark.parametrize("samples", [None, 5200])
@pytest.mark.parametrize(
    ("channel", "filter"),
    [
        ("current", ("bessel", 4, 10e3)),
        ("v_out", ("butterworth", 1, 30e3)),
        ("current", ("butterworth", 2, 15e3)),
    ],
)
def test_elements_are_those_behind_known_filters(channel, filter, samples):
    """Of whole periods, and of a record that begins and ends anywhere."""
    rng = np.random.default_rng([1, *filter[0].encode(), filter[1]])
    text = "{} {} {:g}".format(*filter)
    every = []
    for _ in range(3):
        stated = {f"{channel}_filter": text}
        one = recorded(rng, **{channel: filter}, samples=samples, **stated)
        fit = etid.identify_skin(one)
        assert fit.verdict == "successful"
        every.append(errors(fit))
    # Nine normal numbers: their mean square is below 3.1 in 0.999 of all sets.
    assert np.mean(np.square(every)) < 3.1


def test_both_channels_may_have_one():
    filters = {"v_out": ("butterworth", 1, 40e3), "current": ("bessel", 4, 12e3)}
    rng = np.random.default_rng(2)
    stated = {"v_out_filter": "butterworth 1 40e3", "current_filter": "bessel 4 12e3"}
    for samples in (None, 5200):
        fit = etid.identify_skin(recorded(rng, **filters, samples=samples, **stated))
        assert fit.verdict == "successful"
        assert np.abs(errors(fit)).max() < 4


def test_a_filter_that_is_not_stated_is_seen():
    strong = recorded(np.random.default_rng(3), current=("bessel", 4, 10e3))
    assert etid.identify_skin(strong, throw=False).verdict != "successful"
    one = recorded(np.random.default_rng(3), current=("bessel", 4, 40e3))
    fit = etid.identify_skin(one, throw=False)
    assert fit.verdict == "misfit"
    assert "a low-pass of the current" in fit.note


@pytest.mark.parametrize("samples", [None, 5200])
def test_errors_contain_the_tolerance_of_a_corner(samples):
    """Corners are drawn from it; without it some of six fits are beyond ten of their ±."""
    rng, records = np.random.default_rng(4), []
    for path in range(12):
        corner = 20e3 * np.exp(0.03 * rng.standard_normal())
        stated = {"v_out_filter": "bessel 4 20e3 600", "path": str(path)}
        records.append(recorded(rng, v_out=("bessel", 4, corner), samples=samples, **stated))
    fits = etid.identify_skins(records)
    assert np.all(fits.verdicts == "successful")
    z = np.array([errors(fits[row]) for row in range(len(records))])
    # Each element has 12 numbers, which are not independent of those of others: fewer than nine of
    # them are within 1.96 ± in one of a hundred sets.
    assert np.all(np.sum(np.abs(z) < 1.96, 0) >= 9)
    assert np.abs(z).max() < 4.5
    fixed = [one.replace(v_out_filter="bessel 4 20e3") for one in records[:6]]
    fits = etid.identify_skins(fixed)
    assert max(np.abs(errors(fits[row])).max() for row in range(len(fixed))) > 10


@pytest.mark.parametrize("kind", ["bessel", "butterworth"])
def test_responses_are_those_of_scipy(kind):
    f = np.geomspace(10.0, 1e5, 40)
    for order in (1, 2, 4, 8):
        filters = Filters.of(None, LowPass.read(f"{kind} {order} 3e3"))
        own, other = filters(f)
        np.testing.assert_allclose(own, 1.0)
        np.testing.assert_allclose(other, response(kind, order, 3e3, f), rtol=1e-9)


def test_derivatives_of_the_gains_with_corners():
    one = recorded(np.random.default_rng(5), v_out_filter="bessel 4 20e3 1e3",
                   current_filter="butterworth 1 3e4 1e3")  # fmt: skip
    lane = Harmonics.of(Inspected.of(one))
    known = known_of(lane, MEASURED_CURRENT, False, MAXIMUM_LIKELIHOOD)
    load = loads_of([lane], source_of(known), etid.SkinRC(), None, None)
    gains = load.gains.at(np.arange(0, lane.size, 97))
    q = np.concatenate([np.log(TRUTH), [0.1, 0.7, -1.2]])[None]
    found, step = gains.slopes(q).by_q[0], 1e-6
    for i, move in enumerate(step * np.eye(q.size)):
        change = (gains.at_few(q + move) - gains.at_few(q - move))[0] / (2 * step)
        # Central differences lose 6e-11 of the gains to rounding.
        np.testing.assert_allclose(found[i], change, atol=1e-9 * np.abs(gains.at_few(q)).max())


def test_rows_have_their_own_filters():
    rng = np.random.default_rng(6)
    corners, records = (10e3, 14e3, None), []
    for row, corner in enumerate(corners):
        given = {} if corner is None else {"current": ("bessel", 4, corner)}
        stated = {} if corner is None else {"current_filter": f"bessel 4 {corner:g}"}
        records.append(recorded(rng, **given, **stated, path=str(row)))
    fits = etid.identify_skins(records)
    for row, one in enumerate(records):
        alone = etid.identify_skin(one)
        assert fits[row].verdict == alone.verdict == "successful"
        off = np.asarray(fits[row].circuit.values()) - np.asarray(alone.circuit.values())
        assert np.all(np.abs(off) < 1e-6 * np.asarray(alone.stderr.values()))


@pytest.mark.parametrize(
    "text",
    ["", "bessel", "bessel 4", "bessel 9 1e3", "bessel 4 -1", "bessel 4 1e3 2e3", "rc 1 1e3"],
)
def test_other_texts_are_refused(text):
    with pytest.raises(RecordingError, match="current_filter"):
        recorded(np.random.default_rng(7), current_filter=text, samples=50)


def test_a_calibration_has_none():
    one = etid.scenes.paper_calibration().simulate(1)["calibration/98k8"]
    with pytest.raises(RecordingError, match="calibration"):
        one.replace(v_out_filter="bessel 4 2e3")


def test_what_knows_no_filters_refuses_them():
    one = recorded(np.random.default_rng(8), current_filter="bessel 4 1e4")
    with pytest.raises(ValueError, match="filter"):
        etid.identify_amplitudes([one, one], circuit=etid.SkinRC())
    with pytest.raises(ValueError, match="filter"):
        etid.predict(one, circuit=SKIN)


def test_behind_a_driver_the_current_is_left_out():
    """V_th and V_out pass the same filter; a current with another one is not used."""
    scene = dataclasses.replace(etid.scenes.paper_dry(), current_snr_db=60.0)
    study = scene.simulate(1)
    driver = etid.identify_driver(study["calibration/98k8"])
    both = etid.identify_skin(study["typical/dry/01"], driver)
    filtered = study["typical/dry/01"].replace(current_filter="bessel 4 1e4")
    alone = etid.identify_skin(filtered, driver)
    said = [int(one.remarks) & Remark.current_unused for one in (alone, both)]
    assert said == [Remark.current_unused, 0]
    assert alone.verdict == "successful"
