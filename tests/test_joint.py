"""One fit of a whole study: what is shared is told from what is each trial's own."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import etid
from benchmarks.failure_axes import Cole
from benchmarks.ladder import LOADS
from etid.recordings.remarks import Remark
from etid.recordings.study import Study
from etid.simulation.scenes import Scene, Trial
from etid.simulation.transformer import ResistorLoad, TransformerDriver
from tests import kept_numbers
from tests.skins import DAMP, DRY, off

KNOWN = (Trial("calibration/0", ResistorLoad(98.8e3)),)
TRIALS = tuple(Trial(f"loaded/{i}", DRY, condition="dry") for i in range(6))
TOGETHER = [trial.path for trial in TRIALS[:2]]  # with one unloaded record; each other has its own
SIGMAS = 5.0  # one in 2 million for a normal error


def two_relaxations(f):
    s = 2j * np.pi * f
    return 20e3 + 1e5 / (1 + s * 1e5 * 0.12e-9) + 6e4 / (1 + s * 6e4 * 3e-9)


def simulate(odd, seed, trigger_jitter_rms=50e-9, **options):
    """Trials and calibration; two trials have one unloaded record."""
    scene = Scene((*TRIALS, odd), KNOWN, trigger_jitter_rms=trigger_jitter_rms, **options)
    apart = scene.simulate(seed)
    together = dataclasses.replace(scene, shared_v_th=True).simulate(seed)
    return Study.from_recordings([(together if p in TOGETHER else apart)[p] for p in apart])


@pytest.fixture(scope="module")
def study():
    made = simulate(Trial("odd", two_relaxations, condition="odd"), seed=3)
    bad = made["loaded/0"]
    short = bad.replace(v_th=bad.v_th[:2500], v_out=bad.v_out[:2500], path="short")
    broken = bad.replace(v_out=np.where(np.arange(bad.v_out.size) == 7, np.nan, bad.v_out))
    return Study.from_recordings(
        [*made.recordings(), short, broken.replace(path="broken", condition="broken")]
    )


@pytest.fixture(scope="module")
def outcome(study):
    return etid.identify_jointly(study)


def test_every_recording_has_its_verdict_and_a_bad_one_costs_itself_alone(study, outcome):
    verdicts = dict(zip(outcome.fits.labels["path"], outcome.fits.verdicts, strict=True))
    assert [verdicts[trial.path] for trial in TRIALS] == ["successful"] * len(TRIALS)
    assert verdicts["odd"] == "misfit"
    assert verdicts["short"] == "not_periodic"
    assert verdicts["broken"] == "nonfinite_samples"
    assert set(verdicts) == set(study.loaded)
    assert outcome.fits.fit.method == "joint"
    # The driver's valley takes dozens of steps; none of them may need all harmonics of a load.
    assert (np.asarray(outcome.fits.where(condition="dry").fit.steps) <= 3).all()
    kept_numbers.check("joint", kept_numbers.of_fit(outcome.fits.fit))
    # Together the trials know the driver better than its calibration.
    [driver] = outcome.drivers.values()
    kept_numbers.check("joint_driver", kept_numbers.of_driver(driver))
    assert driver.verdict == "successful"
    alone, frequency = etid.identify_driver(study["calibration/0"]), jnp.array([3e3, 60e3, 80e3])
    assert (driver.response_stderr(frequency) < alone.response_stderr(frequency)).all()


def test_a_recording_that_is_given_twice_is_refused(study):
    """Its noise would count twice: the errors of the driver would be too small."""
    again = study["loaded/0"].replace(path="again")
    with pytest.raises(etid.RecordingError, match=r"same samples as .*\. Pass each") as caught:
        etid.identify_jointly(Study.from_recordings([*study.recordings(), again]))
    assert caught.value.path == "again"
    assert caught.value.field == "study['again']"
    assert "study['loaded/0']" in caught.value.message


@pytest.mark.slow
def test_known_elements_of_a_joint_fit_help_the_others(study, outcome):
    few = Study.from_recordings([study[path] for path in ("calibration/0", *TOGETHER)])
    free = outcome.fits.where(path=TOGETHER[0])[0]
    tolerance = etid.Instrument(r_load=0.01)
    known = 33401.0  # R_s is 33400, which is exp(ln 33400)
    fixed = etid.identify_jointly(few, fixed={"r_s": known}, instrument=tolerance)
    for fit in fixed.fits:
        assert fit.verdict == "successful"
        assert fit.circuit.r_s == known
        assert fit.stderr.r_s < 1e-8 * DRY.r_s  # the tolerance of R_L does not reach it
        assert (np.abs(off(fit)[1:]) < SIGMAS).all()
    assert fixed.settings is not None
    assert fixed.settings.fixed == ("r_s 33401.0",)
    told = etid.identify_jointly(few, prior={"r_p": (float(DRY.r_p), 10.0)}).fits[0]
    assert told.stderr.r_p < 10.0 < 0.1 * free.stderr.r_p
    assert told.stderr.r_s < free.stderr.r_s


@pytest.mark.slow
def test_bounds_of_a_joint_fit_leave_the_driver_as_it_is(study, outcome):
    free = outcome.fits.where(path=TOGETHER[0])
    low = float(free.circuit.r_s[0] + free.stderr.r_s[0])
    told = etid.identify_jointly(study, bounds={"r_s": (low, None)})
    fit = told.fits.where(path=TOGETHER[0])
    assert int(fit.fit.remarks[0]) & Remark.at_bound
    assert fit.circuit.r_s[0] > low
    # Of a normal distribution, one standard deviation above its mean, 0.446 is left.
    np.testing.assert_allclose(fit.stderr.r_s[0] / free.stderr.r_s[0], 0.446, rtol=0.01)
    assert fit.fit.shared_cov[0, 0, 0] < fit.cov[0, 0, 0]
    for of, other in zip(told.drivers.values(), outcome.drivers.values(), strict=True):
        np.testing.assert_allclose(of.b, other.b, rtol=1e-6)


def test_another_skin_is_a_misfit_where_chi2_does_not_show_it():
    """R_s would be wrong by more than five of its standard errors and called successful."""
    odd = Trial("odd", Cole(LOADS["dry"], alpha=0.9), condition="odd")
    study = simulate(odd, seed=4, snr_db=40.0)
    fits = etid.identify_jointly(study).fits
    another = fits.where(path="odd")
    assert another.counts() == {"misfit": 1}
    assert another.fit.chi2.item() < 1.5
    assert abs(off(another)[0, 0]) > SIGMAS
    dry = fits.where(condition="dry")
    assert dry.counts() == {"successful": len(TRIALS)}
    # At 40 dB and more than 500 harmonics, χ² has a deviation of less than 0.05.
    np.testing.assert_allclose(dry.fit.chi2, 1.0, atol=SIGMAS * 0.05)


@pytest.mark.parametrize("kind", LOADS)
def test_skin_of_another_circuit_does_not_move_the_elements_of_the_others(kind):
    """At 50 dB its χ² is 1.5 at most, and C_p of the others would be several errors off."""
    odd = Trial("odd", Cole(LOADS[kind], alpha=0.9), condition="odd")
    study = simulate(odd, seed=4, snr_db=50.0)
    without = Study.from_recordings([one for one in study.recordings() if one.path != "odd"])
    fits, alone = (etid.identify_jointly(one).fits for one in (study, without))
    assert fits.where(path="odd").counts() == {"misfit": 1}
    others = fits.where(condition="dry")
    assert others.counts() == {"successful": len(TRIALS)}
    # Both searches end within 0.01 standard errors of the minimum.
    np.testing.assert_allclose(off(others), off(alone), atol=0.05)


def test_elements_are_within_their_errors_and_spread_by_their_own_part(outcome):
    fits = outcome.fits.where(condition="dry").usable()
    assert (np.abs(off(fits)) < SIGMAS).all()
    error = np.asarray(fits.circuit.values()) - np.asarray(DRY.values())
    own = np.sqrt(np.diagonal(fits.cov - fits.fit.shared_cov, axis1=1, axis2=2))
    shared = np.sqrt(np.diagonal(fits.fit.shared_cov, axis1=1, axis2=2))
    assert (own > 0).all()
    assert (shared > 0).all()
    # Deviations from the mean over own errors: chi-squared, 5 degrees of freedom, for each element.
    # These limits are exceeded once in ten thousand.
    scaled = ((error - error.mean(0)) / own) ** 2
    assert (scaled.sum(0) > 0.08).all()
    assert (scaled.sum(0) < 25.7).all()
    # Noise of an unloaded record of several trials is none of their own: σ_y² is left of
    # σ_y² + |G|² σ_x², half to three quarters of it; the sum remains.
    together = np.isin(fits.labels["path"], TOGETHER)
    assert together.sum() == 2
    ratio = own[together] ** 2 / (own[~together] ** 2).mean(0)
    assert (ratio > 0.45).all(), ratio
    assert (ratio < 0.85).all(), ratio
    whole = np.asarray(fits.stderr.values())
    alone = whole[~together].mean(0)
    np.testing.assert_allclose(whole[together] / alone[None, :], np.ones((2, 3)), rtol=0.1)


def test_the_tolerance_of_the_resistor_is_shared_and_passes_one_to_one(study, outcome):
    tolerance = etid.Instrument(r_load=0.01)
    doubtful = etid.identify_jointly(study, instrument=tolerance).fits.where(condition="dry")
    fits = outcome.fits.where(condition="dry")
    values = np.asarray(fits.circuit.values())
    for cov, before in (
        (doubtful.cov, fits.cov),
        (doubtful.fit.shared_cov, fits.fit.shared_cov),
    ):
        grown = (cov - before) / values[:, :, None] / values[:, None, :]
        sign = np.array([1, 1, -1])  # a resistor that is larger makes the capacitor smaller
        np.testing.assert_allclose(grown[0], 1e-4 * np.outer(sign, sign), rtol=1e-3)


@pytest.mark.slow
def test_delays_that_do_not_scatter_leave_smaller_errors_and_the_fits_say_so():
    """One trigger for all records: R_s and C_p need not pay for delays that the study excludes."""
    many = tuple(Trial(f"loaded/{i}", DRY, condition="dry") for i in range(60))
    odd = Trial("odd", two_relaxations, condition="odd")
    common = Scene((*many, odd), KNOWN, trigger_jitter_rms=0.0)
    fits = etid.identify_jointly(common.simulate(seed=3)).fits
    dry = fits.where(condition="dry").usable()
    assert len(dry) == len(many)
    assert (np.asarray(dry.fit.remarks) & Remark.small_delays).all()
    assert not (np.asarray(fits.where(path="odd").fit.remarks) & Remark.small_delays).any()
    assert (np.abs(off(dry)) < SIGMAS).all()
    apart = dataclasses.replace(common, trigger_jitter_rms=50e-9)
    scattered = etid.identify_jointly(apart.simulate(seed=3)).fits.where(condition="dry")
    assert not (np.asarray(scattered.fit.remarks) & Remark.small_delays).any()
    # By the bound, C_p of dry skin has 0.7 of its error then, and two studies differ by a tenth.
    assert np.median(dry.stderr.c_p) < 0.85 * np.median(scattered.stderr.c_p)


def test_three_records_whose_delays_are_alike_by_chance_limit_none():
    """Else R_p of damp skin would be 8.8 standard errors off."""
    trials = tuple(Trial(name, load) for name, load in LOADS.items())
    scene = Scene(trials, KNOWN, snr_db=40.0, samples=10_000, trigger_jitter_rms=50e-9)
    fits = etid.identify_jointly(scene.simulate(seed=16)).fits
    for i, load in enumerate(LOADS.values()):
        off_by = np.array(list(fits[i].circuit.values())) - dataclasses.astuple(load)
        assert (np.abs(off_by / list(fits[i].stderr.values())) < SIGMAS).all()


def test_a_driver_that_changed_after_its_calibration_is_no_success(study):
    """R_p would be 5 % wrong at chi-squared 1."""
    changed = TransformerDriver(r_protection=1.1 * TransformerDriver().r_protection)
    other = Scene((), KNOWN, changed).simulate(seed=2)
    records = [study[path] for path in study if path != "calibration/0"]
    mixed = etid.identify_jointly(Study.from_recordings([*other.recordings(), *records]))
    assert "successful" not in mixed.fits.counts()
    assert "inconsistent" in mixed.fits.counts()
    assert {d.verdict for d in mixed.drivers.values()} == {"inconsistent"}


@pytest.mark.parametrize(("circuit", "snr_db", "seed"), [(DRY, 21.8, 28), (DAMP, 26.8, 9)])
def test_noisy_studies_come_to_their_minimum(circuit, snr_db, seed):
    """From the own parameters that loads have alone, with a Z_th each, the search never ended."""
    loaded = tuple(Trial(f"loaded/{i}", circuit) for i in range(6))
    options = {"shared_v_th": circuit is DAMP, "trigger_jitter_rms": 50e-9}
    scene = Scene(loaded, KNOWN, snr_db=snr_db, **options)
    fits = etid.identify_jointly(scene.simulate(seed)).fits
    assert (fits.verdicts == "successful").all()
    assert (np.asarray(fits.fit.steps) < 40).all()
