"""Drivers: a source impedance, its covariance, and the calibrations that it comes from."""

import abc
import dataclasses
import importlib
import os
from collections.abc import Sequence
from typing import Any, ClassVar, Literal

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int

from etid.circuits.impedance import Quantity
from etid.precision import Module, array_function, in_float64, namespace, untraced
from etid.printing import Overview, Overviewed, per_cent, plus_minus, quality, rounded, several
from etid.recordings.recording import Recording
from etid.recordings.remarks import texts
from etid.recordings.study import Study
from etid.results.feed import AbstractFeed, Load, SourceImpedance
from etid.results.instrument import Instrument
from etid.results.verdicts import RESULTS, leaving, message
from etid.signals.harmonics import Spectrum
from etid.signals.transfer import AnyArray, Rational, delay_variable, reciprocal

Order = int | Literal["auto"]
AUTO: Literal["auto"] = "auto"
LEAST, LARGEST = 4, 8  # orders for which a driver has room for evidence


class OrderEvidence(Module):
    """Evidence of the calibrations for each order that `order="auto"` tried.

    The arrays have one place for each order from `LEAST` to `LARGEST`. Drivers therefore share
    compiled functions, however many orders were tried.

    Attributes:
        bic: Schwarz's criterion; NaN if the order was not tried.
        missing_pole: Largest score statistic of one more section; NaN if the order was not tried.
        adequate: Whether the driver of this order was successful.
    """

    bic: Float[Array | np.ndarray, " order"]
    missing_pole: Float[Array | np.ndarray, " order"]
    adequate: Bool[Array | np.ndarray, " order"]

    @classmethod
    def none(cls) -> "OrderEvidence":
        """No order was tried, because the user chose it."""
        empty = np.full(LARGEST - LEAST + 1, np.nan)
        return cls(empty, empty, np.zeros(empty.shape, bool))

    @property
    def orders(self) -> list[int]:
        """The orders that were tried."""
        return (LEAST + np.flatnonzero(~np.isnan(self.bic))).tolist()

    @np.errstate(over="ignore", invalid="ignore")  # a driver that failed may hold any number
    def __str__(self) -> str:
        """One line; empty if no order was tried."""
        if not self.orders:
            return ""
        least = min(self.bic[order - LEAST] for order in self.orders)
        found = [
            f"{order} {self.bic[order - LEAST] - least:+.3g}"
            + ("" if self.adequate[order - LEAST] else " (not adequate)")
            for order in self.orders
        ]
        return f"orders tried and their BIC above the least: {', '.join(found)}"


class Calibration(Overviewed, Module):
    """Results of the calibrations that a skin needs besides Z_th and its covariance.

    Attributes:
        r_load: Known resistors [Ω].
        delay_samples: Trigger delay of each calibration [samples of the calibration].
        delay_std_samples: Standard deviation of the common trigger delay of the calibrations
            [samples]. Only records with different resistors can separate this delay from a fast
            pole of Z_th. With one resistor the delay stays open.
        mismatch: Difference between the logarithm of each known resistor and its value from the
            other calibrations, and the standard error of this difference. None for one
            calibration, or if not known.
        across: Capacitance across each known resistor that the other calibrations do not show, and
            its standard error [F]; None in the same cases.
        errors: Errors of the instrument that several calibrations show [standard deviations that an
            `Instrument` states]; None if they are 0.
    """

    r_load: Float[AnyArray, " record"]
    delay_samples: Float[AnyArray, " record"]
    delay_std_samples: Float[AnyArray, ""]
    mismatch: Float[AnyArray, "2 record"] | None = None
    across: Float[AnyArray, "2 record"] | None = None
    errors: Float[AnyArray, " error"] | None = None

    def _overview(self) -> Overview:
        open_delay = float(self.delay_std_samples)
        rows = [
            (f"{float(ohm) / 1e3:g} kΩ", rounded(float(delay), 3))
            for ohm, delay in zip(self.r_load, self.delay_samples, strict=True)
        ]
        return Overview(
            several(len(rows), "calibration"),
            rows,
            ("resistor", "trigger delay [samples]"),
            [f"One delay of all is open: ± {rounded(open_delay)} samples."],
        )


class Driver(AbstractFeed):
    """An identified driver: the fields and methods that all kinds of drivers have.

    The kinds are `DiscreteDriver`, `ContinuousDriver` and `HarmonicDriver`. Only ratios to Z_th are
    observable. The tolerance of the calibration resistor therefore passes 1:1 into every resistance
    identified with this driver.

    Attributes:
        b: Numerator α₀ … of the discrete Z_th by Steiglitz-McBride (paper, eq. 4) [Ω].
        a: Denominator 1, β₁ … of the discrete Z_th.
        sample_rate: Rate of the calibrations and of the discrete filter [Hz].
        rrse: Largest root relative squared error over the calibrations (paper, eq. 3).
        chi2: Σ residual² / expected variance, per degree of freedom; 1 if the model is right.
        result: Verdict.
        steps: Iterations of the solver.
        method: Name of the estimator.
        remarks: Remarks on the calibrations, `etid.recordings.remarks.Remark` as an integer.
        recordings: Calibrations of a driver that `identify_driver` returned. They are no leaves,
            since no computation needs them: a driver that JAX has mapped has none.
    """

    recorded: ClassVar[str] = "v_th"
    recordings: ClassVar[Sequence[Recording]] = ()
    _: dataclasses.KW_ONLY
    b: Float[AnyArray, " b"]
    a: Float[AnyArray, " a"]
    sample_rate: float | Float[AnyArray, ""]
    rrse: Float[AnyArray, ""]
    chi2: Float[AnyArray, ""]
    result: RESULTS
    steps: Int[AnyArray, ""]
    method: str = eqx.field(static=True)
    remarks: Int[AnyArray, ""] = eqx.field(default_factory=lambda: np.zeros((), int))

    @property
    def order(self) -> int:
        """Number of poles."""
        return self.a.shape[0] - 1

    @property
    def inexact(self) -> bool:
        """Whether Z_th leaves more than noise; the standard errors then contain it."""
        return False

    @property
    def leaves(self) -> str:
        """A sentence on what Z_th leaves, if ± contain it; otherwise empty."""
        return leaving("Z_th", self.chi2, self.rrse) if self.usable and self.inexact else ""

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write the calibrations; `etid.read_driver` identifies the driver from them again.

        Raises:
            ValueError: `identify_driver` did not return this driver.
            RecordingError: The file cannot be written.
        """
        if not self.recordings:
            raise ValueError(
                "this driver does not hold its calibrations; write the one that "
                "etid.identify_driver or etid.calibrate returns"
            )
        Study.from_recordings(self.recordings).write(path)

    def plot(
        self,
        calibration: Recording | None = None,
        *,
        axes: Any = None,
        size: tuple[float, float] | None = None,
        title: str | None = "",
    ) -> np.ndarray:
        """Draw Z_th, or a pulse of a calibration; the same as `etid.plot(driver, calibration)`."""
        drawn = importlib.import_module("etid.plotting")  # a higher layer
        return drawn.plot(self, calibration, axes=axes, size=size, title=title)

    @in_float64
    @array_function
    def gain(self, load: Load, frequency: Quantity) -> Complex[AnyArray, "..."]:
        """H = Z_L / (Z_L + Z_th)."""
        z_load = untraced(load)
        return z_load * reciprocal(z_load + self.response(frequency))

    def sensitivity(self, load: Load, frequency: Quantity) -> Complex[AnyArray, "..."]:
        """∂ ln H / ∂ ln Z_L = Z_th / (Z_L + Z_th)."""
        z_th = self.response(frequency)
        return z_th * reciprocal(load + z_th)

    @abc.abstractmethod
    def response(self, frequency: Quantity) -> Complex[AnyArray, "..."]:
        """Source impedance Z_th(j 2π f) [Ω], in continuous time if the method gives it.

        Args:
            frequency: Real frequencies [Hz].

        Returns:
            Impedance, an array of NumPy outside of transformations of JAX.
        """

    @abc.abstractmethod
    def log_response_stderr(self, frequency: Quantity) -> Float[AnyArray, "2 ..."]:
        """Standard errors of ln |Z_th| and of the phase [rad]; NaN if there is no covariance."""

    @in_float64
    def response_stderr(self, frequency: Quantity) -> Float[AnyArray, "..."]:
        """Standard error of |Z_th|, from the derivatives of |Z_th| by its parameters.

        Args:
            frequency: Real frequencies [Hz].

        Returns:
            Standard errors [Ω]; NaN if the method gives no covariance.
        """
        z_th = self.response(frequency)
        return namespace(z_th).abs(z_th) * self.log_response_stderr(frequency)[0]

    @property
    def note(self) -> str:
        """The message of the verdict, with the numbers that explain it."""
        return f"{message(self.verdict)} {self._numbers()}".strip()

    @property
    def why(self) -> str:
        """The verdict and its note, for fits behind this driver; empty if it can be used."""
        return "" if self.usable else f"Its driver: {self.verdict}. {self.note}"

    def _numbers(self) -> str:
        """A sentence with the numbers that explain the verdict; empty if there are none."""
        if self.verdict == "approximate":
            return self.leaves
        if self.verdict == "misfit":
            return f"chi2 is {rounded(float(self.chi2), 3)}; noise alone gives 1."
        if self.verdict == "implausible":
            return f"|Z_th| is {np.abs(self._at_1_khz()):.4g} ohm at 1 kHz."
        return ""

    def _at_1_khz(self) -> complex:
        return complex(np.asarray(self.response(jax.device_put(np.array([1e3]))))[0])

    def _overview(self) -> Overview:
        at, verdict = jax.device_put(np.array([1e3])), self.verdict
        z = self._at_1_khz()
        size = float(np.abs(z))  # `abs` raises where a number overflows
        of_size, of_phase = np.asarray(self.log_response_stderr(at))[:, 0].tolist()
        rows = [
            ("|Z_th| at 1 kHz", plus_minus(size / 1e3, of_size * size / 1e3), "kΩ"),
            ("its phase", plus_minus(*np.degrees((np.angle(z), of_phase)).tolist()), "°"),
        ]
        why = [] if verdict == "successful" else [message(verdict)]
        notes = [*self._findings(), *why, *filter(None, [self.leaves])]
        return Overview(
            f"Driver of order {self.order}: {verdict} in {several(int(self.steps), 'step')} "
            f"({self.method}), {quality(float(self.rrse), float(self.chi2))}",
            rows,
            notes=[*notes, *texts(int(self.remarks))],
        )

    def _findings(self) -> list[str]:
        """Lines on the orders tried, and on known resistors and their values from the others."""
        return []


class DiscreteDriver(Driver):
    """A driver from Steiglitz-McBride: Z_th is the discrete filter `b`, `a` (paper, eq. 4)."""

    @in_float64
    @array_function
    def response(self, frequency: Quantity) -> Complex[AnyArray, "..."]:
        """Source impedance Z_th [Ω] of the discrete filter at real frequencies [Hz]."""
        b, a, rate, at = untraced((self.b, self.a, self.sample_rate, frequency))
        return Rational(b, a)(delay_variable(namespace(at).asarray(at, float), rate))

    def log_response_stderr(self, frequency: Quantity) -> Float[AnyArray, "2 ..."]:
        """NaN: Steiglitz-McBride gives no covariance."""
        return np.full((2, *np.shape(frequency)), np.nan)


class ContinuousDriver(Driver):
    """A driver with Z_th in continuous time and its covariance.

    Attributes:
        source: Continuous Z_th, valid at any sample rate.
        cov: Covariance of the parameters of `source`, flattened in field order.
        calibration: Results of the calibrations that skins need.
        instrument: Tolerances of the instrument; None if it has none. `cov` does not contain them.
        tried: Orders that `order="auto"` tried; none if the user chose the order.
        start: Which start of Z_th led here, from 0 on: three generic ones, and one with the
            resonance that Steiglitz-McBride found.
    """

    _: dataclasses.KW_ONLY
    source: SourceImpedance
    cov: Float[AnyArray, "parameter parameter"]
    calibration: Calibration
    instrument: Instrument | None = None
    tried: OrderEvidence = eqx.field(default_factory=OrderEvidence.none)
    start: Int[AnyArray, ""] = eqx.field(default_factory=lambda: np.array(0))

    @property
    def inexact(self) -> bool:
        """Whether Z_th leaves more than noise; the standard errors then contain it."""
        return self.source.departure is not None

    @property
    def drift(self) -> Float[Array | np.ndarray, ""] | None:
        """Relative standard deviation of the change of each parameter of `source` until a skin.

        None if there is no change. `cov` does not contain it.
        """
        drift = None if self.instrument is None else self.instrument.drift
        return np.asarray(drift) if isinstance(drift, int | float) else drift

    def drift_std(self, drift: float | None = None) -> Float[AnyArray, " parameter"]:
        """Standard deviations of the parameters of `source` that come from a drift alone.

        It is that of the driver if it is not given.
        """
        # Frequencies, dampings and R are stored as logarithms, so their changes are relative.
        vector = self.source.vector()
        place, xp = np.arange(vector.shape[0]), namespace(vector)
        own = 0.0 if self.drift is None else self.drift
        size = xp.where(np.isin(place, self.source.gains), xp.abs(vector), 1.0)
        size = xp.where(place < self.source.modes, size, 0.0)  # a departure does not drift
        return size * (own if drift is None else drift)

    def later_cov(self) -> Float[AnyArray, "parameter parameter"]:
        """Covariance of the parameters of `source` at the time when a skin is recorded."""
        if self.drift is None:
            return self.cov
        cov, std = untraced((self.cov, self.drift_std()))
        return cov + namespace(cov, std).diag(std**2)

    @property
    def r_known(self) -> Float[AnyArray, ""]:
        """Resistor of the first calibration [Ω]."""
        return self.calibration.r_load[0]

    def response(self, frequency: Quantity) -> Complex[AnyArray, "..."]:
        """Source impedance Z_th [Ω] in continuous time at real frequencies [Hz]."""
        return self.source.response(frequency)

    @in_float64
    @array_function
    def log_response_stderr(self, frequency: Quantity) -> Float[AnyArray, "2 ..."]:
        """Standard errors of ln |Z_th| and of its phase [rad] at real frequencies [Hz].

        var = J cov Jᵀ,    J = ∂(ln |Z_th|, arg Z_th) / ∂parameters
        """
        at, cov = untraced((frequency, self.cov))
        at = namespace(at).asarray(at, float)
        z_th, slopes = self.source.with_slopes(at.reshape(-1))
        xp, relative = namespace(z_th, cov), slopes * reciprocal(z_th)
        parts = xp.stack([relative.real, relative.imag])
        return xp.sqrt((parts * (cov @ parts)).sum(1)).reshape(2, *at.shape)

    def _numbers(self) -> str:
        if self.verdict == "resistors_disagree":
            return " ".join(f"{line}." for line in self._mismatches())
        if self.verdict == "implausible":  # as it was given, in ohm
            known = " and ".join(f"{r:.6g}" for r in self.calibration.r_load.tolist())
            return f"With r_load {known} ohm, {super()._numbers()}"
        return super()._numbers()

    def _findings(self) -> list[str]:
        return [*([str(self.tried)] if self.tried.orders else []), *self._mismatches()]

    def _mismatches(self) -> list[str]:
        known = self.calibration
        if known.mismatch is None:
            return []
        across: list[str] = [""] * known.r_load.size
        if known.across is not None:
            across = [
                f", with {' '.join(plus_minus(1e12 * c, 1e12 * error).split())} pF across it"
                for c, error in np.asarray(known.across).T.tolist()
            ]
        return [
            f"r_load {float(r) / 1e3:.6g} kΩ is {100 * float(np.expm1(off)):+.3g}"
            f" ± {per_cent(float(error))} off what the others say{of_c}"
            for r, off, error, of_c in zip(known.r_load, *known.mismatch, across, strict=True)
        ]


class HarmonicDriver(ContinuousDriver):
    """A driver that was identified from the harmonics of its calibrations and keeps them.

    Attributes:
        spectra: Harmonics of the calibrations, stacked along a leading axis.
        unloaded: Checksums of the unloaded records of the calibrations; None if not known. A load
            with another checksum shares no unloaded record with them. Its fit then skips the
            search for what they share, which doubles the cost.
        missing_pole: Largest score statistic of one more section
            (`etid.likelihood.of_calibrations`).
    """

    _: dataclasses.KW_ONLY
    spectra: Spectrum
    missing_pole: Float[AnyArray, ""]
    unloaded: Int[AnyArray, " record"] | None = None
