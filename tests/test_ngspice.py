"""Recordings by ngspice: the netlist by nodal analysis of its text, the rest also without it."""

import dataclasses
import shutil

import numpy as np
import pytest

import etid
from benchmarks import ladder, ngspice
from etid.simulation.scenes import Scene, Trial
from etid.simulation.transformer import OpenLoad, ResistorLoad, SkinLoad, TransformerDriver, loading

DRY = SkinLoad(33.4e3, 186e3, 0.12e-9)
RATE = 60.0
# Relative to the peak, measured on circuits with elements spread by 30 %: at most 7e-6.
DEVIATION = 1e-5
SIGMAS = 5.0  # one in 2e6; with fixed seeds a test passes always or never
ELEMENTS = 2e-4  # by which ngspice may move an element, noise and delays being the same

needs_ngspice = pytest.mark.skipif(
    shutil.which("ngspice") is None, reason="ngspice is not installed; Debian package ngspice"
)


@pytest.fixture(autouse=True)
def _empty_cache(tmp_path, monkeypatch):
    monkeypatch.setattr(ngspice, "CACHE", tmp_path / "cache")
    known = ngspice.harmonics, ngspice._version
    for cached in known:
        cached.cache_clear()
    yield
    for cached in known:
        cached.cache_clear()


# --- the netlist ----------------------------------------------------------------------------------


def lines_of(text):
    """Lines of a netlist that are parts: name, and what follows it."""
    body = [line.split() for line in text.splitlines()[1:]]
    return {words[0]: words[1:] for words in body if words and words[0][0] not in "*."}


def response(text, f):
    """Voltage at o per volt of the source, by modified nodal analysis of the text alone."""
    parts = lines_of(text)
    branches = [name for name in parts if name[0] in "VEF"]
    names = {word for name, words in parts.items() for word in words[:2]} - {"0"}
    index = {name: i for i, name in enumerate([*sorted(names), *branches])}
    matrix, drive = np.zeros((len(index), len(index)), complex), np.zeros(len(index))

    def add(row, column, value):
        if row != "0" and column != "0":
            matrix[index[row], index[column]] += value

    s = 2j * np.pi * f
    for name, (plus, minus, *rest) in parts.items():
        if name[0] in "RLC":
            value = float(rest[0])
            y = {"R": 1 / value, "C": s * value, "L": 1 / (s * value)}[name[0]]
            for node, other in ((plus, minus), (minus, plus)):
                add(node, node, y)
                add(node, other, -y)
            continue
        add(plus, name, 1.0)
        add(minus, name, -1.0)
        if name[0] == "F":  # current of the branch = gain times that of another
            add(name, name, 1.0)
            add(name, rest[0], -float(rest[1]))
            continue
        add(name, plus, 1.0)
        add(name, minus, -1.0)
        if name[0] == "E":
            add(name, rest[0], -float(rest[2]))
            add(name, rest[1], float(rest[2]))
        else:
            drive[index[name]] = name == "Vp"  # the other one is a probe of current
    return np.linalg.solve(matrix, drive)[index["o"]]


@pytest.mark.parametrize("load", [OpenLoad(), ResistorLoad(98.8e3), DRY])
def test_netlist_is_the_circuit_of_the_driver(load):
    driver = dataclasses.replace(TransformerDriver(), c_winding=9e-12, turns=11.0)
    text = ngspice.netlist(driver, load, RATE)
    for frequency in (20.0, 60.0, 3e3, 60e3, 500e3):
        f = np.array([frequency])
        pulse = driver.width * np.sinc(f * driver.width) * np.sinc(f * driver.edge)
        centre = driver.lead_in + (driver.width + driver.edge) / 2
        source = driver.amplitude * pulse * np.exp(-2j * np.pi * f * centre)
        expected = driver.v_th_spectrum(f) / source * loading(load(f), driver.z_th(f))
        # two ways to solve one network of a condition of 1e6
        np.testing.assert_allclose(response(text, frequency), expected[0], rtol=1e-9)


# --- what is done with its answer, without it -----------------------------------------------------


def raw_file(time, v):
    points = np.stack([time, v], axis=1)
    head = f"Title: x\nNo. Variables: 2\nNo. Points: {len(points)}\nVariables:\n\t0 time time\n"
    return head.encode() + b"\t1 v(o) voltage\nBinary:\n" + points.tobytes()


@pytest.mark.parametrize("growth", [0.0, 1e-3])
def test_harmonics_of_uneven_steps_are_those_of_the_waveform(monkeypatch, growth):
    c = {1: 0.5 - 0.2j, 3: 0.1j, 7: -0.05}
    steps = np.random.default_rng(0).uniform(0.5, 1.5, 20_000)
    time = 0.1 + (2 / RATE + 4e-6) * np.cumsum(steps) / steps.sum()
    v = sum(2 * np.real(a * np.exp(2j * np.pi * k * RATE * (time - time[-1])))
            for k, a in c.items())  # fmt: skip
    monkeypatch.setattr(ngspice, "solve", lambda netlist: (time, v * (1 + growth * time / 0.1)))
    if growth:
        with pytest.raises(ngspice.NgspiceError, match="last two periods differ by"):
            ngspice.harmonics("any", RATE, 10)
        return
    found = ngspice.harmonics("any", RATE, 10)
    expected = np.array([c.get(k, 0.0) for k in range(1, 11)])
    # spline through steps of 2 us: the seventh harmonic turns by 0.005 a step, to the fourth power
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_ngspice_runs_once_per_circuit_and_load(monkeypatch):
    runs = []

    def fake(*arguments):
        if "--version" in arguments:
            return "** ngspice-99 : simulator"
        runs.append(arguments)
        raw = arguments[arguments.index("-r") + 1]
        with open(raw, "wb") as file:
            file.write(raw_file(np.arange(3.0), np.arange(3.0)))
        return ""

    monkeypatch.setattr(ngspice, "_ngspice", fake)
    for text in ("one", "one", "other", "one"):
        np.testing.assert_array_equal(ngspice.solve(text)[1], np.arange(3.0))
    assert len(runs) == 2


# --- with it --------------------------------------------------------------------------------------


@needs_ngspice
@pytest.mark.slow
@pytest.mark.parametrize("sample_rate", [200e3, 1e6])
def test_records_of_ngspice_are_those_of_the_scene(sample_rate):
    scene = Scene(
        (Trial("skin", DRY), Trial("open", OpenLoad())),
        (Trial("calibration", ResistorLoad(21.62e3)),),
        sample_rate=sample_rate,
        snr_db=None,
        bits=None,
        trigger_jitter_rms=1e-6,
    )
    ours, exact = ngspice.record(scene, 3), scene.simulate(3)
    for path in exact:
        for name in ("v_th", "v_out"):
            found, expected = getattr(ours[path], name), getattr(exact[path], name)
            assert np.abs(found - expected).max() < DEVIATION * np.abs(expected).max()


@needs_ngspice
@pytest.mark.slow
@pytest.mark.parametrize("load", ladder.LOADS)
def test_skin_is_identified_from_ngspice_as_from_the_scene(load):
    scene = ladder.rung(load, bits=None)
    found = []
    for study in (ngspice.record(scene, 0), scene.simulate(0)):
        driver = etid.identify_driver(study[ladder.CALIBRATION])
        found.append(etid.identify_skin(study[ladder.TRIAL], driver))
    ours, exact = (np.asarray(fit.circuit.values()) for fit in found)
    truth = np.array(list(scene.truth()[ladder.TRIAL].values()))
    assert np.all(np.abs(ours - truth) < SIGMAS * np.asarray(found[0].stderr.values()))
    np.testing.assert_allclose(ours, exact, rtol=ELEMENTS)
