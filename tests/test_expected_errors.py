"""The standard errors to expect behind a driver: the bound of its fits, by `etid.calibrate`."""

import inspect
import re

import numpy as np
import pytest

import etid
from benchmarks.coverage import scene
from benchmarks.ladder import LOADS
from etid.results.driver import HarmonicDriver
from etid.simulation.calibration import MOST, NOW, SKINS, expected_errors
from etid.simulation.published import REFERENCE

RATE = 200e3
ROUNDING = 1e-9  # sums of 2 000 numbers, and the inverse of a matrix of condition 1e6
RESISTORS = (1e3, 1e4, 9.8e4, 1e6)  # far below |Z_th|, near it, the one that is known, far above


@pytest.fixture(scope="module")
def drivers():
    """Drivers from one calibration, by the SNR of it [dB]."""
    found = {}
    for snr_db in (20.0, 40.0, 60.0):
        study = scene(snr_db, 10_000).simulate(seed=int(snr_db))
        found[snr_db] = etid.identify_driver(study["calibration/0"], throw=False)
    return found


@pytest.mark.parametrize("snr_db", [20.0, 40.0, 60.0])
@pytest.mark.parametrize("skin", SKINS)
def test_nothing_that_is_recorded_besides_makes_an_error_larger(drivers, snr_db, skin):
    """One random draw for each row made C_p at 20 dB worse with a second resistor."""
    of = drivers[snr_db], SKINS[skin]
    now = np.array(list(expected_errors(*of).values()))
    for more in ({"periods": 1.5}, *({"further": r} for r in RESISTORS)):
        then = np.array(list(expected_errors(*of, **more).values()))
        assert (then <= now * (1 + ROUNDING)).all(), more
    near = np.array(list(expected_errors(*of, further=1e4).values()))
    assert (near < 0.95 * now).all()


def impedance(q, f):
    """Z_th of order 5 from its flattened parameters, as the guide has it."""
    (r, (w_1, w_2), (d_1, d_2), (g_1, g_2), (h_1, h_2), w, g) = (
        *(q[0], np.exp(q[1:3]), np.exp(q[3:5]), q[5:7], q[7:9], np.exp(q[9]), q[10]),
    )
    z, s = np.exp(r) + 0j, 2j * np.pi * f
    for omega, zeta, gain, slope in ((w_1, d_1, g_1, h_1), (w_2, d_2, g_2, h_2)):
        x = s / omega
        z = z + (gain + slope * x) / (1 + 2 * zeta * x + x**2)
    return z + g / (1 + s / w)


def independent(driver, skin, resistors):
    """The bound by differences of the gains, each record with an input of its own."""
    of = driver.spectra
    f, power = np.array(of.frequency[0]), np.abs(of.x[0]) ** 2 - np.array(of.variance_x[0])
    source = np.concatenate([np.ravel(getattr(driver.source, one)) for one in (
        *("log_resistance", "log_omega", "log_zeta", "gain", "slope"),
        *("log_omega_real", "gain_real"),
    )])  # fmt: skip
    start = np.concatenate([np.log(skin.values()), np.zeros(1 + len(resistors)), source])
    s = 2j * np.pi * f

    def gains(q):
        (r_s, r_p, c_p), late = np.exp(q[:3]), q[3 : 4 + len(resistors)]
        z_th = impedance(q[4 + len(resistors) :], f)
        loads = [r_s + r_p / (1 + s * r_p * c_p), *(r + 0 * s for r in resistors)]
        of_each = zip(loads, late, strict=True)
        return np.stack([np.exp(-s * tau / RATE) * z / (z + z_th) for z, tau in of_each])

    steps = 1e-5 * np.maximum(np.abs(start), 1.0)
    slopes = [
        (gains(start + way) - gains(start - way)) / (2 * step)
        for way, step in zip(np.diag(steps), steps, strict=True)
    ]
    noise = np.array(of.variance_y[0]) + np.abs(gains(start)) ** 2 * np.array(of.variance_x[0])
    weight = np.where(np.array(of.selected[0]), 2 * np.maximum(power, 0) / noise, 0.0)
    information = np.einsum("imk,mk,jmk->ij", np.conj(slopes), weight, slopes).real
    # The priors of `etid.likelihood.source_prior`, and half a sample for each delay.
    large = 10 * REFERENCE
    widths = [3.0, 3.0, 1.5, 1.5, 0.5, *[large] * 4, 3.0, large]
    prior = [*np.full(3, np.inf), *np.full(1 + len(resistors), 0.5), *widths]
    information += np.diag(1 / np.square(prior))
    scale = np.sqrt(np.diag(information))
    cov = np.linalg.inv(information / np.outer(scale, scale)) / np.outer(scale, scale)
    return np.sqrt(np.diag(cov))[:3]


@pytest.mark.parametrize("snr_db", [40.0, 60.0])
@pytest.mark.parametrize("skin", SKINS)
@pytest.mark.parametrize("further", [None, 1e4])
def test_expected_errors_are_those_of_an_independent_bound(drivers, snr_db, skin, further):
    driver = drivers[snr_db]
    resistors = [REFERENCE] if further is None else [REFERENCE, further]
    found = list(expected_errors(driver, SKINS[skin], further).values())
    # Between knots the gains are straight lines; the share of noise in V_th is a local mean.
    assert found == pytest.approx(independent(driver, SKINS[skin], resistors), rel=0.02)


@pytest.mark.parametrize(("resistors", "further"), [((REFERENCE,), None), ((REFERENCE, 1e4), 1e4)])
def test_they_are_about_those_of_every_driver(drivers, resistors, further):
    """`etid.bound` knows nothing of the shape of Z_th, so it is larger, for C_p by a seventh."""
    bounds = etid.bound(scene(60.0, 10_000, resistors))
    for name, skin in SKINS.items():
        found = np.array(list(expected_errors(drivers[60.0], skin, further).values()))
        limit = np.array(list(bounds[name].relative.values()))
        # The noise of the record is estimated to 2 %; the last harmonics are left out.
        assert (found < 1.05 * limit).all()
        assert (found > 0.8 * limit).all()


def test_tolerances_are_in_the_errors_to_expect_and_no_period_helps_against_them(drivers):
    study = scene(60.0, 10_000).simulate(seed=60)
    known = study["calibration/0"].replace(instrument="r_load=0.02")
    found = etid.calibrate(known)
    alone = expected_errors(drivers[60.0], SKINS["dry"])["r_p"]
    assert found.expected["dry"][NOW]["r_p"] == pytest.approx(np.hypot(0.02, alone), rel=0.01)
    assert np.isinf(found.times)
    assert f"not even {MOST:g} times as many periods make it 1 %" in str(found)
    # Two resistors have independent errors, so that their mean is better known.
    assert found.expected["dry"]["also with 10 kΩ"]["r_p"] < 0.9 * found.expected["dry"][NOW]["r_p"]


def test_so_many_periods_make_the_least_known_element_known_to_one_per_cent(drivers):
    study = scene(40.0, 10_000).simulate(seed=40)
    found = etid.calibrate(study["calibration/0"])
    errors = [expected_errors(drivers[40.0], skin, periods=found.times) for skin in SKINS.values()]
    largest = max(
        (error, skin, name)
        for skin, by in found.expected.items()
        for name, error in by[NOW].items()
    )
    then = dict(zip(SKINS, errors, strict=True))[largest[1]][largest[2]]
    assert then == pytest.approx(0.01, rel=0.01)
    assert f"1 % takes {np.ceil(found.times):.0f} times as many periods" in str(found)


def test_what_helps_most_is_the_row_of_the_table_with_the_least_error():
    study = scene(60.0, 10_000).simulate(seed=60)
    found = etid.calibrate(study["calibration/0"])
    words = re.search(
        r"least known is (\w+) of (\w+) skin, .*; what helps most: (.+), ±", str(found)
    )
    assert words is not None
    name, skin, what = words.groups()
    errors = {what: of[name] for what, of in found.expected[skin].items()}
    assert errors[NOW] == max(max(of[NOW].values()) for of in found.expected.values())
    assert len(errors) > 2  # the best of one row is no choice
    assert errors[what] == min(errors.values())


@pytest.mark.parametrize("samples", [3334, 3000])
def test_a_record_of_one_period_or_less_is_calibrated_too(samples):
    """Maximum likelihood needs several periods; a choice of the order needs it."""
    found = etid.calibrate(scene(40.0, samples).simulate(seed=1)["calibration/0"])
    assert found.driver.verdict == "successful"
    assert bool(found.expected) == (samples == 3334)
    assert ("to expect" in str(found)) == (samples == 3334)


def test_one_order_is_the_default_everywhere():
    functions = (
        *(etid.calibrate, etid.read_driver, etid.identify_driver, etid.identify_study),
        *(etid.identify_jointly, etid.fit_file),
    )
    assert {inspect.signature(of).parameters["order"].default for of in functions} == {5}


@pytest.mark.slow
@pytest.mark.parametrize("resistors", [(REFERENCE,), (REFERENCE, 1e4)])
def test_drawn_recordings_scatter_as_expected(resistors):
    drawn = scene(40.0, 10_000, resistors)
    further = resistors[1] if len(resistors) > 1 else None
    errors, expected = [], []
    for seed in range(40):
        study = drawn.simulate(seed)
        known = list(study.calibrations.recordings())
        driver = etid.identify_driver(known, throw=False)
        first = etid.identify_driver(known[0], throw=False)
        assert isinstance(first, HarmonicDriver)
        fits = {name: etid.identify_skin(study[name], driver, throw=False) for name in LOADS}
        errors.append([
            np.array(fits[name].circuit.values()) / list(drawn.truth()[name].values()) - 1
            for name in SKINS
        ])  # fmt: skip
        expected.append([
            list(expected_errors(first, skin, further).values()) for skin in SKINS.values()
        ])  # fmt: skip
    ratio = np.sqrt(np.mean(np.square(errors), axis=0)) / np.median(expected, axis=0)
    # With 40 draws, 99.8 % of root mean squares of standard normal numbers are within these.
    assert (ratio > 0.67).all()
    assert (ratio < 1.36).all()
