"""The distance of the pulses is measured, and compared with what a file says of both rates."""

import numpy as np
import pytest
import scipy.fft

import etid
from etid.identify.planning import explained
from etid.recordings.preflight import Inspected, preflight
from etid.recordings.remarks import Remark
from etid.signals.drift import clocks_apart
from etid.signals.periods import fast_length
from etid.signals.pulse_train import find_pulses
from etid.simulation.scenes import Scene, Trial
from etid.simulation.transformer import SkinLoad

DAMP = SkinLoad(r_s=6.1e3, r_p=17.4e3, c_p=0.66e-9)
PULSE = 60.0


def simulate(sample_rate=200e3, periods=3.0, seed=1, **options):
    scene = Scene(
        (Trial("a", DAMP),),
        sample_rate=sample_rate,
        samples=int(periods * sample_rate / PULSE) + 1,
        **options,
    )
    return scene.simulate(seed)["a"]


@pytest.mark.parametrize("sample_rate", [100e3, 1e6])
@pytest.mark.parametrize("start", [0.0, 0.5e-3, 10e-3])  # before, in and after a pulse
def test_pulses_are_found_and_right_rates_pass(sample_rate, start):
    record = simulate(sample_rate, 4.0, snr_db=20.0, start=start)
    for periods in (1.0, 1.5, 2.0, 3.0, 4.0):
        v_th = record.v_th[: int(periods * sample_rate / PULSE) + 1]
        train = find_pulses(v_th, sample_rate, PULSE)
        assert train.mismatch == ""
        assert train.counted == PULSE
        assert train.edges.size in (int(periods), int(periods) + 1)
        if train.spacing is not None:
            # 1 V of noise on edges of 20 V per sample, a fifth of it at 1 MHz: below half a sample.
            span = train.edges.size - 1
            assert span * abs(train.spacing - sample_rate / PULSE) < 0.5


@pytest.fixture(scope="module", params=[100e3, 500e3])
def noisy(request):
    return simulate(request.param, 6.0, snr_db=20.0)


@pytest.mark.parametrize(
    ("periods", "factor"),
    [
        *((1.5, factor) for factor in (1 / 3, 0.99, 2.0, 40.0)),
        *((2.0, factor) for factor in (0.5, 1.01, 3.0, 1000.0)),
        *((6.0, factor) for factor in (2e-3, 1 / 3, 0.5, 0.99, 2.0, 60.0)),
    ],
)
def test_a_wrong_rate_is_a_mismatch(noisy, periods, factor):
    """Half and double distances are no way out; from 1.5 periods on two pulses are there."""
    rate, size = noisy.sample_rate, int(periods * noisy.sample_rate / PULSE) + 1
    record = noisy.replace(v_th=noisy.v_th[:size], v_out=noisy.v_out[:size], adc_range=None)
    for changes in ({"sample_rate": factor * rate}, {"pulse_rate": PULSE / factor}):
        wrong = record.replace(**changes)
        assert preflight(Inspected.of(wrong)) == "rate_mismatch"
        # Either number explains it, to a sample.
        text = explained(Inspected.of(wrong), "rate_mismatch")
        right = wrong.sample_rate * PULSE / rate, wrong.pulse_rate * rate / PULSE
        found = [float(part.split(" Hz")[0]) for part in text.split("rate = ")[1:]]
        np.testing.assert_allclose(found, right[::-1], rtol=2 * PULSE / rate)


@pytest.mark.parametrize("sample_rate", [100e3, 500e3])
@pytest.mark.parametrize(
    ("ppm", "snr_db", "refused"),
    [
        (20.0, None, True),
        (-20.0, 60.0, True),
        (300.0, 40.0, True),  # a sample and more, as if some were lost
        (5.0, 60.0, False),
        (20.0, 20.0, False),
    ],
)
def test_two_records_with_different_clocks_are_a_mismatch(sample_rate, ppm, snr_db, refused):
    """20 ppm are 0.33 µs from one pulse to the next; R_s was 1.5 % wrong at 60 dB, seven σ."""
    one, other = (simulate(sample_rate, 5.0, snr_db=snr_db, pulse_rate_ppm=of) for of in (0.0, ppm))
    record = Inspected.of(one.replace(v_out=other.v_out))
    assert preflight(record) == ("rate_mismatch" if refused else None)
    if refused:
        said = f"their clocks differ by about {abs(ppm):g} ppm"
        assert said in explained(record, "rate_mismatch")


@pytest.mark.parametrize("sample_rate", [20e3, 100e3, 1e6])
@pytest.mark.parametrize("before", [10e-6, 20e-6, 40e-6, 60e-6])
def test_a_record_that_begins_close_to_an_edge_has_one_clock(sample_rate, before):
    record = simulate(sample_rate, snr_db=60.0, start=1.2e-4 - before)
    assert preflight(Inspected.of(record)) is None


def test_the_drift_is_from_the_first_pulse_to_the_last():
    """Also in a record that begins long before a pulse."""
    one, other = (
        simulate(200e3, 6.0, pulse_rate_ppm=of, snr_db=80.0, start=-15e-3) for of in (0.0, 100.0)
    )
    train = find_pulses(one.v_th, 200e3, PULSE)
    first, last = train.edges[[0, -1]]
    assert first > 2500
    records, sigma = np.stack([one.v_th, other.v_out])[None], np.full((1, 2), 1e-3)
    [drift] = clocks_apart(records, sigma, [train], np.zeros(1))
    # Its sign is that of a later pulse. A slower clock by 0.01 % of its own is 0.01 % of this.
    assert abs(drift) == pytest.approx(1e-4 * (last - first), rel=0.03)


@pytest.mark.parametrize(("uneven", "even"), [(0.02, True), (0.1, False)])
def test_pulses_have_one_rate_if_their_distances_are_equal_to_a_twentieth(uneven, even):
    v = np.zeros(20_000)
    for number, start in enumerate(1000 + 3333 * np.arange(5)):
        late = round(0.5 * uneven * 3333) * (number % 2)  # every other distance is longer
        v[start + late : start + late + 60] = 50.0
    v += np.random.default_rng(0).normal(scale=1e-3, size=v.size)
    assert (find_pulses(v, 200e3, PULSE).spacing is not None) == even


def test_a_disturbed_period_is_no_drift():
    record = simulate(snr_db=60.0)
    for period in (slice(3334), slice(6667, None)):
        v_out = record.v_out.copy()
        v_out[period] *= 0.5
        assert not Inspected.of(record.replace(v_out=v_out)).clocks_differ


def test_a_period_that_is_given_as_a_rate_is_named(noisy):
    wrong = Inspected.of(noisy.replace(pulse_rate=1 / PULSE))
    assert preflight(wrong, periodic=True) == "rate_mismatch"
    assert "pulse_rate is a period in seconds" in explained(wrong, "rate_mismatch")


@pytest.mark.parametrize(
    ("periods", "ppm"), [(30.0, 0.0), (30.0, 200.0), (30.0, -1000.0), (3.0, -1000.0)]
)
def test_a_clock_that_is_off_is_counted_and_said(periods, ppm):
    record = simulate(50e3, periods, pulse_rate_ppm=ppm, snr_db=24.0)
    seen = Inspected.of(record)
    counted = seen.train.counted / PULSE - 1
    # To half a sample from the first pulse to the last, and not if it is less than that.
    span = (periods - 1) * 50e3 / PULSE
    assert abs(counted - 1e-6 * ppm) < 0.5 / span
    assert (counted == 0) == (abs(ppm) * 1e-6 * span < 0.5)
    assert preflight(seen) is None
    assert seen.remarks == (Remark.pulse_rate_counted if abs(ppm) > 300 else Remark(0))


def test_other_signals_have_no_pulses_to_compare():
    generator = np.random.default_rng(0)
    time = np.arange(10_000.0)
    for v in (generator.normal(size=10_000), time, -time, np.zeros(10_000), np.zeros(0)):
        train = find_pulses(v, 200e3, PULSE)
        assert train.spacing is None
        assert train.mismatch == ""
        assert train.counted == PULSE


def test_transforms_have_the_lengths_that_scipy_recommends():
    for least in (1, 7, 1667, 10_007, 65_537, 2_100_001, 9_760_067):
        assert fast_length(least) == scipy.fft.next_fast_len(least, real=True)


def test_check_and_import_compare_the_rates(tmp_path):
    record = simulate()
    wrong = record.replace(sample_rate=100e3, calibration=())
    etid.Study.from_recordings([wrong]).write(tmp_path / "wrong.h5")
    [problem] = etid.check(tmp_path / "wrong.h5")
    assert (problem.path, problem.field) == ("a", "pulse_rate")
    assert "3333." in str(problem)
    assert "sample_rate = 200000 Hz" in str(problem)
    table = np.stack([record.v_th, record.v_out], axis=1)
    np.savetxt(tmp_path / "a.csv", table, delimiter=",", header="th,out", comments="")
    names = {"v_th": "th", "v_out": "out", "sample_rate": 200e3, "scale": 1}
    etid.import_file(tmp_path / "a.csv", tmp_path / "a.h5", pulse_rate=60.0, **names)
    assert etid.check(tmp_path / "a.h5") == []
    with pytest.raises(etid.RecordingError, match=r"pulse_rate: .*pulse_rate = 60 Hz"):
        etid.import_file(tmp_path / "a.csv", tmp_path / "b.h5", pulse_rate=120.0, **names)
    assert not (tmp_path / "b.h5").exists()
