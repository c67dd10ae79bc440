"""Clipping in a converter or an amplifier: found where a pulse is cut, and nowhere else."""

import itertools

import numpy as np
import pytest

import etid
from benchmarks.laboratory import Output, noise
from benchmarks.ladder import LOADS
from benchmarks.perturbed_study import drawn_driver
from etid.recordings.preflight import Inspected, preflight
from etid.recordings.recording import Recording
from etid.signals.clipping import is_clipped
from etid.simulation.transformer import ResistorLoad, TransformerDriver
from tests.conftest import REFERENCE_DATA

RATE, SAMPLES, FULL_SCALE = 200e3, 10_000, 10.0
NOISE_DB = (40.0, 60.0, 80.0, np.inf)


@pytest.fixture(scope="module")
def waves():
    """Voltages at the converter behind drivers whose parts differ by 10 %, and noise at 0 dB."""
    found = []
    for number in range(4):
        driver = drawn_driver(number, 0.1, TransformerDriver())
        outputs = [Output(driver), *(Output(driver, (load,)) for load in LOADS.values())]
        rng = np.random.default_rng(number)
        volts = np.stack([one.volts(RATE, SAMPLES, rng) for one in outputs])
        found.append((volts, noise(driver, RATE, 0.0)))
    return found


def converted(volts, bits, sigma, seed, rails=(-np.inf, np.inf)):
    """Volts, rounded as the converter does, which do not say its step."""
    noisy = volts + sigma * np.random.default_rng(seed).standard_normal(volts.shape)
    step = 2 * FULL_SCALE / 2**bits
    return np.rint(np.clip(noisy, *rails) / step) * step


@pytest.mark.parametrize("snr_db", NOISE_DB)
@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
def test_rounded_volts_are_not_clipped(waves, bits, snr_db):
    """Of damp skin, 12 bits and 60 dB, 21 of 24 were saturated."""
    for number, (volts, at_0_db) in enumerate(waves):
        for v in converted(volts, bits, at_0_db * 10 ** (-snr_db / 20), number):
            assert not is_clipped(v, 0.0)


@pytest.mark.parametrize("snr_db", NOISE_DB)
@pytest.mark.parametrize("bits", [12, 14, 16])
def test_a_pulse_whose_top_is_cut_by_5_percent_is_clipped(waves, bits, snr_db):
    for number, (volts, at_0_db) in enumerate(waves):
        sigma = at_0_db * 10 ** (-snr_db / 20)
        for v in volts:
            top = v[np.argmax(np.diff(v)) + 12]  # after the overshoot
            assert is_clipped(converted(v, bits, sigma, number, (-np.inf, 0.95 * top)), 0.0)
            assert is_clipped(-converted(v, bits, sigma, number, (-np.inf, 0.95 * top)), 0.0)


@pytest.mark.parametrize("width", [1, 9])
def test_commands_of_a_generator_are_not_clipped(width):
    phase = np.arange(SAMPLES) * 60.0 / RATE % 1
    first, second = phase < 0.04, (phase >= 0.04) & (phase < 0.08)
    window = np.hanning(width + 2) / np.hanning(width + 2).sum()
    for command in (first * 4.2, first * 4.2 - second * 4.2, first * (4.2 - 10 * phase)):
        v = np.convolve(command, window, "same")
        for sign in (1.0, -1.0):
            assert not is_clipped(sign * v, 0.0)
            assert not is_clipped(converted(sign * v, 14, 0.0, 0), 0.0)


def test_drawn_drivers_pass_with_converters_of_all_bits():
    data = REFERENCE_DATA / "drawn_drivers"
    if not data.is_dir():
        pytest.skip("../shared/data/drawn_drivers is absent")
    held = np.load(data / "records.npz")
    for bits, codes in zip(itertools.cycle((10, 12, 14, 16)), held["codes"].astype(float)):
        step = float(held["lsb"]) * 2 ** (16 - bits)
        th, out = np.rint(codes * held["lsb"] / step) * step / held["scale"]
        one = Recording(th, out, sample_rate=float(held["fs"]), pulse_rate=float(held["f0"]))
        assert preflight(Inspected.of(one)) is None


def test_a_value_with_few_samples_beside_the_rail_is_no_clipping():
    """At the rail 5 samples in a row, next to it 1, then 3 at each value of the droop."""
    top = np.repeat(np.arange(100.0, 60.0, -1.0), [5, 1, *[3] * 38])
    quiet = np.resize([0.0, 1.0, -1.0, 1.0, 0.0, -1.0], 2000)
    v = np.concatenate([np.concatenate([quiet, top]) for _ in range(3)])
    for sign in (1.0, -1.0):
        assert not is_clipped(sign * v, 1.0)
    assert is_clipped(np.minimum(v, 80.0), 1.0)


# --- Before the converter -------------------------------------------------------------------------


def judged(v_th, v_out, **fields):
    one = etid.Recording(v_th, v_out, sample_rate=RATE, pulse_rate=60.0, **fields)
    return preflight(Inspected.of(one))


@pytest.fixture(scope="module", params=["dry", "damp"])
def good(request):
    scene = getattr(etid.scenes, f"paper_{request.param}")(snr_db=60.0)
    study = scene.simulate(seed=0)
    return study[f"typical/{request.param}/04"]


@pytest.mark.parametrize(
    ("noise", "adc_range"),  # [V], behind the limiter
    [(0.0, (-186.9, 186.9)), (0.01, None), (0.05, (-186.9, 186.9))],
)
@pytest.mark.parametrize("part", [0.4, 0.6, 0.8, 0.9])
def test_an_amplifier_that_limits_within_the_range_is_seen(good, part, noise, adc_range):
    """The verdict was `misfit`, `rate_mismatch` or `changed`."""
    top = part * np.quantile(good.v_out, 0.99)
    more = noise * np.random.default_rng(1).standard_normal(good.v_out.size)
    v_out = np.minimum(good.v_out, top) + more
    assert judged(good.v_th, v_out, adc_range=adc_range) == "saturated"
    assert judged(-good.v_th, -v_out, adc_range=adc_range) == "saturated"
    late = judged(good.v_th, np.roll(v_out, 7), adc_range=adc_range)
    assert late == "saturated"


def test_a_clipped_record_has_no_fit():
    study = etid.scenes.paper_dry(snr_db=60.0).simulate(seed=0)
    driver = etid.identify_driver(study["calibration/98k8"], order=5)
    one = study["typical/dry/04"]
    for top in (20.0, 30.0, 40.0, 45.0):
        fit = etid.identify_skin(one.replace(v_out=np.minimum(one.v_out, top)), driver, throw=False)
        assert fit.verdict == "saturated"
        assert np.isnan(fit.circuit.values()).all()


HOLDING = {  # against the droop of V_th
    "slow layer": etid.SkinLayers(2e4, 5e4, 0.3e-9, 5e4, 6e-9),
    "capacitor in series": etid.circuit("R0-C1"),
    "cole": etid.SkinCole(),
    "diffusion": etid.SkinWarburg(),
}


@pytest.mark.parametrize(
    ("number", "snr_db"),
    [*zip([0, 1, 2, 0, 1, 2, 0, 6], [20.0, 25.0, 30.0, 35.0, 40.0, 60.0, 80.0, 80.0], strict=True)],
)
def test_no_good_record_stays_at_its_extreme_value(number, snr_db):
    """A slow layer may hold V_out against the droop of V_th: its top has another shape."""
    typed = type(HOLDING["capacitor in series"])(r_0=2e4, c_1=5e-9)
    loads = [*LOADS.values(), *(ResistorLoad(r) for r in (21.6e3, 98.8e3, 555e3))]
    loads += [lambda f, one=one: np.asarray(one.response(f)) for one in (*HOLDING.values(), typed)]
    driver = drawn_driver(number, 0.1, TransformerDriver())
    rng = np.random.default_rng(number)
    outputs = [Output(driver), *(Output(driver, (load,)) for load in loads)]
    volts = np.stack([one.volts(RATE, SAMPLES, rng) for one in outputs])
    sigma = noise(driver, RATE, 0.0) * 10 ** (-snr_db / 20)
    for bits in (8, 12, 16):
        v_th, *rest = (converted(v, bits, sigma, i) for i, v in enumerate(volts))
        for v_out in rest:
            assert judged(v_th, v_out) != "saturated"


def test_a_stimulator_that_holds_its_voltage_is_not_clipped():
    t = np.arange(SAMPLES) / RATE * 60.0 % 1
    held = np.where(t < 0.04, 10.0, 0.0)
    current = 1e-3 * held / 10.0 * np.exp(-t / 0.02)
    rng = np.random.default_rng(0)
    v_out, i = (v + 1e-3 * np.ptp(v) * rng.standard_normal(SAMPLES) for v in (held, current))
    one = etid.Recording(v_out=v_out, current=i, sample_rate=RATE, pulse_rate=60.0)
    assert preflight(Inspected.of(one)) is None
