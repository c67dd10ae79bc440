"""Synthetic recordings against SPICE, the circuit's differential equations, and closed forms."""

import dataclasses
from typing import Any

import numpy as np
import pytest
import scipy.linalg
import scipy.signal
from hypothesis import given
from hypothesis import strategies as st

from etid.simulation import scenes, transformer
from etid.simulation.scenes import Scene, Trial
from etid.simulation.transformer import OpenLoad, ResistorLoad, SkinLoad, TransformerDriver

CLEAN: dict[str, Any] = {"snr_db": None, "bits": None}
DRY = SkinLoad(33.4e3, 186e3, 0.12e-9)
# What the harmonics beyond the summed band may add to a 50 V pulse (see transformer._BANDWIDTH).
TRUNCATION = 1e-6
FIVE_SIGMA = 5.0  # one in 2e6; with fixed seeds a test passes always or never


def one(load, **settings):
    """The recording of one load."""
    return Scene((Trial("x", load),), **settings).simulate(0)["x"]


def state_equations(d, load):
    """x' = A x + B u of driver and load, by Kirchhoff's laws; the terminal is state 2.

    States: voltages of p, s and the terminal; currents of the primary, the magnetising inductance
    and the secondary; voltage of C_p.
    """
    p, s, o, i_1, i_m, i_2, x = np.eye(7)
    u = 0.0
    v_m = d.r_core * (i_1 - i_m - d.turns * i_2)  # the core loss carries what is left
    i_prot = (s - o) / d.r_protection
    i_load = 0 * x
    i_c = -x  # an idle state that decays
    if isinstance(load, ResistorLoad):
        i_load = o / load.r
    if isinstance(load, SkinLoad):
        i_load = (o - x) / load.r_s
        i_c = i_load - x / load.r_p
    rows = [
        (u - p) / d.r_source - i_1,
        i_2 - i_prot,
        i_prot - o / d.r_divider - i_load,
        p - d.r_primary * i_1 - v_m,
        v_m,
        d.turns * v_m - d.r_secondary * i_2 - s,
        i_c,
    ]
    c_p = load.c_p if isinstance(load, SkinLoad) else 1.0
    windings = d.c_primary + d.c_winding, d.c_secondary + d.c_winding, d.c_cable + d.c_divider
    storage = np.diag([*windings, d.l_primary, d.l_magnetising, d.l_secondary, c_p])
    storage[0, 1] = storage[1, 0] = -d.c_winding
    drive = np.zeros(7)
    drive[0] = 1 / d.r_source
    return np.linalg.solve(storage, np.array(rows)), np.linalg.solve(storage, drive)


def time_domain(d, load, *, sample_rate, pulse_rate, samples, start):
    """Sampled steady state by matrix exponentials, exact for the piecewise linear source."""
    A, B = state_equations(d, load)
    corner = 2 * np.pi * 0.4 * sample_rate
    Af, Bf, Cf, _ = scipy.signal.zpk2ss(*scipy.signal.buttap(4))  # corner at 1 rad/s
    F = np.zeros((13, 13))  # circuit, filter, source voltage, source slope
    F[:7, :7], F[:7, 11] = A, B
    F[7:11, 7:11], F[7:11, 2] = corner * Af, corner * Bf[:, 0]
    F[11, 12] = 1.0
    rise, fall, period = d.lead_in, d.lead_in + d.width, 1 / pulse_rate
    slope = d.amplitude / d.edge
    # the source at the start of each straight piece: time, voltage, slope
    pieces = [(0.0, 0.0, 0.0), (rise, 0.0, slope), (rise + d.edge, d.amplitude, 0.0)]
    pieces += [(fall, d.amplitude, -slope), (fall + d.edge, 0.0, 0.0)]
    ends = [time for time, _, _ in pieces[1:]] + [period]

    steps = [scipy.linalg.expm(F * (end - p[0])) for p, end in zip(pieces, ends, strict=True)]
    affine, shift = np.eye(11), np.zeros(11)
    for (_, voltage, rate), step in zip(pieces, steps, strict=True):
        affine = step[:11, :11] @ affine
        shift = step[:11, :11] @ shift + step[:11, 11:] @ [voltage, rate]
    x = np.linalg.solve(np.eye(11) - affine, shift)  # periodic

    times = start + np.arange(samples) / sample_rate
    one_step = scipy.linalg.expm(F / sample_rate)
    v = np.full(samples, np.nan)
    for number in range(int(times[-1] / period) + 1):
        for (begin, voltage, rate), end, step in zip(pieces, ends, steps, strict=True):
            z = np.concatenate([x, [voltage, rate]])
            inside = np.flatnonzero(
                (times >= number * period + begin) & (times < number * period + end)
            )
            at = z
            for count, index in enumerate(inside):
                ahead = times[index] - number * period - begin
                at = one_step @ at if count else scipy.linalg.expm(F * ahead) @ z
                v[index] = Cf[0] @ at[7:11]
            x = (step @ z)[:11]
    return v


@pytest.mark.parametrize("load", [OpenLoad(), ResistorLoad(21.62e3), DRY])
def test_v_out_solves_the_differential_equations_of_the_circuit(load):
    window = {"sample_rate": 200e3, "samples": 4000, "start": 1.23e-3}
    expected = time_domain(TransformerDriver(), load, pulse_rate=60.0, **window)
    np.testing.assert_allclose(one(load, **window, **CLEAN).v_out, expected, atol=TRUNCATION)


def test_clock_offset_changes_the_period_and_not_the_pulse():
    window = {"sample_rate": 100e3, "samples": 4000, "start": 0.0}
    expected = time_domain(TransformerDriver(), DRY, pulse_rate=60.0 * (1 + 150e-6), **window)
    recording = one(DRY, pulse_rate_ppm=150.0, **window, **CLEAN)
    np.testing.assert_allclose(recording.v_out, expected, atol=TRUNCATION)
    assert recording.pulse_rate == 60.0  # the file tells the nominal rate


@given(factors=st.lists(st.floats(0.01, 100.0), min_size=13, max_size=13))
def test_source_impedance_is_passive_for_any_elements(factors):
    default = TransformerDriver()
    names = [field.name for field in dataclasses.fields(default)]
    passive = [name for name in names if name[:2] in ("r_", "l_", "c_")]
    each = zip(passive, factors, strict=False)
    changes = {name: getattr(default, name) * factor for name, factor in each}
    f = np.concatenate([[0.0], np.geomspace(0.1, 1e7, 200)])
    z_th = dataclasses.replace(default, **changes).z_th(f)
    assert np.all(np.real(z_th) >= -1e-9 * np.abs(z_th))  # rounding where the phase is near 90°


def test_windows_of_any_length_and_start_cut_the_same_waveform(monkeypatch):
    block, first = one(DRY, **CLEAN).v_out, 1234
    for samples in (1, 600, 3333, 12_333, 30_000):
        window = one(DRY, samples=samples, start=first / 200e3, **CLEAN).v_out
        expected = block[(first + np.arange(samples)) % 10_000]
        # Phases of up to 1e6 cycles keep 1e-10; times 50 V.
        np.testing.assert_allclose(window, expected, rtol=0, atol=1e-8)
    monkeypatch.setattr(transformer, "_MAX_BLOCK", 0)  # a direct sum in the place of a transform
    summed = one(DRY, samples=200, start=1e-4, **CLEAN).v_out
    np.testing.assert_allclose(summed, block[20:220], rtol=0, atol=1e-8)


def many(count, **settings):
    """The same open circuit many times."""
    trials = tuple(Trial(f"x/{i}", OpenLoad()) for i in range(count))
    return list(Scene(trials, **{**CLEAN, **settings}).simulate(1).values())


def test_noise_has_the_stated_variance_and_is_independent():
    clean = one(OpenLoad(), **CLEAN).v_th
    records = many(20, snr_db=40.0)
    noise = np.array([v - clean for r in records for v in (r.v_th, r.v_out)])
    sigma = clean.std() / 100  # three whole periods: effective value, no DC
    relative_error = FIVE_SIGMA / np.sqrt(2 * noise.size)
    assert noise.std() == pytest.approx(sigma, rel=relative_error)
    correlation = np.corrcoef(noise)
    correlation[np.diag_indices(len(noise))] = 0
    assert np.abs(correlation).max() < FIVE_SIGMA / np.sqrt(10_000)
    lag = np.mean(noise[:, 1:] * noise[:, :-1]) / sigma**2
    assert abs(lag) < FIVE_SIGMA / np.sqrt(noise.size)  # white


def test_jitter_delays_every_record_on_its_own():
    rms, load = 5e-7, ResistorLoad(98.8e3)
    clean = one(load, **CLEAN)
    trials = tuple(Trial(f"x/{i}", load) for i in range(200))
    scene = Scene(trials[:100], trials[100:], trigger_jitter_rms=rms, **CLEAN)
    k = np.arange(1, 25)  # a 4 % pulse has no 25th harmonic

    def delay(v, exact):  # from the phase at the pulse harmonics; a pure delay has one slope
        phase = np.angle(np.fft.fft(v)[3 * k] / np.fft.fft(exact)[3 * k])
        slope = phase / (2 * np.pi * 60.0 * k)
        np.testing.assert_allclose(slope, slope[-1], rtol=0, atol=1e-4 * rms)
        return slope[-1]

    records = scene.simulate(1).values()
    delays = np.array([[delay(r.v_th, clean.v_th), delay(r.v_out, clean.v_out)] for r in records])
    assert delays.std() == pytest.approx(rms, rel=FIVE_SIGMA / np.sqrt(2 * delays.size))
    assert abs(delays.mean()) < FIVE_SIGMA * rms / np.sqrt(delays.size)
    assert abs(np.corrcoef(delays.T)[0, 1]) < FIVE_SIGMA / np.sqrt(len(delays))


def test_offset_is_constant_within_a_record_and_drawn_for_each():
    clean = one(OpenLoad(), samples=500, **CLEAN).v_th
    records = many(200, offset_rms=0.02, samples=500)
    shift = 0.0535 * np.array([v - clean for r in records for v in (r.v_th, r.v_out)])
    np.testing.assert_allclose(np.ptp(shift, axis=1), 0, atol=1e-12)
    offsets = shift.mean(1)
    assert offsets.std() == pytest.approx(0.02, rel=FIVE_SIGMA / np.sqrt(2 * offsets.size))


@pytest.mark.parametrize(("bits", "dtype"), [(8, np.int16), (16, np.int16), (24, np.int32)])
def test_codes_are_the_volts_rounded_to_one_step(bits, dtype):
    noisy: dict[str, Any] = {"snr_db": 50.0, "trigger_jitter_rms": 1e-7, "offset_rms": 0.01}
    volts = one(DRY, bits=None, **noisy)
    codes = one(DRY, bits=bits, **noisy)
    step = 20 / 2**bits / 0.0535
    for name in ("v_th", "v_out"):
        assert codes.samples[name].stored.dtype == dtype
        assert codes.samples[name].resolution == pytest.approx(step)
        error = codes.samples[name].values - volts.samples[name].values
        assert np.abs(error).max() <= step / 2 * (1 + 1e-9)  # half a step and rounding


@pytest.mark.parametrize("bits", [16, None])
def test_full_scale_clips_and_adc_range_says_where(bits):
    wide = one(OpenLoad(), snr_db=60.0, bits=None)
    clipped = one(OpenLoad(), snr_db=60.0, bits=bits, full_scale=0.5)
    assert clipped.adc_range is not None
    low, high = clipped.adc_range
    step = 1.0 / 2**bits / 0.0535 if bits else 0.0
    assert (low, high) == pytest.approx((-0.5 / 0.0535, 0.5 / 0.0535 - step))
    assert clipped.v_th.min() == pytest.approx(low)
    assert clipped.v_th.max() == pytest.approx(high)
    expected = np.clip(wide.v_th, low, high)
    np.testing.assert_allclose(clipped.v_th, expected, rtol=0, atol=step / 2 + 1e-9)


def test_a_seed_and_a_path_give_one_record_whatever_the_other_trials_are():
    scene = scenes.paper_damp(trigger_jitter_rms=1e-7, offset_rms=0.01)
    alone = dataclasses.replace(scene, trials=scene.trials[3:4], calibration=())
    path = scene.trials[3].path
    a, b, c = (of.simulate(seed)[path] for of, seed in ((scene, 3), (alone, 3), (scene, 4)))
    for name in ("v_th", "v_out"):
        first, again, other = (record.samples[name].stored for record in (a, b, c))
        np.testing.assert_array_equal(first, again)
        assert np.any(first != other)


@pytest.mark.parametrize("name", scenes.PRESETS)
def test_every_preset_simulates_and_tells_its_truth(name):
    scene = scenes.PRESETS[name](samples=100)
    study = scene.simulate(0)
    truth = scene.truth()
    assert list(study) == list(truth)
    calibrations = [path for path, r in study.items() if r.is_calibration]
    assert calibrations == ["calibration/98k8"]
    assert truth["calibration/98k8"] == {"r": 98.8e3} == {"r": study["calibration/98k8"].r_load}
    for path, recording in study.items():
        assert recording.calibration == (() if recording.is_calibration else tuple(calibrations))
        assert path.startswith("calibration/") == recording.is_calibration


def test_preset_elements_are_those_of_the_tables_and_in_the_published_ranges():
    truth = scenes.paper().truth()
    resistors = {path: e["r"] for path, e in truth.items() if path.startswith("resistors/")}
    sizes = {"21k62": 21.62e3, "55k2": 55.2e3, "216k6": 216.6e3, "328k9": 328.9e3, "555k": 555e3}
    assert resistors == {f"resistors/{name}": r for name, r in sizes.items()}
    built = [e for path, e in truth.items() if path.startswith("built/")]
    assert built == 23 * [{"r_s": 32.46e3, "r_p": 179.8e3, "c_p": 0.12e-9}]
    assert truth["typical/dry/01"] == {"r_s": 33.4e3, "r_p": 186e3, "c_p": 0.12e-9}
    assert truth["typical/damp/01"] == {"r_s": 6.1e3, "r_p": 17.4e3, "c_p": 0.66e-9}
    assert {"s01/dry/03", "s10/damp/05"} < truth.keys()
    for condition, ranges in {
        "dry": {"r_s": (19e3, 69.8e3), "r_p": (194e3, 616e3), "c_p": (45e-12, 165e-12)},
        "damp": {"r_s": (3.9e3, 19.8e3), "r_p": (20.2e3, 165e3), "c_p": (160e-12, 845e-12)},
    }.items():
        trials = [t for t in scenes.paper_subjects().trials if t.condition == condition]
        elements = {trial.subject: trial.load for trial in trials}
        assert (len(trials), len(set(elements.values()))) == (50, 10)
        assert all(trial.load == elements[trial.subject] for trial in trials)
        for name, (low, high) in ranges.items():
            assert all(low <= getattr(load, name) <= high for load in elements.values())


def test_what_cannot_be_simulated_is_refused():
    for make, message in (
        (lambda: Scene(2 * (Trial("a", DRY),)), "occur more than once"),
        (lambda: Scene((), (Trial("c", DRY),)), "needs a ResistorLoad"),
        (lambda: Scene(sample_rate=0.0), "sample_rate is 0"),
        (lambda: Scene(full_scale=np.inf), "full_scale is inf"),
        (lambda: Scene(antialias=80e3), "relative to sample_rate"),
        (lambda: Scene(trigger_jitter_rms=-1e-9), "must not be negative"),
        (lambda: Scene(samples=0), "at least one"),
        (lambda: Scene(bits=1), "2 to 32"),
        (lambda: Scene(snr_db=np.nan), "snr_db is nan"),
        (lambda: Scene(current_snr_db=np.nan), "current_snr_db is nan"),
        (lambda: Trial("", DRY), "cannot name a trial"),
        (lambda: Trial("/a", DRY), "cannot name a trial"),
        (lambda: Trial("a/", DRY), "cannot name a trial"),
        (lambda: one(lambda f: f[:1] + 0j), "load of 'x'"),
        (lambda: one(lambda f: np.nan * f), "load of 'x'"),
    ):
        with pytest.raises(ValueError, match=message):
            make()
