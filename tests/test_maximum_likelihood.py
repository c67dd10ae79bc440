"""Maximum likelihood on the harmonics: exact without noise, joint with its calibrations."""

import pathlib
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal

import etid
from etid.circuits.circuit import SkinRC
from etid.estimators.lanes import Harmonics
from etid.estimators.maximum_likelihood.rows import calibrated, loads_of, source_of
from etid.estimators.registry import MAXIMUM_LIKELIHOOD
from etid.identify.fitting import known_of
from etid.likelihood import search
from etid.recordings.preflight import Inspected
from etid.simulation.scenes import Scene, Trial, paper_calibration
from etid.simulation.transformer import ResistorLoad, TransformerDriver
from etid.solvers.matrices import inverse_root
from tests import kept_numbers
from tests.skins import DRY, off

SAMPLES = 10_000
SIGMAS = 5.0  # one in 2 million for a normal error
FILES = 53  # that a reader of `identify_skin` opens at most, inspection and verdict included


def simulate(trials=1, resistors=(98.8e3,), samples=SAMPLES, seed=0, **options):
    return Scene(
        tuple(Trial(f"loaded/{i}", DRY) for i in range(trials)),
        tuple(Trial(f"calibration/{i}", ResistorLoad(r)) for i, r in enumerate(resistors)),
        samples=samples,
        **options,
    ).simulate(seed=seed)


@pytest.fixture(scope="module")
def study():
    return simulate(4, snr_db=60.0, trigger_jitter_rms=500e-9, seed=3)


@pytest.fixture(scope="module")
def driver(study):
    return etid.identify_driver(study["calibration/0"])


def test_the_driver_is_the_transformers_impedance_within_its_error(driver):
    assert driver.verdict == "successful"
    frequency = jnp.array([600.0, 5e3, 2e4, 4e4])
    true = np.abs(TransformerDriver().z_th(np.asarray(frequency)))
    off = np.abs(np.asarray(driver.response(frequency))) - true
    stderr = np.asarray(driver.response_stderr(frequency))
    assert (np.abs(off) < SIGMAS * stderr).all()
    assert (stderr < 0.02 * true).all()


@pytest.mark.parametrize("seed", [102, 173])  # the two of 200 where the noise leads astray
def test_noise_where_the_pulse_has_no_power_does_not_lead_a_driver_astray(seed):
    """With all harmonics Z_th is wrong by 23 and 30 % at 8 kHz; the rms of all seeds is 6 %."""
    scene = paper_calibration(snr_db=30.0, samples=SAMPLES, trigger_jitter_rms=50e-9)
    driver = etid.identify_driver([*scene.simulate(seed).values()], order=5)
    frequency = np.array([8e3])
    off = np.asarray(driver.response(frequency)) / scene.driver.z_th(frequency) - 1
    assert driver.verdict == "successful"
    assert np.abs(off) < 0.1


def test_trigger_delays_of_a_tenth_of_a_sample_leave_every_trial_within_its_error(study, driver):
    """One of them does not fit: its RRSE is large enough to say of which voltage it is a part."""
    last = study["loaded/3"]
    records = [study[f"loaded/{i}"] for i in range(3)]
    fits = etid.identify_skins([*records, last.replace(v_out=0.8 * last.v_out)], driver)
    assert fits.verdicts[:3].tolist() == ["successful"] * 3
    assert fits.verdicts[-1] != "successful"
    # In units of the elements, too: 500 ns would otherwise spread R_s by 93 %.
    assert (np.abs(off(fits)[:3]) < SIGMAS).all()
    values = np.asarray(fits.circuit.values())[:3]
    np.testing.assert_allclose(values, np.tile(DRY.values(), (3, 1)), rtol=0.02)
    kept_numbers.check("skins", kept_numbers.of_fit(fits.fit))
    kept_numbers.check("calibrated", kept_numbers.of_driver(driver))
    alone = etid.identify_skin(records[1], driver)
    # The lanes run the same steps; only the order of sums differs.
    np.testing.assert_allclose(alone.circuit.values(), fits[1].circuit.values(), rtol=1e-6)
    np.testing.assert_allclose(alone.chi2, fits.chi2[1], rtol=1e-6)


def test_a_fit_passes_through_few_files(study, driver):
    folder = pathlib.Path(etid.__file__).parent
    record = study["loaded/0"]
    etid.identify_skin(record, driver)  # keeps what it learns of the driver
    entered: set[str] = set()

    def note(frame, event, _):
        if event == "call":
            entered.add(frame.f_code.co_filename)

    before = sys.getprofile()
    sys.setprofile(note)
    try:
        etid.identify_skin(record, driver)
    finally:
        sys.setprofile(before)
    found = {path for path in map(pathlib.Path, entered) if path.is_relative_to(folder)}
    runs = folder / "garbage.py", folder / "precision.py"
    found = {path for path in found if not any(map(path.is_relative_to, runs))}
    assert folder / "identify" / "fitting.py" in found
    names = " ".join(sorted(path.relative_to(folder).as_posix() for path in found))
    assert len(found) <= FILES, names


@pytest.mark.parametrize(
    ("starts", "best"),
    [
        ([1.0, 2.0, 0.5, 3.0], 3.0),  # 9 is less than 4 times the 10 numbers of 5 harmonics
        ([7.0, 9.0, 6.4, 6.2], 6.2),
        ([1.0, 2.0, 0.5, 6.4], 0.5),
        ([0.5, 2.0, 7.0, 6.4], 0.5),
        ([7.0, 9.0, 8.0, 6.4], 6.4),
        ([1.0, 2.0, 0.5, np.nan], 0.5),
        ([np.nan, 7.0, np.nan, np.nan], 7.0),
        ([np.inf, np.nan, 8.0, 9.0], 8.0),
        ([8.0], 8.0),
    ],
)
def test_the_likeliest_start_is_taken_unless_it_is_bad(starts, best):
    starts = np.array(starts)[::-1]  # the likeliest is the first
    place = search.likeliest(0.5 * starts[:, None] ** 2, np.array([10.0]))
    assert starts[place[0]] == best


def test_a_record_without_a_whole_period_is_fitted_with_the_states_at_its_ends(study, driver):
    record, known = study["loaded/0"], study["calibration/0"]
    short = record.replace(v_th=record.v_th[:3332], v_out=record.v_out[:3332])
    for method in (None, "output_error"):
        fit = etid.identify_skin(short, driver, method=method)
        truth = np.array([33.4e3, 186e3, 0.12e-9])
        off = (np.asarray(fit.circuit.values()) - truth) / np.asarray(fit.stderr.values())
        assert np.abs(off).max() < 4
    steep = int(np.argmax(np.abs(np.diff(known.v_th))))  # a period cut within an edge is none
    part = slice(steep, steep + 3333)
    cut = known.replace(v_th=known.v_th[part], v_out=known.v_out[part])
    assert not Inspected.of(cut).is_periodic
    again = np.abs(etid.identify_driver(cut).response(np.array([1e3, 1e4])))
    before = driver.response(np.array([1e3, 1e4]))
    errors = 4 * driver.log_response_stderr(np.array([1e3, 1e4]))[0] + 0.02
    assert (np.abs(again / np.abs(before) - 1) < errors).all()


def test_one_unloaded_record_for_calibration_and_trial_tells_of_its_voltage_twice(study, driver):
    """As much as the bound of such a scene says, a fifth more of R_p than with two."""
    trials, known = (Trial("a", DRY),), (Trial("c", ResistorLoad(98.8e3)),)
    scene = Scene(trials, known, samples=SAMPLES, snr_db=60.0, shared_v_th=True)
    both = scene.simulate(seed=2)
    fits = etid.identify_skins([both["a"]], etid.identify_driver(both["c"]))
    bound = etid.bound(scene)["a"]
    found = fits[0].stderr.r_p / bound.stderr["r_p"]
    np.testing.assert_allclose(found, 1.0, atol=0.1)  # without it 1.2
    assert (np.abs(off(fits)) < SIGMAS).all()
    kept_numbers.check("shared_v_th", kept_numbers.of_fit(fits.fit))
    # Only the noise of V_out is the trial's own: half of it or more, as V_out is smaller.
    apart = etid.identify_skins([study["loaded/0"]], driver)
    own = [np.diagonal(of.cov[0] - of.fit.shared_cov[0]) for of in (fits, apart)]
    assert (own[0] > 0.45 * own[1]).all()
    assert (own[0] < 0.85 * own[1]).all()


def test_the_search_at_the_knots_ends_at_the_minimum_of_all_harmonics(study, driver):
    lane = Harmonics.of(Inspected.of(study["loaded/0"]))
    known = known_of(lane, driver, True, MAXIMUM_LIKELIHOOD)
    of = loads_of([lane], source_of(known), SkinRC(), None, calibrated(known))
    start = np.concatenate([np.log([30e3, 150e3, 0.2e-9]), [0.3], known.mean])
    q = jnp.asarray(search.minimum(of, start[None, None]).q[0])

    def objective(q):
        return of.objective(q[None])[0]

    slope, curvature = jax.jit(lambda q: (jax.grad(objective)(q), jax.hessian(objective)(q)))(q)
    left = slope @ inverse_root(curvature)
    # Lines between knots are wrong by a thousandth, and the residual has a standard deviation.
    assert float(jnp.linalg.norm(left)) < 0.03


def test_a_driver_that_is_followed_too_far_is_no_success():
    """At 20 dB a calibration leaves much of Z_th open; of 120 fits three went beyond it."""
    trials = tuple(Trial(f"loaded/{i}", DRY) for i in range(2))
    known = (Trial("c", ResistorLoad(98.8e3)),)
    scene = Scene(trials, known, samples=SAMPLES, snr_db=20.0, trigger_jitter_rms=50e-9)
    verdicts = []
    for seed in (1, 12):
        study = scene.simulate(seed=seed)
        driver = etid.identify_driver(study["c"], throw=False)
        fits = etid.identify_skins(study.loaded, driver)
        assert (np.abs(off(fits.usable(), DRY)) < SIGMAS).all()
        verdicts += fits.verdicts.tolist()
    assert "driver_unclear" in verdicts
    assert "successful" in verdicts


def test_records_of_ragged_lengths_are_fitted_together(study, driver):
    records = [
        record.replace(v_th=record.v_th[:size], v_out=record.v_out[:size])
        for record in study.loaded.recordings()
        for size in range(6_667, 10_000, 417)
    ]
    fits = etid.identify_skins(records, driver)
    assert fits.counts() == {"successful": len(records)}
    assert (np.abs(off(fits)) < SIGMAS).all()


def test_a_circuit_far_from_its_typical_values_is_found():
    """Fits never start at the truth: three decades of impedance around it."""
    study = simulate(snr_db=70.0, seed=9)
    driver = etid.identify_driver(study["calibration/0"])
    for factor in (1 / 30, 30.0):
        start = SkinRC(r_s=20e3 * factor, r_p=300e3 * factor, c_p=0.2e-9 / factor)
        fit = etid.identify_skin(study["loaded/0"], driver, circuit=start)
        assert (np.abs(off(fit)) < SIGMAS).all()


def test_coloured_noise_makes_the_errors_larger_where_it_is_strong():
    """Noise of 1 in 1000, nearly all of it below 1 kHz where R_p is seen."""
    quiet = simulate(6, snr_db=80.0, seed=4)
    generator = np.random.default_rng(4)

    def hum(v):
        noise = scipy.signal.lfilter([1], [1, -0.98], generator.normal(size=v.size + 2000))[2000:]
        return v + 1e-3 * np.std(v) * np.asarray(noise) / np.std(noise)

    records = {
        p: quiet[p].replace(v_th=hum(quiet[p].v_th), v_out=hum(quiet[p].v_out)) for p in quiet
    }
    driver = etid.identify_driver(records.pop("calibration/0"))
    fits = etid.identify_skins(records.values(), driver)
    assert fits.counts() == {"successful": 6}
    z = off(fits)
    assert (np.abs(z) < SIGMAS).all()
    # Of six errors that share a driver's; a factor of two would be no accident.
    assert (np.sqrt((z**2).mean(0)) < 2).all()
