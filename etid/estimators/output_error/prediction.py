"""Terminal voltage predicted from the recorded V_th, and its difference from the recorded V_out.

The loaded driver is a continuous-time system. It is simulated exactly for band-limited samples
(`etid.signals.filtering`), so discretisation causes no error at the sample rate of the recorder.
The nuisances are the state at the start of the record, an offset of V_out and its trigger delay.

**Noise on both records.** The residual r = V_out_predicted − V_out contains the noise of V_out and
the noise of V_th filtered by the loaded driver G. For white noise its variance is

    s(θ) = σ_out² Σ k² + σ_th² Σ h²,

where k is the impulse response of the interpolation, and h that of the interpolation followed by G.
The minimum of Σ r²/s(θ) is consistent, because E Σ r² = |noise-free misfit|² + N s(θ). The minimum
of Σ r² alone is not consistent: at 30 dB it gives a Z_th of −90 kΩ.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from etid.estimators.unknowns import Nuisance
from etid.results.feed import CurrentSource, SourceImpedance, loaded
from etid.signals.filtering import CUTOFF, TAPS, StateSpace, band_limited, hold, shiftable, simulate
from etid.signals.noise import Measurement
from etid.signals.transfer import Rational

IMPULSE = 256  # length of the impulse response whose squares are summed [samples]


class Records(eqx.Module):
    """Data of a recording for one fit: the interpolated V_th, the measured V_out, their noise.

    Attributes:
        hold: Polynomial coefficients of the band-limited V_th.
        v_out: Measured voltage [V] as polynomials of a delay, filtered like V_th.
        sigma_th: Noise of V_th [V].
        sigma_out: Noise of V_out [V].
        sample_rate: Sampling rate [Hz].
        used: 1 for the intervals of the record, 0 for padding to a common length.
    """

    hold: Float[Array, "interval degree"]
    v_out: Float[Array, "interval shift"]
    sigma_th: Float[Array, ""]
    sigma_out: Float[Array, ""]
    sample_rate: Float[Array, ""]
    used: Float[Array, " interval"]

    @property
    def intervals(self) -> Float[Array, ""]:
        """Number of used intervals."""
        return self.used.sum()


def prepare(
    m: Measurement, cutoff: float = CUTOFF, samples: Int[Array, ""] | int | None = None
) -> Records:
    """The interpolated V_th of a recording, without the edges, where samples are missing.

    `cutoff` is that of `filtering.band_limited`. Padding follows after `samples`, if given.
    """
    held, delayed = band_limited(m.v_th, cutoff), shiftable(m.v_out, cutoff)
    rows = jnp.arange(held.shape[0])
    last = held.shape[0] if samples is None else samples - 2 * TAPS + 1
    used = (rows < last).astype(held.dtype)
    return Records(held, delayed, m.sigma_th, m.sigma_out, jnp.asarray(m.sample_rate), used)


def loaded_filter(
    source: SourceImpedance | CurrentSource,
    load: Rational | StateSpace,
    sample_rate: Float[Array, ""],
) -> StateSpace:
    """Discrete filter from the interpolated V_th to V_out."""
    return hold(loaded(source, load, sample_rate), sample_rate)


def predict(system: StateSpace, records: Records, nuisance: Nuisance) -> Float[Array, " interval"]:
    """Terminal voltage [V]."""
    return simulate(system, records.hold, nuisance.state)[0] + nuisance.offset


def measured(records: Records, delay_samples: Float[Array, ""]) -> Float[Array, " interval"]:
    """Measured voltage at the sampling times of V_th [V]; it was sampled `delay_samples` late.

    50 ns between the triggers of two records are 0.01 samples and cause a spread of 8 % in R_s.
    """
    late = -delay_samples
    value = records.v_out[:, -1]
    for k in range(records.v_out.shape[1] - 2, -1, -1):  # Horner
        value = value * late + records.v_out[:, k]
    return value


class StateScale(eqx.Module):
    """Unknowns η that stand for the state at the start of a record, so that all are determined.

    A record does not determine all states of a ladder of relaxations: together they would be
    singular to 1e-16. Before the record, each has seen a current like that of the record, for as
    long. This is the prior of a state, with a standard deviation of 1 for η. The directions of η
    are orthogonal in their effects on the record.

    Attributes:
        directions: State for each η.
        known: Precision of the prior of each η; 0 for the states of the source, which have none.
    """

    directions: Float[Array, "state state"]
    known: Float[Array, " state"]

    def state_of(self, nuisance: Nuisance) -> Nuisance:
        """The nuisances with the state, from those with η."""
        return eqx.tree_at(lambda one: one.state, nuisance, self.directions @ nuisance.state)

    def eta_of(self, nuisance: Nuisance) -> Nuisance:
        """The inverse of `state_of`."""
        state = jnp.linalg.solve(self.directions, nuisance.state)
        return eqx.tree_at(lambda one: one.state, nuisance, state)


def state_scale(
    records: Records, source: SourceImpedance | CurrentSource, load: Rational | StateSpace
) -> StateScale:
    """The unknowns of a loaded ladder; for a ratio of polynomials they are the state itself."""
    system = loaded(source, load, records.sample_rate)
    if isinstance(load, Rational):
        return StateScale(jnp.eye(system.C.size), jnp.zeros(system.C.size))
    count = load.C.size
    first, zero = system.C.size - count, jnp.zeros(())
    largest = jnp.max(jnp.abs(records.hold[:, 0]) * records.used)
    least = records.sample_rate / records.intervals
    rate = jnp.maximum(jnp.abs(jnp.diagonal(system.A)), least)
    width = (jnp.abs(system.B[:, 0]) * largest / rate)[first:]

    def effect(state: Float[Array, " state"]) -> Float[Array, " interval"]:
        both = jnp.concatenate([jnp.zeros(first), width * state])
        return scaled_residual(records, source, load, Nuisance(both, zero, zero))

    effects = jax.jacfwd(effect)(jnp.zeros(count))
    turned = jnp.linalg.svd(jnp.linalg.qr(effects)[1])[2].T
    directions = jax.scipy.linalg.block_diag(jnp.eye(first), width[:, None] * turned)
    return StateScale(directions, (jnp.arange(system.C.size) >= first).astype(width.dtype))


def impulse_response(system: StateSpace) -> Float[Array, " lag"]:
    """Response h of the loaded driver to one sample of V_th, including the interpolation."""
    return simulate(system, impulse(), jnp.zeros_like(system.C))[0]


def impulse() -> Float[Array, "lag degree"]:
    """One sample of noise of V_th, interpolated."""
    return band_limited(jnp.zeros(IMPULSE + 2 * TAPS).at[2 * TAPS].set(1.0))


def measured_impulse() -> Float[Array, "lag shift"]:
    """One sample of noise of V_out, as a function of the delay."""
    return shiftable(jnp.zeros(IMPULSE + 2 * TAPS).at[2 * TAPS].set(1.0))


def residual_variance(records: Records, h: Float[Array, " lag"]) -> Float[Array, ""]:
    """Variance s = σ_out² Σ k² + σ_th² Σ h² of the residual [V²]."""
    k = impulse()[:, 0]
    return records.sigma_out**2 * jnp.sum(k**2) + records.sigma_th**2 * jnp.sum(h**2)


def _times(load: Rational | StateSpace, factor: Float[Array, ""]) -> Rational | StateSpace:
    """The load with its impedance multiplied by a factor."""
    if isinstance(load, Rational):
        return Rational(factor * load.num, load.den)
    return StateSpace(load.A, load.B, factor * load.C, factor * load.D)


class Change(eqx.Module):
    """Derivatives of terminal voltage [V] and impulse response with respect to a small change.

    Several changes are stacked along a last axis.
    """

    v_out: Float[Array, "interval *change"]
    h: Float[Array, "lag *change"]


def scaled_residual(
    records: Records,
    source: SourceImpedance | CurrentSource,
    load: Rational | StateSpace,
    nuisance: Nuisance,
    change: Change | None = None,
) -> Float[Array, " interval"]:
    """(Predicted − measured) / √s; `change` is added to the prediction."""
    return residual_and_response(records, source, load, nuisance, change)[0]


def residual_and_response(
    records: Records,
    source: SourceImpedance | CurrentSource,
    load: Rational | StateSpace,
    nuisance: Nuisance,
    change: Change | None = None,
) -> tuple[Float[Array, " interval"], Float[Array, " lag"]]:
    """`scaled_residual` and the impulse response."""
    system = loaded_filter(source, load, records.sample_rate)
    predicted, h = predict(system, records, nuisance), impulse_response(system)
    if change is not None:
        predicted, h = predicted + change.v_out, h + change.h
    scale = records.used / jnp.sqrt(residual_variance(records, h))
    return (predicted - measured(records, nuisance.delay_samples)) * scale, h


def late_calibration(
    records: Records,
    source: SourceImpedance | CurrentSource,
    load: Rational | StateSpace,
    r_load: Float[Array, ""],
    x0: Float[Array, " state"],
) -> Change:
    """Derivatives with respect to the delay of the calibration, without the part that is a delay.

    A calibration with R_L that is late by τ yields Z_th + sτ (R_L + Z_th) in place of Z_th. To
    first order in τ, no record with this R_L can separate the two. A load Z_L then has the total

        Z_L + Z_th + sτ (R_L + Z_th) = (1 + sτ) (Z_L + Z_th) + sτ (R_L − Z_L).

    The first part is a delay, which the skin's own delay absorbs. The second is an excess
    impedance; this function returns the derivatives with respect to it. They are 0 for a measured
    current, which has no calibration. `x0` is the state of the loaded driver at the start.
    """
    if isinstance(source, CurrentSource):
        return Change(jnp.zeros_like(records.v_out[:, 0]), jnp.zeros(IMPULSE + 1))
    system = loaded(source, load, records.sample_rate)
    x0_rate = (system.A @ x0 + system.B[:, 0] * records.hold[0, 0]) / records.sample_rate

    def rate(hold: Float[Array, "interval c"]) -> Float[Array, "interval c"]:  # per sample
        steps = jnp.arange(1.0, hold.shape[1])
        return jnp.pad(hold[:, 1:] * steps[None, :], ((0, 0), (0, 1)))

    # Replacing Z_th by Z_th + ε (R_L − Z_L) equals replacing R by R + ε R_L and Z_L by (1 − ε) Z_L,
    # except for a factor of V_out, which belongs to the delay.
    def excess(epsilon: Float[Array, ""]) -> tuple[Float[Array, " interval"], Float[Array, " lag"]]:
        shifted = jnp.log(jnp.exp(source.log_resistance) + epsilon * r_load)
        altered = eqx.tree_at(lambda z: z.log_resistance, source, shifted)
        reduced = _times(load, 1 - epsilon)
        filtered = loaded_filter(altered, reduced, records.sample_rate)
        v_out = simulate(filtered, rate(records.hold), x0_rate)[0]
        return v_out, simulate(filtered, rate(impulse()), jnp.zeros_like(x0_rate))[0]

    return Change(*jax.jvp(excess, (jnp.zeros(()),), (jnp.ones(()),))[1])
