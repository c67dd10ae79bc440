"""What a circuit leaves: how large it is, what is done with it, and what has a name."""

import dataclasses
import functools

import numpy as np
import pytest

import etid
from benchmarks import perturbed_study as lab
from benchmarks.inexact import covariance, inexact
from benchmarks.perturbation_list import change_of
from etid.estimators.lanes import Bins, Harmonics
from etid.estimators.maximum_likelihood.estimator import MaximumLikelihood
from etid.estimators.maximum_likelihood.rows import loads_of, source_of
from etid.estimators.registry import MAXIMUM_LIKELIHOOD
from etid.identify.fitting import known_of
from etid.likelihood.approximate import departs, with_delta
from etid.likelihood.discrepancy import FUNCTIONS, Discrepancy, kernels, nodes, splines
from etid.likelihood.fit import fit
from etid.likelihood.gains import VoltageAndCurrent
from etid.likelihood.load import Anew, Near
from etid.likelihood.noise import is_smooth
from etid.likelihood.restricted import LEVELS, restricted
from etid.likelihood.search import minimum
from etid.likelihood.starts import starts
from etid.recordings.preflight import Inspected
from etid.results.feed import MEASURED_CURRENT
from tests.skins import sampled

HARMONICS = 1500
DRY = etid.SkinRC(33e3, 186e3, 0.12e-9)


@functools.cache
def fits_of(change: str, number: int, snr_db: float = 60.0):
    """Fits of the skins of a study by path, the true elements, and the driver."""
    study = lab.undisturbed(number, snr_db)
    if change.startswith("δ"):
        study = inexact(study, *map(float, change[1:].split()))
    elif change:
        study = change_of(change)(study)
    of = study.recordings()
    driver = etid.identify_driver(list(of.calibrations.recordings()), throw=False)
    records = list(of.loaded.recordings())
    fits = {one.path: etid.identify_skin(one, driver, throw=False) for one in records}
    return fits, {path: truth.low for path, truth in study.truths.items()}, driver, records


def deviations(change, numbers, snr_db=60.0):
    """Errors in ±, and errors of the logarithms of the elements, of fits that can be used."""
    z, errors = [], []
    for number in numbers:
        fits, truth, *_ = fits_of(change, number, snr_db)
        for path, one in fits.items():
            if one.usable:
                off = np.asarray(one.circuit.values()) - truth[path]
                z.append(off / np.asarray(one.stderr.values()))
                errors.append(off / truth[path])
    return np.array(z), np.array(errors)


@pytest.mark.parametrize("length", [0.5, 2.0])
def test_errors_contain_what_no_circuit_explains(length):
    """Weights of the noise err by 1 to 5 % here, at ± of 0.1 to 0.3 %."""
    z, _ = deviations(f"δ0.002 {length:g}", range(40, 44))
    assert len(z) >= 7  # of 8: one in some hundred has the shape of a fault that has a name
    # Of 24 numbers 0.95 are within 1.96 ±; fewer than 0.79 in one of a thousand, and nearly none
    # is beyond five.
    assert np.mean(np.abs(z) < 1.96) >= 0.79
    assert np.abs(z).max() < 5


def test_elements_are_nearer_than_those_of_weights_of_the_noise():
    """Those trust the strongest harmonics to 1e-4."""
    numbers, by_noise = range(40, 44), []
    _, errors = deviations("δ0.002 2", numbers)
    for number in numbers:
        _, truth, driver, records = fits_of("δ0.002 2", number)
        for one in records:
            load = load_of(one, driver)
            least = minimum(load, starts(load)).q[0, :3]
            by_noise.append(np.exp(least) / truth[one.path] - 1)
    both = [np.sqrt(np.mean(np.square(of)[:, [0, 2]])) for of in (errors, by_noise)]
    assert both[0] < both[1] / 3  # R_s and C_p; of ten such sets the ratio is 4 to 7


def load_of(recording, driver, kind=Harmonics):
    lane = kind.of(Inspected.of(recording))
    known = known_of(lane, driver, False, MAXIMUM_LIKELIHOOD)
    return loads_of([lane], source_of(known), etid.SkinRC(), None, None)


@pytest.mark.parametrize(
    ("change", "number", "snr_db"),
    [("", 20, 40.0), ("", 21, 60.0), ("base_six_periods", 20, 60.0)],
)
def test_good_recordings_get_none(change, number, snr_db):
    fits, *_ = fits_of(change, number, snr_db)
    for one in fits.values():
        assert one.verdict == "successful"
        assert not one.inexact
        assert "circuit" not in one.budget(None, None).parts


@pytest.mark.parametrize(
    "change",
    [
        *("cole_alpha0.8", "two_rc_mid", "gain_-5%_skin", "driver_Lls_x1.2"),
        *("Rp_nonlinear_0.2", "Rp_nonlinear_0.4"),
    ],
)
def test_what_has_a_name_is_no_such_error(change):
    """It lies nearly in the span of the elements, which no residual can make good."""
    fits, *_ = fits_of(change, 60)
    for path, one in fits.items():
        assert not one.usable, path


def test_another_circuit_at_little_noise_is_no_such_error():
    """What is so large that it is not linear in one number; elements were 30 to 100 ± off."""
    skins = {
        "a": etid.SkinCole(33e3, 186e3, 22e-6, 0.8),
        "b": etid.SkinCole(6e3, 17e3, 11e-6, 0.8),
        "c": DRY,
        "d": etid.SkinRC(6.1e3, 17.4e3, 0.66e-9),
    }
    trials = tuple(etid.scenes.Trial(path, skin) for path, skin in skins.items())
    calibration = etid.scenes.paper_calibration().calibration
    study = etid.scenes.Scene(trials, calibration, snr_db=80.0).simulate(seed=4)
    driver = etid.identify_driver(study[calibration[0].path])
    for paths, circuit in (("ab", etid.SkinRC()), ("cd", etid.Resistor())):
        fits = etid.identify_skins([study[path] for path in paths], driver, circuit=circuit)
        assert not len(fits.usable())


def test_its_profiles_contain_it():
    """Draws would be of all coefficients of δ."""
    fits, *_ = fits_of("δ0.002 1", 41)
    for one, name in zip(fits.values(), ("r_p", "r_s"), strict=True):
        value, error = (getattr(of, name) for of in (one.circuit, one.stderr))
        low, high = one.profile(name).interval()
        # Skewed a little: 1.96 ± is 0.95 of it.
        np.testing.assert_allclose([value - low, high - value], 1.96 * error, rtol=0.15)
        with pytest.raises(ValueError, match="profile"):
            one.posterior()


def test_its_share_of_the_errors_is_told():
    fits, _, driver, records = fits_of("δ0.002 1", 41)
    for one in records:
        fitted = fits[one.path]
        budget = fitted.budget(one, driver)
        assert fitted.inexact
        assert (budget.parts["circuit"] > 0.3 * budget.together).any()
        relative = np.asarray(fitted.stderr.values()) / np.asarray(fitted.circuit.values())
        # Parts of a covariance add up, but for the part of driver and recording that fell below 0.
        np.testing.assert_allclose(budget.together, relative, rtol=0.05)


def test_the_verdict_follows_what_is_left():
    """0.3 % of the signal is approximate; a laboratory that accepts 0.1 % gets a misfit."""
    _, _, driver, records = fits_of("δ0.003 1", 42)
    named = {}
    for accept in (0.02, 1e-3):
        method = MaximumLikelihood(accept=accept)
        fits = etid.identify_skins(records, driver, method=method)
        named[accept] = fits.verdicts.tolist()
    assert named[0.02] == ["approximate"] * 2
    assert named[1e-3] == ["misfit"] * 2


def test_a_joint_fit_leaves_them_alone():
    """They are fitted with what their circuits leave, and do not move Z_th of the others."""
    good, one = lab.undisturbed(43, 60.0), inexact(lab.undisturbed(43, 60.0), 0.003, 1.0)
    inexact_one = dataclasses.replace(one.trials[0], path="inexact")
    every = dataclasses.replace(good, trials=(*good.trials, inexact_one)).recordings()
    alone, both = etid.identify_jointly(good.recordings()), etid.identify_jointly(every)
    rows = {path: both.fits[i] for i, path in enumerate(both.fits.labels["path"])}
    for i, path in enumerate(alone.fits.labels["path"]):
        fit_alone = alone.fits[i]
        assert rows[path].verdict == fit_alone.verdict == "successful"
        errors = np.asarray(fit_alone.stderr.values())
        off = np.asarray(rows[path].circuit.values()) - np.asarray(fit_alone.circuit.values())
        assert np.all(np.abs(off) < 1e-3 * errors)
    assert rows["inexact"].verdict == "approximate"
    truth = one.truths[one.trials[0].path].low
    off = np.asarray(rows["inexact"].circuit.values()) - truth
    assert np.all(np.abs(off) < 4 * np.asarray(rows["inexact"].stderr.values()))


@pytest.mark.slow
def test_errors_of_a_single_period_contain_it():
    """Behind a driver, of records of one period and a bit."""
    z = []
    for number in range(44, 48):
        study = inexact(lab.lasting(3400)(lab.undisturbed(number, 60.0)), 0.003, 1.0)
        of = study.recordings()
        driver = etid.identify_driver(list(of.calibrations.recordings()))
        for one in of.loaded.recordings():
            found = etid.identify_skin(one, driver, throw=False)
            if found.usable:  # hum and wander of so short a record explain some of it
                off = np.asarray(found.circuit.values()) - study.truths[str(one.path)].low
                z.append(off / np.asarray(found.stderr.values()))
    assert len(z) >= 5  # others look like a fault that has a name
    assert np.mean(np.abs(z) < 1.96) >= 0.8  # of 15 numbers and more: less in one of fifty sets
    assert np.abs(z).max() < 5


def cut(rng: np.random.Generator, samples: int, first: int, size: float, length: float):
    """A record of current and V_out of dry skin that begins anywhere, with a δ of V_out."""
    f = 60.0 * np.arange(1, 1600)
    edges = [np.exp(-2j * np.pi * f * t) for t in (7.0e-3, 7.2e-3, 7.4e-3)]
    pulse = 0.06 * (edges[0] - 2 * edges[1] + edges[2]) / (2j * np.pi * f)  # 1 mA
    pulse = pulse / (1 + (f / 60e3) ** 8)
    x = np.linspace(0.0, np.log(f.size), 80)
    root = np.linalg.cholesky(covariance(x, size, length) + 1e-10 * size**2 * np.eye(80))
    real, imaginary = (np.interp(np.log(f / 60.0), x, root @ rng.standard_normal(80))
                       for _ in range(2))  # fmt: skip
    z = np.asarray(DRY.response(f)) * np.exp(real + 1j * imaginary)
    both = sampled([pulse, pulse * z], first, samples)
    noise = 1e-3 * np.abs(both).max(-1, keepdims=True)
    current, v_out = both + noise * rng.standard_normal(both.shape)
    return etid.Recording(v_out=v_out, current=current, sample_rate=200e3, pulse_rate=60.0)


@pytest.mark.parametrize(("samples", "first"), [(3400, 0), (5200, 1350)])
def test_errors_of_records_cut_anywhere_contain_it(samples, first):
    """By a measured current; the second record begins in a pulse. Noise hides δ of some."""
    z, left = [], []
    for number in range(10):
        rng = np.random.default_rng([number, 7])
        found = etid.identify_skin(cut(rng, samples, first, 0.005, 0.5), throw=False)
        if found.verdict == "approximate":
            off = np.asarray(found.circuit.values()) - np.array(DRY.values())
            z.append(off / np.asarray(found.stderr.values()))
            left.append(found.inexact)
    assert len(z) >= 4
    assert all(left)
    assert np.mean(np.abs(z) < 1.96) >= 0.8  # of 12 numbers and more: less in one of fifty sets
    assert np.abs(z).max() < 5


@pytest.mark.parametrize("filtered", [False, True])
def test_gradient_of_a_record_with_states(filtered):
    """That of the condensed terms is that of the whole likelihood, also for δ of the states."""
    one = cut(np.random.default_rng(1), 5200, 1350, 0.005, 0.5)
    if filtered:
        one = one.replace(current_filter="bessel 4 1e4 300", v_out_filter="butterworth 1 3e4")
    lane = Bins.of(Inspected.of(one))
    known = known_of(lane, MEASURED_CURRENT, False, MAXIMUM_LIKELIHOOD)
    load = loads_of([lane], source_of(known), DRY, None, None)
    load = with_delta(load, 1e-4 * kernels(lane.size)[5][None])
    q = 0.3 * np.random.default_rng(0).normal(size=(1, load.gains.owned))
    q[:, :3] = np.log(DRY.values()) + np.array([0.01, -0.01, 0.01])
    q[:, load.gains.exact :] *= 0.3
    at = load.gains.at(load.knots.index)
    found = Anew(load, at).at(Near.of(load, at, q)).gradient[0]
    step, exact = 1e-4, load.gains.exact
    for i in (*range(exact), exact + 10, exact + 30, exact + 35):
        move = step * np.eye(q.size)[i]
        change = (load.objective(q + move) - load.objective(q - move))[0] / (2 * step)
        # Sums at the knots are good to 3e-3; without what δ makes of the states, 3 to 15 % are off.
        np.testing.assert_allclose(found[i], change, rtol=5e-3)


def test_a_row_does_not_depend_on_others():
    """One of them is not finite."""
    _, _, driver, records = fits_of("δ0.002 1", 41)
    *_, good = fits_of("", 20)
    loads = [load_of(one, driver) for one in (*records, *good)]
    rows = dataclasses.replace(
        loads[0],
        gains=dataclasses.replace(
            loads[0].gains, frequency=np.concatenate([of.gains.frequency for of in loads])
        ),
        records=type(loads[0].records)(
            *(np.concatenate(each) for each in zip(*(of.records for of in loads), strict=True))
        ),
    )
    rows.records.y[-1] = np.nan
    every = fit(rows, starts(rows))
    for row, load in enumerate(loads[:-1]):
        alone = fit(load, starts(load))
        errors = np.sqrt(np.diagonal(alone.cov[0]))
        assert np.all(np.abs(every.logs[row] - alone.logs[0]) < 1e-6 * errors)
        assert every.approximate[row] == alone.approximate[0] == (row < 2)
    assert not np.isfinite(every.chi2[-1])


@pytest.mark.parametrize("current", [False, True])
def test_derivatives_of_the_gains_with_it(current):
    _, _, driver, records = fits_of("", 20)
    load = load_of(records[0], driver)
    harmonics = load.records.x.shape[-1]
    load = with_delta(load, 1e-4 * kernels(harmonics)[5][None])
    gains = load.gains
    if current:
        gains = dataclasses.replace(gains, outputs=VoltageAndCurrent())
    gains = gains.at(np.arange(0, harmonics, 97))
    size = gains.owned + gains.source.mean.size
    q = np.random.default_rng(0).normal(0.0, 0.3, (1, size))
    q[:, :3] += np.log([3e4, 2e5, 1e-10])
    found = gains.slopes(q).by_q[0]
    step = 1e-6
    for i, move in enumerate(step * np.eye(size)):
        change = (gains.at_few(q + move) - gains.at_few(q - move))[0] / (2 * step)
        # Central differences lose 6e-12 of the gains to rounding, 2e-11 to the third derivative.
        np.testing.assert_allclose(found[i], change, atol=1e-9 * np.abs(gains.at_few(q)).max())


def test_its_functions_have_its_covariance():
    """Twenty of them leave 2e-4 of the variance of the shortest length."""
    covariance = kernels(HARMONICS)
    root = Discrepancy.of_covariance(HARMONICS, covariance).root
    np.testing.assert_allclose(root @ root.swapaxes(-1, -2), covariance, atol=2e-4)


def test_a_spline_through_the_nodes_is_as_smooth_as_it():
    x, at = nodes(HARMONICS), np.log(np.arange(1, HARMONICS + 1))
    for shift in range(5):
        values = np.sin(x / 0.5 + shift)  # bends as much as the shortest length
        np.testing.assert_allclose(values @ splines(HARMONICS), np.sin(at / 0.5 + shift), atol=0.02)


def test_its_size_is_that_of_the_restricted_likelihood():
    """The mean of all kernels and sizes, weighted by the likelihood as it is defined."""
    rng = np.random.default_rng(1)
    count, half, left = 3, 60, 0.02
    x = nodes(HARMONICS)
    unit = splines(HARMONICS)[:, np.unique(np.geomspace(1, HARMONICS - 1, half).astype(int))]
    half = unit.shape[-1]
    c = rng.uniform(10, 300, half)  # information about the gain at each knot
    u = c * unit
    smooth = rng.standard_normal((count, 4)) @ np.vander(np.linspace(-1, 1, half), 4).T
    j = c * (smooth + 1j * smooth[::-1])
    delta = left * (np.sin(x) + 1j * np.cos(0.7 * x))
    y = delta @ u + rng.standard_normal(half) + 1j * rng.standard_normal(half)
    precision = np.array([0.0, 1.0, 4.0])
    zero = np.zeros((1, count))

    def paired(of):
        return np.concatenate([of.real, of.imag], -1)

    rows, both = np.concatenate([j, y[None]]), np.concatenate([u, 1j * u])
    of = np.diag(precision)[None], zero, np.array([left]), HARMONICS
    found = restricted(paired(rows)[None], paired(both)[None], *of)

    def value(of_gains):
        cov = np.eye(2 * half) + of_gains
        inverse = np.linalg.inv(cov)
        left_side = paired(j) @ inverse
        expected = left_side @ paired(j).T + np.diag(precision)
        told = left_side @ paired(y)
        squares = paired(y) @ inverse @ paired(y) - told @ np.linalg.solve(expected, told)
        return np.linalg.slogdet(cov)[1] + np.linalg.slogdet(expected)[1] + squares

    whole = paired(both)
    every = [(of, whole.T @ np.kron(np.eye(2), of) @ whole) for of in kernels(HARMONICS)]
    squares = (left * np.array(LEVELS)) ** 2
    sizes = [square * kernel for kernel, _ in every for square in squares]
    values = np.array([value(square * of_gains) for _, of_gains in every for square in squares])
    weight = np.exp(-0.5 * (values - values.min()))
    expected = np.tensordot(weight / weight.sum(), np.array(sizes), 1)
    # The functions of a kernel leave a part of its variance.
    np.testing.assert_allclose(found.covariance[0], expected, atol=1e-3 * np.abs(expected).max())
    assert found.ratio.shape == found.explained.shape == (1, 0)
    assert FUNCTIONS < nodes(HARMONICS).size


def test_a_change_that_is_the_cause_explains_it():
    """One of two changes is in the terms, at a hundred times its standard deviation."""
    rng = np.random.default_rng(2)
    half = 80
    at = np.unique(np.geomspace(1, HARMONICS - 1, half).astype(int))
    half, c = at.size, 200.0
    unit = c * splines(HARMONICS)[:, at]
    line = np.linspace(-1, 1, half)
    j = c * np.array([np.ones(half), line])
    cause, other = c * line**3, c * 1j * line**2
    size = 100 / np.sqrt(np.sum(cause**2))
    y = size * cause + rng.standard_normal(half) + 1j * rng.standard_normal(half)
    rows = np.array([*j, y, cause, other]) + 0j
    rows, unit = ((one.real, one.imag) for one in (rows, np.concatenate([unit, 1j * unit])))
    rows, unit = (np.concatenate(one, -1)[None] for one in (rows, unit))
    none = np.zeros((1, 2))
    found = restricted(rows, unit, none[..., None] * none, none, np.array([size]), HARMONICS)
    assert found.ratio[0, 0] > 12 > found.ratio[0, 1]
    assert found.explained[0, 0] > 0.9 > found.explained[0, 1]


def test_what_is_not_smooth_is_no_error_of_the_gain():
    """Edges of a current that are recorded late by parts of a sample: no δ, and no long search."""
    rng, f = np.random.default_rng(0), 60.0 * np.arange(1, 1500)
    edges = np.exp(-2j * np.pi * np.outer(f, [1e-3, 1.6e-3, 6e-3, 6.6e-3]))
    late = np.exp(-2j * np.pi * f[:, None] * 1e-6 * rng.standard_normal(4))
    signs, size = np.array([1, -1, -1, 1]), 0.06 / (2j * np.pi * f) / (1 + (f / 60e3) ** 8)
    i, other = (size * (of @ signs) for of in (edges, edges * late))
    both = sampled([i, other * np.asarray(DRY.response(f))])
    both += 1e-4 * np.abs(both).max(-1, keepdims=True) * rng.standard_normal(both.shape)
    one = etid.Recording(current=both[0], v_out=both[1], sample_rate=200e3, pulse_rate=60.0)
    lane = Harmonics.of(Inspected.of(one))
    known = known_of(lane, MEASURED_CURRENT, False, MAXIMUM_LIKELIHOOD)
    load = loads_of([lane], source_of(known), DRY, None, None)
    near = minimum(load, starts(load)).near
    assert is_smooth(near.condensed.part, load.gains.exact).all()
    assert not departs(load, near).any()
    assert etid.identify_skin(one, throw=False).verdict == "misfit"


def test_a_successful_fit_of_a_file_finds_it_in_the_recording():
    """Its verdict does not tell that ± contain it, and files keep no effects."""
    fits, _, driver, (record, *_) = fits_of("δ0.0005 2", 40)
    known = fits[record.path]
    of_file = dataclasses.replace(known, by_tolerance=None)
    assert known.verdict == "successful"
    assert known.inexact
    assert not of_file.inexact
    whole, again = (one.profile("r_s", record, driver) for one in (known, of_file))
    np.testing.assert_allclose(again.interval(), whole.interval(), rtol=1e-9)
