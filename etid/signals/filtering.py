"""Differentiable discrete-time filters, and continuous systems driven by band-limited samples.

All functions here evaluate one recursion,

    x[n+1] = A x[n] + B u[n],      y[n] = C x[n] + D u[n],

in blocks of `BLOCK` samples. Inside a block the response is a product with a lower triangular
Toeplitz matrix. Between blocks a scan carries the state. This takes 30-100 times fewer sequential
steps than a scan over samples, and it can be differentiated in forward and in reverse mode.

**Band-limited hold.** The usual discretisations of a continuous-time system assume that its input
is constant, linear or Tustin-warped between samples. At 200 kHz Tustin alone biases the skin's C_p
by 9 %. Here the input between two samples is the band-limited interpolation of its neighbours (a
Kaiser-windowed sinc). It is written as a polynomial

    v((n + τ) / fs) = Σ_k c_k[n] τ^k,      0 ≤ τ ≤ 1,

whose coefficients depend on the data alone. The state then advances exactly,

    x[n+1] = e^{A/fs} x[n] + Σ_k Γ_k c_k[n],      Γ_k = ∫ e^{A (1−τ)/fs} B τ^k dτ / fs,

with all Γ_k from one matrix exponential (Van Loan 1978).

**Precision.** Driver and skin in modal blocks have rounding errors of 3e-16 of the peak in double
precision at 200 kHz to 2 MHz, and of 3e-7 in single precision. Single precision is therefore enough
to simulate them. The same system as a quotient of polynomials has rounding errors of 1e-5 in double
precision at 2 MHz. In single precision it overflows from 1 MHz on.
"""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float

from etid.precision import Module, in_turn, namespace
from etid.signals.transfer import AnyArray

BLOCK = 32  # samples; a larger block costs more in the Toeplitz product and less in the scan
TAPS = 24  # samples of the interpolation kernel on each side of an interval
CUTOFF = 0.35  # cutoff of the interpolation as a fraction of the sample rate
DEGREE = 7  # degree of the interpolating polynomial inside one interval


class StateSpace(Module):
    """A linear system; each function that takes one says whether it is continuous or discrete."""

    A: Float[AnyArray, "state state"]
    B: Float[AnyArray, "state input"]
    C: Float[AnyArray, " state"]
    D: Float[AnyArray, " input"]


def simulate(
    system: StateSpace,
    u: Float[AnyArray, "*input_row time input"],
    x0: Float[AnyArray, "*state_row state"],
) -> tuple[Float[AnyArray, "*row time"], Float[AnyArray, "*row state"]]:
    """Run the discrete recursion x[n+1] = A x[n] + B u[n], y[n] = C x[n] + D u[n].

    Rows of inputs and of initial states are broadcast against each other.
    """
    A, B, C, D = system.A, system.B, system.C, system.D
    xp, states = namespace(A, B, C, D, u, x0), C.shape[0]
    *rows, time, inputs = u.shape
    every = np.broadcast_shapes(rows, np.shape(x0)[:-1])
    x0 = xp.broadcast_to(xp.asarray(x0), (*every, states))
    blocks, rest = divmod(time, BLOCK)

    powers = xp.eye(states, dtype=A.dtype)[None]  # A^0 … A^BLOCK by doubling
    top = A
    while powers.shape[0] < BLOCK:
        powers = xp.concatenate([powers, powers @ top])
        top = top @ top
    observed = xp.einsum("s,ksr->kr", C, powers)  # C A^k
    impulse = xp.concatenate([D[None], observed[:-1] @ B])  # h[0] = D, h[k] = C A^{k-1} B
    lag = np.arange(BLOCK)[:, None] - np.arange(BLOCK)[None, :]
    impulse = xp.pad(impulse, ((0, 1), (0, 0)))  # h[BLOCK] stands for h[k] with k < 0
    toeplitz = xp.take(impulse, np.where(lag >= 0, lag, BLOCK), axis=0, mode="clip")
    reach = xp.einsum("ksr,ri->ksi", powers[::-1], B)  # A^{BLOCK-1-k} B

    whole = u[..., : blocks * BLOCK, :].reshape(*rows, blocks, BLOCK, inputs)
    forced = xp.einsum("ijm,...bjm->...bi", toeplitz, whole)
    kicks = xp.moveaxis(xp.einsum("jsm,...bjm->...bs", reach, whole), -2, 0)
    kicks = kicks.reshape(blocks, *[1] * (len(every) - len(rows)), *rows, states)

    starts, x = (_recur if xp is np else _carry)(top, x0, kicks)
    free = xp.moveaxis(starts @ observed.T, 0, -2)
    y = (forced + free).reshape(*every, -1)
    if rest:
        tail = u[..., blocks * BLOCK :, :]
        y_tail = xp.einsum("ijm,...jm->...i", toeplitz[:rest, :rest], tail) + x @ observed[:rest].T
        y = xp.concatenate([y, y_tail], -1)
        x = x @ powers[rest].T + xp.einsum("jsm,...jm->...s", reach[BLOCK - rest :], tail)
    return y, x


def _recur(
    a: Float[AnyArray, "state state"],
    x0: Float[AnyArray, "*row state"],
    u: Float[AnyArray, "time *#row state"],
) -> tuple[Float[AnyArray, "time *row state"], Float[AnyArray, "*row state"]]:
    """States of x[n+1] = a x[n] + u[n] before every step, and the state after the last step."""
    if namespace(a, x0, u) is np:
        states = np.empty((u.shape[0], *x0.shape))
        for step, of in enumerate(u):
            states[step] = x0
            x0 = x0 @ a.T + of
        return states, x0

    def advance(
        x: Float[Array, "*row state"], u: Float[Array, "*#row state"]
    ) -> tuple[Float[Array, "*row state"], Float[Array, "*row state"]]:
        # Not `a @ x`: for several x at once, such as derivatives, XLA calls a library each step.
        return jnp.sum(a * x[..., None, :], axis=-1) + u, x

    x, states = jax.lax.scan(advance, x0, u)
    return states, x


@jax.custom_jvp
def _carry(
    a: Float[Array, "state state"],
    x0: Float[Array, "*row state"],
    u: Float[Array, "time *#row state"],
) -> tuple[Float[Array, "time *row state"], Float[Array, "*row state"]]:
    """`_recur` with its own derivative: the same recursion, driven by du + da x.

    The derivative that JAX makes forms da x step by step inside its scan. That costs six times as
    much.
    """
    return _recur(a, x0, u)


@_carry.defjvp
def _carry_jvp(
    primals: tuple[Array, Array, Array], tangents: tuple[Array, Array, Array]
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    (a, _, _), (da, dx0, du) = primals, tangents
    states, last = _carry(*primals)
    return (states, last), _recur(a, dx0, du + states @ da.T)


def companion(b: Float[AnyArray, " b"], a: Float[AnyArray, " a"]) -> StateSpace:
    """Transposed direct form II of B(z⁻¹)/A(z⁻¹); its state is SciPy's `zi`."""
    xp, order = namespace(b, a), max(b.shape[0], a.shape[0]) - 1
    b = xp.pad(b, (0, order + 1 - b.shape[0])) / a[0]
    a = xp.pad(a, (0, order + 1 - a.shape[0])) / a[0]
    shift = xp.eye(order, k=1, dtype=a.dtype)
    first = xp.eye(1, order, dtype=a.dtype)
    return StateSpace(
        A=shift - a[1:, None] * first,
        B=(b[1:] - a[1:] * b[0])[:, None],
        C=first[0],
        D=b[:1],
    )


def lfilter(
    b: Float[Array, " b"],
    a: Float[Array, " a"],
    x: Float[Array, " time"],
    zi: Float[Array, " order"] | None = None,
) -> tuple[Float[Array, " time"], Float[Array, " order"]]:
    """Filter `x` by the difference equation of `scipy.signal.lfilter`.

    a[0] y[n] = b[0] x[n] + … + b[M] x[n−M] − a[1] y[n−1] − … − a[N] y[n−N]

    Args:
        b: Numerator coefficients in powers of z⁻¹.
        a: Denominator coefficients in powers of z⁻¹, `a[0] ≠ 0`.
        x: Input.
        zi: Initial state, as SciPy defines it; zero if not given.

    Returns:
        The output and the final state.
    """
    if max(b.shape[0], a.shape[0]) == 1:
        return b[0] / a[0] * x, jnp.zeros(0, x.dtype)
    system = companion(b, a)
    zi = jnp.zeros(system.C.shape[0], x.dtype) if zi is None else zi
    return simulate(system, x[:, None], zi)


def from_rest(
    b: Float[AnyArray, " b"], a: Float[AnyArray, " a"], x: Float[AnyArray, "*record time"]
) -> Float[AnyArray, "*record time"]:
    """`lfilter` from a state of 0, of several records at once."""
    if namespace(a, b, x) is np:
        return scipy.signal.lfilter(b, a, x)
    each = jax.vmap(lambda one: lfilter(b, a, one)[0])(x.reshape(-1, x.shape[-1]))
    return each.reshape(x.shape)


@functools.cache
def _interpolation_kernel(cutoff: float, earliest: float, degree: int) -> np.ndarray:
    """Weights of the neighbours n−TAPS+1 … n+TAPS as polynomials in τ on [earliest, 1]."""
    points = np.polynomial.chebyshev.chebpts1(4 * degree)
    nodes = earliest + (1 - earliest) * (points + 1) / 2
    distance = nodes[:, None] - np.arange(-TAPS + 1, TAPS + 1)[None, :]
    window = np.i0(10.0 * np.sqrt(np.maximum(0.0, 1 - (distance / TAPS) ** 2))) / np.i0(10.0)
    values = 2 * cutoff * np.sinc(2 * cutoff * distance) * window
    return np.polynomial.polynomial.polyfit(nodes, values, degree).T


def band_limited(
    v: Float[AnyArray, " time"], cutoff: float = CUTOFF
) -> Float[AnyArray, "interval degree"]:
    """Polynomial coefficients of the band-limited interpolation of `v` in every interval.

    Row i belongs to the interval that starts at sample `TAPS − 1 + i`. There is a row for each
    interval whose `2·TAPS` neighbours all lie inside the record: `time − 2·TAPS + 1` rows.

    Args:
        v: Samples.
        cutoff: Cutoff of the interpolation as a fraction of the sample rate. Fits use the default:
            it excludes the aliases that an imperfect anti-alias filter lets through.
    """
    return _interpolate(v, _interpolation_kernel(cutoff, 0.0, DEGREE))


def shiftable(
    v: Float[AnyArray, " time"], cutoff: float = CUTOFF
) -> Float[AnyArray, "interval degree"]:
    """Polynomial coefficients of every sample as a function of a time shift τ.

    v((n + τ) / fs) = Σ_k c_k[n] τ^k for −1 ≤ τ ≤ 1. The rows are those of `band_limited`.

    Args:
        v: Samples.
        cutoff: As in `band_limited`.
    """
    return _interpolate(v, _interpolation_kernel(cutoff, -1.0, 10))  # it spans two intervals


def _interpolate(
    v: Float[AnyArray, " time"], weights: Float[np.ndarray, "tap degree"]
) -> Float[AnyArray, "interval degree"]:
    xp, rows = namespace(v), v.shape[0] - 2 * TAPS + 1
    neighbours = xp.stack([v[j : j + rows] for j in range(2 * TAPS)])
    return neighbours.T @ xp.asarray(weights, v.dtype)


def _expm(matrix: Float[AnyArray, "n n"]) -> Float[AnyArray, "n n"]:
    """Matrix exponential by a Taylor series of the scaled matrix and repeated squaring.

    `jax.scipy.linalg.expm` compiles a solver for each of its five Padé orders. It compiles three
    times as long as this function.
    """
    xp = namespace(matrix)
    norm = xp.abs(matrix).sum(0).max()
    # At a norm of 0.2, the eleventh term of the series is 1e-16.
    squarings = xp.ceil(xp.log2(xp.maximum(norm / 0.2, 1.0)))
    unit = xp.eye(matrix.shape[0], dtype=matrix.dtype)
    small = matrix * xp.exp2(-squarings)

    # Horner's rule for e^M − 1 instead of e^M, so that terms much smaller than 1 are not lost.
    def term(total: Float[AnyArray, "n n"], k: AnyArray) -> Float[AnyArray, "n n"]:
        return small @ (unit + total) / k

    def square(total: Float[AnyArray, "n n"], k: AnyArray) -> Float[AnyArray, "n n"]:
        return xp.where(k < squarings, 2 * total + total @ total, total)

    orders = np.arange(10, 0, -1, dtype=matrix.dtype)
    total = in_turn(term, xp.zeros_like(matrix), [orders])
    return unit + in_turn(square, total, [np.arange(32, dtype=matrix.dtype)])


def hold(system: StateSpace, sample_rate: float | Float[AnyArray, ""]) -> StateSpace:
    """Discretise a single-input continuous system for inputs given by `band_limited`."""
    xp, states = namespace(system.A, system.B, sample_rate), system.A.shape[0]
    both = xp.concatenate([system.A, system.B], axis=1) / sample_rate
    chain = xp.eye(DEGREE + 1, states + DEGREE + 1, k=states + 1, dtype=both.dtype)
    exponential = _expm(xp.concatenate([xp.pad(both, ((0, 0), (0, DEGREE))), chain]))
    factorials = np.array([math.factorial(k) for k in range(DEGREE + 1)], system.A.dtype)
    return StateSpace(
        A=exponential[:states, :states],
        B=exponential[:states, states:] * factorials[None, :],
        C=system.C,
        D=xp.pad(system.D, (0, DEGREE)),
    )
