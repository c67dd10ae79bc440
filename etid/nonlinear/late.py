"""Score test whether a resistance follows its current late.

A resistor R / (1 + |i| / I_0) follows its current at once. Skin does not: Kaczmarek and Webster
(1989) saw its resistance fall within 46.7 µs, and recover within 52.8 and 642.6 µs. The test asks
how much of the residual a resistor R / (1 + m / I_0) explains to first order in m − |i|, where m is
|i| behind a low-pass filter of one time constant. Such a resistor scales with the amplitude, and a
missing relaxation of a linear circuit does not: it explains the residual of the one, and little of
that of the other. A late fall and a late recovery are not told apart.
"""

import numpy as np
from jaxtyping import Complex, Float

from etid.likelihood.linear import inverse
from etid.nonlinear.amplitudes import Amplitudes
from etid.nonlinear.balance import to_harmonics, to_time
from etid.nonlinear.response import Balanced
from etid.signals.harmonics import real_parts
from etid.signals.transfer import frequency_variable, reciprocal

# Of Σ r². It was 0.47 or more for resistances that follow late, and 0.16 or less for other misfits:
# layers, constant phases, clipping, low-passes, gains, other laws of the fall.
SHARE = 1 / 3
# Time constants, parts of a period: 42 µs to 5.6 ms at 60 Hz, each 2.3 times the one before.
TIMES = np.geomspace(1 / 400, 1 / 3, 7)


def follows_late(
    of: Amplitudes,
    q: Float[np.ndarray, " q"],
    slopes: Complex[np.ndarray, "own record harmonic"],
    terms: Complex[np.ndarray, "record harmonic"],
) -> bool:
    """Whether a resistance that follows its current late explains the residual.

    `slopes` and `terms` are those at the minimum `q`, times the weights.
    """
    response = of.at(q)
    if not isinstance(response, Balanced):
        return False
    late, rows = (real_parts(each).reshape(len(each), -1)
                  for each in (of.weight * _added(response), of.by_q(slopes)))  # fmt: skip
    matrix = rows @ rows.T + np.diag(1 / of.width**2)
    late = late - late @ rows.T @ inverse(matrix) @ rows  # what the unknowns cannot do
    along = late @ real_parts(terms).ravel()
    explained = np.where(along > 0, along**2 / (late**2).sum(1), 0.0)
    return bool(explained.max() > SHARE * (real_parts(terms) ** 2).sum())


def _added(response: Balanced) -> Complex[np.ndarray, "time record harmonic"]:
    """What a late resistance adds to V_out [V], for each time constant."""
    at = response.balance
    level = np.abs(at.current) / at.element.i_0
    s = frequency_variable(np.arange(float(at.mirror.shape[-1])))  # times the period
    behind = reciprocal(1 + s * TIMES[:, None])[:, None]
    delayed = to_time(to_harmonics(level) * behind, level.shape[-1])
    rise = (level - delayed) / (1 + level)  # of the resistance, relative
    voltage = at.wave - at.resistance * at.current
    current = -rise * voltage * at.flow  # at the same wave
    return response.moved(-2 * at.resistance * at.reflected(current), current)
