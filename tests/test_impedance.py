"""Circuits from measured impedance: soldered ones, and simulated ones with known noise."""

import pickle

import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.figure import Figure

import etid
from tests.skins import DRY, off

# Fitted without weights by impedance.py's makers and by others (SOURCE.txt of the data).
PUBLISHED = {
    "Circuit1_EIS_1": (29.14, 46.65, 10.43e-6),
    "Circuit2_EIS_1": (150.3, 502.5, 31.13e-9),
}
DRAWS = 60  # of fits that take 50 ms; an error of a third too small is seen
FEW = np.geomspace(100.0, 1e5, 6)


def zplot(path):
    """Frequency and impedance of a ZPlot file."""
    lines = path.read_text(errors="replace").splitlines()
    start = next(i for i, line in enumerate(lines) if line.strip() == "End Comments") + 1
    table = np.array([line.split("\t") for line in lines[start:] if line.strip()], float)
    return table[:, 0], table[:, 4] + 1j * table[:, 5]


@pytest.mark.parametrize("name", PUBLISHED)
def test_soldered_circuits_are_those_published(reference_data, name):
    frequency, z = zplot(reference_data("dummy_circuits_eis") / f"{name}.z")
    fit = etid.identify_impedance(frequency, z)
    # DESIGN's half per cent: the digits of the published values and the choice of points.
    np.testing.assert_allclose(fit.circuit.values(), PUBLISHED[name], rtol=5e-3)
    assert float(fit.rrse) < 0.004  # as published, 0.30 to 0.38 %


def measured(circuit, sigma, seed):
    rng = np.random.default_rng(seed)
    frequency = np.geomspace(10, 1e6, 50)
    z = np.asarray(circuit.response(jnp.asarray(frequency)))
    return frequency, z + sigma * (rng.normal(size=50) + 1j * rng.normal(size=50))


def test_any_size_is_found_from_the_typical_values():
    for scale in (1e-4, 1.0, 1e3):
        circuit = etid.SkinRC(r_s=33.4e3 * scale, r_p=186e3 * scale, c_p=1e-9 / scale)
        fit = etid.identify_impedance(*measured(circuit, 10.0 * scale, 1), stderr=10.0 * scale)
        np.testing.assert_allclose(fit.circuit.values(), circuit.values(), rtol=0.01)
    for circuit in (DRY, etid.Resistor()):  # exact impedances have no remark
        fit = etid.identify_impedance(*measured(circuit, 0.0, 0), circuit=circuit)
        assert int(fit.remarks) == 0


def test_what_the_data_do_not_show_is_insensitive():
    frequency, z = measured(DRY, 2e3, 3)
    high = frequency > 3e5  # far above the corner: no R_p
    fit = etid.identify_impedance(frequency[high], z[high], stderr=2e3, throw=False)
    assert fit.verdict == "insensitive"
    assert "Not determined: r_p." in fit.note


def spectrum(circuit, size, seed=0):
    """A spectrum with noise that is a part of |Z|."""
    frequency, z = measured(circuit, 0.0, seed)
    parts = np.random.default_rng(seed).normal(size=(2, 50))
    return frequency, z + size * np.abs(z) * (parts[0] + 1j * parts[1])


@pytest.mark.parametrize("size", [None, 3e-2])
def test_intervals_hold_the_truth(size):
    """With noise of 300 Ω that is told, and with one that is a part of |Z| and is not."""
    inside, chi2 = [], []
    for seed in range(DRAWS):
        if size is None:
            fit = etid.identify_impedance(*measured(DRY, 300.0, seed), stderr=300.0)
            chi2.append(float(fit.chi2))
        else:
            fit = etid.identify_impedance(*spectrum(DRY, size, seed))
        assert int(fit.remarks) == 0
        inside.append(np.abs(off(fit)) < 1.96)
    assert (np.abs(np.mean(inside, 0) - 0.95) < 3 * np.sqrt(0.95 * 0.05 / DRAWS)).all()
    assert size is not None or abs(np.mean(chi2) - 1) < 3 * np.sqrt(2 / 97 / DRAWS)


def test_few_points_determine_themselves_and_the_errors_know_it():
    """Of 12 numbers three are fitted: the residual has three quarters of the noise's variance."""
    rng, z, z_scores = np.random.default_rng(0), np.asarray(DRY.response(FEW)), []
    for _ in range(DRAWS):
        noise = 0.01 * np.abs(z) * (rng.normal(size=6) + 1j * rng.normal(size=6))
        fit = etid.identify_impedance(FEW, z + noise)
        z_scores.append(off(fit))
    # 180 numbers, of which some 120 are independent: three standard errors of their size.
    assert abs(np.sqrt(np.mean(np.square(z_scores))) - 1) < 0.2


def test_noise_that_is_told_too_small_is_a_misfit_with_errors_as_large_as_it_is():
    frequency, z = spectrum(DRY, 1e-2)
    half, third = (
        etid.identify_impedance(frequency, z, stderr=1e-2 * np.abs(z) / part, throw=False)
        for part in (2, 3)
    )
    assert half.verdict == third.verdict == "misfit"
    np.testing.assert_allclose(third.chi2 / half.chi2, 9 / 4, rtol=1e-6)
    np.testing.assert_allclose(third.cov, half.cov, rtol=1e-4)


COLE = etid.SkinCole(33.4e3, 186e3, 22.3e-6, 0.8)
FAST = etid.ParallelRC(200e3, 100e-12)


@pytest.mark.parametrize(
    ("truth", "change", "circuit", "words"),
    [
        (DRY, np.conj, None, "Im Z is positive"),
        (DRY, np.abs, None, "Z is real"),
        (DRY, lambda z: np.where(np.arange(50) == 30, 1.5 * z, z), None, "by far the most at"),
        (DRY, lambda z: np.where(np.arange(50) < 20, z / 1e3, z), None, "misfit"),  # kΩ
        (COLE, lambda z: z, etid.SkinRC(), "not white noise"),
        (DRY, lambda z: z, etid.ParallelRC(), "not white noise"),
        # A meter that shows at least 40 kΩ, at the right phase, has no series resistance.
        *(
            (FAST, lambda z: z * np.hypot(1.0, 40e3 / np.abs(z)), circuit, "misfit")
            for circuit in (etid.SkinRC(), etid.ParallelRC())
        ),
    ],
)
def test_what_is_wrong_with_a_spectrum_is_named(truth, change, circuit, words):
    frequency, z = spectrum(truth, 0.005)
    with pytest.raises(etid.IdentificationError, match="misfit") as error:
        etid.identify_impedance(frequency, change(z), circuit=circuit)
    assert words in str(error.value)
    assert words not in str(etid.identify_impedance(frequency, z, circuit=type(truth)()))


def test_two_points_beside_the_others_are_named():
    """As hum puts them there; the remark had a list of causes, and named no frequency."""
    frequency, z = spectrum(DRY, 0.002)
    wrong = np.argsort(np.abs(frequency - 50.0))[:2]
    z[wrong] *= [1.1, 0.9]
    said = str(etid.identify_impedance(frequency, z, throw=False))
    assert "leave such points out, or give stderr" in said
    assert all(f"{frequency[at]:.3g} Hz" in said for at in wrong)


def test_errors_of_calibration_widen_the_standard_errors():
    """A gain that wanders by 0.5 % over the sweep is no noise; the truth stays inside."""
    frequency, z = spectrum(DRY, 2e-4)
    for phase in np.linspace(0.0, 5.0, 6):
        fit = etid.identify_impedance(
            frequency, z * (1 + 0.005 * np.sin(np.log(frequency) + phase))
        )
        assert "not white noise" in str(fit)
        assert "Neighbouring impedances miss alike" in str(fit)
        # 2 standard errors are 95 %, of 18 numbers that are not drawn by chance.
        assert (np.abs(off(fit)) < 2).all()
        assert (np.asarray(fit.stderr.values()) < 0.03 * np.asarray(DRY.values())).all()


def test_two_layers_do_not_end_as_one():
    """From the best start alone, this fit ended with an infinite r_2 and χ² 6.9."""
    truth = etid.SkinLayers(6.1e3, 8.7e3, 1.32e-9, 8.7e3, 5.94e-9)
    frequency = 60.0 * np.arange(1, 1167)
    z = np.asarray(truth.response(jnp.asarray(frequency)))
    sigma = 23.5 * (1 + frequency / 1e3)
    rng = np.random.default_rng(0)
    parts = rng.standard_normal((2, frequency.size))
    z = z + sigma * (parts[0] + 1j * parts[1])
    fit = etid.identify_impedance(frequency, z, stderr=sigma, circuit=etid.SkinLayers())
    assert (np.abs(off(fit, truth)) < 4).all()


def test_a_fit_to_an_impedance_is_drawn_with_its_points():
    frequency = jnp.geomspace(60.0, 1e5, 20)
    z = np.asarray(DRY.response(frequency))
    fit = pickle.loads(pickle.dumps(etid.identify_impedance(frequency, z)))
    for show in ("pulse", "impedance"):  # the first is the default
        nyquist, *_ = fit.plot(show=show, axes=Figure().subplots(1, 3))
        points = nyquist.containers[0].lines[0]
        np.testing.assert_allclose(
            points.get_xydata(), np.stack([np.real(z), -np.imag(z)], 1) / 1e3
        )
        labels = [text.get_text() for text in nyquist.get_legend().get_texts()]
        assert labels == ["fit", "measured"]  # no standard errors are known
    assert "chi2" not in str(fit)  # there is none
