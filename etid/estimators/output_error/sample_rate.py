"""Whether a record is sampled fast enough, from its power near half the sample rate.

χ² does not show it. At 100 kHz and 60 dB it is 1.2, and R_s is wrong by five standard errors; at
200 kHz and 80 dB it is 1.4, and nothing is wrong.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from etid.signals.noise import Measurement

NEAR_NYQUIST = 0.45  # of the sample rate
# A current has aliases if its power above NEAR_NYQUIST is surely above the noise, and above this
# part of its power at a third of the rate. Steps have 0.03 to 0.16 after a filter of fourth order
# at 0.4 of the rate, and at most 0.007 after one of eighth order at 0.3.
ALIASES, SURE = 0.015, 5.0
# The interpolation leaves out a thirtieth of the part of V_th above NEAR_NYQUIST. What this shifts,
# in standard errors, grows with the root of the number of samples. Between 40 and 80 dB and 100 and
# 1000 kHz, elements were three and more standard errors off only where this part is more than 15
# times the noise over that root, and more than 1e-4 of the signal.
LEFT_OUT, HARMLESS, HIDDEN = 1 / 30, 1e-4, 15.0
TAPER = 48  # samples at each end of a record that a jump there does not reach


def has_aliases(m: Measurement, samples: Int[Array, ""]) -> Bool[Array, ""]:
    """Whether a current has aliases: edges that the sample rate does not resolve.

    No filter lets pass what it sees next to half the sample rate and stops all that lies above.

    Args:
        m: The recording; its v_th is the current [A].
        samples: Number of its samples; the others fill it up.
    """
    window = _taper(m, samples)
    power = jnp.abs(jnp.fft.rfft(m.v_th * window)) ** 2 / jnp.sum(window**2)
    at = jnp.fft.rfftfreq(m.v_th.shape[0])

    def signal(low: float) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Power of the signal per sample in a band of 0.05 of the sample rate, and its error."""
        band = ((at >= low) & (at < low + 0.05)).astype(float)
        noise, count = m.sigma_th**2, jnp.sum(band)
        return band @ power / count - noise, noise / jnp.sqrt(count)

    (last, error), (before, _) = signal(NEAR_NYQUIST), signal(0.3)
    return (last > SURE * error) & (last > ALIASES * before)


def leaves_out(m: Measurement, samples: Int[Array, ""]) -> Bool[Array, ""]:
    """Whether the interpolation leaves out more of V_th than the noise of both records hides.

    Args:
        m: The recording.
        samples: Number of its samples; the others fill it up.
    """
    window = _taper(m, samples)
    count = jnp.sum(window**2)

    def tapered(record: Float[Array, " time"]) -> Float[Array, " time"]:
        return window * (record - jnp.sum(window * record) / jnp.sum(window))

    v_th, v_out = tapered(m.v_th), tapered(m.v_out)
    above = jnp.fft.rfftfreq(v_th.size) >= NEAR_NYQUIST
    high = jnp.sum(jnp.where(above, jnp.abs(jnp.fft.rfft(v_th)) ** 2, 0.0)) * 2 / v_th.size
    signal = high - (1 - 2 * NEAR_NYQUIST) * m.sigma_th**2 * count
    part = LEFT_OUT * jnp.sqrt(jnp.maximum(signal, 0.0) / jnp.sum(v_th**2))
    noise = jnp.sqrt((m.sigma_th**2 + m.sigma_out**2) / jnp.sum(v_out**2))
    return part > jnp.maximum(HARMLESS, HIDDEN * noise)


def _taper(m: Measurement, samples: Int[Array, ""]) -> Float[Array, " time"]:
    """A window that is 1 but for TAPER samples at each end."""
    middle = jnp.arange(float(m.v_th.shape[0])) + 0.5
    to_end = jnp.minimum(middle, samples.astype(float) - middle)
    return jnp.sin(jnp.pi / 2 * jnp.clip(to_end / TAPER, 0.0, 1.0)) ** 2
