"""Kramers-Kronig test: whether a measured impedance can be that of any passive linear circuit.

The linear test (Boukamp 1995) fits a chain of relaxations with fixed time constants,

    Z(jω) = R + jωL + 1 / (jωC) + Σ_k R_k / (1 + jω τ_k),

which meets the Kramers-Kronig relations for all R_k. The parameters enter linearly. The number of
relaxations is the smallest whose mean square residual per degree of freedom is near the least one:
more would describe noise. An impedance that drifts during its measurement, or that is not linear,
leaves residuals that are not noise.
"""

import dataclasses

import numpy as np
import numpy.typing as npt
from jaxtyping import Complex, Float

from etid.circuits.overview import Overview, Overviewed

NEAR = 1.2  # times the least mean square; no data tell such models apart
EXACT = 1e-4  # relative residual that is as good as none
_COLUMNS = 3  # of a chain without relaxations
FAIL = 0.01  # relative residual above which a measurement without known errors is suspect


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class KramersKronig(Overviewed):
    """The residuals of a Kramers-Kronig test.

    Attributes:
        frequency: Frequencies [Hz].
        fitted: Impedance that meets the relations [Ω].
        residual: (measured − fitted) / |fitted|.
        relaxations: Number of relaxations.
    """

    frequency: Float[np.ndarray, " frequency"]
    fitted: Complex[np.ndarray, " frequency"]
    residual: Complex[np.ndarray, " frequency"]
    relaxations: int

    @property
    def largest(self) -> float:
        """Largest relative residual of a real or an imaginary part."""
        return float(np.abs([np.real(self.residual), np.imag(self.residual)]).max())

    @property
    def passed(self) -> bool:
        """Whether no residual exceeds 1 %."""
        return self.largest <= FAIL

    def _overview(self) -> Overview:
        rms = float(np.sqrt(np.mean(np.abs(self.residual) ** 2 / 2)))
        at = self.frequency[np.argmax(np.abs(self.residual))]
        verdict = "passed" if self.passed else "not passed"
        rows = [
            ("largest residual", f"{100 * self.largest:.2g} %", f"at {at:.3g} Hz"),
            ("rms residual", f"{100 * rms:.2g} %", ""),
            ("relaxations", str(self.relaxations), ""),
        ]
        return Overview(f"Kramers-Kronig test: {verdict}", rows)


def kramers_kronig(frequency: npt.ArrayLike, impedance: npt.ArrayLike) -> KramersKronig:
    """Test whether a measured impedance meets the Kramers-Kronig relations.

    Args:
        frequency: Frequencies [Hz], > 0.
        impedance: Complex impedance [Ω] at each frequency.

    Returns:
        Residuals and verdict.

    Raises:
        ValueError: The shapes differ, a number is not finite, a frequency is not positive, or there
            are fewer than five frequencies.
    """
    f, z = np.asarray(frequency, float), np.asarray(impedance, complex)
    if f.ndim != 1 or z.shape != f.shape or f.size < 5:
        raise ValueError(
            f"frequency has shape {f.shape} and impedance {z.shape}; both must be (n,), n ≥ 5"
        )
    if not (np.isfinite(z).all() and np.isfinite(f).all() and (f > 0).all()):
        raise ValueError("all numbers must be finite, and all frequencies > 0")
    tried = [_fitted(f, z, count) for count in range(1, f.size - 2)]
    squares = [
        np.sum(np.abs(one / z - 1) ** 2) / (2 * f.size - _COLUMNS - count)
        for count, one in enumerate(tried, 1)
    ]
    limit = max(NEAR * min(squares), EXACT**2)
    chosen = next(number for number, square in enumerate(squares) if square <= limit)
    fitted = tried[chosen]
    return KramersKronig(f, fitted, (z - fitted) / np.abs(fitted), chosen + 1)


def _fitted(
    f: Float[np.ndarray, " frequency"], z: Complex[np.ndarray, " frequency"], count: int
) -> Complex[np.ndarray, " frequency"]:
    """The impedance of the best chain with `count` relaxations."""
    s = 2j * np.pi * f
    tau = np.geomspace(1 / s.imag.max(), 1 / s.imag.min(), count)
    columns = [np.ones_like(s), s / s.imag.max(), s.imag.min() / s]
    model = np.stack([*columns, *(1 / (1 + s * one) for one in tau)], axis=1)
    weight = np.tile(1 / np.abs(z), 2)
    rows = np.concatenate([np.real(model), np.imag(model)]) * weight[:, None]
    return model @ np.linalg.lstsq(rows, np.concatenate([np.real(z), np.imag(z)]) * weight)[0]
