"""The residual of a fit by frequency: on the noise that the fit expects, which is what acts."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest
import scipy.signal
import scipy.special
from matplotlib.colors import to_hex

import etid
from benchmarks.inexact import inexact
from benchmarks.perturbed_study import undisturbed
from etid.estimators.lanes import Harmonics
from etid.plotting.bands import continuous
from etid.plotting.by_frequency import LEFT, band_of, by_frequency, sample_std
from etid.plotting.style import BLUE
from etid.recordings.preflight import Inspected
from etid.results.driver import ContinuousDriver
from tests import pictures

CORNER, ORDER = 30e3, 4  # of the filter that the noise passes
SCENE = dataclasses.replace(etid.scenes.paper_dry(snr_db=None), bits=None)


def noisy(seed, *, filtered, snr_db=50.0, scene=SCENE):
    """A calibration and a trial without noise, and the same with white or filtered noise."""
    clean, rng = scene.simulate(seed=seed), np.random.default_rng(seed)
    b, a = np.asarray(scipy.signal.butter(ORDER, CORNER, fs=scene.sample_rate))

    def noise(v):
        white = rng.normal(size=v.size + 1000) * np.std(v) * 10 ** (-snr_db / 20)
        return (scipy.signal.lfilter(b, a, white) if filtered else white)[1000:]

    paths = "calibration/98k8", "typical/dry/01"
    return [
        (
            clean[path],
            clean[path].replace(v_th=of.v_th + noise(of.v_th), v_out=of.v_out + noise(of.v_th)),
        )
        for path in paths
        for of in [clean[path]]
    ]


def shown(recording, driver, circuit, found):
    """What the picture shows by frequency."""
    of, feed = continuous(recording, driver)
    return by_frequency(Inspected.of(of), feed, circuit, found)


class Judged:
    """A driver and a fit of one kind of noise."""

    def __init__(self, filtered):
        (_, self.calibration), (self.clean, self.recording) = noisy(8, filtered=filtered)
        self.driver = etid.identify_driver(self.calibration, order=5)
        self.fit = etid.identify_skin(self.recording, self.driver)
        load = etid.Resistor(98.8e3)
        self.found = shown(self.recording, self.driver, self.fit.circuit, self.fit)
        self.of_driver = shown(self.calibration, self.driver, load, self.driver)


@pytest.fixture(scope="module", params=[False, True], ids=["white", "filtered"])
def judged(request):
    return Judged(request.param), request.param


def test_the_line_is_the_noise_that_weights_the_fit(judged):
    of, _ = judged
    lane = Harmonics.of(Inspected.of(of.recording))
    z = of.fit.circuit.response(jnp.asarray(lane.frequency))
    gain = np.asarray(of.driver.gain(z, jnp.asarray(lane.frequency)))
    weighed = (lane.variance_y + np.abs(gain) ** 2 * lane.variance_x)[lane.selected]
    axis = of.fit.plot()[2]
    (line,) = [one for one in axis.lines if one.get_linestyle() == "-"]
    np.testing.assert_allclose(line.get_xdata(), 1e-3 * lane.frequency[lane.selected])
    samples = Inspected.of(of.recording).periods[1]
    unit = 1e-6 if "µV" in axis.get_ylabel() else 1e-9
    density = np.sqrt(2 * samples / of.recording.sample_rate * weighed)
    # The fit moves Z_th within its standard error, which is below 1 % in |G|.
    np.testing.assert_allclose(unit * np.asarray(line.get_ydata()), density, rtol=0.01)
    # The points and the line give χ² of the fit, whose dozen unknowns are 0.4 % of its terms.
    used = of.found.selected
    squares = np.sum((of.found.residual / of.found.noise)[used] ** 2)
    assert squares / np.count_nonzero(used) == pytest.approx(float(of.fit.chi2), abs=0.01)
    plt.close("all")


def test_the_residual_of_a_good_recording_lies_on_the_noise_at_every_frequency(judged):
    of, filtered = judged
    for found in (of.found, of.of_driver):
        used = found.selected
        band = band_of(used.size)
        number = np.bincount(band, used)
        there = number > 0
        number = number[there]
        power, noise = (
            np.bincount(band, np.where(used, size**2, 0.0))[there] / number
            for size in (found.residual, found.noise)
        )
        # In a band of n harmonics the noise is known from 2 n bins between them, 12 at least.
        error = np.sqrt(1 / number + 1 / np.maximum(2 * number, 12))
        z = (power / noise - 1) / error
        assert z.size > 20
        assert np.sqrt(np.mean(z**2)) < 1.5  # χ² of 20 numbers: one of 1 000 exceeds 1.5² · 20
        assert np.abs(z[number > 30]).max() < 4
        low, high = (scipy.special.gammaincinv(number, p) / number for p in (0.025, 0.975))
        outside = (power / noise < low) | (power / noise > high)
        # Of 25 bands, 5 % and those in which the noise is less certain: 1 % of counts exceed 6.
        assert np.count_nonzero(outside) <= 6
        size = [found.noise[np.argmin(np.abs(found.frequency - f))] for f in (10e3, 55e3)]
        warped = np.tan(np.pi * np.array([10e3, 55e3, CORNER]) / 200e3)
        passed = (1 + (warped[:2] / warped[2]) ** (2 * ORDER)) ** -0.5  # Butterworth
        falls = passed[0] / passed[1] if filtered else 1.0
        # Each band of the noise is known to a fifth; |G| of the skin rises by a fifth, too.
        assert 0.6 < size[0] / size[1] / falls < 1.7


def test_the_band_in_time_is_that_of_the_noise_of_both_records(judged):
    """The noise of a record is known from it to some 2 %."""
    of, _ = judged
    of_th, of_out = of.recording.v_th - of.clean.v_th, of.recording.v_out - of.clean.v_out
    f = jnp.asarray(np.fft.rfftfreq(of_th.size, 1 / of.recording.sample_rate))
    gain = np.asarray(of.driver.gain(pictures.SKIN.response(f), f))
    through = np.fft.irfft(np.fft.rfft(of_th) * gain, of_th.size)
    sigma = sample_std(Inspected.of(of.recording), of.driver, pictures.SKIN)
    assert sigma == pytest.approx(np.std(through - of_out), rel=0.06)


def words(axes):
    """The entries of the legend below a picture."""
    (legend,) = axes[0].figure.legends
    plt.close(axes[0].figure)
    return [one.get_text() for one in legend.get_texts()]


def test_the_picture_says_with_which_noise_a_fit_was_judged(judged):
    of, _ = judged
    # Two of three bins of 10 000 samples lie between the harmonics of three periods. The two below
    # the first harmonic are left out.
    between = "noise between the harmonics (3330 bins)"
    assert between in words(of.fit.plot())
    assert between in words(of.driver.plot(of.calibration))
    v_th, v_out = of.recording.v_th[:3333], of.recording.v_out[:3333]
    single = of.recording.replace(v_th=v_th, v_out=v_out)
    for method, recording, noise in (
        ("output_error", of.recording, "white noise"),
        ("maximum_likelihood", of.recording, between),
        ("maximum_likelihood", single, "noise in the quiet part"),
    ):
        axes = dataclasses.replace(of.fit, method=method).plot(recording, of.driver)
        assert len(axes) == 3
        assert any(one.startswith(noise) for one in words(axes))


def test_a_measured_current_shows_its_noise_too():
    recording = pictures.with_current().replace(v_th=None)
    fit = etid.identify_skin(recording)
    axes = fit.plot()
    assert len(axes) == 3
    assert any(one.startswith("noise between") for one in words(axes))
    found = shown(recording, None, fit.circuit, fit)
    squares = np.mean((found.residual / found.noise)[found.selected] ** 2)
    assert squares == pytest.approx(float(fit.chi2), abs=0.01)


def test_a_single_period_shows_the_noise_of_its_quiet_part():
    recording = pictures.with_current().replace(v_th=None)
    part = {
        "v_out": recording.v_out[:3333],
        "current": recording.samples["current"].values[:3333],
    }
    fit = pictures.fit()
    (shown,) = [one for one in words(fit.plot(recording.replace(**part))) if "noise in" in one]
    assert shown.startswith("noise in the quiet part (")


def test_what_a_fit_did_not_use_is_pale_and_has_no_noise():
    """8000 samples hold two periods, whose aliases cover the highest harmonics."""
    recording = pictures.dry()
    two = recording.replace(v_th=recording.v_th[:8000], v_out=recording.v_out[:8000])
    axis = pictures.fit().plot(two, pictures.driver())[2]
    pale, clear = (line for line in axis.lines if line.get_linestyle() == "None")
    assert {to_hex(one.get_color()) for one in (pale, clear)} == {BLUE}
    assert pale.get_alpha() < 0.5 < clear.get_alpha()
    (noise,) = [line for line in axis.lines if line.get_linestyle() == "-"]
    last = np.max(noise.get_xdata())
    assert np.min(pale.get_xdata()) > last > np.max(clear.get_xdata())
    plt.close("all")


@pytest.mark.parametrize("change", ["no whole period", "missing sample"])
def test_without_harmonics_there_are_two_panels(change):
    calibration = pictures.study()["calibration/98k8"]
    v_th, v_out = np.array(calibration.v_th), np.array(calibration.v_out)
    if change == "missing sample":
        v_out[700] = np.nan
    else:
        v_th, v_out = v_th[:3000], v_out[:3000]
    axes = etid.plot(pictures.driver(), calibration.replace(v_th=v_th, v_out=v_out))
    assert len(axes) == 2
    plt.close("all")


def test_a_driver_that_failed_is_drawn_as_far_as_it_is_known():
    calibration, driver = pictures.study()["calibration/98k8"], pictures.driver("misfit")
    assert isinstance(driver, ContinuousDriver)
    without_errors = dataclasses.replace(driver, cov=np.nan * jnp.asarray(driver.cov))
    (noise,) = [
        line for line in without_errors.plot(calibration)[2].lines if line.get_linestyle() == "-"
    ]
    assert np.isfinite(noise.get_ydata()).all()
    unknown = jax.tree.map(lambda of: np.nan * of, driver.source)
    last = dataclasses.replace(driver, source=unknown).plot(calibration)[2]
    assert [one.get_text() for one in last.texts] == ["nothing predicted"]
    plt.close("all")


@functools.cache
def behind_one_driver(size):
    """Skin of a study, and its driver; each gain is wrong by a smooth error of this size."""
    study = undisturbed(41, 60.0)
    of = (inexact(study, size, 1.0) if size else study).recordings()
    driver = etid.identify_driver(list(of.calibrations.recordings()))
    return next(of.loaded.recordings()), driver


def test_what_the_circuit_leaves_has_a_band_below_what_is_accepted():
    recording, driver = behind_one_driver(0.005)
    fit = etid.identify_skin(recording, driver)
    found = shown(recording, driver, fit.circuit, fit)
    used = found.selected
    assert found.accept == 0.02
    assert (found.left > 0).all()
    # δ is at every frequency about as large as the error that was put into it: 95 % are below
    # √(2 ln 20) of its 0.5 %; its size is known to a factor of two, as its few values tell it.
    size = 0.02 * np.median((found.left / found.accepted)[used]) / np.sqrt(2 * np.log(20))
    assert 0.0025 < size < 0.01
    most = np.hypot(1.5 * found.noise, found.left)
    assert np.mean((found.residual < most)[used]) > 0.9
    axis = fit.plot()[2]
    labels = axis.get_legend_handles_labels()[1]
    assert labels == [LEFT, "accepted: 2 % of the signal", found.which]
    plt.close("all")


def test_a_circuit_that_leaves_noise_alone_has_no_such_band():
    recording, driver = behind_one_driver(0.0)
    fit = etid.identify_skin(recording, driver)
    found = shown(recording, driver, fit.circuit, fit)
    assert not found.left.any()
    assert len(fit.plot()[2].get_legend_handles_labels()[1]) == 1
    plt.close("all")
