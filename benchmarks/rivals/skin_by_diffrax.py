"""diffrax's periodic response of `etid.SkinCurrent`: `python -m ... PROBLEM RESULT`.

Its methods are those of its documentation for stiff equations and for narrow tolerances, with step
sizes by a PID controller and derivatives by forward mode. A current source is a formula, the best
case of a solver that chooses its own times. V_th is known at times only; between them it is SciPy's
cubic spline, which is far more exact than diffrax's Hermite polynomials. `benchmarks.amplitudes`
makes the problem. RESULT gets for each method the voltage [V], the processor times of it alone and
with its derivatives with respect to the logarithms, and the wall time of both first calls [s].
"""

import time

import diffrax  # pyright: ignore[reportMissingImports]  # see lmfit_leastsq
import jax
import jax.numpy as jnp
import numpy as np
from scipy.interpolate import CubicSpline

from benchmarks.rivals import serve

REPEATS = 7
LONGEST = 1 / 80  # step, of a period: a longer one would step over a pulse


def by_current(given):
    """Start, derivatives and voltage under a current source."""
    times, height, width = given["edges"], float(given["height"]), float(given["width"])

    def current(t):
        steps = jax.scipy.special.erf((t - times) / width) / 2
        return height * (steps[0] - 2 * steps[1] + steps[2])

    def slope(t, state, elements):
        _, r_p, c_p, i_0 = elements
        (u,) = state
        return ((current(t) - u / (r_p * (1 - jnp.abs(u) / (r_p * i_0)))) / c_p,)

    def voltage(t, state, elements):
        return state[0] + elements[0] * jax.vmap(current)(t)

    return (jnp.zeros(()),), slope, voltage


def by_driver(given):
    """The same behind a resistance and an inductance."""
    period, r, inductance = (float(given[name]) for name in ("period", "resistance", "inductance"))
    v_th = np.append(given["v_th"], given["v_th"][0])
    at = np.linspace(0, period, v_th.size)
    spline = CubicSpline(at, v_th, bc_type="periodic").c
    source = diffrax.CubicInterpolation(jnp.asarray(at), tuple(map(jnp.asarray, spline)))

    def slope(t, state, elements):
        r_s, r_p, c_p, i_0 = elements
        u, drop = state  # of the resistance of the driver, so that all states are volts
        i = drop / r
        through = u / (r_p * (1 - jnp.abs(u) / (r_p * i_0)))
        return (i - through) / c_p, (source.evaluate(t) - u - (r + r_s) * i) * r / inductance

    def voltage(t, state, elements):
        return state[0] + elements[0] * state[1] / r

    return (jnp.zeros(()), jnp.zeros(())), slope, voltage


def response(given, method, tolerance):
    """The voltage as a function of the logarithms of the elements."""
    start, slope, voltage = (by_driver if "v_th" in given else by_current)(given)
    period, at = float(given["period"]), jnp.asarray(given["t"])
    term = diffrax.ODETerm(slope)

    def solved(state, elements, saved):
        return diffrax.diffeqsolve(
            term,
            getattr(diffrax, method)(),
            0.0,
            period,
            period * 1e-4,
            state,
            args=elements,
            saveat=saved,
            stepsize_controller=diffrax.PIDController(
                rtol=tolerance, atol=tolerance, dtmax=LONGEST * period
            ),
            max_steps=1 << 16,
            adjoint=diffrax.ForwardMode(),
        ).ys

    def predicted(logs):
        elements, state = jnp.exp(logs), start
        for _ in range(int(given["periods"]) - 1):
            state = jax.tree.map(lambda y: y[-1], solved(state, elements, diffrax.SaveAt(t1=True)))
        return voltage(at, solved(state, elements, diffrax.SaveAt(ts=at)), elements)

    return predicted


def timed(function, logs):
    """Value, wall time of the first call, and median processor time of the next ones [s]."""
    begin = time.perf_counter()
    value = np.asarray(function(logs))
    first, runs = time.perf_counter() - begin, []
    for _ in range(REPEATS):
        begin = time.process_time()
        jax.block_until_ready(function(logs))
        runs.append(time.process_time() - begin)
    return value, first, float(np.median(runs))


def solved(given):
    jax.config.update("jax_enable_x64", True)
    logs, rows = jnp.asarray(given["logs"]), []
    for method, tolerance in zip(given["methods"], given["tolerances"], strict=True):
        alone = response(given, str(method), float(tolerance))
        value, first, seconds = timed(jax.jit(alone), logs)
        _, also, slopes = timed(jax.jit(jax.jacfwd(alone)), logs)
        rows.append((value, seconds, slopes, first + also))
    return dict(zip(("voltage", "seconds", "slopes", "first"), zip(*rows, strict=True),
                    strict=True))  # fmt: skip


if __name__ == "__main__":
    serve(solved)
