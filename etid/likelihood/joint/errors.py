"""Standard errors of many loads with one driver: the own part of each load, and the shared part.

    cov = H⁻¹ (Jᵀ C J) H⁻¹

is that of `etid.likelihood.sandwich`. For `common` the own parameters of the loads are eliminated.
A load inherits K cov Kᵀ with its slope K = −A⁻¹ B.

**One unloaded record in several loads** has the same noise of X in all of them. The fit takes the
loads as independent, but the standard errors do not. The effect of unit noise in X on the terms of
all loads is propagated to `common` and to each load. The effects are added before they are squared.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from etid.likelihood import scores
from etid.likelihood.calibrations import Calibrations
from etid.likelihood.joint.loads import Loads
from etid.likelihood.linear import inverse
from etid.likelihood.load import Near
from etid.likelihood.noise import excess
from etid.likelihood.profile import rrse
from etid.precision import array_function
from etid.signals.harmonics import signal_share
from etid.signals.transfer import AnyArray, as_complex


class AtMinimum(NamedTuple):
    """Loads of one length at their minima; `own` parameters come before the common ones.

    Attributes:
        chi2: χ² per degree of freedom.
        rrse: RRSE of the output that is predicted worst.
        jacobian: Derivatives of the condensed terms.
        share: Share of signal in each term.
        noise: Variance of each term.
        terms: The terms.
        precision: What the priors tell of the parameters.
        rows: Derivatives of the terms with respect to each change that is tested.
        by_x: Effect on the gradient of unit noise in X, of two numbers for each knot.
    """

    chi2: Float[np.ndarray, " load"]
    rrse: Float[np.ndarray, " load"]
    jacobian: Float[np.ndarray, "load parameter term"]
    share: Float[np.ndarray, "load term"]
    noise: Float[np.ndarray, "load term"]
    terms: Float[np.ndarray, "load term"]
    precision: Float[np.ndarray, "load parameter parameter"]
    rows: Mapping[str, Float[np.ndarray, "load change term"]]
    by_x: Float[np.ndarray, "load x parameter"]

    @property
    def expected(self) -> Float[np.ndarray, "load parameter parameter"]:
        """Curvature of each load."""
        return self._product(self.share)

    @property
    def score(self) -> Float[np.ndarray, "load parameter parameter"]:
        """Covariance of the gradient of each load."""
        return self._product(self.noise)

    def _product(self, weight: Float[np.ndarray, "load term"]) -> AnyArray:
        weighted = self.jacobian * weight[:, None, :]
        return weighted @ self.jacobian.swapaxes(1, 2) + self.precision


class Eliminated(NamedTuple):
    """Loads whose own parameters are eliminated.

    Attributes:
        rest: Curvature over `common` that remains.
        score: Covariance of the gradient over `common`.
        cov: Covariance of the own parameters at a given `common`.
        slope: Derivatives of the minimum over the own parameters with respect to `common`.
        bread: Inverse of the curvature over the own parameters.
        x_by_common: Effect of unit noise in X on the gradient over `common`.
        x_by_own: The same on the own parameters.
    """

    rest: Float[np.ndarray, "load common common"]
    score: Float[np.ndarray, "load common common"]
    cov: Float[np.ndarray, "load own own"]
    slope: Float[np.ndarray, "load own common"]
    bread: Float[np.ndarray, "load own own"]
    x_by_common: Float[np.ndarray, "load x common"]
    x_by_own: Float[np.ndarray, "load x own"]

    @classmethod
    def of(cls, at: AtMinimum, own: int) -> "Eliminated":
        """The loads; the first `own` parameters are their own."""
        h, m = at.expected, at.score
        bread = inverse(h[:, :own, :own])
        slope = -bread @ h[:, :own, own:]
        back, mixed = slope.swapaxes(1, 2), m[:, own:, :own] @ slope
        score = m[:, own:, own:] + mixed + mixed.swapaxes(1, 2) + back @ m[:, :own, :own] @ slope
        rest = h[:, own:, own:] + h[:, own:, :own] @ slope
        first, others = at.by_x[..., :own], at.by_x[..., own:]
        by_x = others + first @ slope, first @ bread
        return cls(rest, score, bread @ m[:, :own, :own] @ bread, slope, bread, *by_x)


@array_function
def at_minimum(
    of: Calibrations,
    common: Float[np.ndarray, " common"],
    loads: Loads,
    owns: Float[np.ndarray, "load own"],
) -> AtMinimum:
    """Loads of one length at their minima."""
    unit = np.eye(common.size)
    source = of.around(common, unit, loads.frequency)
    known = None if loads.same is None else of.calibrated(common, unit)

    def few(loads: Loads, owns: AnyArray) -> AtMinimum:
        load, own = loads.behind(source, known), owns.shape[1]
        q = np.concatenate([owns, np.zeros((len(owns), common.size))], 1)
        near, records = Near.of(load, load.gains.at(load.knots.index), q), load.known(q)
        profile, condensed = near.profile, near.condensed
        share, noise = (
            signal_share(profile.x, records.variance_x),
            excess(profile.squares, records.used),
        )
        values = np.stack([np.broadcast_to(share[:, None], noise.shape), noise], 1)
        means = condensed.means([profile], load.knots, values)
        changes = scores.changes(load, near)
        brought = profile.whitened(profile.gains * np.sqrt(records.variance_x)[:, None])
        brought = load.knots.at(brought * as_complex(1 / np.sqrt(profile.expected)))
        jacobian = near.jacobian
        return AtMinimum(
            chi2=2 * profile.objective / (records.terms - own),
            rrse=rrse(load.records, profile),
            jacobian=jacobian,
            share=means[:, 0],
            noise=means[:, 1],
            terms=condensed.part,
            precision=np.broadcast_to(load.told(q).matrix, (*q.shape, q.shape[-1])),
            rows={name: condensed.rows(change) for name, change in changes.items()},
            by_x=by_noise(jacobian, brought),
        )

    parts = [few(some, owns[rows]) for rows, some in loads.parts()]
    return jax.tree.map(lambda *each: np.concatenate(each), *parts)


def by_noise(
    jacobian: Float[np.ndarray, "load parameter term"],
    gains: Complex[AnyArray, "load output knot"],
) -> Float[np.ndarray, "load x parameter"]:
    """Effect of unit noise on the gradient, if `gains` bring it into the terms of each output."""
    parts = jacobian.reshape(*jacobian.shape[:2], 2, *gains.shape[1:])
    real, imaginary = parts[:, :, 0], parts[:, :, 1]
    re, im = gains.real[:, None], gains.imag[:, None]
    both = re * real + im * imaginary, re * imaginary - im * real
    return np.concatenate([of.sum(2) for of in both], -1).swapaxes(1, 2)


class Common(NamedTuple):
    """The common parameters at the minimum.

    Attributes:
        values: The parameters.
        bread: Inverse of their curvature from all terms.
        score: Covariance of the gradient, if no two loads share an unloaded record.
        cov: Covariance of the parameters.
    """

    values: Float[np.ndarray, " common"]
    bread: Float[np.ndarray, "common common"]
    score: Float[np.ndarray, "common common"]
    cov: Float[np.ndarray, "common common"]

    @classmethod
    def of(
        cls,
        calibrations: Calibrations,
        values: Float[np.ndarray, " common"],
        groups: Sequence[Loads],
        each: Sequence[Eliminated],
    ) -> "Common":
        """Those of calibrations and of loads whose own parameters are eliminated."""
        total = calibrations.linear(calibrations.near(values)).curvature()
        expected, score, more = total.expected, total.score, 0.0
        for loads, found in zip(groups, each, strict=True):
            expected = expected + found.rest[loads.used].sum(0)
            score = score + found.score[loads.used].sum(0)
            both = loads.used & (loads.unloaded >= 0)
            more = more + correlated(found.x_by_common[both], loads.unloaded[both])
        bread = inverse(expected)
        return cls(values, bread, score, bread @ (score + more) @ bread)


def correlated(
    x_by_common: Float[np.ndarray, "load x common"], unloaded: Int[np.ndarray, " load"]
) -> Float[np.ndarray, "common common"]:
    """Covariance of the gradient over `common` that loads with the same unloaded records add."""
    alone = np.tensordot(x_by_common, x_by_common, ([0, 1], [0, 1]))
    whole = np.zeros_like(alone)
    for record in np.unique(unloaded):
        together = x_by_common[unloaded == record].sum(0)
        whole += together.T @ together
    return whole - alone


def tested(
    at: AtMinimum,
    found: Eliminated,
    used: Bool[np.ndarray, " load"],
    common: Common,
    elements: int,
) -> dict[str, scores.Scores]:
    """What each load shows of another circuit, and of faults of its outputs.

    The terms of loads that take part are `used` in `common`.
    """
    slope, own = found.slope, found.bread.shape[1]
    mixed = slope @ common.bread
    whole = np.empty_like(at.expected)
    whole[:, :own, :own] = found.bread + mixed @ slope.swapaxes(1, 2)
    whole[:, :own, own:], whole[:, own:, :own] = mixed, mixed.swapaxes(1, 2)
    whole[:, own:, own:] = common.bread
    spread = at.precision.copy()
    spread[:, own:, own:] += common.score - np.where(used[:, None, None], found.score, 0.0)
    # At the minimum the other terms have the opposite gradient.
    pull = -(at.jacobian @ at.terms[..., None])[..., 0]
    pull[~used, own:] = 0.0
    of = at.jacobian, at.share, at.noise, at.terms, pull, spread, whole
    return scores.of_changes(scores.Linear(*of), at.rows, elements)
