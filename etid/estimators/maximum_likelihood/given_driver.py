"""The distribution of Z_th at the harmonics of a load, given the calibrations of its driver.

The common parameters c are the parameters of Z_th and the delays of the calibrations. The
calibrations give a distribution of c around the minimum of their likelihood. In modal parameters it
is far from normal: a fast pole and a delay form a curved valley. At the harmonics it is nearly
normal in

    W = log(Z_th + R).

A calibration with R shows log(R X / Y), which is W apart from −jωτ, linear in its delay τ. So

    W = W₀ + Σ_i z_i ∂W/∂z_i,      c = c₀ + L z,      L Lᵀ = H⁻¹,      z ~ N(z₀, 1),

where H is the curvature of the likelihood of the calibrations, and z₀ is the remaining step to its
minimum. A load is identified *jointly* with z. The fit uses the information of its record about
Z_th, and about the delay that one known resistor does not determine. It does not evaluate the terms
of the calibrations again, which would take ten times as long. `etid.likelihood.joint.fit` uses the
terms themselves, for many loads at once. Both estimates have the same errors against the truth, but
they are not equal. They may differ by a standard error along the direction that one known resistor
does not determine.

**Errors of the instrument** θ with a tolerance are further common parameters. Several known
resistors tell of them, too. A gain g, a crosstalk κ and a capacitance C change the outputs of a
load (`etid.likelihood.gains`); all but C also change the calibrations. An error
that nobody stated stays 0 in the fit. If it is not 0, the minimum of the calibrations moves,

    ∂z₀/∂θ = −Lᵀ H_cθ,

and the elements with it.

W is linear in all of them but a capacitance C across the only resistor, which moves it by 4 % for
each pF. The data fix the gain of the calibration. With Q = 1 + Z_th/R, u = s R C and v = s δ, where
δ is the change of its delay,

    W = log(Q e^(−v) + u) − log(1 + u) + log R,      ∂²W = u² + 2 u v / Q − u² / Q².
"""

import dataclasses

import equinox as eqx
import numpy as np
from jaxtyping import Complex, Float

from etid.likelihood.calibrations import Calibrations
from etid.likelihood.gains import FAULTS
from etid.likelihood.source_prior import DELAY_WIDTH
from etid.likelihood.unloaded import UnloadedShape, shape_of
from etid.precision import Module, array_function, namespace
from etid.results.driver import ContinuousDriver, HarmonicDriver
from etid.results.instrument import BUDGETED, Instrument
from etid.signals.harmonics import Spectrum
from etid.signals.transfer import AnyArray, as_complex, frequency_variable, reciprocal
from etid.solvers.matrices import inverse_root, root


class InstrumentErrors(Module):
    """Errors of the instrument: those with a tolerance by z, and what the others would change.

    Attributes:
        at: The errors at z = 0 [their standard deviations].
        by_z: Their derivatives; 0 for an error that nobody stated.
        unstated: Changes of z₀ by each error that nobody stated, of the size in `BUDGETED`; 0 for
            the others.
        direct: Sizes of gain, crosstalk and capacitance that nobody stated; 0 for the others.
        drift: Changes of z₀ by a drift of each parameter of Z_th that nobody stated, and by one
            standard deviation of a drift with a tolerance.
        told: The instrument; None without one.
    """

    at: Float[AnyArray, " error"]
    by_z: Float[AnyArray, "z error"]
    unstated: Float[AnyArray, "z error"]
    direct: Float[AnyArray, "3"]
    drift: Float[AnyArray, "z parameter"]
    told: Instrument | None


class GivenDriver(Module):
    """What is given of the feed of the loads: the distribution of Z_th, or a measured current.

    Attributes:
        frequency: The harmonics [Hz]. The harmonics of a load may differ from them by a small
            common factor, because of clocks and of records cut to a whole number of samples.
        loaded: Z_th + R [Ω] at W₀.
        w_slope: ∂W₀/∂ log f.
        slope: ∂W/∂z.
        resistance: R [Ω], the mean of the known resistors.
        mean: z₀.
        cov: Covariance of z, from the noise in the residuals of the calibrations.
        records: The calibrations, if a load may have the unloaded record of one of them.
        gains: Gains of these calibrations.
        gain_slopes: Derivatives of these gains with respect to z.
        shape: Unloaded voltage of the first calibration; None if it cannot be compared.
        delay_width: Prior standard deviation of the trigger delay of a load [samples].
        faults: Gain, crosstalk and capacitance at z = 0 and by z; None if the instrument has no
            tolerances.
        errors: The errors of the instrument; None if they are not known.
        bend: ∂²W by the last of these errors, a capacitance across the only resistor; None if it is
            not needed.
        aside: Distance of the first delay of a search from that of its start [samples].
        by_current: Whether the input is a measured current: the gain is Z_L, and there is no z.
        decays: Those of the states of the driver, for records that are not of whole periods.
        beyond: The same at the nodes of a hold; None if no record needs them.
    """

    frequency: Float[AnyArray, " harmonic"]
    loaded: Complex[AnyArray, " harmonic"]
    w_slope: Complex[AnyArray, " harmonic"]
    slope: Complex[AnyArray, "z harmonic"]
    resistance: Float[AnyArray, ""]
    mean: Float[AnyArray, " z"]
    cov: Float[AnyArray, "z z"]
    records: Spectrum | None
    gains: Complex[AnyArray, "calibration known"] | None
    gain_slopes: Complex[AnyArray, "z calibration known"] | None
    shape: UnloadedShape | None = None
    delay_width: Float[AnyArray, ""] = eqx.field(default_factory=lambda: np.asarray(DELAY_WIDTH))
    faults: tuple[Float[AnyArray, "3"], Float[AnyArray, "z 3"]] | None = None
    errors: InstrumentErrors | None = None
    bend: Complex[AnyArray, " harmonic"] | None = None
    aside: Float[AnyArray, ""] = eqx.field(default_factory=lambda: np.zeros(()))
    by_current: bool = eqx.field(static=True, default=False)
    decays: Complex[AnyArray, "decay harmonic"] | None = None
    beyond: "GivenDriver | None" = None

    @classmethod
    def measured(cls, frequency: Float[AnyArray, " harmonic"]) -> "GivenDriver":
        """The measured current of loads with these harmonics [Hz]."""
        nothing, none = np.zeros(frequency.shape, complex), np.zeros(0)
        return cls(
            frequency=frequency,
            loaded=nothing,
            w_slope=nothing,
            slope=nothing[None][:0],
            resistance=np.zeros(()),
            mean=none,
            cov=np.diag(none),
            records=None,
            gains=None,
            gain_slopes=None,
            by_current=True,
            decays=nothing[None][:0],
        )


@array_function
def given(
    driver: HarmonicDriver, frequency: Float[AnyArray, " harmonic"], shared: bool
) -> GivenDriver:
    """The distribution of Z_th given the calibrations, at the harmonics of the loads [Hz].

    `shared` says whether the unloaded record of a load may be that of a calibration.
    """
    xp = namespace(frequency, driver.source.gain)
    calibrations, told = Calibrations.of(driver), driver.instrument
    c, unknowns = calibrations.start(), calibrations.unknowns
    # Those that nobody stated have a size, too, so that their effects are known.
    every = dataclasses.replace(calibrations, instrument=(told or Instrument()).complete())
    sizes = every.tolerances
    at = xp.concatenate([c[:unknowns], xp.zeros_like(sizes) if told is None else c[unknowns:]])
    near = every.near(at)
    linear = every.linear(near)
    stated = xp.zeros_like(sizes)
    if told is not None:
        stated = xp.where(calibrations.tolerances > 0, 1.0, 0.0)
    free = xp.concatenate([xp.ones(unknowns), stated])[: c.size]
    curvature = linear.curvature().expected
    fixed = xp.diag(1 - free)
    own = curvature[: c.size, : c.size] * free[:, None] * free[None] + fixed
    directions = free[:, None] * inverse_root(own)
    mean = -directions.T @ every.gradient(near, linear)[: c.size]
    along = xp.pad(directions, ((0, at.size - c.size), (0, 0)))
    cov = linear.along(along).curvature().score + fixed
    unstated = -directions.T @ curvature[: c.size, unknowns:] * (1 - stated)[None]
    drift = driver.drift_std(BUDGETED["drift"])
    drift = directions.T @ own[:, : drift.size] * drift[None]
    if driver.drift is not None:  # later changes are further z
        std = driver.drift_std()
        drift = xp.concatenate([xp.zeros_like(drift), xp.eye(std.size)])
        later = xp.pad(xp.diag(std), ((0, c.size - std.size), (0, 0)))
        directions = xp.concatenate([directions, later], axis=1)
        mean, unstated = (
            xp.concatenate([of, xp.zeros((std.size, *of.shape[1:]))]) for of in (mean, unstated)
        )
        cov = xp.pad(cov, (0, std.size)) + np.diag(np.arange(len(cov) + std.size) >= len(cov))
    found = around(calibrations, c, directions, frequency, shared, mean, cov)
    if found.gain_slopes is not None:  # the calibrations tell nothing about later changes
        own = np.arange(len(found.gain_slopes)) < c.size
        gain_slopes = xp.where(own[:, None, None], found.gain_slopes, 0.0)
        found = dataclasses.replace(found, gain_slopes=gain_slopes)
    bend = None
    if told is not None and calibrations.calibration.r_load.size == 1:
        s, resistance = frequency_variable(frequency), calibrations.calibration.r_load[0]
        u = s * as_complex(resistance * sizes[-1])
        v = s * as_complex(every.following(linear)[unknowns - 1, -1] / calibrations.rate)
        inverse = as_complex(resistance) * reciprocal(found.loaded)
        bend = u * u + 2 * u * v * inverse - (u * inverse) ** 2
    by_z = xp.pad(directions[unknowns:].T, ((0, 0), (0, at.size - c.size)))
    errors = InstrumentErrors(
        at[unknowns:], by_z, unstated, ((1 - stated) * sizes)[:FAULTS], drift, told
    )
    return dataclasses.replace(found, shape=shape_of(driver, frequency), errors=errors, bend=bend)


@array_function
def by_covariance(driver: ContinuousDriver, frequency: Float[AnyArray, " harmonic"]) -> GivenDriver:
    """The same of a driver without its calibrations, from its covariance."""
    xp, deviations = namespace(frequency, driver.source.gain), root(driver.later_cov())
    count, rate = driver.calibration.r_load.shape[0], xp.asarray(driver.sample_rate)
    nothing = np.zeros((count, 0))
    none = Spectrum(nothing, 1j * nothing, 1j * nothing, nothing, nothing, nothing > 0)
    calibrations = Calibrations(driver.source, driver.calibration, none, rate)
    common = calibrations.start()
    directions = xp.pad(deviations, ((0, common.size - deviations.shape[0]), (0, 0)))
    size = deviations.shape[1]
    return around(calibrations, common, directions, frequency, False, np.zeros(size), np.eye(size))


@array_function
def around(
    calibrations: Calibrations,
    c: Float[AnyArray, " common"],
    directions: Float[AnyArray, "common z"],
    frequency: Float[AnyArray, " harmonic"],
    shared: bool,
    mean: Float[AnyArray, " z"],
    cov: Float[AnyArray, "z z"],
) -> GivenDriver:
    """A driver around the common parameters c, with z along `directions`; like `given`."""
    source = calibrations.around(c, directions, frequency)
    known = calibrations.calibrated(c, directions) if shared else None
    of = source.tolerances
    return GivenDriver(
        frequency=frequency,
        loaded=source.loaded,
        w_slope=source.w_slope,
        slope=source.by_z,
        resistance=source.resistance,
        mean=mean,
        cov=cov,
        records=calibrations.spectra if shared else None,
        gains=None if known is None else known.gains,
        gain_slopes=None if known is None else known.gains_by_z,
        delay_width=source.delay_width,
        faults=None if of is None else (of.faults, of.faults_by_z),
        decays=source.decays,
    )
