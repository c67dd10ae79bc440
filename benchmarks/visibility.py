"""By how many standard deviations the best test could see a change of the records.

The records are those of `etid.simulation.bound`: X_k and Z_th(f_k) are unknown at every harmonic,
and so are the elements and the delays. The best test knows that the unloaded voltages of both
records are one pulse, with an amplitude and a delay of each. A change adds ε ∂Y_k to the loaded
voltages, ε = 1 for the change itself. What of it those unknowns cannot imitate, over the noise, is
the largest number of standard deviations by which any test without a bias can see it. By the lemma
of Neyman and Pearson (1933), the test that refuses beyond `LIMIT` of them is the most powerful one
with its rate of false alarms. `missed` is the probability that it does not refuse. The fits of etid
do not use that the pulses are one: it would double their time for bounds that are 10 to 17 %
smaller.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.stats
from jaxtyping import Complex, Float

from benchmarks.ladder import rung
from etid.circuits.circuit import SkinRC
from etid.circuits.directions import DIRECTIONS, At
from etid.simulation.published import REFERENCE
from etid.simulation.transformer import ResistorLoad, SkinLoad

BAND = 0.4  # of the sample rate
LIMIT = 3.0  # standard deviations; a test with this limit refuses one good recording of 370
RARE = 3.89  # one of 10 000, as a study can bear of a test that is asked of every recording

Gain = Complex[np.ndarray, " f"]


class Change(NamedTuple):
    """A change of the gains of V_out."""

    of: Callable[[At], Gain]
    calibration: bool  # whether the resistor's gain changes as well

    def __call__(self, skin: At, resistor: At) -> tuple[Gain, Gain]:
        """Changes with the skin and with the resistor."""
        return self.of(skin), self.calibration * self.of(resistor)


def fault(name: str, size: float, calibration: bool = False) -> Change:
    """A fault of `DIRECTIONS`."""
    return Change(lambda at: size * DIRECTIONS[name].change(at)[0, 0], calibration)


def lowpass(corner: float) -> Change:
    """A filter of first order before V_out [Hz], with the skin only."""
    return Change(lambda at: -at.gains[0] * np.log(1 + 1j * at.frequency / corner), False)


def information(
    load: SkinLoad, snr_db: float, band: float, *changes: Change, one_pulse: bool = False
) -> Float[np.ndarray, "q q"]:
    """Fisher information of the elements' logarithms, both delays [µs], and the sizes of changes.

    `band` is the highest frequency, relative to the sample rate. With `one_pulse`, the amplitude of
    the second pulse and its delay [µs] come before the changes.
    """
    scene = rung("dry", snr_db=snr_db)
    wave = scene.waveform()
    inside = wave.f < band * scene.sample_rate
    f, z_th = wave.f[inside], wave.z_th[inside]
    x = wave.v_th[inside] * math.sqrt(scene.samples) / wave.sigma
    circuit, at = SkinRC(load.r_s, load.r_p, load.c_p), jnp.asarray(f)
    logs = circuit.log_values()
    slope = np.asarray(jax.jacfwd(lambda logs: circuit.with_log_values(logs).response(at))(logs))
    both = [At.behind(f, z_th, of) for of in (load, ResistorLoad(REFERENCE))]
    loads, gains = [of.z for of in both], [of.gains[0] for of in both]
    changed = [change(*both) for change in changes]
    # Rows: V_out with the skin and the resistor, then both V_th. Columns of b: Z_th, and each X.
    known = 7 if one_pulse else 5
    a = np.zeros((f.size, 4, known + len(changes)), complex)
    b = np.zeros((f.size, 4, 2 if one_pulse else 3), complex)
    late = -2e-6j * np.pi * f
    for i in range(2):
        each = 1 if one_pulse else 1 + i
        b[:, i, each], b[:, 2 + i, each] = gains[i], 1
        b[:, i, 0] = -gains[i] * x / (loads[i] + z_th)
        a[:, i, 3 + i] = late * gains[i] * x
        for column, pair in enumerate(changed):
            a[:, i, known + column] = pair[i] * x
    for row, gain_of in ((1, gains[1]), (3, np.ones(f.size))) if one_pulse else ():
        a[:, row, 5], a[:, row, 6] = gain_of * x, late * gain_of * x
    a[:, 0, :3] = (x * z_th / (loads[0] + z_th) ** 2)[:, None] * slope
    q, _ = np.linalg.qr(b)
    rest = (a - q @ (np.conj(np.swapaxes(q, 1, 2)) @ a)).reshape(-1, a.shape[-1])
    return 2 * np.real(np.conj(rest.T) @ rest)


def found(
    load: SkinLoad, snr_db: float, change: Change | None, times: float, delay: float = 0.0
) -> float:
    """Probability that the best test finds a fault of so many tolerances behind a skin.

    `change` is that of one tolerance. Without one the record of the skin is late, and `delay` is
    the tolerance of its delay and of that of the calibration [s]. Faults within the tolerance,
    N(0, 1) in its units, are no finding: an estimate with the standard deviation s is N(0, 1 + s²)
    then, and exceeds `RARE` of its own standard deviations in one recording of 10 000.
    """
    of = information(load, snr_db, BAND, *([change] if change else []), one_pulse=True)
    if change:
        variance = np.linalg.inv(of)[-1, -1]
    else:
        tolerance = 1e6 * delay  # [µs]
        of[4, 4] += tolerance**-2
        variance = np.linalg.inv(of)[3, 3] / tolerance**2
    noise = scipy.stats.norm(times, np.sqrt(variance))
    limit = RARE * np.sqrt(1 + variance)
    return float(noise.sf(limit) + noise.cdf(-limit))


def missed(load: SkinLoad, snr_db: float, change: Change) -> float:
    """Probability that the best test misses a change behind a skin."""
    of = information(load, snr_db, BAND, change, one_pulse=True)
    at = 1 / np.sqrt(np.linalg.inv(of)[-1, -1])
    return float(scipy.stats.norm.cdf(LIMIT - at) - scipy.stats.norm.cdf(-LIMIT - at))
