"""Elements with bounds: estimates, errors and their coverage, files, commands, and wrong bounds."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
import scipy.stats

import etid
from etid import cli
from etid.estimators.element_limits import truncated, within
from etid.printing import quantity
from etid.recordings.remarks import Remark
from etid.results.fit import Support
from etid.results.verdicts import verdict
from tests.test_current import SKIN, recorded
from tests.test_judging import estimate, judged


@pytest.fixture(scope="module")
def noisy():
    """R_s has an error of 8 %."""
    return recorded(SKIN, snr_db=20.0, seed=3)


@pytest.fixture(scope="module")
def free(noisy):
    return etid.identify_skin(noisy)


@pytest.fixture(scope="module")
def beyond(noisy, free):
    """A fit whose free estimate lies one standard error below its bound."""
    return etid.identify_skin(noisy, bounds={"r_s": (above(free, 1.0), None)})


def above(fit, errors):
    """A value of R_s this many standard errors above a fit [Ω]."""
    return float(fit.circuit.r_s + errors * fit.stderr.r_s)


@pytest.mark.parametrize(
    ("low", "high"), [(-1.0, 2.0), (0.5, np.inf), (3.0, 3.001), (-9.0, -8.0), (30.0, np.inf)]
)
def test_moments_of_a_truncated_normal_are_those_of_scipy(low, high):
    mean, deviation = 5.0, 2.0
    found = truncated(
        *map(np.array, (mean, deviation, *(mean + deviation * np.array([low, high]))))
    )
    # SciPy's own moments lose digits far out, so the integral is compared: by its density.
    x = np.linspace(low, min(high, low + 10.0), 200_001)
    weight = np.exp(scipy.stats.norm.logpdf(x) - scipy.stats.norm.logpdf(x).max())
    centre = np.trapezoid(weight * x, x) / np.trapezoid(weight, x)
    variance = np.trapezoid(weight * (x - centre) ** 2, x) / np.trapezoid(weight, x)
    # The sum of 200 000 steps has the integral to 10⁻⁸.
    np.testing.assert_allclose(found[0], mean + deviation * centre, rtol=1e-7)
    np.testing.assert_allclose(found[1], deviation**2 * variance, rtol=1e-5)


def test_several_bounded_elements_are_those_of_draws_inside_the_box():
    circuit, deviation = etid.SkinRC(30e3, 180e3, 0.1e-9), np.array([6e3, 5e3, 4e-12])
    related = np.array([[1, -0.9, 0.5], [-0.9, 1, -0.4], [0.5, -0.4, 1]])
    cov = related * np.outer(deviation, deviation)
    bounds = (("r_s", 33e3, np.inf), ("r_p", 170e3, 182e3))
    found = within(circuit, circuit.values(), cov, 0.5 * cov, bounds)
    x = np.random.default_rng(2).multivariate_normal(circuit.values(), cov, 100_000)
    x = x[(x[:, 0] > 33e3) & (x[:, 1] > 170e3) & (x[:, 1] < 182e3)]
    # Expectation propagation is not exact for several elements; a tenth of an error is no harm.
    assert np.abs((found.values - x.mean(0)) / x.std(0)).max() < 0.1
    np.testing.assert_allclose(np.sqrt(np.diagonal(found.cov)), x.std(0), rtol=0.1)
    assert float(found.outside[0]) < 0
    assert not bool(found.contradicted)
    own = np.linalg.eigvalsh((found.cov - found.shared_cov) / np.outer(deviation, deviation))
    assert own.min() > 0
    # R_s moves R_p with it, below 0.
    far = within(circuit, circuit.values(), cov, cov, (("r_s", 500e3, np.inf),))
    assert np.isnan(far.values).all()
    assert bool(far.contradicted)


def test_the_deviance_of_several_bounds_is_that_of_the_nearest_point_between_them():
    """A bound far away leaves its element free to follow: two standard errors of R_s cost 4.

    In NumPy and in JAX.
    """
    circuit, deviation = etid.SkinRC(30e3, 180e3, 0.1e-9), np.array([3e3, 3e3, 3e-12])
    related = np.array([[1, -0.9, 0], [-0.9, 1, 0], [0, 0, 1]])
    cov, bounds = (
        related * np.outer(deviation, deviation),
        (("r_s", 36e3, np.inf), ("r_p", 90e3, 270e3)),
    )
    found = within(circuit, circuit.values(), cov, cov, bounds)
    traced = jax.jit(
        lambda values: within(circuit, values, jnp.asarray(cov), jnp.asarray(cov), bounds)
    )
    for one, other in zip(found, traced(jnp.asarray(circuit.values())), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9)
    np.testing.assert_allclose(found.deviance, 4.0, rtol=1e-6)


TRUTH, ERROR = np.array([30e3, 180e3, 0.1e-9]), np.array([3e3, 3e3, 3e-12])
RELATED = np.array([[1, -0.8, 0.5], [-0.8, 1, -0.4], [0.5, -0.4, 1]])


def coverage(bounds, draws=10_000):
    """Part of the intervals of 95 % that contain the truth, for each element."""
    cov = RELATED * np.outer(ERROR, ERROR)
    drawn = np.random.default_rng(1).multivariate_normal(TRUTH, cov, draws)
    covs = np.broadcast_to(cov, (draws, 3, 3))
    found = within(etid.SkinRC(), drawn, covs, covs, bounds)
    errors = np.sqrt(np.diagonal(found.cov, axis1=1, axis2=2))
    return np.mean(np.abs(found.values - TRUTH) < 1.96 * errors, axis=0)


@pytest.mark.parametrize("from_bound", [0.0, 1.0, 4.0])
def test_intervals_contain_the_truth_as_often_as_they_say_near_and_far_from_a_bound(from_bound):
    """Between 94.2 and 97.3 % by quadrature; three standard deviations of 10 000 draws are 0.7."""
    covered = coverage((("r_s", float(TRUTH[0] - from_bound * ERROR[0]), 60e3),))
    assert 0.935 < covered[0] < 0.98
    # An element that is related to it is covered worst if the truth is the bound itself: 90 %.
    assert ((covered > 0.89 if from_bound == 0 else covered > 0.93) & (covered < 0.98)).all(), (
        covered
    )


@pytest.mark.slow
@pytest.mark.parametrize(("from_bounds", "expected"), [(0.0, 0.729), (0.5, 0.913), (1.0, 0.955)])
def test_intervals_of_three_bounded_elements_hold_what_the_guide_says(from_bounds, expected):
    """The worst element in the worst corner of a box whose sides are six errors long."""
    low = TRUTH - ERROR * np.array([from_bounds, 6.0 - from_bounds, from_bounds])
    bounds = zip(("r_s", "r_p", "c_p"), low, low + 6.0 * ERROR, strict=True)
    covered = coverage(tuple((name, float(a), float(b)) for name, a, b in bounds), draws=2000)
    assert abs(covered.min() - expected) < 3 * np.sqrt(expected * (1 - expected) / 2000)


def test_bounds_far_away_change_nothing_and_those_that_contradict_the_data_are_no_success():
    of = estimate(relative=(0.05, 0.02, 0.03))
    free = judged(of, etid.SkinRC())

    def bounded(errors):
        bounds = (("r_s", above(free, errors), np.inf),)
        return judged(of, etid.SkinRC(), bounds=bounds)

    far = bounded(-10.0)
    np.testing.assert_allclose(far.circuit.values(), free.circuit.values(), rtol=1e-9)
    np.testing.assert_allclose(far.cov, free.cov, rtol=1e-9)
    assert (far.verdict, int(far.remarks)) == ("successful", 0)
    assert (bounded(3.2).verdict, int(bounded(3.2).remarks)) == ("successful", Remark.at_bound)
    assert bounded(3.5).verdict == "out_of_bounds"


def test_an_element_that_only_its_bounds_determine_is_no_more_insensitive():
    of = estimate(relative=(1.5, 0.02, 0.03))
    assert judged(of, etid.SkinRC()).verdict == "insensitive"
    known = judged(of, etid.SkinRC(), bounds=(("r_s", 1e4, 3e4),))
    assert known.verdict == "successful"
    failed = judged(of, etid.SkinRC(), verdict("nonphysical"), (("r_s", 1e4, 3e4),))
    assert failed.verdict == "driver_failed"


def test_an_element_beyond_its_bound_is_said_and_has_the_error_of_what_is_left(free, beyond):
    assert beyond.verdict == "successful"
    assert int(beyond.remarks) & Remark.at_bound
    assert "would lie outside" in str(beyond)
    left = scipy.stats.truncnorm(1.0, np.inf, float(free.circuit.r_s), float(free.stderr.r_s))
    np.testing.assert_allclose(beyond.circuit.r_s, left.mean(), rtol=1e-9)
    np.testing.assert_allclose(beyond.stderr.r_s, left.std(), rtol=1e-9)
    # R_s + R_p is known well, so the other elements follow, with smaller errors.
    assert beyond.circuit.r_p < free.circuit.r_p
    assert beyond.stderr.r_p < 0.7 * free.stderr.r_p


def test_draws_keep_to_the_bounds_and_agree_with_the_fit(free, beyond):
    posterior = beyond.posterior(draws=2000)
    inside = posterior.weights[np.asarray(posterior.draws.r_s) < above(free, 1.0)]
    assert inside.sum() == 0.0
    assert posterior.effective > 400
    # The likelihood is skewed at 20 dB: its mean differs by a quarter of a standard error.
    mean = posterior.weights @ np.asarray(posterior.draws.r_s)
    assert abs(mean - beyond.circuit.r_s) < 0.4 * beyond.stderr.r_s
    # An interval of the normal distribution, cut at the bound, has its probability all the same.
    for name, (low, high) in beyond.intervals().items():
        draws = np.asarray(getattr(posterior.draws, name))
        assert posterior.weights[(draws >= low) & (draws <= high)].sum() > 0.92
    assert beyond.intervals()["r_s"][0] == above(free, 1.0)


def r_p_at(bound, free):
    """R_p and its error where R_s is at a bound: a normal distribution, up to the skew at 20 dB."""
    cov = np.asarray(free.cov)
    middle = float(free.circuit.r_p) + cov[0, 1] / cov[0, 0] * (bound - float(free.circuit.r_s))
    return middle, np.sqrt(cov[1, 1] - cov[0, 1] ** 2 / cov[0, 0])


@pytest.mark.slow
def test_profiles_keep_to_the_bounds(free, beyond):
    bound = above(free, 1.0)
    own, other = beyond.profile("r_s"), beyond.profile("r_p")
    np.testing.assert_allclose(own.values[0], bound, rtol=1e-9)
    # The likeliest value inside is the bound; r_p follows, and without bounds it does not.
    np.testing.assert_allclose(own.deviance[0], 0.0, atol=1e-3)
    assert np.all(np.diff(own.deviance) > 0)
    assert own.interval()[0] == bound
    assert other.deviance.min() > -1e-3
    middle, error = r_p_at(bound, free)
    likeliest = other.values[np.argmin(other.deviance)]
    ends = likeliest, other.interval()[1]
    np.testing.assert_allclose(ends, [middle, middle + 1.96 * error], rtol=0, atol=0.4 * error)


def test_a_profile_ends_at_an_upper_bound(noisy, free):
    bound = above(free, -1.0)
    ended = etid.identify_skin(noisy, bounds={"r_s": (None, bound)}).profile("r_s")
    np.testing.assert_allclose(ended.values[-1], bound, rtol=1e-9)
    assert ended.interval()[1] == bound


@pytest.mark.slow
def test_profiles_of_other_elements_keep_to_an_upper_bound(noisy, free):
    """R_s may not be above its bound, so R_p, which has its sum with R_s, may hardly be below."""
    bound = above(free, -1.0)
    profile = etid.identify_skin(noisy, bounds={"r_s": (None, bound)}).profile("r_p")
    middle, error = r_p_at(bound, free)
    low = profile.interval()[0]
    np.testing.assert_allclose(low, middle - 1.96 * error, rtol=0, atol=0.4 * error)


def test_a_choice_compares_each_circuit_inside_its_own_bounds(noisy, free):
    """R_p of the true circuit is forbidden; another circuit has no such element."""
    candidates = [etid.SkinRC(), etid.Resistor()]
    inside = {"r_p": (0.5 * float(free.circuit.r_p), 2.0 * float(free.circuit.r_p))}
    chosen = etid.select_circuit(noisy, candidates=candidates, bounds=inside)
    assert type(chosen.fit.circuit) is etid.SkinRC
    of = estimate(relative=(0.05, 0.02, 0.03))
    support = Support(jnp.array(10.0), jnp.array(100.0), *[jnp.zeros(of) for of in (9, (), 3, ())])
    of = of._replace(support=support)
    alone = judged(of, etid.SkinRC())
    bounds = ("r_s", above(alone, 2.0), np.inf), ("r", 1.0, 2.0)
    told = judged(of, etid.SkinRC(), bounds=bounds)
    assert told.support is not None
    # The likeliest point inside is two standard errors away.
    np.testing.assert_allclose(told.support.deviance, 14.0, rtol=1e-6)


@pytest.mark.slow
def test_an_element_outside_and_its_bound_are_named_wherever_verdicts_are(
    noisy, free, beyond, tmp_path
):
    bound = quantity(above(free, 1.0), "ohm")
    words = f"Without bounds, r_s would be 1.0 standard errors below {bound}."
    assert beyond.outside == words
    assert words in str(beyond)
    assert beyond.table()["at_bound"] == words
    beyond.write(tmp_path / "fit.h5")
    read = etid.Fits.read(tmp_path / "fit.h5")
    assert read[0].outside == words
    assert read[0].intervals() == beyond.intervals()
    assert read.table()["at_bound"].tolist() == [words]
    assert "at_bound" not in free.table()
    free.write(tmp_path / "free.h5")
    both = etid.Fits.concatenate([read, etid.Fits.read(tmp_path / "free.h5")])
    assert [both[0].outside, both[1].outside] == [words, ""]
    with pytest.raises(etid.IdentificationError, match=r"out_of_bounds.* r_s would be 4\.0"):
        etid.identify_skin(noisy, bounds={"r_s": (above(free, 4.0), None)})
    flat = noisy.replace(v_out=0 * noisy.v_out)
    fits = etid.identify_skins([noisy, flat], bounds={"r_s": (above(free, 4.0), None)})
    assert fits.verdicts.tolist() == ["out_of_bounds", "flat"]
    assert "r_s would be 4.0" in fits.notes[0]
    assert fits[1].outside == ""


def test_bounds_on_the_command_line_in_batches_and_reports(noisy, beyond, free, tmp_path, capsys):
    study, target = tmp_path / "study.h5", tmp_path / "fits.h5"
    etid.Study.from_recordings([noisy.replace(path="s01/0")]).write(study)
    bound = repr(above(free, 1.0))
    command = ["fit", str(study), "-o", str(target), "--force"]
    assert cli.main([*command, "--bound", f"r_s={bound}:"]) == 0
    found = etid.StudyFits.read(target)
    fit = found.fits[0]
    np.testing.assert_allclose(fit.circuit.values(), beyond.circuit.values(), rtol=1e-7)
    assert int(fit.remarks) & Remark.at_bound
    assert found.settings is not None
    assert found.settings.bounds == (f"r_s above {bound}",)
    etid.write_report(target, tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text("utf-8")
    assert f"r_s ≥ {float(bound):g}" in page
    assert "Without bounds, r_s would be 1.0 standard errors below" in page
    capsys.readouterr()
    assert cli.main([*command, "--bound", "r_s=2:1"]) == 1
    assert "bounds of r_s are 2 and 1" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        cli.main([*command, "--bound", "r_s=2"])
    assert "write --bound r_s=100:2000" in capsys.readouterr().err


@pytest.mark.slow
def test_bounds_in_time_and_at_several_amplitudes(noisy):
    single = recorded(SKIN, periods=1.1, snr_db=40.0)
    alone = etid.identify_skin(single)
    fit = etid.identify_skin(single, bounds={"r_s": (above(alone, 1.0), None)})
    assert fit.method.startswith("maximum_likelihood")
    assert int(fit.remarks) == Remark.at_bound
    np.testing.assert_allclose(fit.stderr.r_s / alone.stderr.r_s, 0.446, rtol=0.01)  # of a normal
    alone = etid.identify_amplitudes([noisy], circuit=etid.SkinRC())
    lowest = above(alone, 1.0)
    several = etid.identify_amplitudes(
        [noisy], circuit=etid.SkinRC(), bounds={"r_s": (lowest, None)}
    )
    assert int(several.remarks) & Remark.at_bound
    assert several.circuit.r_s > lowest
