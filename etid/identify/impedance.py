"""Identification of a circuit from its measured impedance: frequency, Z, standard error.

Potentiostats and impedance analysers measure Z itself, without a driver in between. The fit
minimises

    Σ_k |Z(jω_k) − Z_k|² / σ_k²

over the logarithms of the elements. It starts at several corner frequencies that span the data,
each with the best of several impedance levels, and keeps the best minimum. From a single start, two
layers sometimes ended as one.
"""

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
import optimistix as optx
from jaxtyping import Array, Complex, Float

from etid.circuits.circuit import AbstractCircuit
from etid.identify.arguments import circuit_of, require_float64
from etid.numpy_tier.tiers import program
from etid.results.data import MeasuredImpedance, with_data
from etid.results.fit import CHANGES, Fit, IdentificationError, Support, complex_rrse
from etid.results.verdicts import RESULTS, first_verdict, message, verdict
from etid.solvers.levenberg_marquardt import LevenbergMarquardt, best_start
from etid.solvers.matrices import inverse

MAX_STEPS = 500
MISFIT_CHI2 = 1.5  # a standard error of a measured impedance is seldom known to better than 20 %
LEVELS = np.geomspace(0.1, 10.0, 5)  # impedance levels of the starts, relative to the data
CORNERS = 5  # corner frequencies of the starts, from the lowest to the highest frequency
SOLVER = LevenbergMarquardt()


@program
def _fit(
    frequency: Float[Array, " frequency"],
    z: Complex[Array, " frequency"],
    sigma: Float[Array, " frequency"],
    circuit: AbstractCircuit,
    known: bool,
) -> Fit:
    def residual(q: Float[Array, " element"], _) -> Float[Array, " part"]:
        difference = (circuit.with_log_values(q).response(frequency) - z) / sigma.astype(z.dtype)
        return jnp.concatenate([difference.real, difference.imag])

    # If a circuit is scaled in impedance by g and in frequency by t, R becomes R·g, C becomes
    # C/(g t).
    typical, (of_level, of_time) = circuit.log_values(), circuit.scaling()
    size = jnp.log(jnp.median(jnp.abs(z)) / jnp.median(jnp.abs(circuit.response(frequency))))
    slow = of_time > 0
    resistance = typical[jnp.argmax(of_level)]
    times = (typical - of_level * resistance) / jnp.where(slow, of_time, 1.0)
    shortest = jnp.where(slow, times, jnp.inf).min()
    corner = jnp.where(slow.any(), 1 / (2 * jnp.pi * jnp.exp(shortest)), 1.0)  # [Hz], roughly
    corners = jnp.exp(jnp.linspace(jnp.log(frequency.min()), jnp.log(frequency.max()), CORNERS))
    levels = size + jnp.log(jnp.asarray(LEVELS))

    def from_corner(faster: Float[Array, ""]) -> optx.Solution:
        starts = (typical - of_time * faster)[None, :] + levels[:, None] * of_level[None, :]
        q0 = best_start(lambda q: residual(q, None), starts)
        return optx.least_squares(residual, SOLVER, q0, max_steps=MAX_STEPS, throw=False)

    every = jax.lax.map(from_corner, jnp.log(corners / corner))
    likeliest = jnp.nanargmin(every.stats["normal_equations"].objective)
    solution = jax.tree.map(lambda one: one[likeliest], every)
    q = solution.value
    equations = solution.stats["normal_equations"]
    chi2 = 2 * equations.objective / (2 * z.size - q.size)
    scale = jnp.maximum(chi2, 1.0) if known else chi2
    cov = inverse(equations.matrix) * scale
    fitted = circuit.with_log_values(q)
    values = fitted.values()
    settled = RESULTS.promote(solution.result) == verdict("successful")
    return Fit(
        circuit=fitted,
        cov=cov * jnp.outer(values, values),
        shared_cov=jnp.zeros_like(cov),
        rrse=complex_rrse(fitted.response(frequency), z),
        chi2=chi2 if known else jnp.asarray(jnp.nan),
        result=first_verdict(
            (~jnp.isfinite(values).all(), RESULTS.nonphysical),
            (fitted.is_too_steep(cov), RESULTS.nonphysical),
            (~settled, verdict("max_steps_reached")),
            ((chi2 > MISFIT_CHI2) & known, RESULTS.misfit),
            (~(jnp.sqrt(jnp.diagonal(cov)) < 1).all(), RESULTS.insensitive),
        ),
        steps=solution.stats["num_steps"],
        method="impedance",
        support=_support(2 * equations.objective, z.size, q.size) if known else None,
    )


def _support(deviance: Float[Array, ""], values: int, elements: int) -> Support:
    """The likelihood of a fit; no changes of the circuit are tested."""
    nothing = jnp.zeros(())
    return Support(
        deviance, jnp.asarray(2.0 * values), jnp.zeros(CHANGES), nothing, jnp.zeros(elements)
    )


def identify_impedance(
    frequency: npt.ArrayLike,
    impedance: npt.ArrayLike,
    *,
    stderr: float | npt.ArrayLike | None = None,
    circuit: AbstractCircuit | None = None,
    throw: bool = True,
) -> Fit:
    """Identify a circuit from its impedance.

    Args:
        frequency: Frequencies [Hz], > 0.
        impedance: Complex impedance [Ω] at each frequency.
        stderr: Standard error [Ω] of the real and of the imaginary part: one number, or one for
            each frequency. If not given, the fit estimates one number from the residual. χ² is
            then NaN, and the fit cannot detect a wrong circuit.
        circuit: Structure of the circuit; `SkinRC` if not given. Its values matter little.
        throw: Raise an error if the verdict is not successful.

    Returns:
        Elements, standard errors and verdict. `fit.plot()` draws the fit and the measured points.

    Raises:
        ValueError: The shapes of the arrays differ, there are too few impedances for the elements,
            or a number is not finite or not positive where it must be.
        IdentificationError: The verdict is not successful and `throw` is set.
    """
    require_float64()
    circuit = circuit_of(circuit)
    f, z = np.asarray(frequency, float), np.asarray(impedance, complex)
    sigma = np.broadcast_to(np.asarray(1.0 if stderr is None else stderr, float), f.shape)
    if f.ndim != 1 or z.shape != f.shape:
        raise ValueError(
            f"frequency has shape {f.shape} and impedance {z.shape}; both must be (n,)"
        )
    if 2 * f.size <= len(circuit.names()):
        raise ValueError(f"{f.size} impedances cannot determine {len(circuit.names())} elements")
    for name, values in {"frequency": f, "stderr": sigma}.items():
        if not (np.isfinite(values).all() and (values > 0).all()):
            raise ValueError(f"{name} must be finite and > 0 everywhere")
    if not np.isfinite(z).all():
        raise ValueError(f"{np.sum(~np.isfinite(z))} impedances are not finite; leave them out")
    arrays = (jnp.asarray(f), jnp.asarray(z), jnp.asarray(sigma))
    known = MeasuredImpedance(f, z, None if stderr is None else sigma)
    fit = with_data(_fit(*arrays, circuit, stderr is not None), known)
    if throw and fit.verdict != "successful":
        raise IdentificationError(f"impedance: {fit.verdict}. {message(fit.verdict)}", fit)
    return fit
