"""Measured impedances with priors, bounds, a choice of circuits, profiles, draws, and batches."""

import numpy as np
import pytest
import scipy.stats

import etid
from etid.recordings.remarks import Remark
from tests.skins import DRY, off

F = np.geomspace(10.0, 1e6, 50)
CIRCUITS = {
    "SkinRC": DRY,
    "ParallelRC": etid.ParallelRC(186e3, 0.12e-9),
    "SkinCole": etid.SkinCole(33.4e3, 186e3, 22e-6, 0.8),
    "SkinLayers": etid.SkinLayers(20e3, 100e3, 0.1e-9, 150e3, 2e-9),
    "SkinWarburg": etid.SkinWarburg(),
}
NOISE = 0.01  # of |Z|


def spectrum(circuit=DRY, seed=0, noise=NOISE):
    parts = np.random.default_rng(seed).standard_normal((2, F.size))
    z = circuit.response(F)
    return z * (1 + noise * (parts[0] + 1j * parts[1])), noise * np.abs(z)


def logs(fit):
    """Logarithms of the elements, and their covariance."""
    values = np.array(fit.circuit.values())
    return np.log(values), np.asarray(fit.cov) / np.outer(values, values)


@pytest.mark.parametrize("known", [True, False])
def test_a_prior_is_one_more_measurement(known):
    """Near the minimum all is normal: the estimate is the mean of both, weighted."""
    z, sigma = spectrum()
    stderr = sigma if known else None
    free = etid.identify_impedance(F, z, stderr=stderr)
    error = float(free.stderr.r_s)
    told = float(free.circuit.r_s) + error, error
    fit = etid.identify_impedance(F, z, stderr=stderr, prior={"r_s": told})
    (q, cov), centre, width = logs(free), np.log(told[0]), told[1] / told[0]
    gain = cov[:, 0] / (cov[0, 0] + width**2)
    found, after = logs(fit)
    errors = np.sqrt(np.diagonal(cov))
    # Without errors, those of the data and those of the weights are two estimates of the noise.
    near = 0.02 if known else 0.1
    assert (np.abs(found - q - gain * (centre - q[0])) < near * errors).all()
    expected = np.sqrt(np.diagonal(cov - np.outer(gain, cov[0])))
    np.testing.assert_allclose(np.sqrt(np.diagonal(after)), expected, rtol=near)


def test_a_prior_determines_what_the_impedance_does_not():
    high = F > 3e5  # far above the corner: no R_p
    z, sigma = spectrum()
    of = {"stderr": sigma[high], "throw": False}
    assert etid.identify_impedance(F[high], z[high], **of).verdict == "insensitive"
    fit = etid.identify_impedance(F[high], z[high], prior={"r_p": (180e3, 20e3)}, **of)
    assert fit.verdict == "successful"
    assert (np.abs(off(fit)) < 4).all()
    np.testing.assert_allclose(fit.stderr.r_p, 20e3, rtol=0.15)  # R_p says little itself


def test_bounds_are_walls_and_contradictions_are_named():
    z, sigma = spectrum()
    free = etid.identify_impedance(F, z, stderr=sigma)
    at, error = float(free.circuit.r_s), float(free.stderr.r_s)
    far = etid.identify_impedance(F, z, stderr=sigma, bounds={"r_s": (at - 9 * error, None)})
    np.testing.assert_allclose(far.circuit.values(), free.circuit.values(), rtol=1e-6)
    near = etid.identify_impedance(F, z, stderr=sigma, bounds={"r_s": (at + error, None)})
    assert int(near.remarks) & Remark.at_bound
    assert near.circuit.r_s > at + error
    expected = scipy.stats.truncnorm(1.0, np.inf, at, error)
    np.testing.assert_allclose(near.circuit.r_s, expected.mean(), rtol=1e-6)
    np.testing.assert_allclose(near.stderr.r_s, expected.std(), rtol=1e-4)
    wrong = {"r_s": (at + 9 * error, None)}
    fit = etid.identify_impedance(F, z, stderr=sigma, bounds=wrong, throw=False)
    assert fit.verdict == "out_of_bounds"
    with pytest.raises(ValueError, match="'tau' is no element of SkinRC"):
        etid.identify_impedance(F, z, bounds={"tau": (1.0, 2.0)})
    both = {"fixed": {"r_p": 186e3}, "bounds": {"r_s": (at - error, at + error)}}
    fit = etid.identify_impedance(F, z, stderr=sigma, **both)
    assert (fit.circuit.r_p, fit.stderr.r_p) == (186e3, 0.0)
    assert abs(fit.circuit.r_s - at) < error


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("name", CIRCUITS)
def test_the_simplest_circuit_that_is_right_is_chosen(name, known):
    """The evidence for one element too many exceeds its penalty in one spectrum of 30."""
    right = 0
    for seed in range(2):
        z, sigma = spectrum(CIRCUITS[name], seed)
        fit = etid.identify_impedance(F, z, circuit="auto", stderr=sigma if known else None)
        right += type(fit.circuit).__name__ == name
    assert right >= 1


@pytest.mark.parametrize(
    "options", [{}, {"fixed": {"r_s": 33.4e3}}, {"prior": {"r_s": (33e3, 300.0)}}]
)
@pytest.mark.parametrize("known", [True, False])
def test_profiles_and_draws_agree_with_standard_errors(options, known):
    """With 1 % noise the likelihood is normal, up to a few hundredths of a standard error."""
    z, sigma = spectrum()
    fit = etid.identify_impedance(F, z, stderr=sigma if known else None, **options)
    profile = fit.profile("r_p")
    error = float(fit.stderr.r_p)
    low, high = profile.interval()
    np.testing.assert_allclose([low, high], fit.intervals()["r_p"], rtol=0, atol=0.1 * error)
    draws = fit.posterior(draws=2000)
    assert draws.effective > 1500
    # Quantiles of 2000 draws scatter by 0.06 standard errors.
    np.testing.assert_allclose(draws.intervals()["r_p"], (low, high), rtol=0, atol=0.3 * error)


def test_draws_and_profiles_stay_inside_bounds():
    z, _ = spectrum()
    fit = etid.identify_impedance(F, z, bounds={"r_p": (186e3, 200e3)})
    low, high = fit.posterior(draws=500).intervals()["r_p"]
    assert 186e3 <= low < high < 187.5e3
    assert fit.profile("r_p").interval()[0] == pytest.approx(186e3)


def test_a_layer_that_noise_hides_has_a_profile_without_an_upper_end():
    z, sigma = spectrum(noise=0.05)
    fit = etid.identify_impedance(F, z, stderr=sigma, circuit=etid.SkinCole())
    low, high = fit.profile("alpha").interval()
    assert low < 1.0 < high * 1.02
    with pytest.raises(ValueError, match="no budget"):
        fit.budget()


def test_many_spectra_are_a_table_and_a_bad_one_costs_itself():
    spectra: dict[str, tuple] = {f"s{i:02d}/dry": (F, spectrum(seed=i)[0]) for i in range(4)}
    spectra["errors"] = (F[::-1], *(of[::-1] for of in spectrum(seed=4)))
    spectra["short"] = (F[:3], np.ones(4))
    spectra["alone"] = (F,)
    layers = spectrum(CIRCUITS["SkinLayers"])[0]
    spectra["layers"] = (F, layers)
    labels = {"s00/dry": {"subject": "s00", "condition": "dry"}}
    for circuit in (None, "auto"):
        fits = etid.identify_impedances(spectra, labels=labels, circuit=circuit)
        verdicts = ["successful"] * 5 + ["unreadable"] * 2 + ["misfit"]
        assert fits.verdicts.tolist() == verdicts
        assert type(fits.circuit).__name__ == "SkinRC"
        assert "'short': frequency has shape (3,)" in fits.notes[5]
        assert "'alone': has 1 array" in fits.notes[6]
        assert ("supports SkinLayers better" in fits.notes[7]) == (circuit == "auto")
        assert fits.labels["subject"][0] == "s00"
    rich = etid.identify_impedances(
        {"bad": (F, F[1:]), "nan": (F, np.nan * F), "layers": (F, layers)}, circuit="auto"
    )
    assert type(rich.circuit).__name__ == "SkinLayers"
    assert rich.verdicts.tolist() == ["unreadable", "nonfinite_samples", "successful"]
    assert "bad: unreadable. frequency has shape" in str(rich)
    alone = etid.identify_impedance(F, spectra["s02/dry"][1])
    of = etid.identify_impedances(spectra)["s02/dry"]
    np.testing.assert_array_equal(of.circuit.values(), alone.circuit.values())
    np.testing.assert_array_equal(of.cov, alone.cov)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (({},), "no impedance"),
        (({"a": (F, F)}, {"b": {}}), "labels has 'b'"),
        (({"a": (F, F)}, {"a": {"finger": "1"}}), "labels has 'finger'"),
    ],
)
def test_wrong_tables_are_refused(arguments, words):
    spectra, *labels = arguments
    with pytest.raises(ValueError, match=words):
        etid.identify_impedances(spectra, labels=labels[0] if labels else None)


def test_what_was_told_is_said_and_fixed_elements_are_not_counted():
    z, sigma = spectrum()
    free = etid.identify_impedance(F, z, stderr=sigma)
    held = etid.identify_impedance(F, z, stderr=sigma, fixed={"r_s": float(free.circuit.r_s)})
    assert "Told before the fit: r_s = " in str(held)
    assert (held.free, free.free) == (2, 3)
    # The minimum is the same, to the part of it that ends a search.
    np.testing.assert_allclose(free.aic - held.aic, 2.0, atol=1e-3)
    np.testing.assert_allclose(free.bic - held.bic, np.log(2 * F.size), atol=1e-3)
    bounds = {"r_s": (40e3, None)}
    wrong = etid.identify_impedance(F, z, stderr=sigma, bounds=bounds, throw=False)
    assert "r_s above 40 kΩ (bounds)" in str(wrong)
    assert "Impedance and bounds contradict" in str(wrong)
    assert str(wrong).count("outside") == 1


def test_fits_of_a_table_know_their_impedance_and_those_of_a_file_say_that_they_do_not(tmp_path):
    spectra = {"a": (F, spectrum()[0]), "bad": (F, F[1:]), "b": (F, *spectrum(seed=1))}
    fits = etid.identify_impedances(spectra, fixed={"r_s": 33.4e3})
    alone = etid.identify_impedance(F, spectra["a"][1], fixed={"r_s": 33.4e3})
    for one in (fits[0], fits["a"], fits.usable()[0], etid.Fits.concatenate([fits, fits])[3]):
        np.testing.assert_array_equal(one.residual().whitened, alone.residual().whitened)
    found = fits["b"].profile("r_p"), fits["b"].posterior(draws=100)
    assert found[0].interval()[0] < fits.circuit.r_p[2] < found[0].interval()[1]
    assert fits["bad"].measured is None
    fits.write(tmp_path / "fits.h5")
    kept = etid.Fits.read(tmp_path / "fits.h5")
    assert "Told before the fit" in str(kept[0])
    for call in (kept[0].residual, kept[0].posterior, lambda: kept[0].profile("r_p")):
        with pytest.raises(ValueError, match="identify the impedance again"):
            call()
    with pytest.raises(TypeError, match="identify the impedance again"):
        kept[0].plot()
    with pytest.raises(ValueError, match="a report is on recordings"):
        etid.write_report(tmp_path / "fits.h5", tmp_path / "page.html")


def test_each_column_of_a_table_has_one_unit():
    """It was that of small values, with numbers of another."""
    large = etid.SkinRC(20.0, 100.0, 20e-6)
    spectra = {name: (F, spectrum(large, seed)[0]) for seed, name in enumerate("ab")}
    text = str(etid.identify_impedances(spectra, labels={"a": {"subject": "1"}}))
    assert "r_s [Ω]" in text
    assert "c_p [µF]" in text
    rows = [line.split() for line in text.splitlines()[2:4]]
    assert [row[0] for row in rows] == ["-", "1"]  # one has no label
    for row in rows:
        assert abs(float(row[2]) - 20.0) < 1.0
