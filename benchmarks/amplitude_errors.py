"""Errors of several amplitudes: how often their intervals are right, against the smallest errors.

The skin is that of Kaczmarek and Webster (1989) under a current source, eight times slower, so that
a record has few harmonics and a fit takes a second. Current and voltage have white noise. SciPy
solves the differential equation of the skin. The smallest errors (Cramér and Rao) come from the
same equation, without etid. The targets of each scene are those of `benchmarks.coverage`.
"""

import argparse
from collections.abc import Sequence

import numpy as np
from scipy.integrate import solve_ivp

import etid
from benchmarks import amplitudes
from benchmarks.amplitudes import PULSE_RATE
from benchmarks.coverage import HEADS, Draws, draw, lines, targets
from benchmarks.runner import Target, option, report

SLOWER = 8
SAMPLE_RATE, SAMPLES = 20e3, 1000  # Hz; three periods
PERIOD = 1 / PULSE_RATE / SLOWER  # s, of the skin as it is
R_S, R_P, C_P, I_0 = 895.0, 60.1e3, 1e-9, 0.585e-3
TRUTH = np.array([R_S, R_P, SLOWER * C_P, I_0])
SCENES = (
    ((0.5e-3, 1e-3, 2e-3, 5e-3), 60.0),
    ((1e-3, 3e-3, 5e-3), 60.0),
    ((0.1e-3, 0.3e-3, 1e-3, 2.5e-3, 5e-3), 60.0),
    ((0.5e-3, 1e-3, 2e-3, 5e-3), 40.0),
)
HARMONICS = int(SAMPLE_RATE / 2 / PULSE_RATE)
POINTS = 2**13  # of the bound, per period: 0.25 µs, and the skin takes 0.7 µs at 5 mA


def pulses(t: np.ndarray) -> np.ndarray:
    """A charge-balanced pulse of height 1 per period, without the factor `SLOWER`."""
    return amplitudes.pulses(t % PERIOD) / amplitudes.HEIGHT


def voltage(amplitude: float, t: np.ndarray, elements: np.ndarray) -> np.ndarray:
    """Voltage [V] of the skin with these r_s, r_p, c_p and i_0."""
    r_s, r_p, c_p, i_0 = elements.tolist()

    def slope(t: float, u: np.ndarray) -> np.ndarray:
        return (amplitude * pulses(np.asarray(t)) - u / (r_p * (1 - np.abs(u) / (r_p * i_0)))) / c_p

    # It is at rest long before the end of a period.
    found = solve_ivp(
        slope, (0, PERIOD), [0.0], method="LSODA", rtol=1e-11, atol=1e-11, max_step=4e-6,
        dense_output=True,
    )  # fmt: skip
    return found.sol(t % PERIOD)[0] + r_s * amplitude * pulses(t)


def draws(heights: Sequence[float], snr_db: float, count: int) -> Draws:
    """Fits of `count` records, each with noise of its own."""
    t, level = np.arange(SAMPLES) / SAMPLE_RATE, 10 ** (-snr_db / 20)
    elements = np.array([R_S, R_P, C_P, I_0])
    clean = [(voltage(one, t / SLOWER, elements), one * pulses(t / SLOWER)) for one in heights]
    rows = []
    for seed in range(count):
        rng = np.random.default_rng([seed, round(snr_db), len(heights)])
        of = []
        for pair in clean:
            v_out, current = (
                etid.Samples(v + level * np.sqrt(np.mean(v**2)) * rng.standard_normal(v.size))
                for v in pair
            )
            one = etid.Recording(
                v_out=v_out, current=current, sample_rate=SAMPLE_RATE, pulse_rate=PULSE_RATE
            )
            of.append(one)
        fit = etid.identify_amplitudes(of, throw=False)
        rows.append(draw(fit, TRUTH.tolist()))
    return Draws.of(rows)


def smallest_errors(heights: Sequence[float], snr_db: float) -> np.ndarray:
    """Cramer-Rao bound of the relative standard error of each element; the delays are unknown.

    The residual of a record has the covariance C = σ_v² I + A A' σ_i² (of harmonics, halved for
    their parts), where A are the derivatives of the voltage by the current. The information is the
    sum of J' C⁻¹ J over the records.
    """
    t = np.arange(POINTS) / POINTS * PERIOD
    elements, step = np.array([R_S, R_P, C_P, I_0]), 1e-4
    information = np.zeros((4 + len(heights),) * 2)
    for number, one in enumerate(heights):
        v, i = voltage(one, t, elements), one * pulses(t)
        by_element = [
            (voltage(one, t, elements * np.exp(d)) - voltage(one, t, elements * np.exp(-d)))
            / (2 * step)
            for d in step * np.eye(4)
        ]
        u = v - R_S * i
        slopes = 1 / (R_P * (1 - np.abs(u) / (R_P * I_0)) ** 2)  # of the current by u [S]
        rows = np.zeros((4 + len(heights), 2 * HARMONICS))
        rows[:4] = _parts(np.array(by_element).T).T
        rows[4 + number] = _parts(np.gradient(v, t)[:, None])[:, 0] * PERIOD
        turns = 2 * np.pi * np.outer(t / PERIOD, np.arange(1, HARMONICS + 1))
        by_current = _parts(_response(slopes, np.hstack([2 * np.cos(turns), -2 * np.sin(turns)])))
        of_v, of_i = (10 ** (-snr_db / 10) * np.mean(w**2) / (2 * SAMPLES) for w in (v, i))
        cov = of_v * np.eye(2 * HARMONICS) + of_i * by_current @ by_current.T
        information += rows @ np.linalg.solve(cov, rows.T)
    return np.sqrt(np.diag(np.linalg.inv(information)))[:4]


def _response(slopes: np.ndarray, currents: np.ndarray) -> np.ndarray:
    """Small change of the voltage by small changes of the current, in the steady state."""
    rate = C_P * POINTS / PERIOD
    kept = (rate - slopes / 2) / (rate + np.roll(slopes, -1) / 2)
    driven = (currents + np.roll(currents, -1, axis=0)) / 2
    driven = driven / (rate + np.roll(slopes, -1) / 2)[:, None]
    u, found = np.zeros(currents.shape[1]), np.empty_like(currents)
    for _ in range(2):  # the first period forgets where it began
        for k in range(POINTS):
            found[k] = u
            u = kept[k] * u + driven[k]
    return found + R_S * currents


def _parts(signals: np.ndarray) -> np.ndarray:
    """Real and imaginary parts of the harmonics of each column."""
    of = np.fft.rfft(signals, axis=0, norm="forward")[1 : HARMONICS + 1]
    return np.concatenate([of.real, of.imag])


PINNED = True
OPTIONS = (option("--draws", default=200, help="of each scene"),)


def main(arguments: argparse.Namespace) -> bool:
    asked, names = list[Target](), etid.SkinCurrent.names()
    print(HEADS)
    for number, (heights, snr_db) in enumerate(SCENES):
        print(f"scene {number}: {', '.join(f'{1e3 * of:g}' for of in heights)} mA, {snr_db:g} dB")
        found = draws(heights, snr_db, arguments.draws)
        least = dict(zip(names, smallest_errors(heights, snr_db).tolist(), strict=True))
        print("\n".join(lines(f"scene {number}", found, least)), flush=True)
        asked += targets(f"scene {number}", found)
    return report(asked)
