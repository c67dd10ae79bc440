"""Whether the residual of a linear load looks like a resistance that falls with its current.

To first order in 1/I_0, a resistor R / (1 + |i|/I_0) adds the voltage −|u| u / (R I_0) to its own
voltage u. The rest of the circuit filters it like the voltage of the relaxations. If a score test
finds this signal in a misfit, and it explains half of the excess of χ², the fit says so.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex

from etid.circuits.circuit import AbstractCircuit
from etid.estimators.lanes import AbstractLane, Harmonics
from etid.results.feed import AbstractFeed
from etid.signals.harmonics import real_parts
from etid.signals.pulse_train import rest

SEEN = 5.0  # standard deviations
SHARE = 0.5  # of the excess of χ²
STEP = 1e-4  # of a logarithm, for derivatives by differences; their error is 1e-8


def falls_with_current(lane: AbstractLane, feed: AbstractFeed, circuit: AbstractCircuit) -> bool:
    """Whether the resistance of a load seems to fall with its current.

    Args:
        lane: The recording.
        feed: Its feed.
        circuit: The fitted linear load.
    """
    if not isinstance(lane, Harmonics):
        return False
    f, x, y = np.asarray(lane.frequency), np.asarray(lane.x), np.asarray(lane.y)
    at = jnp.asarray(f)

    def gain(circuit: AbstractCircuit) -> Complex[np.ndarray, " harmonic"]:
        return np.asarray(feed.gain(circuit.response(at), at))

    logs, g, z = circuit.log_values(), gain(circuit), circuit.response(at)
    variance = lane.variance_y + np.abs(g) ** 2 * lane.variance_x
    turn = 2 * np.pi * f / np.asarray(lane.sample_rate)
    late = rest(g * x, y, np.asarray(lane.selected / variance), turn)
    weight = np.where(lane.selected, np.sqrt(2 / variance), 0.0) * np.exp(-1j * turn * late)
    v = g * x
    r = weight * (y * np.exp(1j * turn * late) - v)
    nuisances = [turn * 1j * v]
    for step in np.eye(logs.size) * STEP:
        ends = (gain(circuit.with_log_values(logs + by)) for by in (step, -step))
        nuisances.append(x * np.subtract(*ends))
    z, sensitivity = np.asarray(z), np.asarray(feed.sensitivity(z, at))
    u = v * (1 - z[-1].real / z)  # without the voltage of a series resistor
    points = np.fft.irfft(np.append(0.0, u), norm="forward")
    added = np.fft.rfft(-np.abs(points) * points, norm="forward")[1 : u.size + 1]
    shape = sensitivity * (z - z[-1].real) * added
    columns = np.stack([real_parts(weight * of) for of in nuisances], axis=1)
    sizes = np.linalg.norm(columns, axis=0)  # 0 for an element without any effect
    basis = np.linalg.qr(columns[:, sizes > 0] / sizes[sizes > 0])[0]
    row = real_parts(weight * shape)
    row = row - basis @ (basis.T @ row)
    residual = real_parts(r)
    size = np.linalg.norm(row)  # 0 for a resistor in series only
    score = row @ residual / size if size > 0 else 0.0
    excess = residual @ residual - 2 * np.sum(lane.selected)
    return bool(score > SEEN and score**2 > SHARE * excess)
