"""Changes of skin and driver from pulse to pulse, and electrodes that cannot be used.

**The innovation** of a pulse is the difference between the logarithms of the elements that this
pulse alone shows and their prediction:

    d = ϑ̂ − ϑ⁻,    S = cov d = H⁻¹ + Λ⁻⁻¹

with the symbols of `etid.online.tracker`. While the skin varies as the tracker expects, the
innovations of different pulses are independent, with mean 0 (Mehra and Peschon 1971). With the
posterior ϑ = ϑ⁻ + (Λ⁻ + H)⁻¹ H d, S⁻¹ d is Λ⁻ (ϑ − ϑ⁻).

**Jump.** The generalised likelihood ratio of a change between this pulse and the one before is
T = dᵀ S⁻¹ d (Willsky and Jones 1976). Its distribution is χ² with one degree of freedom per
element. An electrode whose T exceeds the limit, or whose pulse does not fit at all, is identified
anew from this pulse alone. It is a jump if the new elements explain the pulse and their T exceeds
the limit as well.

**Drift.** A slow change hides in the noise of a pulse, but not in a moving mean of innovations:

    m ← (1 − λ) m + λ d,    P ← (1 − λ)² P + λ² S,    Q = mᵀ P⁻¹ m

(multivariate exponentially weighted moving average, Lowry et al. 1992; P is computed, so that the
chart holds from its first pulse on). Q has the distribution of T.

**Element.** A change of element j alone explains (e_jᵀ S⁻¹ d)² / (e_jᵀ S⁻¹ e_j) of T. The element
that explains most is reported.

**Driver.** A change of Z_th by a factor moves the elements of all electrodes along one direction a,
the powers of impedance to which the elements are proportional. z = aᵀS⁻¹d / √(aᵀS⁻¹a) is a normal
variable for each electrode. Its deciles over n electrodes are ±1.282, with the standard deviation
1.709/√n. A change is the driver's if nine tenths of the z lie on one side: if the lower decile
of z, or of the z of the moving means, is `DRIVER` standard deviations above −1.282, or the upper
one as far below 1.282. Half of the electrodes cannot do this. It is also the driver's if more than
half of the electrodes jump at once. Skin that changes at all electrodes at once looks the same.
"""

import dataclasses
import math
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Bool, Float, Int

from etid.online.state import TrackerState
from etid.results.verdicts import verdict_names
from etid.solvers.matrices import inverse_of_few

FALSE_ALARMS = 0.05  # per electrode and hour, expected if T and Q have exactly their distributions
WEIGHT = 0.1  # λ, of the newest innovation in the moving mean
DRIVER = 9.0  # standard deviations; no false alarm is expected in a year
COMMON = 8  # electrodes that are needed to tell the driver from the skin
OPEN = 0.99  # effective gain above which an electrode touches nothing
SHORTED = 0.02  # effective gain below which an electrode is shorted
DRY = 700e3  # [Ω] at the lowest frequency; the driest fingertip of the paper's Table II has 686 kΩ
RECENT = 60  # pulses for which an electrode that has drifted is called drifting
NONE, JUMP, DRIFT = range(3)
KINDS = ("none", "jump", "drift")


def limit(elements: int, pulse_rate: float) -> float:
    """Value that T and Q exceed `FALSE_ALARMS` times per hour together.

    Args:
        elements: Number of elements of the circuit.
        pulse_rate: Pulses per second [Hz].
    """
    return float(scipy.special.chdtri(elements, FALSE_ALARMS / 2 / (3600 * pulse_rate)))


class Innovation(NamedTuple):
    """Difference between a pulse and its prediction.

    Attributes:
        d: New minus predicted logarithms.
        weight: S⁻¹.
        cov: S.
    """

    d: Float[Array, " element"]
    weight: Float[Array, "element element"]
    cov: Float[Array, "element element"]

    @classmethod
    def of(
        cls,
        d: Float[Array, " element"],
        spread: Float[Array, "element element"],
        information: Float[Array, "element element"],
    ) -> "Innovation":
        """The innovation.

        Args:
            d: Elements by the pulse alone minus predicted elements.
            spread: Covariance of the elements by the pulse alone, H⁻¹.
            information: Inverse covariance of the prediction, Λ⁻; not singular.
        """
        cov = spread + inverse_of_few(information)
        return cls(d, inverse_of_few(cov), cov)

    def statistic(self) -> Float[Array, ""]:
        """T."""
        return self.d @ self.weight @ self.d

    def element(self) -> Int[Array, ""]:
        """Number of the element whose change alone explains most of T."""
        return jnp.argmax((self.weight @ self.d) ** 2 / jnp.diagonal(self.weight))

    def along(self, direction: Float[Array, " element"]) -> Float[Array, ""]:
        """Component along a direction [standard deviations]."""
        weighted = self.weight @ direction
        return weighted @ self.d / jnp.sqrt(weighted @ direction)


def averaged(
    mean: Float[Array, " element"], cov: Float[Array, "element element"], new: Innovation
) -> Innovation:
    """The moving mean of the innovations after one more of them."""
    cov = (1 - WEIGHT) ** 2 * cov + WEIGHT**2 * new.cov
    return Innovation((1 - WEIGHT) * mean + WEIGHT * new.d, inverse_of_few(cov), cov)


def driver_change(
    jumped: Bool[Array, " lane"],
    z: Float[Array, "test lane"],
    counts: Bool[Array, " lane"],
    running: Bool[Array, " lane"],
) -> Bool[Array, ""]:
    """Whether the electrodes have changed together.

    Args:
        jumped: Electrodes that have jumped.
        z: z of the innovation and of the moving mean.
        counts: Electrodes that have a prediction, touch something, and keep their amplitude.
        running: Electrodes that have a prediction. If only a few of them count, these are the ones
            in trouble while the amplitude of the others rises.
    """
    number = jnp.sum(counts, dtype=float)
    limit = DRIVER * 1.709 / jnp.sqrt(jnp.maximum(number, 1.0)) - 1.282
    above, below = (
        jnp.sum(counts[None, :] & of, axis=1, dtype=float) for of in (z > limit, z < -limit)
    )
    moved = jnp.any(jnp.maximum(above, below) >= jnp.floor(0.9 * number))
    enough = (number >= COMMON) & (number > jnp.sum(running, dtype=float) / 2)
    return enough & (moved | (jnp.sum(jumped & counts, dtype=float) > number / 2))


@dataclasses.dataclass(frozen=True)
class Change:
    """A change that a pulse has shown.

    Attributes:
        pulse: Number of the pulse since the start, from 1 on.
        electrode: Number of the electrode; None if the driver has changed.
        kind: `jump`, `drift`, or `driver`.
        element: Name of the element that explains the change best; empty for the driver.
        factor: New value of this element divided by the old one; NaN for the driver.
    """

    pulse: int
    electrode: int | None
    kind: str
    element: str
    factor: float


def changes(state: TrackerState, names: tuple[str, ...]) -> list[Change]:
    """The changes that the last pulse has shown; see `Tracker.changes`."""
    number, lanes = int(state.number), state.electrodes
    if state.driver_event:
        return [Change(number, None, "driver", "", math.nan)]
    event, element, factor = map(np.asarray, (lanes.event, lanes.element, lanes.factor))
    return [
        Change(
            number,
            int(at),
            KINDS[event[at]],
            names[element[at]],
            float(np.exp(factor[at, element[at]])),
        )
        for at in np.flatnonzero(event != NONE)
    ]


def bad_electrodes(state: TrackerState, impedance: Float[np.ndarray, " lane"]) -> dict[int, str]:
    """Electrodes that cannot be used, with the reason; see `Tracker.bad_electrodes`."""
    lanes = state.electrodes
    known = np.asarray(lanes.pulses) > 0
    since = int(state.number) - np.asarray(lanes.drifted)
    reasons = {
        "open": verdict_names(lanes.result) == "unconnected",
        "shorted": np.asarray(lanes.level) < SHORTED,
        "dry": known & (impedance > DRY),
        "drifting": (np.asarray(lanes.drifted) >= 0) & (since < RECENT),
    }
    found: dict[int, str] = {}
    for reason, applies in reasons.items():
        for electrode in np.flatnonzero(applies):
            found.setdefault(int(electrode), reason)
    return dict(sorted(found.items()))
