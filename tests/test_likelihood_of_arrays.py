"""`etid.Likelihood`: the likelihood that a fit maximises, as a function of arrays."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import etid

PATHS = "typical/dry/01", "typical/dry/02", "typical/damp/01"
RATES: dict = {"sample_rate": 200e3, "pulse_rate": 60.0}


@pytest.fixture(scope="module")
def study():
    return etid.read("data_schema/example.h5")


@pytest.fixture(scope="module")
def driver(study):
    return etid.identify_driver(study["calibration/98k8"], order=5)


def of(driver, *records, first=0, last=None):
    """The likelihood of recordings, as rows if there are several."""
    both = [[getattr(one, name)[first:last] for one in records] for name in ("v_th", "v_out")]
    v_th, v_out = (np.stack(v) if len(v) > 1 else v[0] for v in both)
    return etid.Likelihood.of(v_th, v_out, driver, **RATES)


@pytest.mark.parametrize("path", PATHS)
def test_its_fit_is_that_of_the_recording(study, driver, path):
    fit, other = of(driver, study[path]).fit(), etid.identify_skin(study[path], driver)
    assert fit.verdict == other.verdict == "successful"
    # Both measure the noise of the same periods.
    np.testing.assert_allclose(fit.circuit.values(), other.circuit.values(), rtol=1e-9)
    np.testing.assert_allclose(fit.cov, other.cov, rtol=1e-6)


@pytest.mark.parametrize("last", [None, 5000])
def test_rows_are_recordings(study, driver, last):
    records = [study[path] for path in PATHS]
    rows = of(driver, *records, last=last)
    fits = rows.fit()
    q = rows.start()
    for row, one in enumerate(records):
        alone = of(driver, one, last=last)
        # Starts of rows are sums in another order.
        np.testing.assert_allclose(rows.residual(q)[row], alone.residual(q[row]), atol=1e-9)
        np.testing.assert_allclose(
            fits.circuit.values()[row], alone.fit().circuit.values(), rtol=1e-7
        )
    assert rows.log_prob(rows.circuit(q), q[:, 3] / 200e3).shape == (3,)


@pytest.mark.parametrize("last", [None, 5000])
def test_its_terms_are_its_logarithm(study, driver, last):
    """Of whole periods, and of a record that ends anywhere."""
    likelihood = of(driver, study[PATHS[0]], last=last)
    q = likelihood.start()
    circuit = likelihood.circuit(q)
    at = likelihood.q(circuit, q[3] / 200e3)
    squares = 0.5 * np.sum(likelihood.residual(at) ** 2)
    assert -likelihood.log_prob(circuit, q[3] / 200e3) == pytest.approx(squares, rel=1e-12)
    assert len(likelihood.names) == q.size


def test_its_minimum_is_the_fit(study, driver):
    likelihood = of(driver, study[PATHS[0]])

    @jax.jit
    def step(q):
        slopes = jax.jacfwd(likelihood.residual)(q)
        return q - jnp.linalg.solve(slopes.T @ slopes, slopes.T @ likelihood.residual(q))

    q = jnp.asarray(likelihood.start())
    for _ in range(4):
        q = step(q)
    fit = likelihood.fit()
    off = (np.array(likelihood.circuit(q).values()) - fit.circuit.values()) / fit.stderr.values()
    assert np.abs(off).max() < 0.01  # where a search ends, in standard errors
    bound = np.sqrt(np.diag(np.linalg.inv(likelihood.information(np.asarray(q)))))[:3]
    # The standard errors of a fit follow the noise that is found, the bound the noise expected.
    np.testing.assert_allclose(bound, fit.stderr.values() / fit.circuit.values(), rtol=0.1)


def test_numpy_and_jax_have_the_same_numbers_and_derivatives(study, driver):
    likelihood = of(driver, study[PATHS[2]])
    circuit = likelihood.circuit(likelihood.start())
    logs, step = np.asarray(circuit.log_values()), 1e-6

    @jax.jit
    @jax.value_and_grad
    def traced(logs):
        return likelihood.log_prob(circuit.of_fit(jnp.exp(logs)), 1e-8)

    value, slope = traced(jnp.asarray(logs))
    assert value == pytest.approx(likelihood.log_prob(circuit, 1e-8), rel=1e-9)
    numeric = [
        (likelihood.log_prob(circuit.of_fit(np.exp(logs + step * e)), 1e-8)
         - likelihood.log_prob(circuit.of_fit(np.exp(logs - step * e)), 1e-8)) / (2 * step)
        for e in np.eye(3)
    ]  # fmt: skip
    np.testing.assert_allclose(slope, numeric, rtol=1e-4, atol=1e-2)


@pytest.mark.slow  # `test_samples` maps the same program; this one takes twenty seconds to compile
def test_fits_of_mapped_arrays(study, driver):
    both = [jnp.stack([getattr(study[path], name) for path in PATHS]) for name in ("v_th", "v_out")]
    fit = lambda v_th, v_out: etid.Likelihood.of(v_th, v_out, driver, **RATES).fit()  # noqa: E731
    fits = jax.jit(jax.vmap(fit))(*both)
    rows = of(driver, *[study[path] for path in PATHS]).fit()
    off = (np.asarray(fits.circuit.values()) - rows.circuit.values()) / rows.stderr.values()
    assert np.abs(off).max() < 0.01


def test_a_measured_current_needs_no_driver(study, driver):
    """A record of the current through the load, of another simulator than the test of the fit."""
    scene = etid.scenes.paper_dry(snr_db=60.0, current_snr_db=60.0)
    one = scene.simulate(seed=0)["typical/dry/01"]
    likelihood = etid.Likelihood.of(one.current, one.v_out, **RATES)
    assert likelihood.names == ("r_s", "r_p", "c_p", "delay")
    fit, other = likelihood.fit(), etid.identify_skin(one.without_v_th())
    np.testing.assert_allclose(fit.circuit.values(), other.circuit.values(), rtol=1e-6)


def test_a_current_beside_v_th_is_a_second_output():
    """Arrays are not aligned by whole samples, and this record needs no alignment."""
    scene = etid.scenes.paper_dry(snr_db=60.0, current_snr_db=60.0)
    study = scene.simulate(seed=0)
    driver, one = etid.identify_driver(study["calibration/98k8"], order=5), study["typical/dry/01"]
    assert one.current is not None
    likelihood = etid.Likelihood.of(one.v_th, one.v_out, driver, current=one.current, **RATES)
    assert likelihood.names[3:5] == ("delay", "current_delay")
    fit, other = likelihood.fit(), etid.identify_skin(one, driver)
    assert fit.verdict == other.verdict == "successful"
    # The current is given without the step of its converter.
    np.testing.assert_allclose(fit.circuit.values(), other.circuit.values(), rtol=1e-6)
    np.testing.assert_allclose(fit.cov, other.cov, rtol=1e-3)
    q = likelihood.start()
    z = q[5:] - likelihood.load.centre[5:]
    again = likelihood.q(likelihood.circuit(q), q[3] / 200e3, z, q[4] / 200e3)
    np.testing.assert_allclose(again, q, rtol=1e-9, atol=1e-12)

    def lost(delay):
        return -2 * likelihood.log_prob(likelihood.circuit(q), q[3] / 200e3, z, delay)

    # Twice the logarithm is the sum of the squares of the terms, up to a constant.
    squares = [(likelihood.residual(of) ** 2).sum() for of in (q, q + 0.1 * np.eye(q.size)[4])]
    moved = lost((q[4] + 0.1) / 200e3) - lost(q[4] / 200e3)
    np.testing.assert_allclose(moved, np.diff(squares)[0], rtol=1e-6)


@pytest.mark.parametrize(("with_driver", "last"), [(False, None), (True, 3000)])
def test_a_current_beside_v_th_needs_a_driver_and_periods(study, driver, with_driver, last):
    both = study[PATHS[0]].v_th[:last], study[PATHS[0]].v_out[:last]
    of = driver if with_driver else None
    with pytest.raises(ValueError, match="a driver and two whole pulse periods"):
        etid.Likelihood.of(*both, of, current=both[0], **RATES)


def test_refusals(study):
    one = study[PATHS[0]]
    old = etid.identify_driver(study["calibration/98k8"], method="steiglitz_mcbride", throw=False)
    with pytest.raises(ValueError, match="maximum_likelihood"):
        etid.Likelihood.of(one.v_th, one.v_out, old, **RATES)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"circuit": "auto"}, "of one circuit, not of 'auto'"),
        ({"sample_rate": -1.0}, "sample_rate is -1 Hz"),
        ({"sample_rate": 60.0, "pulse_rate": 200e3}, "pulses must be slower than samples"),
        ({"pulse_rate": 0.0}, "pulse_rate 0 Hz"),
        ({"resolution": -1.0}, "resolution -1 V"),
        ({"v_th": np.append(np.zeros(9_998), [np.nan, np.inf])}, "v_th has 2 values that are not"),
        ({"v_out": np.append(np.zeros(9_999), np.nan)}, "v_out has 1 value that is not finite"),
    ],
)
def test_what_cannot_be_is_refused(study, driver, changed, words):
    one = study[PATHS[0]]
    given = {"v_th": one.v_th, "v_out": one.v_out, "driver": driver, **RATES}
    with pytest.raises(ValueError, match=words):
        etid.Likelihood.of(**(given | changed))


MEAN = np.log([6.2e3, 17e3, 0.64e-9])
COV = np.array([[0.02, 0.01, 0.0], [0.01, 0.03, -0.01], [0.0, -0.01, 0.02]])


def correlated(skin):
    root = np.linalg.inv(np.linalg.cholesky(COV))
    return root @ (jnp.log(jnp.stack([skin.r_s, skin.r_p, skin.c_p])) - MEAN)


def test_own_prior_of_one_element_is_that_of_its_name(study, driver):
    one = study[PATHS[2]]
    plain = etid.identify_skin(one, driver)
    near = float(plain.circuit.r_s + plain.stderr.r_s)

    def known(skin):
        return (np.log([skin.r_s]) - np.log(near)) / 0.01

    fit = etid.Likelihood.of(one.v_th, one.v_out, driver, **RATES, prior=known).fit()
    other = etid.identify_skin(one, driver, prior={"r_s": (near, 0.01 * near)})
    assert fit.verdict == other.verdict
    assert fit.method == (
        "maximum_likelihood with the prior test_own_prior_of_one_element_is_that_of_its_name"
        ".<locals>.known"
    )
    # Both searches stop near the minimum: they may differ by a thousandth of a standard error.
    away = (fit.circuit.values() - other.circuit.values()) / other.stderr.values()
    np.testing.assert_allclose(away, 0, atol=1e-3)
    np.testing.assert_allclose(fit.cov, other.cov, rtol=1e-3)


def test_own_prior_is_in_terms_logarithm_and_information(study, driver):
    one = study[PATHS[0]]
    of = one.v_th, one.v_out, driver
    plain, told = (etid.Likelihood.of(*of, **RATES, prior=prior) for prior in (None, correlated))
    with jax.enable_x64(True):
        q = plain.start()
        circuit, off = plain.circuit(q), q[:3] - MEAN
        apart = off @ np.linalg.inv(COV) @ off
        assert (told.residual(q) ** 2).sum() - (plain.residual(q) ** 2).sum() == pytest.approx(
            apart, rel=1e-9
        )
        difference = plain.log_prob(circuit) - told.log_prob(circuit)
        assert difference == pytest.approx(apart / 2, rel=1e-6)
        added = told.information(q) - plain.information(q)
    expected = np.zeros_like(added)
    expected[:3, :3] = np.linalg.inv(COV)
    # Information about R_s is 1e6 times larger than that of the prior, so the last digits are lost.
    np.testing.assert_allclose(added, expected, atol=1e-3)


def test_own_prior_by_numpy_and_jax_and_of_rows(study, driver):
    records = [study[path] for path in PATHS[:2]]
    v_th, v_out = (np.stack([getattr(one, of) for one in records]) for of in ("v_th", "v_out"))

    def fit(v_th, v_out):
        return etid.Likelihood.of(v_th, v_out, driver, **RATES, prior=correlated).fit()

    rows = fit(v_th, v_out)
    with jax.enable_x64(True):
        traced = jax.jit(fit)(jnp.asarray(v_th[0]), jnp.asarray(v_out[0]))
    alone = fit(v_th[0], v_out[0])
    for other, row in ((rows, 0), (traced, ())):
        # All end at the same minimum; the search stops a thousandth of a standard error from it.
        away = (np.asarray(other.circuit.values())[row] - alone.circuit.values()) / np.asarray(
            alone.stderr.values()
        )
        np.testing.assert_allclose(away, 0, atol=1e-3)
