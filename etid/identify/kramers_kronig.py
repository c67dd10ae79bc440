"""Kramers-Kronig test: whether a measured impedance can be that of any passive linear circuit.

The linear test (Boukamp 1995) fits a chain of relaxations with fixed time constants,

    Z(jω) = R + jωL + 1 / (jωC) + Σ_k R_k / (1 + jω τ_k),

which meets the Kramers-Kronig relations for all R_k. The parameters enter linearly. The number of
relaxations is the smallest whose mean square residual per degree of freedom is near the least one:
more would describe noise. An impedance that drifts during its measurement, or that is not linear,
leaves residuals that are not noise.

With standard errors σ_k the residuals are weighted by 1/σ_k, and χ² decides. Without them they are
weighted by 1/|Z|, and none may exceed 1 %.
"""

import dataclasses

import numpy as np
import numpy.typing as npt
import scipy
from jaxtyping import Complex, Float

from etid.precision import in_float64, unmasked
from etid.printing import Overview, Overviewed, per_cent, rounded, several

MISFIT_CHI2 = 1.5  # a standard error of a measured impedance is seldom known to better than 20 %
EXACT = 1e-4  # relative residual that is as good as none
_COLUMNS = 3  # of a chain without relaxations
_SPARSE = 3.0  # least frequencies per decade
FAIL = 0.01  # relative residual above which a measurement without known errors is suspect


class NotFinite(ValueError):
    """An impedance is missing or not finite."""


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class KramersKronig(Overviewed):
    """The residuals of a Kramers-Kronig test.

    Attributes:
        frequency: Frequencies [Hz].
        fitted: Impedance that meets the relations [Ω].
        residual: (measured − fitted) / |fitted|.
        relaxations: Number of relaxations.
        chi2: Mean square residual per degree of freedom, in units of the standard errors; None if
            they are not known.
        limit: Largest `chi2` of a measurement that passes, or largest relative residual if the
            standard errors are not known.
    """

    frequency: Float[np.ndarray, " frequency"]
    fitted: Complex[np.ndarray, " frequency"]
    residual: Complex[np.ndarray, " frequency"]
    relaxations: int
    chi2: float | None
    limit: float

    @property
    def parameters(self) -> int:
        """Number of fitted parameters."""
        return _COLUMNS + self.relaxations

    @property
    def largest(self) -> float:
        """Largest relative residual of a real or an imaginary part."""
        return float(np.abs([np.real(self.residual), np.imag(self.residual)]).max())

    @property
    def passed(self) -> bool:
        """Whether the residuals are noise, or without standard errors: whether none exceeds 1 %."""
        return (self.largest if self.chi2 is None else self.chi2) <= self.limit

    def _overview(self) -> Overview:
        rms = float(np.sqrt(np.mean(np.abs(self.residual) ** 2 / 2)))
        at = self.frequency[np.argmax(np.abs(self.residual))]
        verdict = "passed" if self.passed else "not passed"
        rows = [
            (
                "largest residual",
                per_cent(self.largest),
                f"at {rounded(at, 3)} Hz",
            ),
            ("rms residual", per_cent(rms), ""),
            ("relaxations", str(self.relaxations), ""),
        ]
        if self.chi2 is None:
            noise = f"Without standard errors, no residual may exceed {100 * self.limit:g} %."
        else:
            rows.append(("chi2", rounded(self.chi2, 3), f"may reach {rounded(self.limit, 3)}"))
            noise = "The residuals are compared with the standard errors."
        return Overview(f"Kramers-Kronig test: {verdict}", rows, notes=(noise,))


@in_float64
def kramers_kronig(
    frequency: npt.ArrayLike,
    impedance: npt.ArrayLike,
    *,
    stderr: float | npt.ArrayLike | None = None,
) -> KramersKronig:
    """Test whether a measured impedance meets the Kramers-Kronig relations.

    Args:
        frequency: Frequencies [Hz], > 0.
        impedance: Complex impedance [Ω] at each frequency.
        stderr: Standard error [Ω] of the real and of the imaginary part: one number, or one for
            each frequency. If not given, no residual may exceed 1 %, whatever the noise.

    Returns:
        Residuals and verdict.

    Raises:
        ValueError: As in `identify_impedance`, or there are fewer than five frequencies, or than
            three in each decade.
    """
    f, z, known = checked_spectrum(frequency, impedance, stderr)
    if f.size < 5:
        raise ValueError(f"frequency has shape {f.shape}; both must be (n,), n ≥ 5")
    sigma = np.abs(z) if known is None else known
    decades = np.log10(f.max() / f.min())
    if f.size < _SPARSE * decades:
        raise ValueError(
            f"{several(f.size, 'frequency')} in {rounded(decades)} decades; the test needs at "
            f"least {_SPARSE:g} in each"
        )
    # Five in a decade describe any circuit to 0.1 %; four degrees of freedom show a residual.
    most = min(2 * f.size - _COLUMNS - 4, int(5.0 * decades) + 2)
    counts = range(1, max(f.size - _COLUMNS, most) + 1)
    tried = [_fitted(f, z, sigma, count) for count in counts]
    degrees = [2 * f.size - _COLUMNS - count for count in counts]
    squares = [
        float(np.sum(np.abs((one - z) / sigma) ** 2)) / free
        for one, free in zip(tried, degrees, strict=True)
    ]
    # No data tell models apart whose mean squares differ by less than a fifth.
    near = max(1.2 * min(squares), EXACT**2 if stderr is None else 1.0)
    chosen = next(number for number, square in enumerate(squares) if square <= near)
    fitted = tried[chosen]
    residual = (z - fitted) / np.abs(fitted)
    if stderr is None:
        return KramersKronig(f, fitted, residual, chosen + 1, None, FAIL)
    # One right measurement of a thousand exceeds it.
    by_chance = float(scipy.special.chdtri(degrees[chosen], 1e-3)) / degrees[chosen]
    limit = max(MISFIT_CHI2, by_chance)
    return KramersKronig(f, fitted, residual, chosen + 1, squares[chosen], limit)


def checked_spectrum(
    frequency: npt.ArrayLike, impedance: npt.ArrayLike, stderr: float | npt.ArrayLike | None
) -> tuple[
    Float[np.ndarray, " frequency"],
    Complex[np.ndarray, " frequency"],
    Float[np.ndarray, " frequency"] | None,
]:
    """Frequencies, impedances and standard errors of a caller, one for each frequency.

    Raises:
        ValueError: The shapes differ, a frequency or a standard error is not positive, or without
            standard errors an impedance is 0.
        NotFinite: An impedance is missing or not finite.
    """
    f, z = _numbers("frequency", frequency, float), _numbers("impedance", impedance, complex)
    sigma = None if stderr is None else _numbers("stderr", stderr, float)
    if f.ndim != 1 or z.shape != f.shape:
        raise ValueError(
            f"frequency has shape {f.shape} and impedance {z.shape}; both must be (n,)"
        )
    if sigma is not None and sigma.shape not in ((), f.shape):
        raise ValueError(
            f"stderr has shape {sigma.shape}; give one number, or one for each of {f.size} "
            "frequencies"
        )
    for name, values in {"frequency": f, "stderr": sigma}.items():
        if values is not None and not (np.isfinite(values).all() and (values > 0).all()):
            raise ValueError(f"{name} must be finite and > 0 everywhere")
    if not np.isfinite(z).all():
        bad = several(int(np.count_nonzero(~np.isfinite(z))), "impedance")
        raise NotFinite(f"{bad} of {z.size} missing or not finite; fit the others")
    if sigma is None and not z.all():
        raise ValueError("impedance is 0 somewhere; leave it out, or give stderr")
    return f, z, None if sigma is None else np.broadcast_to(sigma, f.shape)


def _numbers(name: str, given: float | npt.ArrayLike, kind: type) -> np.ndarray:
    """The numbers of a caller as an array of float or complex numbers."""
    found = np.asarray(unmasked(given))
    if found.dtype.kind not in ("iuf" if kind is float else "iufc"):
        words = "real numbers" if kind is float else "complex numbers"
        raise ValueError(f"{name} has dtype {found.dtype}, must be {words}")
    return found.astype(kind)


def _fitted(
    f: Float[np.ndarray, " frequency"],
    z: Complex[np.ndarray, " frequency"],
    sigma: Float[np.ndarray, " frequency"],
    count: int,
) -> Complex[np.ndarray, " frequency"]:
    """The impedance of the best chain with `count` relaxations, weighted by 1 / sigma."""
    s = 2j * np.pi * f
    tau = np.geomspace(1 / s.imag.max(), 1 / s.imag.min(), count)
    columns = [np.ones_like(s), s / s.imag.max(), s.imag.min() / s]
    model = np.concatenate([np.stack(columns, 1), 1 / (1 + s[:, None] * tau)], axis=1)
    weight = np.tile(1 / sigma, 2)
    rows = np.concatenate([np.real(model), np.imag(model)]) * weight[:, None]
    return model @ np.linalg.lstsq(rows, np.concatenate([np.real(z), np.imag(z)]) * weight)[0]
