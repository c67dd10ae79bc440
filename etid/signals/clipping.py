"""Whether a converter of unknown range, or an amplifier before it, clipped a record.

A clipped signal arrives at the rail at full slope and stays there, so one extreme value has many
samples in a row, and the values just inside the rail have few. A smooth signal that turns at its
peak has at most 2.4 times as many samples at its extreme value, because it is a parabola there. One
that droops has no more of them than at the next value. A signal that settles at a level approaches
it in small steps.

A generator's command rests at exact levels too, its baseline included. It has no noise
(`is_command`).

**Noise behind the limiter** hides the exact level, and a range that is known is not reached where
an amplifier limits earlier. But V_th droops over its pulse, and V_out with it. So V_out was limited
where it stays at its extreme value within its noise while V_th moves by many times of this noise
(`is_limited`). Ringing is over sooner than `SHORTEST`. A relaxation of the load may hold V_out
against the droop, but only on a parabola, whose top is as deep as the band that is looked at.
"""

import numpy as np
from jaxtyping import Bool, Float
from numpy.polynomial import legendre

from etid.signals.white_noise import noise_std


def may_be_clipped(
    v: Float[np.ndarray, "*record time"], limits: Float[np.ndarray, "*record limit"]
) -> Bool[np.ndarray, "*record"]:
    """Whether three samples in a row are at the smallest or at the largest sample of a record."""
    found = np.zeros(v.shape[:-1], bool)
    for extreme in np.moveaxis(limits, -1, 0):
        at = v == extreme[..., None]
        found |= (at[..., :-2] & at[..., 1:-1] & at[..., 2:]).any(-1)
    return found


def is_clipped(v: Float[np.ndarray, " time"], step: float) -> bool:
    """Whether many samples in a row are at a rail."""
    rails = [extreme for extreme in (v.min(), v.max()) if _has_run(v == extreme)]
    if not rails:  # nearly all records
        return False
    values, counts = np.unique(v, return_counts=True)
    # A record of rounded volts shows its step; an unknown converter has at most 16 bits.
    span = values[-1] - values[0]
    step = max(step, np.diff(values).min(), span * 2.0**-16)
    jump = 8 * step  # a clipped signal reaches its rail in a larger jump
    rest = values[np.argmax(counts)]
    if 2 * counts.max() >= v.size and _arrivals(v, rest).min(initial=np.inf) > jump:
        # Noise in the pulses is that of a record whose baseline is at the rail.
        others = v[v != rest]
        if is_command(float(noise_std(others)), step, span):
            return False
    for rail in rails:
        # A peak of fourth order has at most 5 times the samples of the next of these values.
        total, *beside = (counts if rail == values[0] else counts[::-1])[:9]
        if total > 4 * max(beside) and _arrivals(v, rail).max(initial=0.0) > jump:
            return True
    return False


SHORTEST = 80e-6, 16  # [s], samples of a flat top; a ringing has several cycles in it
BAND = 8.0  # [steps or standard deviations of the noise] below the extreme value: ± 4
MOVED = 12.0  # of the same unit, by the droop of V_th; noise moves a top of 16 samples by 0.9
EDGE = 2  # samples at both ends of a top, within the edges


def may_be_limited(
    v: Float[np.ndarray, "record time"],
    limits: Float[np.ndarray, "record limit"],
    unit: Float[np.ndarray, " record"],
    sample_rate: float,
) -> Bool[np.ndarray, " record"]:
    """Whether records have enough samples at an extreme value for `is_limited`."""
    band = BAND * unit
    low, high = (limits[:, 0] + band)[:, None], (limits[:, 1] - band)[:, None]
    count = np.maximum(np.count_nonzero(v >= high, axis=1), np.count_nonzero(v <= low, axis=1))
    return count >= shortest(sample_rate)


def shortest(sample_rate: float) -> float:
    """Samples of the shortest flat top."""
    return max(SHORTEST[0] * sample_rate, float(SHORTEST[1]))


def is_limited(
    cause: Float[np.ndarray, " time"],
    v: Float[np.ndarray, " time"],
    unit: float,
    sample_rate: float,
) -> bool:
    """Whether a record stays at its extreme value while its cause moves.

    Of 4 694 good recordings of drawn drivers and many circuits, at 20 to 80 dB and with 8 to 16
    bits, none does so (`tests/test_clipping.py` draws some of them). Natural tops that are as long
    have a shape of 0.7 units or more.

    Args:
        cause: V_th, aligned with the record.
        v: V_out.
        unit: Standard deviation of its noise, or its converter step if this is larger.
        sample_rate: Sampling rate [Hz].
    """
    least = shortest(sample_rate)
    for sign, at in (
        (1.0, v >= v.max() - BAND * unit),
        (-1.0, v <= v.min() + BAND * unit),
    ):
        if np.count_nonzero(at) < least:  # nearly all records
            continue
        at &= sign * cause > 0.5 * (sign * cause).max()
        ends = np.flatnonzero(np.diff(at, prepend=False, append=False))
        tops = [
            slice(first + EDGE, last - EDGE)
            for first, last in ends.reshape(-1, 2)
            if last - first - 2 * EDGE >= least
        ]
        if tops:
            rise, shape = _shape(v, tops)
            gain = abs(float(cause @ v)) / float(cause @ cause)
            moved = 2 * gain * abs(_shape(cause, tops)[0])
            if (
                moved > MOVED * unit
                and abs(rise) < 0.075 * moved
                and shape < min(0.4 * unit, moved / 20)
            ):
                return True
    return False


def _shape(v: Float[np.ndarray, " time"], tops: list[slice]) -> tuple[float, float]:
    """Half of the linear rise over the parts of a record, and rms of its cubic polynomial.

    All parts are taken to have the same shape, at levels of their own.
    """
    parts = [v[top] - v[top].mean() for top in tops]
    basis = [legendre.legvander(np.linspace(-1, 1, part.size), 3)[:, 1:] for part in parts]
    found = np.linalg.lstsq(np.concatenate(basis), np.concatenate(parts))[0]
    return float(found[0]), float(np.sqrt(np.sum(found**2 / np.array([3.0, 5.0, 7.0]))))


def is_command(noise: float, step: float, span: float) -> bool:
    """Whether a record may be a generator's command: it has almost no noise.

    Args:
        noise: Standard deviation of its noise, in its unit.
        step: Step of its converter; 0 if it is unknown.
        span: Its peak-to-peak value.
    """
    return bool(noise <= max(step, 1e-5 * span))


def _has_run(at: Bool[np.ndarray, " time"]) -> bool:
    """Whether three samples in a row are true."""
    return bool(np.count_nonzero(at) >= 3 and (at[:-2] & at[1:-1] & at[2:]).any())


def _arrivals(v: Float[np.ndarray, " time"], level: float) -> Float[np.ndarray, " arrival"]:
    """Size of each step by which the record arrives at a level."""
    at = v == level
    return np.abs(v[:-1] - level)[at[1:] & ~at[:-1]]
