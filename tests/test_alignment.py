"""Records of two triggers are aligned by whole samples, before a fit and in it."""

import numpy as np
import pytest

import etid
from etid.estimators.lanes import Bins, Harmonics
from etid.recordings.causes import why_misaligned
from etid.recordings.preflight import Inspected, preflight
from etid.recordings.remarks import Remark
from etid.signals.lags import lags_of, whole_lag
from etid.signals.pulse_train import find_pulses
from etid.simulation.scenes import Scene, Trial
from etid.simulation.transformer import ResistorLoad, TransformerDriver
from tests.skins import DAMP, DRY, off

PULSE = 60.0
LOADS = {"dry": DRY, "damp": DAMP, "resistor": etid.Resistor(21.62e3)}
SIGMAS = 5.0  # one in 2 million for a normal error


def simulate(
    late=0.0, sample_rate=200e3, seed=0, snr_db: float | None = 60.0, periods=3.0, **driver
):
    """Records whose `v_out` is late by so many samples; a pulse begins at 40 % of a period."""

    def study(start):
        return Scene(
            tuple(Trial(name, load) for name, load in LOADS.items()),
            (Trial("98k8", ResistorLoad(98.8e3)),),
            sample_rate=sample_rate,
            samples=round(periods * sample_rate / PULSE),
            start=start,
            snr_db=snr_db,
            driver=TransformerDriver(**driver),
        ).simulate(seed)

    early, other = study(0.010), study(0.010 - late / sample_rate)
    return {name: early[name].replace(v_out=other[name].samples["v_out"]) for name in early}


@pytest.fixture(scope="module")
def driver():
    return etid.identify_driver(simulate(seed=5)["98k8"])


@pytest.mark.parametrize(
    ("sample_rate", "snr_db", "late"),
    [
        *((100e3, 10.0, late) for late in (0.0, 1.5, -300.0)),
        *((200e3, 20.0, late) for late in (0.0, 50.3)),
        *((500e3, 20.0, late) for late in (1.5, 50.3, -300.0)),
    ],
)
def test_the_lag_is_found_to_less_than_a_sample(sample_rate, snr_db, late):
    """A damp skin's own delay is 2.5 µs, half of it in the edges: half a sample at 500 kHz."""
    for name, record in simulate(late, sample_rate, snr_db=snr_db, periods=1.0).items():
        train = find_pulses(record.v_th, sample_rate, PULSE)
        [lag] = lags_of(np.stack([record.v_th, record.v_out])[None], [train])
        assert lag is not None, name
        assert abs(lag - late) < 1.0, name
        assert (whole_lag(lag) == 0) == (late == 0.0)


def test_noise_that_hides_the_edges_is_named_before_other_causes():
    found = [simulate(snr_db=3.0, seed=seed)["resistor"] for seed in range(6)]
    hidden = [one for one in map(Inspected.of, found) if preflight(one) == "misaligned"]
    assert hidden
    for one in hidden:
        assert "times the power of the noise: it may hide the edges" in why_misaligned(one)


def test_opposite_polarity_and_lags_out_of_reach_are_misaligned():
    record = simulate(periods=1.0)["damp"]
    assert np.isnan(Inspected.of(record.replace(v_out=-record.v_out)).correlated)
    for late in (450.0, -450.0):
        assert preflight(Inspected.of(simulate(late, periods=1.0)["damp"])) == "misaligned"


@pytest.mark.parametrize("width", [2.5e-3, 1 / 120, 12e-3])
def test_a_long_pulse_is_not_taken_for_one_of_the_other_polarity(width):
    """Its two edges are alike but for their signs; at half a period, so are those of half of it."""
    for seed in range(2):
        record = simulate(50.3, seed=seed, width=width)["damp"]
        lag = Inspected.of(record).correlated
        assert abs(lag - 50.3) < 1.0
        assert np.isnan(Inspected.of(record.replace(v_out=-record.v_out)).correlated)


@pytest.mark.parametrize("late", [3, -120])
def test_what_is_fitted_does_not_depend_on_whole_samples(late):
    """To the steps of a 16-bit converter: nothing wraps around, and the phases are exact."""
    there, here = Inspected.of(simulate(late, snr_db=None)["dry"]), simulate(snr_db=None)["dry"]
    assert there.lag == late
    harmonic, right = Harmonics.of(there), Harmonics.of(Inspected.of(here))
    step = 10 / 2**15 / 0.0535  # rounding of two records, shared by 10 000 samples
    np.testing.assert_allclose(harmonic.y, right.y, atol=6 * step / np.sqrt(10_000))
    v_th, v_out = there.aligned
    begin, size = max(0, -late), 10_000 - abs(late)
    np.testing.assert_array_equal(v_th, here.v_th[begin : begin + size])
    np.testing.assert_allclose(v_out, here.v_out[begin : begin + size], atol=1.01 * step)
    bins, samples = Bins.of(there), here.v_th[begin : begin + size]
    expected = np.fft.rfft(samples)[1 : bins.size + 1] / size
    used = np.flatnonzero(bins.selected)
    np.testing.assert_allclose(np.asarray(bins.x)[used], expected[used], atol=1e-12)


def test_elements_are_those_without_the_delay(driver):
    names = ("dry", "damp", "dry")
    lates = zip(names, (1.5, -5.0, 300.0), strict=True)
    records = [simulate(late, seed=8)[name] for name, late in lates]
    fits = etid.identify_skins(records, driver)
    assert fits.counts() == {"successful": 3}
    assert (np.asarray(fits.fit.remarks) == Remark.aligned).all()
    truth = np.array([LOADS[name].values() for name in names])
    assert (np.abs(off(fits, truth)) < SIGMAS).all()
    # The prediction is that of the record as it is: to its noise, 10 mV, and that of V_th.
    circuit = etid.SkinRC(*map(float, np.asarray(fits.circuit.values())[0]))
    rest = etid.predict(records[0], driver, circuit) - records[0].v_out
    assert np.nanstd(rest) < 2 * np.sqrt(2) * float(Inspected.of(records[0]).sigma[1])


def test_a_calibration_that_is_late_serves_as_well():
    late = etid.identify_driver(simulate(-5.0, seed=6)["98k8"])
    assert late.remarks == Remark.aligned
    fit = etid.identify_skin(simulate(seed=8)["dry"], late)
    assert (np.abs(off(fit)) < SIGMAS).all()


def test_what_looks_later_than_it_is_is_aligned_again(driver, monkeypatch):
    """Edges that a load smoothes may be found two samples late: the misfit tells how many."""
    monkeypatch.setattr("etid.recordings.inspection.whole_lag", lambda lag: round(lag) - 2)
    record = simulate(7.0, seed=8)["dry"]
    alone = etid.identify_skin(record, driver)
    fits = etid.identify_skins([record, simulate(0.0, seed=9)["dry"]], driver)
    assert fits.counts() == {"successful": 2}
    for fit in (alone, fits[0]):
        assert (np.abs(off(fit)) < SIGMAS).all()


@pytest.mark.slow
def test_a_joint_fit_aligns_its_recordings():
    study, late = simulate(0.0, seed=3), simulate(40.4, seed=4)
    names = ("dry", "damp")
    trials = [study[n].replace(path=f"a/{n}") for n in names]
    trials += [late[n].replace(path=f"b/{n}") for n in names]
    found = etid.identify_jointly(etid.Study.from_recordings([study["98k8"], *trials]))
    assert found.fits.counts() == {"successful": 4}
    truth = np.array([LOADS[name].values() for name in names * 2])
    assert (np.abs(off(found.fits, truth)) < SIGMAS).all()
    remarks = np.asarray(found.fits.fit.remarks)
    np.testing.assert_array_equal(remarks, [0, 0, int(Remark.aligned), int(Remark.aligned)])
