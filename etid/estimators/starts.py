"""Starts of Z_th: generic resonances, and that of a simpler estimate."""

import numpy as np
from jaxtyping import Float

from etid.precision import array_function, namespace
from etid.results.driver import SourceImpedance
from etid.signals.transfer import AnyArray, poles

# Starts of Z_th: frequency, relative to the sample rate, and damping ratio of two sections.
# `FAR` is that of all further sections.
GENERIC = (((0.1, 0.3), (0.5, 1.5)), ((0.25, 0.3), (0.5, 1.5)), ((0.1, 0.3), (0.25, 0.3)))
FAR = (0.5, 1.5)


@array_function
def source_starts(
    baseline: Float[AnyArray, " a"],
    order: int,
    sample_rate: Float[AnyArray, ""],
    r_load: Float[AnyArray, ""],
) -> SourceImpedance:
    """Starts of Z_th, stacked: three generic ones, and one with the resonance of the baseline.

    Each start has one slow real pole, and sections with given frequencies and damping ratios. All
    gains have the size of a tenth of the known resistor. The baseline is the denominator of a
    discrete Z_th.
    """
    xp, sections = namespace(baseline, sample_rate, r_load), (order - 1) // 2
    reals = order - 2 * sections
    # Further sections start overdamped at the edge of the sampled band.
    pairs = dict.fromkeys((*of, *[FAR] * sections)[:sections] for of in GENERIC)
    places = np.reshape([*pairs], (len(pairs), sections, 2))
    if sections:
        s = xp.log(poles(baseline))  # s / fs of the discrete poles
        # Resonances are poles well inside the band. The least damped one is used.
        resonant = (s.imag > 0.05) & (s.imag < 0.9 * np.pi) & (s.real < 0)
        damping = xp.where(resonant, -s.real / xp.abs(s), np.inf)
        found = xp.argmin(damping)
        usable = xp.isfinite(damping[found])
        omega = xp.where(usable, xp.abs(s[found]) / (2 * np.pi), 0.1)
        zeta = xp.where(usable, damping[found], 0.3)
        own = xp.concatenate([xp.stack([omega, zeta])[None], np.tile(FAR, (sections - 1, 1))])
        places = xp.concatenate([places, own[None]])
    turn, small = 2 * np.pi * sample_rate, 0.1 * r_load
    slow = np.array([3e-4] + [0.5] * (reals - 1))
    count = len(places)
    each = xp.zeros((count, sections)) + small
    return SourceImpedance(
        log_resistance=xp.zeros(count) + xp.log(0.05 * small),
        log_omega=xp.log(places[..., 0] * turn),
        log_zeta=xp.log(xp.asarray(places[..., 1])),
        gain=each,
        slope=each,
        log_omega_real=xp.zeros((count, reals)) + xp.log(slow * turn),
        gain_real=xp.zeros((count, reals)) - 0.5 * small,
    )
