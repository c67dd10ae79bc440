"""A pulse period of a whole number of samples: aliases fall on the harmonics.

The records are sums of harmonics up to 4 MHz, folded by hand: harmonic k falls on k modulo the
number of samples of a period. Driver, loads and filter are formulas, so the truth is exact.
"""

import dataclasses
import functools

import numpy as np
import pytest

import etid
from etid.signals.harmonics import ALIASED, aliases
from etid.simulation.transformer import TransformerDriver

pytestmark = pytest.mark.usefixtures("run_as_for_users")

SKINS = {
    "dry": etid.SkinRC(r_s=33.4e3, r_p=186e3, c_p=0.12e-9),
    "damp": etid.SkinRC(r_s=6.1e3, r_p=17.4e3, c_p=0.66e-9),
}
REFERENCE = 98.8e3
# As many harmonics as those of other tests, after padding, so that nothing is compiled for them.
RATE, PULSES, PERIODS = 204e3, 60.0, 3
HIGHEST = 4e6  # [Hz] harmonics above are below 1e-6 of the pulse, 16 edges of 250 ns
PARTS = [
    field.name
    for field in dataclasses.fields(TransformerDriver)
    if field.name.startswith(("r_", "l_", "c_"))
]
SIGMAS = 4.0  # one of 16 000 for a normal error; 600 elements are compared below


def impedance(skin, f):
    r_s, r_p, c_p = (float(value) for value in (skin.r_s, skin.r_p, skin.c_p))
    return r_s + r_p / (1 + 2j * np.pi * f * r_p * c_p)


def butterworth(f, corner):
    """Of fourth order: |H|² = 1 / (1 + (f / corner)⁸)."""
    s, poles = 1j * f / corner, np.exp(1j * np.pi * (5 + 2 * np.arange(4)) / 8)
    return 1 / np.prod(s - poles[:, None], axis=0)


@dataclasses.dataclass
class Bench:
    """A driver, a converter and its filter; the pulses begin anywhere between two samples."""

    seed: int
    rate: float = RATE
    pulses: float = PULSES
    periods: int = PERIODS
    snr_db: float = 60.0
    filtered: bool = True

    def __post_init__(self):
        self.rng = np.random.default_rng(self.seed)
        usual = TransformerDriver()
        drawn = {name: getattr(usual, name) * self.rng.uniform(0.9, 1.1) for name in PARTS}
        width = self.rng.choice([160 / 240e3, 0.04 / 60, 0.04 / self.pulses])
        driver = TransformerDriver(**drawn, width=float(width))
        self.k = np.arange(1, int(HIGHEST / self.pulses))
        self.f = self.k * self.pulses
        self.filter = butterworth(self.f, 0.4 * self.rate) if self.filtered else 1.0
        self.x = self.pulses * driver.v_th_spectrum(self.f) * self.filter
        self.z_th = driver.z_th(self.f)
        self.start = self.rng.uniform(0, 1)
        self.noise = np.sqrt(2 * np.sum(np.abs(self.x) ** 2)) * 10 ** (-self.snr_db / 20)

    def folded(self, coefficients, late=0.0):
        """One period of a waveform."""
        size = round(self.rate / self.pulses)
        c = coefficients * np.exp(2j * np.pi * self.f / self.rate * (self.start + late))
        spectrum = np.zeros(size, complex)
        np.add.at(spectrum, self.k % size, c)
        return 2 * size * np.fft.ifft(spectrum).real

    def record(self, coefficients, noise=None):
        """Noisy periods, a tenth of a sample late or early."""
        one = np.tile(self.folded(coefficients, 0.1 * self.rng.standard_normal()), self.periods)
        return one + (self.noise if noise is None else noise) * self.rng.standard_normal(one.size)

    def recording(self, path, z, **fields):
        return etid.Recording(
            self.record(self.x),
            self.record(self.x * z / (z + self.z_th)),
            sample_rate=self.rate,
            pulse_rate=self.pulses,
            adc_range=(-200.0, 200.0),
            path=path,
            **fields,
        )

    def calibration(self):
        return self.recording("calibration", np.full(self.f.shape, REFERENCE), r_load=REFERENCE)

    def loaded(self, name):
        skin = self.recording(name, impedance(SKINS[name], self.f))
        return skin.replace(calibration=("calibration",))


@functools.cache
def study(filtered):
    bench = Bench(seed=1, filtered=filtered)
    return etid.Study.from_recordings([bench.calibration(), *map(bench.loaded, SKINS)])


def each(fits):
    """The fits of the skins with their names."""
    return [(fits[number], name) for number, name in enumerate(SKINS)]


def off(fit, name):
    """Errors in standard errors."""
    values, errors = (np.asarray(of.values()) for of in (fit.circuit, fit.stderr))
    return (values - np.asarray(SKINS[name].values())) / errors


@pytest.mark.parametrize(
    "identify", [etid.identify_study, pytest.param(etid.identify_jointly, marks=pytest.mark.slow)]
)
def test_a_fit_is_by_maximum_likelihood_and_right(identify):
    for fit, name in each(identify(study(True)).fits):
        assert fit.verdict == "successful"
        assert fit.method in ("maximum_likelihood", "joint")
        assert np.abs(off(fit, name)).max() < SIGMAS


def test_without_a_filter_the_records_are_biased():
    """Maximum likelihood would be up to fifty of its standard errors off."""
    with pytest.raises(etid.IdentificationError, match=r"'calibration': biased.*anti-alias filter"):
        etid.identify_driver(study(False)["calibration"])
    driver = etid.identify_driver(study(True)["calibration"])
    for name in SKINS:
        fit = etid.identify_skin(study(False)[name], driver, throw=False)
        assert fit.verdict == "biased"
    joint = etid.identify_jointly(study(False))
    assert set(joint.fits.verdicts) == {"driver_failed"}
    assert all("biased" in note for note in joint.fits.notes)
    with pytest.raises(etid.IdentificationError, match="biased"):
        etid.Tracker.of(driver, study(False)["calibration"], electrodes=1)


def exact(bench, coefficients):
    """Fourier coefficients of a period, with aliases and without, below half the rate."""
    size = round(bench.rate / bench.pulses)
    number = (size - 1) // 2
    found = np.fft.rfft(bench.folded(coefficients))[1 : number + 1] / size
    turned = coefficients * np.exp(2j * np.pi * bench.f / bench.rate * bench.start)
    return found, turned[:number]


@pytest.mark.parametrize(("rate", "pulses"), [(200e3, 50.0), (240e3, 60.0), (500e3, 50.0)])
@pytest.mark.parametrize("load", ["open", *SKINS])
def test_aliases_behind_a_filter_are_not_larger_than_estimated(rate, pulses, load):
    """Nor are they more than 20 times smaller where they matter most, at the highest harmonics."""
    for seed in range(10):
        bench = Bench(seed, rate, pulses)
        x = bench.x
        if load != "open":
            z = impedance(SKINS[load], bench.f)
            x = x * z / (z + bench.z_th)
        found, true = exact(bench, x)
        size = round(rate / pulses)
        quiet = np.full(found.shape, 1e-12 * np.abs(found[-1]) ** 2)
        of = aliases(found, quiet, 3, 3 * size)
        for part in (0.1, 0.2, 0.3, ALIASED):
            # 25 harmonics hold a whole lobe of the spectrum of a pulse.
            around = slice(round(part * size) - 25, round(part * size) + 25)
            ratio = np.mean(of.power[around]) / np.mean(np.abs(found - true)[around] ** 2)
            assert ratio > 1
        assert ratio < 20


def test_a_spectrum_that_ends_in_the_noise_has_no_aliases():
    rng = np.random.default_rng(4)
    parts = rng.standard_normal((2, 2000))
    noise = np.full(2000, 2.0)
    pulse = 1e6 * np.exp(-np.arange(2000) / 50)
    of = aliases(pulse + parts[0] + 1j * parts[1], noise, 5, 20_000)
    assert not of.power.any()
    assert not of.are_unknown(noise)


def test_a_spectrum_that_falls_with_a_power_has_the_aliases_of_this_power():
    size = 4000
    u = np.arange(1, 2000) / size
    of = aliases(u**-7.0 + 0j, np.full(u.size, 1e-9), 5, 5 * size)
    # A spectrum as steep as this changes by a factor of five over a band, whose mean lies higher.
    np.testing.assert_allclose(of.fall, 14.0, rtol=0.03)
    np.testing.assert_allclose(of.power[:1400], (1 - u[:1400]) ** -14.0, rtol=0.15)


def drawn(**settings):
    """Errors of skins behind drawn drivers in standard errors; skins that are not fitted."""
    errors, others = [], []
    for draw in range(18):
        bench = Bench(100 + draw, snr_db=(40.0, 60.0, 80.0)[draw % 3], **settings)
        try:
            driver = etid.identify_driver(bench.calibration())
        except etid.IdentificationError as error:
            others += [str(error).split(": ")[1].split(".")[0].split(",")[0]] * len(SKINS)
            continue
        fits = etid.identify_skins([bench.loaded(name) for name in SKINS], driver)
        for fit, name in each(fits):
            if fit.verdict == "successful":
                errors.append(off(fit, name))
            else:
                others.append(fit.verdict)
    return np.array(errors), others


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rate", "pulses", "periods"), [(200e3, 50.0, 10), (240e3, 60.0, 3)], ids=["50 Hz", "60 Hz"]
)
def test_behind_a_filter_the_elements_are_within_their_errors(rate, pulses, periods):
    errors, others = drawn(rate=rate, pulses=pulses, periods=periods)
    assert len(others) <= 2
    assert np.abs(errors).max() < SIGMAS
    assert np.sqrt(np.mean(errors**2, axis=0)).max() < 1.3  # 1 ± 0.09 without any aliases


@pytest.mark.slow
@pytest.mark.parametrize(("rate", "pulses"), [(200e3, 50.0), (240e3, 60.0)], ids=["50 Hz", "60 Hz"])
def test_without_a_filter_no_fit_is_silently_wrong(rate, pulses):
    errors, others = drawn(rate=rate, pulses=pulses, filtered=False)
    assert others.count("biased") >= 0.75 * 36
    assert not errors.size or np.abs(errors).max() < SIGMAS
