"""Commands that a converter holds between samples, against exact discretisations of SciPy."""

from typing import Any

import numpy as np
import pytest
from scipy.signal import cont2discrete, lfilter

import etid
from etid.signals.hold import NODES, added, images, of_hold

RATE, BEFORE = 200e3, 4000  # samples before a record, in which its state is reached
SKIN = np.array([33e3, 186e3, 0.12e-9])
SERIES, PARALLEL, CAPACITANCE = SKIN
SNR = 1e-3  # noise of V_out, relative to its standard deviation or to that of the command
KNOWN = 98.8e3


def polynomials():
    """Numerator and denominator of the skin, and of a source with two resonances and a pole."""
    skin = np.poly1d([SERIES * PARALLEL * CAPACITANCE, SERIES + PARALLEL])
    turn = 2 * np.pi * np.array([30e3, 60e3])
    num, den = np.poly1d([5e3]), np.poly1d([1.0])
    parts = [([6e3 * 5e4], [1, 5e4])]
    parts += [
        ([gain * 2 * damping * of, 0], [1, 2 * damping * of, of**2])
        for of, damping, gain in zip(turn, (0.6, 0.4), (8e3, 12e3), strict=True)
    ]
    for top, bottom in parts:
        num, den = num * np.poly1d(bottom) + np.poly1d(top) * den, den * np.poly1d(bottom)
    return (skin, np.poly1d([PARALLEL * CAPACITANCE, 1.0])), (num, den)


def of_load(load):
    """V_out per V_th with a load behind the source."""
    (num, den), source = load, polynomials()[1]
    return (num * source[1]).c, (num * source[1] + source[0] * den).c


def discrete(system):
    found: Any = cont2discrete(system, 1 / RATE, "zoh")
    return found[0][0], found[1]


def command(kind, size, rng):
    """A command of size 1 [its unit]: pulses of 60 Hz, one step, or a random sequence at rest."""
    time = np.arange(size + BEFORE)
    if kind == "pulses":
        phase = (time - BEFORE - 200) % (RATE / 60)
        return 1.0 * (phase < 40) - ((phase >= 40) & (phase < 80))
    if kind == "step":
        return 1.0 * (time > BEFORE + 300)
    of_bits = np.repeat(rng.choice([-1.0, 1.0], size), 7)[: size // 2]
    return np.concatenate([np.zeros(BEFORE + 300), of_bits, np.zeros(size)])[: time.size]


def recorded(kind, size, seed, system, **of):
    rng = np.random.default_rng(seed)
    unit = 1e-3 if of.pop("current", False) else 50.0
    cause = unit * command(kind, size, rng)
    v_out = np.asarray(lfilter(*discrete(system), cause))[BEFORE:]
    noisy = v_out + SNR * v_out.std() * rng.standard_normal(size)
    of |= {"current" if unit < 1 else "v_th": cause[BEFORE:], "v_out": noisy}
    return etid.Recording(sample_rate=RATE, pulse_rate=60.0, hold="zero", **of)


def off(fit):
    return (fit.circuit.values() - SKIN) / np.array(fit.stderr.values())


@pytest.mark.parametrize("resonates", [False, True])
def test_images_make_a_discretisation_of_a_response(resonates):
    """`etid.signals.hold` states the accuracy; a hold alone would be wrong by half and more."""
    skin = polynomials()[0]
    num, den = of_load(skin) if resonates else (skin[0].c, skin[1].c)
    place = np.geomspace(1e-4, 0.45, 50)
    b, a = (np.polyval(of[::-1], np.exp(-2j * np.pi * place)) for of in discrete((num, den)))
    expected = b / a
    smooth, beyond = (np.polyval(num, s) / np.polyval(den, s) for s in (
        2j * np.pi * RATE * place, 2j * np.pi * RATE * NODES))  # fmt: skip
    found = (smooth + added(beyond, images(place))) * of_hold(place)
    np.testing.assert_allclose(found, expected, rtol=3e-5)
    assert np.abs(smooth * of_hold(place) / expected - 1).max() > 0.5


@pytest.mark.parametrize(
    ("kind", "size"),
    [
        pytest.param("pulses", 10_000, marks=pytest.mark.slow),
        ("pulses", 3334),
        ("pulses", 2345),
        ("step", 2345),
        pytest.param("bits", 3000, marks=pytest.mark.slow),
    ],
)
def test_a_held_current_shows_the_load(kind, size):
    """Whole periods and not; the command has no noise.

    The three errors of a fit are nearly one. 12 independent squares have a root of the mean of
    1 ± 0.2; the limits are three of these.
    """
    numerator, denominator = polynomials()[0]
    errors = []
    for seed in range(12):
        one = recorded(kind, size, seed, (numerator.c, denominator.c), current=True)
        fit = etid.identify_skin(one)
        assert (np.array(fit.stderr.values()) < 0.01 * SKIN).all()
        errors.append(off(fit))
    assert 0.4 < np.sqrt(np.mean(np.square(errors))) < 1.6


@pytest.mark.slow
def test_a_held_voltage_shows_the_driver_and_the_load():
    """The record ends in the middle of a period."""
    resistor = np.poly1d([KNOWN]), np.poly1d([1.0])
    calibration = recorded("pulses", 2345, 0, of_load(resistor), r_load=KNOWN)
    driver = etid.identify_driver(calibration)
    fit = etid.identify_skin(recorded("pulses", 2345, 1, of_load(polynomials()[0])), driver)
    assert np.abs(off(fit)).max() < 4
    assert (np.array(fit.stderr.values()) < 0.02 * SKIN).all()


def test_a_prediction_holds_the_command():
    numerator, denominator = polynomials()[0]
    one = recorded("pulses", 3334, 0, (numerator.c, denominator.c), current=True)
    left = etid.predict(one, None, etid.SkinRC(*SKIN)) - one.v_out
    assert np.nanstd(left) == pytest.approx(SNR * one.v_out.std(), rel=0.05)
    held = etid.predict(one.replace(hold=None), None, etid.SkinRC(*SKIN)) - one.v_out
    assert np.nanstd(held) > 10 * np.nanstd(left)


def test_what_takes_no_held_command_says_so(tmp_path):
    numerator, denominator = polynomials()[0]
    one = recorded("pulses", 3334, 0, (numerator.c, denominator.c), current=True)
    with pytest.raises(ValueError, match="takes no command that a converter holds"):
        etid.identify_skin(one, method="output_error")
    with pytest.raises(ValueError, match="identify each recording alone"):
        etid.identify_amplitudes([one, one.replace(v_out=2 * one.v_out)], circuit="R0-p(R1,C1)")
    with pytest.raises(etid.RecordingError, match="'first', must be 'zero'"):
        one.replace(hold="first")
    with pytest.raises(etid.RecordingError, match="no filter may follow"):
        one.replace(v_out_filter="butterworth 1 80000")
    etid.Study.from_recordings([one.replace(path="a")]).write(tmp_path / "study.h5")
    with etid.read(tmp_path / "study.h5") as study:
        assert study["a"].hold == "zero"
