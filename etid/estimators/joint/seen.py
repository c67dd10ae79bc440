"""A load of a joint fit at its minimum: what standard errors and tests need of its records.

Terms are linear in (common, own); the last terms are the priors of the own parameters. Those of the
records are condensed (`etid.estimators.maximum_likelihood.condensed`).
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from etid.estimators.joint.terms import DriverStudy, Loads, Own
from etid.estimators.maximum_likelihood.condensed import means
from etid.estimators.maximum_likelihood.given_driver import GivenDriver
from etid.estimators.maximum_likelihood.load import Load, changes
from etid.estimators.sandwich import Linear
from etid.signals.harmonics import signal_share
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

    The noise has two numbers at each knot. A caller that does not use its effect does not compute
    it.

    Args:
        study: All data of the fit.
        driver: The driver at the minimum.
        load: One of the loads.
        own: Unknowns of the load.
    """
    lane, q = study.lane(driver, load), jnp.concatenate([own.vector(), driver.mean])
    near, records, o = lane.near(q), lane.known(q), lane.gains.owned
    profile, condensed = near.profile, near.condensed
    noise = profile.excess(records)
    share = jnp.broadcast_to(signal_share(profile.x, records.variance_x), noise.shape)
    of_noise = means([profile], lane.knots, jnp.stack([share, noise]))
    linear = _linear(lane, q, o, near.jacobian, of_noise)
    rows = _padded(condensed.rows(changes(lane, near)), o)
    seen = Seen(
        chi2=2 * profile.objective / (lane.terms - o),
        rrse=profile.rrse(records, load.spectrum.x),
        terms=jnp.concatenate([condensed.part, lane.rest(q[:o])]),
        linear=linear,
        changes=rows,
        by_scale=linear.told(rows[-1:])[0] if lane.gains.outputs > 1 else jnp.zeros_like(q),
    )
    brought = profile.whitened(profile.gains * as_complex(jnp.sqrt(records.variance_x))[None, :])
    brought = brought * as_complex(1 / jnp.sqrt(profile.expected))
    return seen, _by_noise(linear, lane.knots.at(brought))


def _padded(rows: Float[Array, "change part"], owned: int) -> Float[Array, "change term"]:
    """Rows of all terms: no change affects the priors."""
    return jnp.pad(rows, ((0, 0), (0, owned)))


def _linear(
    lane: Load,
    q: Float[Array, " q"],
    owned: int,
    jacobian: Float[Array, "q part"],
    of_noise: Float[Array, "2 part"],
) -> Linear:
    """Terms, linear in (common, own), from their derivatives in (own, common)."""
    of_own = jnp.diag(1 / lane.gains.widths(q[:owned]))
    of_priors = jnp.concatenate([jnp.zeros((q.size - owned, owned)), of_own])
    jacobian = jnp.concatenate([jacobian[owned:], jacobian[:owned]])
    jacobian = jnp.concatenate([jacobian, of_priors], axis=1)
    return Linear(jacobian, *jnp.concatenate([of_noise, jnp.ones((2, owned))], axis=1))


def _by_noise(linear: Linear, gains: Complex[Array, "output x"]) -> Float[Array, "both parameter"]:
    """Effect of unit noise on the gradient, if `gains` bring it into the terms of each output."""
    outputs, size = gains.shape
    jacobian = linear.jacobian[:, : 2 * gains.size].reshape(-1, 2, outputs, size)
    real, imaginary = jacobian[:, 0], jacobian[:, 1]
    re, im = gains.real[None], gains.imag[None]
    both = re * real + im * imaginary, re * imaginary - im * real
    return jnp.concatenate([of.sum(1).T for of in both])
