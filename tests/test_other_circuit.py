"""Score tests against other circuits: the changes, their statistics, what they see in records."""

import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

import etid
from benchmarks.failure_axes import Cole, TwoLayers
from benchmarks.ladder import CALIBRATION, LOADS, rung
from benchmarks.perturbed_study import all_records, out, undisturbed
from etid.circuits import directions
from etid.circuits.circuit import Resistor, impedance_at
from etid.circuits.directions import DIRECTIONS, FALSE_ALARMS, At, scored
from etid.likelihood.fit import would_show
from etid.likelihood.scores import Linear, Scores, doubt, seen, smooth
from etid.precision import array_function
from etid.simulation.scenes import Trial


def place(circuit, f):
    """A load at some frequencies, of which its impedance is used only."""

    def impedance(f):
        return impedance_at(circuit, np.log(np.asarray(circuit.values())), f)

    return At(f, impedance(f), impedance=impedance, exponents=bool(circuit.exponents()))


def test_the_slope_is_that_of_a_constant_phase_and_of_the_asymmetry_of_one():
    """Against central differences: of (jω)^α for jω, and of ln s + ε ln² (s/s₀) for ln s."""
    step, f = 1e-5, np.geomspace(60.0, 1e5, 30)
    log_s, middle = np.log(2j * np.pi * f), np.log(2 * np.pi * np.sqrt(60.0 * 1e5))
    skin, cole = etid.SkinRC(33.4e3, 186e3, 0.12e-9), etid.SkinCole(33e3, 186e3, 22e-6, 0.85)

    def spread(epsilon):
        return 33.4e3 + 186e3 / (1 + np.exp((1 + epsilon) * log_s) * 186e3 * 0.12e-9)

    def skewed(epsilon):
        s = np.exp(log_s + epsilon * (log_s - middle) ** 2)
        return 33e3 + 186e3 / (1 + (s * 22e-6) ** 0.85)

    for circuit, changed in ((skin, spread), (cole, skewed)):
        at = place(circuit, f)
        np.testing.assert_allclose(at.z, changed(0.0), rtol=1e-12)
        expected = (changed(step) - changed(-step)) / (2 * step)
        # step², and rounding over step
        np.testing.assert_allclose(directions.spread(at), expected, rtol=1e-7)


def test_a_relaxation_becomes_a_layer_of_diffusion():
    r_p, tau, f = 1e5, 90e-6, np.geomspace(60.0, 1e6, 30)
    whole = 8 / np.pi**2 * (1 + np.sum(1 / directions.FASTER**2))  # without still faster ones
    at = place(etid.ParallelRC(whole * r_p, 4 / np.pi**2 * tau / (whole * r_p)), f)
    z, _ = DIRECTIONS["layer"].of_load(at, 1.0)
    root = np.sqrt(2j * np.pi * f * tau)
    assert whole > 0.96
    assert np.max(np.abs(z - r_p * np.tanh(root) / root)) < 1.01 * (1 - whole) * r_p


def test_a_change_shows_unless_the_circuit_makes_it_or_an_element_would_be_negative():
    """Z is linear in R, 1/C and, here, the logarithm of a third element."""
    z, stderr = np.array([1.0, 1.0, 1.0, 1.0, np.nan, np.nan]), np.full(6, 0.1)
    slope = [(-0.9, 0.9, -9.0), (-1.1, 0.0, 0.0), (0.0, 1.1, 0.0), (9.0, -9.0, 9.0)]
    slope = np.array([*slope, (0.0, 0.0, 0.0), (-1.1, 0.0, 0.0)])
    found = would_show(Scores(z, z, z, stderr, slope, slope, z), np.array([1.0, -1.0, 0.0]))
    np.testing.assert_allclose(found, [10.0, np.inf, np.inf, 10.0, 0.0, 0.0])


@array_function
def scores(residual, rows, jacobian):
    """Without priors, in white noise of known size."""
    q = jacobian.shape[0]
    ones, without = np.ones(residual.size), (np.zeros(q), np.zeros((q, q)))
    bread = np.linalg.inv(jacobian @ jacobian.T)
    return smooth(Linear(jacobian, ones, ones, residual, *without, bread), rows, q)


def named(found):
    """The scores of each change."""
    return found.named({name: DIRECTIONS[name].count for name in NAMES})


def is_misfit(found):
    return any(
        on and DIRECTIONS[name].verdict == "misfit" for name, on in seen(named(found)).items()
    )


NAMES = [name for name in scored() if not DIRECTIONS[name].of_others]  # no currents
COUNT = sum(DIRECTIONS[name].count for name in NAMES)
NUMBER = {"spread": 0, "relaxation": 3, "gain": 9, "capacitance": 11}


@pytest.mark.parametrize("change", NUMBER)
def test_what_counts_is_the_residual_along_what_the_parameters_cannot_do(change):
    rng, limit = np.random.default_rng(4), DIRECTIONS[change].limit
    jacobian, rows = rng.normal(size=(3, 50)), rng.normal(size=(COUNT, 50))
    rows += 0.1 * jacobian.sum(0)  # so that a change moves the elements
    row, others = rows[NUMBER[change]], np.delete(rows, NUMBER[change], axis=0)
    along = row - np.linalg.lstsq(jacobian.T, row, rcond=None)[0] @ jacobian
    # Orthogonal to all other changes, each of which has a limit of its own.
    every = np.concatenate([jacobian, others])
    rest = row - np.linalg.lstsq(every.T, row, rcond=None)[0] @ every
    anything = rng.normal(size=3) @ jacobian  # a fit that has not quite ended
    for z in (0.99 * limit, 1.01 * limit, -1.01 * limit):
        residual = z * rest * np.linalg.norm(along) / (rest @ along)
        found = scores(residual + anything, rows, jacobian)
        assert float(found.z[NUMBER[change]]) == pytest.approx(z)
        assert is_misfit(found) == (abs(z) > limit)
        shown = {name for name, on in seen(named(found)).items() if on}
        assert shown == ({change} if abs(z) > limit else set())


@pytest.mark.parametrize("change", NUMBER)
def test_a_change_that_hardly_matters_is_none(change):
    """However well it is determined: a driver that is not quite right looks like that."""
    rng, of = np.random.default_rng(6), DIRECTIONS[change]
    jacobian, rows = 1e4 * rng.normal(size=(3, 50)), 1e4 * rng.normal(size=(COUNT, 50))
    row = rows[NUMBER[change]]
    others = np.linalg.lstsq(jacobian.T, row, rcond=None)[0]
    size = max(of.least, of.moves / max(abs(others)))
    alone = np.zeros_like(rows)
    alone[NUMBER[change]] = row
    for factor in (0.99, 1.01):
        found = scores(factor * size * row, alone, jacobian)
        assert is_misfit(found) == (factor > 1)


def test_a_relaxation_that_the_circuit_has_is_none():
    """What is left of its direction is rounding, whose score would be any number."""
    f = np.geomspace(60.0, 1e5, 200)
    tau = 1 / (2 * np.pi * np.geomspace(30.0, 2e5, directions.RELAXATIONS)[4])
    circuit = etid.SkinRC(33e3, 186e3, tau / 186e3)

    def real(z):
        return jnp.concatenate([z.real, z.imag], axis=-1) / 1e3

    def impedance(log_values):
        return real(circuit.with_log_values(log_values).impedance()(jnp.asarray(2j * np.pi * f)))

    jacobian = jax.jit(jax.jacfwd(impedance))(circuit.log_values()).T
    term = DIRECTIONS["relaxation"].term
    assert term is not None
    rows = real(jnp.asarray(term(place(circuit, f))))
    z = scores(np.random.default_rng(7).normal(size=400), rows, jacobian).z
    np.testing.assert_array_equal(np.isnan(z), np.arange(z.size) == 4)


def identified(load, snr_db, circuit):
    scene = dataclasses.replace(rung("dry", snr_db=snr_db), trials=(Trial("skin", load),))
    study = scene.simulate(12)
    driver = etid.identify_driver(study[CALIBRATION])
    return etid.identify_skin(study["skin"], driver, circuit=circuit, throw=False)


@pytest.mark.parametrize(
    ("load", "snr_db", "circuit", "most"),
    [
        (Cole(LOADS["dry"], 0.9), 40.0, None, 1.5),  # R_s of these is 24 and 10 % off
        (TwoLayers(LOADS["damp"], 0.05), 40.0, None, 1.5),
        # Without a phase to be spread, only one more relaxation tells. It was called successful.
        (LOADS["dry"], 20.0, Resistor(), 1.1),
    ],
)
def test_another_skin_is_a_misfit_where_chi2_does_not_show_it(load, snr_db, circuit, most):
    fit = identified(load, snr_db, circuit)
    assert fit.chi2 < most
    assert fit.verdict == "misfit"
    found = re.search(
        r"The residual looks like (a|another|one more) .* \((\d+) standard dev", fit.note
    )
    assert found is not None
    assert int(found[2]) >= 5


@pytest.mark.parametrize(
    ("load", "snr_db", "circuit"),
    [
        (LOADS["damp"], 40.0, None),
        (LOADS["damp"], 80.0, None),  # a driver of order 5 is not quite that of the scene, of 6
        (etid.scenes.ResistorLoad(55.2e3), 60.0, Resistor()),
    ],
)
def test_the_circuit_itself_is_none(load, snr_db, circuit):
    assert identified(load, snr_db, circuit).verdict == "successful"


def test_a_wrong_gain_is_seen_where_it_moves_r_p_by_a_quarter():
    """At 40 dB, 1 % is five standard deviations of the gain: 86 % exceed 3.9, half exceed 5."""
    study = etid.scenes.paper_dry(snr_db=40.0).simulate(seed=3)
    driver = etid.identify_driver(study["calibration/98k8"])
    right = list(study.loaded.recordings())
    wrong = [one.replace(v_out=1.01 * one.v_out, adc_range=None) for one in right]
    assert etid.identify_skins(right, driver).counts() == {"successful": 10}
    assert etid.identify_skins(wrong, driver).counts()["misfit"] >= 8


@pytest.mark.parametrize(
    ("z", "likely"), [(2.4, False), (-3.0, True), (4.5, False), (np.nan, False)]
)
def test_a_gain_that_is_likely_goes_into_the_errors_and_one_that_is_proven_does_not(z, likely):
    """With an error of 2 %, as large as gains are expected, the mean is half of the estimate."""
    stderr, slope = 0.02, np.array([3.0, -2.0])
    numbers = z, z * stderr, 3 * abs(z) * stderr, stderr, slope, slope, z**2
    gain = Scores(*map(np.asarray, numbers))
    found, cov = doubt(gain, DIRECTIONS["gain"].seen(*gain[:3]))
    assert bool(found) is likely
    expected = np.outer(slope, slope) * (z * stderr / 2) ** 2 if likely else np.zeros((2, 2))
    np.testing.assert_allclose(cov, expected, rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(("snr_db", "gain"), [(40.0, 1.01), (40.0, 0.99), (60.0, 1.001)])
def test_a_gain_in_all_records_that_no_test_proves_is_in_the_errors(snr_db, gain):
    """Without that, 11, 7 and 15 of 16 were wrong, R_p of dry skin by 14 % and 24 standard errors.

    The gain is three of its standard errors, and looks like less than `DOUBTED` in four of 16.
    """
    silent = 0
    for number in range(8):
        study = all_records(out(gain=gain))(undisturbed(number, snr_db))
        driver = etid.identify_driver([of.recording(number) for of in study.calibrations])
        for of in study.trials:
            fit = etid.identify_skin(of.recording(number), driver, throw=False)
            truth = np.array(dataclasses.astuple(LOADS[of.path]))
            off_by = (np.array(fit.circuit.values()) - truth) / fit.stderr.values()
            silent += fit.verdict == "successful" and bool(np.abs(off_by).max() > 5)
    assert silent <= 6


@pytest.mark.slow
@pytest.mark.parametrize("snr_db", [30.0, 60.0])
def test_good_recordings_are_refused_as_rarely_as_a_study_can_bear(snr_db):
    """Of 2000 with drawn drivers; seven tests of 1 in 10 000 refuse 1.4 of them.

    More than seven have a probability of 4e-5. With a limit of three standard deviations for the
    gain, 3 of 7200 recordings at 40 to 50 dB were refused, and 14 of 6664 of another draw. At 24 dB
    other reasons are more frequent: one driver of ten is unclear.
    """
    tests, drivers, seeds = 7, 10, 100
    verdicts = []
    for number in range(drivers):
        study = undisturbed(number, snr_db)
        driver = etid.identify_driver([of.recording(number) for of in study.calibrations])
        records = [of.recording(1000 + seed) for of in study.trials for seed in range(seeds)]
        verdicts += list(etid.identify_skins(records, driver).verdicts)
    most = scipy.stats.poisson.isf(1e-4, tests * FALSE_ALARMS * len(verdicts))
    assert len(verdicts) - verdicts.count("successful") <= most
