"""Averages over the periods of a record that are free of aliases.

A sampled edge holds frequencies beyond half the sample rate fs. In period p, which begins a
fraction pδ of a sample later than a whole number of samples, the alias of fs − f is turned by
e^(j 2π p δ) against the signal at f. If all periods together are a whole number of samples, the sum
of these turns is 0, and so the mean over the periods has no aliases. It is not where the pulses
have a clock of their own: 15 ppm at 200 kHz and six periods are 0.3 samples, and without a filter
a percent of the spectrum at 20 kHz is aliases. With weights a_p,

    Σ a_p = 1,    Σ a_p e^(j 2π p δ) = 0,    and with five periods or more Σ a_p e^(j 4π p δ) = 0,

the mean is free of them at any clock. The weights with the least Σ a_p² are taken: noise grows by
P Σ a_p².
"""

import numpy as np
from jaxtyping import Float

SEAM = 4  # samples on each side of the joint between two periods
APART = 0.3  # least |e^(j 2π δ) − 1| of aliases that can be told from the signal


def weights(fraction: float, periods: int) -> Float[np.ndarray, " period"]:
    """The weights of periods whose length has this fraction of a sample, δ."""
    number = np.arange(periods)
    turns = [np.exp(2j * np.pi * k * fraction * number) for k in ((1, 2) if periods > 4 else (1,))]
    apart = [turn for turn in turns if abs(turn[1] - 1) > APART]
    rows = np.array(
        [np.ones(periods), *(p for turn in apart for p in (np.real(turn), np.imag(turn)))]
    )
    return np.linalg.pinv(rows)[:, 0]


def weighted(
    v: Float[np.ndarray, "*record time"], spacing: float, of: Float[np.ndarray, " period"]
) -> Float[np.ndarray, "*record time"]:
    """Records of whole periods, each period times its weight and their number."""
    ends = np.minimum(np.rint(np.arange(of.size + 1) * spacing), v.shape[-1]).astype(int)
    ends[-1] = v.shape[-1]
    # A level at the joints would become a step there.
    joints = (ends[1:-1, None] + np.arange(-SEAM, SEAM)).ravel()
    level = v[..., joints].mean(-1, keepdims=True)
    return (v - level) * np.repeat(of.size * of, np.diff(ends))
