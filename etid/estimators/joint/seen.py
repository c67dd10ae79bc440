"""A load of a joint fit at its minimum: what standard errors and tests need of its records.

Terms are linear in (common, own); the last terms are the priors of the own parameters. Those of
V_th and V_out are taken at the knots (`etid.signals.knots`), those with a current at all harmonics.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from etid.estimators.joint.terms import DriverStudy, Loads, Own
from etid.estimators.maximum_likelihood import with_current
from etid.estimators.maximum_likelihood.given_driver import GivenDriver
from etid.estimators.maximum_likelihood.load import Around, Load
from etid.estimators.maximum_likelihood.terms import apart, excess, residual, variance
from etid.estimators.maximum_likelihood.with_current import LoadWithCurrent
from etid.estimators.sandwich import Linear
from etid.results.fit import complex_rrse
from etid.signals.harmonics import Spectrum, signal_share
from etid.signals.knots import knots
from etid.signals.transfer import as_complex


class Seen(NamedTuple):
    """A load at its minimum; several can be stacked.

    Attributes:
        chi2: χ² per degree of freedom.
        rrse: RRSE; with a current that of the record that is predicted worse.
        terms: Terms of the records, and the priors of the own parameters.
        linear: The same, linear in (common, own).
        changes: Derivatives of the terms with respect to changes of the circuit, to a gain of
            V_out, and to a gain of the current if there is one.
        by_scale: Pull of a measured current that is larger by its own size on the parameters; 0
            without a current.
    """

    chi2: Float[Array, "*load"]
    rrse: Float[Array, "*load"]
    terms: Float[Array, "*load term"]
    linear: Linear
    changes: Float[Array, "*load change term"]
    by_scale: Float[Array, "*load parameter"]


def seen_at(
    study: DriverStudy, driver: GivenDriver, load: Loads, own: Own
) -> tuple[Seen, Float[Array, "x parameter"]]:
    """A load at its minimum, and the effect of unit noise in its X on the gradient.

    The noise has two numbers at each knot, or at each harmonic. A caller that does not use its
    effect does not compute it.

    Args:
        study: All data of the fit.
        driver: The driver at the minimum.
        load: One of the loads.
        own: Unknowns of the load.
    """
    lane, q = study.lane(driver, load), jnp.concatenate([own.vector(), driver.mean])
    if isinstance(lane, LoadWithCurrent):
        return _with_current(lane, driver, q)
    return _voltages(lane, load.spectrum, q)


def _voltages(
    lane: Load, spectrum: Spectrum, q: Float[Array, " q"]
) -> tuple[Seen, Float[Array, "x parameter"]]:
    """A load whose V_th and V_out were recorded."""
    o = lane.gain.owned
    g, known = apart(lane.predicted, q)
    part = residual(known, g)
    around = Around.of(lane, q, (g, known))
    noise = excess(part, known.selected)[: g.size]
    means = around.mean(jnp.stack([signal_share(around.x, known.variance_x), noise]))
    linear = _linear(lane, q, o, around.jacobian, means)
    chi2, rrse = _misfit(spectrum, g, part, o)
    seen = Seen(
        chi2,
        rrse,
        terms=jnp.concatenate([around.part, _rest(lane, q[:o])]),
        linear=linear,
        changes=_padded(around.at.rows(around.by_changes()), o),
        by_scale=jnp.zeros_like(q),
    )
    size = knots(g.size).at(jnp.sqrt(known.variance_x / variance(known, g)))
    return seen, _by_noise(linear, 0, around.slopes.gain * as_complex(size))


def _with_current(
    lane: LoadWithCurrent, driver: GivenDriver, q: Float[Array, " q"]
) -> tuple[Seen, Float[Array, "x parameter"]]:
    """A load whose current was recorded too."""
    seen, o = apart(lane.seen, q), lane.elements + 2
    true, (g, h), part = seen.true_x(), seen.gains, seen.parts()
    jacobian = apart(lambda q: seen.scaled(lane.slopes(q, true.x)), q)
    share = jnp.tile(signal_share(true.x, true.variance_x), 4)
    selected = jnp.stack([seen.first.selected, seen.second.selected])
    noise = jax.vmap(excess)(part, selected).ravel()
    linear = _linear(lane, q, o, jacobian, jnp.stack([share, noise]))
    changes = seen.scaled(with_current.changes(lane, driver, q, seen, true.x))[:-1]
    changes = _padded(changes, o)
    # Where Y tells more of X than X itself, the noise of X hardly affects the term of the current.
    first, of_y = seen.first, variance(seen.first, g)
    by_y = g * as_complex(jnp.sqrt(first.variance_x / of_y))
    left = first.variance_y / of_y * jnp.sqrt(first.variance_x / variance(seen.second, h))
    by_x = _by_noise(linear, 0, by_y) + _by_noise(linear, 2 * g.size, h * as_complex(left))
    squares = jnp.sum(part**2)
    found = Seen(
        chi2=squares / (4 * jnp.sum(first.selected, dtype=squares.dtype) - o),
        rrse=lane.rrse(seen),
        terms=jnp.concatenate([part.ravel(), _rest(lane, q[:o])]),
        linear=linear,
        changes=changes,
        by_scale=linear.told(changes[-1:])[0],
    )
    return found, by_x


def _misfit(
    spectrum: Spectrum, gain: Complex[Array, " harmonic"], part: Float[Array, " part"], owned: int
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """χ² and RRSE of a load, from its gain and the terms of its recording."""
    squares = jnp.sum(part**2)
    freedom = 2 * jnp.sum(spectrum.selected, dtype=squares.dtype) - owned
    return squares / freedom, complex_rrse(gain * spectrum.x, spectrum.y, spectrum.selected)


def _rest(lane: Load | LoadWithCurrent, own: Float[Array, " own"]) -> Float[Array, " own"]:
    """Terms of the priors of the own parameters."""
    return (own - lane.centre(own)) / lane.widths(own)


def _padded(rows: Float[Array, "change part"], owned: int) -> Float[Array, "change term"]:
    """Rows of all terms: no change affects the priors."""
    return jnp.pad(rows, ((0, 0), (0, owned)))


def _linear(
    lane: Load | LoadWithCurrent,
    q: Float[Array, " q"],
    owned: int,
    jacobian: Float[Array, "q part"],
    of_noise: Float[Array, "2 part"],
) -> Linear:
    """Terms, linear in (common, own), from their derivatives in (own, common)."""
    of_own = jnp.diag(1 / lane.widths(q[:owned]))
    of_priors = jnp.concatenate([jnp.zeros((q.size - owned, owned)), of_own])
    jacobian = jnp.concatenate([jacobian[owned:], jacobian[:owned]])
    jacobian = jnp.concatenate([jacobian, of_priors], axis=1)
    return Linear(jacobian, *jnp.concatenate([of_noise, jnp.ones((2, owned))], axis=1))


def _by_noise(
    linear: Linear, first: int, gain: Complex[Array, " x"]
) -> Float[Array, "both parameter"]:
    """Effect of unit noise on the gradient, if `gain` brings it into the terms from `first` on."""
    jacobian = linear.jacobian.T[first : first + 2 * gain.size]
    real, imaginary = jacobian[: gain.size], jacobian[gain.size :]
    re, im = gain.real[:, None], gain.imag[:, None]
    return jnp.concatenate([re * real + im * imaginary, re * imaginary - im * real])
