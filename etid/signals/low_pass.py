"""Known low-pass filters of the channels of an instrument.

A filter of real poles and pairs of poles has

    H(s) = Π 1 / (1 + s τ_k),

and each τ_k is inversely proportional to its corner, the frequency of −3 dB.

**Two channels.** If V_out passes H_v and the current H_i, then V_out = (H_v / H_i) Z I. Each
channel is made to pass the filter of the other one, too, so that they cancel out and no noise is
amplified. What is left is the error of the corners,

    V_out / I = Z F,      F = H_v(τ_v e^(−u_v)) / H_v(τ_v) · H_i(τ_i) / H_i(τ_i e^(−u_i)),

where u is the error of the logarithm of a corner.
"""

import functools

import numpy as np
from jaxtyping import Complex, Float

from etid.precision import Module, namespace
from etid.signals.transfer import AnyArray, as_complex, frequency_variable, reciprocal

KINDS = ("bessel", "butterworth")
MOST = 8  # poles


class LowPass(Module):
    """A filter of one channel.

    Attributes:
        times: τ_k [s].
        width: Standard deviation of the logarithm of its corner.
    """

    times: Complex[np.ndarray, " pole"]
    width: float

    @classmethod
    def read(cls, text: str) -> "LowPass":
        """The filter of a text such as `"bessel 4 2000"`, or `"bessel 4 2000 100"`.

        The numbers are the order, the corner [Hz], and its standard deviation [Hz].

        Raises:
            ValueError: It is no such text.
        """
        kind, *numbers = text.split() or [""]
        try:
            order, corner, error = map(float, [*numbers, "0"][:3])
        except ValueError:
            order = corner = error = np.nan
        sound = corner > 0 and 0 <= error < corner and len(numbers) in (2, 3)
        if kind not in KINDS or order not in range(1, MOST + 1) or not (sound and corner < np.inf):
            raise ValueError(
                f"{text!r} is no filter; write kind ({' or '.join(KINDS)}), order (1 to {MOST}), "
                "corner [Hz] and, if it is uncertain, its standard deviation [Hz], as in "
                "'bessel 4 2000 100'"
            )
        poles = 2 * np.pi * corner * np.array(_poles(kind, int(order)))
        return cls(-1 / poles, error / corner)


@functools.cache
def _poles(kind: str, order: int) -> tuple[complex, ...]:
    """The poles of a filter whose corner is at 1 rad/s."""
    if kind == "butterworth":
        angles = np.pi * (2 * np.arange(order) + 1 + order) / (2 * order)
        return tuple(np.exp(1j * angles).tolist())
    from scipy.signal import besselap  # most recordings state no filter

    return tuple(np.asarray(besselap(order, norm="mag")[1]).tolist())


class Filters(Module):
    """The filters of V_out and of the current, of one recording or of several.

    Attributes:
        times: τ_k of each channel [s]; 0 if it has fewer poles, or no filter.
        width: Standard deviation of the logarithm of each corner.
    """

    times: Complex[AnyArray, "*lane channel pole"]
    width: Float[AnyArray, "*lane channel"]

    @classmethod
    def of(cls, *channels: LowPass | None) -> "Filters":
        """The filters of V_out and of the current; None for a channel without one."""
        most = max(one.times.size for one in channels if one is not None)
        times, width = np.zeros((2, most), complex), np.zeros(2)
        for row, one in enumerate(channels):
            if one is not None:
                times[row, : one.times.size], width[row] = one.times, one.width
        return cls(times, width)

    def rows(self, rows: np.ndarray) -> "Filters":
        """Those of some of the recordings."""
        return Filters(self.times[rows], self.width[rows])

    def _turned(
        self, frequency: Float[AnyArray, "*lane bin"], u: Float[AnyArray, "*row channel"]
    ) -> Complex[AnyArray, "*row channel pole bin"]:
        """S τ_k at other corners."""
        s = frequency_variable(frequency)[..., None, None, :]
        off = namespace(u).exp(-u * self.width)
        return s * (self.times * as_complex(off)[..., None])[..., None]

    def __call__(
        self, frequency: Float[AnyArray, "*lane bin"]
    ) -> Complex[AnyArray, "*lane channel bin"]:
        """H of each channel at its stated corner."""
        turned = self._turned(frequency, 0 * self.width)
        return reciprocal((1 + turned).prod(-2))

    def error(
        self, frequency: Float[AnyArray, "*lane bin"], u: Float[AnyArray, "*row channel"]
    ) -> Complex[AnyArray, "*row bin"]:
        """F at corners whose logarithms are larger by u times their standard deviations."""
        changed = (1 + self._turned(frequency, u)).prod(-2) * self(frequency)
        return changed[..., 1, :] * reciprocal(changed[..., 0, :])

    def slopes(
        self, frequency: Float[AnyArray, "*lane bin"], u: Float[AnyArray, "*row channel"]
    ) -> Complex[AnyArray, "*row channel bin"]:
        """∂ ln F/∂u."""
        turned = self._turned(frequency, u)
        by_corner = (turned * reciprocal(1 + turned)).sum(-2)
        sign = np.array([1.0, -1.0])[:, None]
        return by_corner * as_complex(self.width)[..., None] * sign

    def decays(
        self, frequency: Float[AnyArray, "*lane bin"]
    ) -> Complex[AnyArray, "*lane channel decay bin"]:
        """Transforms of what the states at the ends of a record add to each channel [s].

        They are H (s τ)^k τ, k = 0, 1, …, with the mean τ of the channel.
        """
        xp, s = namespace(self.times), frequency_variable(frequency)
        tau = xp.abs(self.times).max(-1)
        at, of = s[..., None, :] * tau[..., None], self(frequency)
        powers = xp.stack([at**k for k in range(self.times.shape[-1])], -2)
        return of[..., None, :] * powers * tau[..., None, None]
