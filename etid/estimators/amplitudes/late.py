"""Score test whether a resistance follows its current late.

A resistor R / (1 + |i| / I_0) follows its current at once. Skin does not: Kaczmarek and Webster
(1989) saw its resistance fall within 46.7 µs, and recover within 52.8 and 642.6 µs. The test asks
how much of the residual a resistor R / (1 + m / I_0) explains to first order in m − |i|, where m is
|i| behind a low-pass filter of one time constant. Such a resistor scales with the amplitude, and a
missing relaxation of a linear circuit does not: it explains the residual of the one, and little of
that of the other. A late fall and a late recovery are not told apart.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float

from etid.circuits.current_dependent import Signals, current_dependent
from etid.estimators.amplitudes.terms import Amplitudes
from etid.signals.harmonics import Spectrum, real_parts
from etid.signals.transfer import as_complex, frequency_variable, reciprocal
from etid.solvers.harmonic_balance import steady_state, to_harmonics, to_time
from etid.solvers.matrices import inverse

# Of Σ r². It was 0.47 or more for resistances that follow late, and 0.16 or less for other misfits:
# layers, constant phases, clipping, low-passes, gains, other laws of the fall.
SHARE = 1 / 3


def follows_late(
    of: Amplitudes,
    q: Float[Array, " q"],
    slopes: Complex[Array, "record q harmonic"],
    terms: Float[Array, "record part"],
) -> Bool[Array, ""]:
    """Whether a resistance that follows its current late explains the residual.

    `slopes` and `terms` are those at the minimum `q`, times the weights.
    """
    if current_dependent(of.circuit.impedance()) is None:
        return jnp.array(False)
    added = jax.lax.map(lambda each: _added(of, *each), (of.own(q), of.spectra))
    late, rows = (
        jnp.moveaxis(real_parts(each), 1, 0).reshape(each.shape[1], -1)
        for each in (added * as_complex(of.weight)[:, None], slopes)
    )
    matrix = rows @ rows.T + jnp.diag(1 / of.widths(q) ** 2)
    late = late - late @ rows.T @ inverse(matrix) @ rows  # what the unknowns cannot do
    along = late @ terms.ravel()
    explained = jnp.where(along > 0, along**2 / jnp.sum(late**2, axis=1), 0.0)
    return jnp.max(explained) > SHARE * jnp.sum(terms**2)


def _added(
    of: Amplitudes, own: Float[Array, " own"], spectrum: Spectrum
) -> Complex[Array, "time harmonic"]:
    """What a late resistance adds to V_out [V], for each time constant."""
    at, size = of.port(own, spectrum)
    slope = at.element.typical_slope(2 * size)
    points = 2 * (at.source.current.size - 1)

    def predicted(
        change: Float[Array, " time"],
    ) -> tuple[Complex[Array, " harmonic"], Float[Array, " time"]]:
        element = eqx.tree_at(lambda e: e.r, at.element, at.element.r * (1 + change))
        voltage, current = steady_state(element.current, slope, *at.source)
        outside = at.outwards(Signals(voltage, current)).voltage[1 : spectrum.frequency.size + 1]
        return of.turned(own, outside, spectrum), to_time(current, points)

    _, along, current = jax.linearize(predicted, jnp.zeros(points), has_aux=True)
    level = jnp.abs(current) / jnp.asarray(at.element.i_0)
    s = frequency_variable(jnp.arange(points // 2 + 1.0))  # times the period

    def late(time: Float[Array, ""]) -> Complex[Array, " harmonic"]:
        delayed = to_time(to_harmonics(level) * reciprocal(1 + s * as_complex(time)), points)
        return along((level - delayed) / (1 + level))

    # Of a period: 42 µs to 5.6 ms at 60 Hz, each 2.3 times the one before.
    return jax.lax.map(late, jnp.asarray(np.geomspace(1 / 400, 1 / 3, 7)))
