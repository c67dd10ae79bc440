"""Standard errors of many loads with one driver: the own part of each load, and the shared part.

    cov = H⁻¹ (Jᵀ C J) H⁻¹

is that of `etid.estimators.maximum_likelihood.terms`. For `common` the own parameters of the loads
are eliminated. A load inherits K cov Kᵀ with its slope K = −A⁻¹ B.

**One unloaded record in several loads** has the same noise of X in all of them. The fit takes the
loads as independent, but the standard errors do not. The effect of unit noise in X on the terms of
all loads is propagated to `common` and to each load. The effects are added before they are squared.
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Complex, Float

from etid.estimators.estimate import Estimate
from etid.estimators.joint.terms import DriverStudy, Loads, in_turn
from etid.estimators.maximum_likelihood.load import Around
from etid.estimators.maximum_likelihood.terms import (
    apart,
    excess,
    residual,
    variance,
)
from etid.estimators.sandwich import Curvature, Linear
from etid.estimators.score_tests import other_circuit
from etid.estimators.unknowns import LoadUnknowns
from etid.results.fits import complex_rrse
from etid.signals.harmonics import Spectrum, signal_share
from etid.signals.knots import knots
from etid.solvers.matrices import inverse

_Sums = tuple[Float[Array, "record x common"], Float[Array, "common common"]]


class _Eliminated(eqx.Module):
    """A load whose own parameters are eliminated.

    Attributes:
        rest: Curvature over `common` that remains.
        cov: Covariance of the own parameters at a given `common`.
        slope: Derivative of the minimum over the own parameters with respect to `common`.
        bread: Inverse of the curvature over the own parameters.
    """

    rest: Curvature
    cov: Float[Array, "own own"]
    slope: Float[Array, "own common"]
    bread: Float[Array, "own own"]


class Delay(eqx.Module):
    """The trigger delay of a load and its error; several can be stacked.

    Attributes:
        samples: The delay [samples].
        own_variance: Variance at given common parameters.
        slope: Derivatives with respect to the common parameters.
    """

    samples: Float[Array, "*load"]
    own_variance: Float[Array, "*load"]
    slope: Float[Array, "*load common"]


def estimates(
    study: DriverStudy,
    common: Float[Array, " common"],
    fitted: Sequence[tuple[LoadUnknowns, optx.RESULTS]],
    several: Sequence[int],
    solution: optx.Solution,
) -> tuple[Float[Array, "common common"], list[tuple[Estimate, Bool[Array, " load"], Delay]]]:
    """Covariance of `common`, and the estimates of each group with their covariances.

    For each load it also returns whether the data show another circuit or another gain of V_out
    (`etid.estimators.score_tests.other_circuit`), and its trigger delay.

    Args:
        study: Calibrations and loads.
        common: Common parameters at the minimum.
        fitted: Unknowns of the loads of each group, and the results of their solvers.
        several: Number of unloaded records in each group that several loads share.
        solution: Solution of the joint solver.
    """
    groups, model = study.groups, study.model
    owns = [own for own, _ in fitted]
    found = [
        _of_group(study, loads, common, own, several=count > 0)
        for loads, own, count in zip(groups, owns, several, strict=True)
    ]
    total = model.calibrations.linear(common).curvature()
    for loads, (eliminated, _) in zip(groups, found, strict=True):
        used = jax.tree.map(
            lambda leaf, loads=loads: jnp.where(loads.used[:, None, None], leaf, 0.0).sum(0),
            eliminated.rest,
        )
        total = jax.tree.map(jnp.add, total, used)
    bread = inverse(total.expected)
    sums = [
        _sums(loads, seen.by_x, count, common.size)
        for loads, (_, seen), count in zip(groups, found, several, strict=True)
    ]
    score = total.score + sum((more for _, more in sums), start=jnp.zeros_like(total.score))
    cov = bread @ score @ bread

    strain = model.calibrations.strain(common)
    judged = []
    for loads, (own, results), each, (sums_of, _) in zip(groups, fitted, found, sums, strict=True):

        def one(
            load: Loads,
            own: LoadUnknowns,
            eliminated: _Eliminated,
            seen: _Seen,
            result: optx.RESULTS,
            sums_of: Float[Array, "record x common"] = sums_of,
        ) -> tuple[Estimate, Bool[Array, ""], Delay]:
            shared = eliminated.slope @ cov @ eliminated.slope.T
            private = eliminated.cov
            if seen.by_x is not None:
                by_x, cross = _by_x(load, seen.by_x, sums_of)
                cross = cross @ bread @ eliminated.slope.T
                shared = shared + by_x + cross + cross.T
                private = private - by_x
            whole = private + shared
            estimate = Estimate(
                parameters=own.log_elements,
                delay_samples=own.delay_samples[None],
                cov=_of_elements(whole),
                shared_cov=_of_elements(shared),
                chi2=seen.chi2,
                rrse=seen.rrse,
                result=optx.RESULTS.where(
                    result == optx.RESULTS.successful, solution.result, result
                ),
                steps=solution.stats["num_steps"],
                strain=strain,
            )
            delay = Delay(own.delay_samples, private[-1, -1], eliminated.slope[-1])
            other = _is_another(seen, load, own, eliminated, bread, total.score)
            return estimate, other, delay

        judged.append(in_turn(one, loads, own, *each, results))
    return cov, judged


def _of_elements(cov: Float[Array, "own own"]) -> Float[Array, "element element"]:
    """Covariance of the elements alone, without the delay."""
    return LoadUnknowns.of(LoadUnknowns.of(cov).log_elements.T).log_elements


class _ByX(NamedTuple):
    """Effect of unit noise in the X of a load, which has two numbers at each knot.

    Attributes:
        of_common: On the score of `common`.
        of_own: On the own parameters.
    """

    of_common: Float[Array, "*load x common"]
    of_own: Float[Array, "*load x own"]


class _Seen(NamedTuple):
    """A load at its minimum.

    Attributes:
        chi2: χ² per degree of freedom.
        rrse: Relative root sum of squared errors.
        terms: Terms at the knots, and the priors of the own parameters.
        linear: The same, linear in (common, own).
        changes: Derivatives of the terms with respect to changes of the circuit and to a gain.
        by_x: Effect of the noise of X; None if no load shares its unloaded record.
    """

    chi2: Float[Array, "*load"]
    rrse: Float[Array, "*load"]
    terms: Float[Array, "*load term"]
    linear: Linear
    changes: Float[Array, "*load change term"]
    by_x: _ByX | None


def _of_group(
    study: DriverStudy,
    loads: Loads,
    common: Float[Array, " common"],
    owns: LoadUnknowns,
    several: bool,
) -> tuple[_Eliminated, _Seen]:
    """Each load of a group at its minimum, evaluated once."""
    driver = study.model.around(common, loads.frequency[0])

    def one(load: Loads, own: LoadUnknowns) -> tuple[_Eliminated, _Seen]:
        lane, o = study.lane(driver, load), study.owned
        q = jnp.concatenate([own.vector(), driver.mean])
        g, known = apart(lane.predicted, q)
        part = residual(known, g)
        around = Around.of(lane, q, (g, known))
        linear = _linear(around, known, part, o)
        eliminated = _eliminated(linear, common.size)
        gain = around.at.gain
        priors = (q[:o] - gain.centre(q[:o])) / gain.widths(q[:o])
        rows = around.at.rows(around.by_changes())
        chi2, rrse = _misfit(load, g, part, o)
        seen = _Seen(
            chi2,
            rrse,
            terms=jnp.concatenate([around.part, priors]),
            linear=linear,
            changes=jnp.pad(rows, ((0, 0), (0, o))),  # no change affects the priors
            by_x=_influence(around, known, g, linear, eliminated) if several else None,
        )
        return eliminated, seen

    return in_turn(one, loads, owns)


def _linear(around: Around, known: Spectrum, part: Float[Array, " part"], owned: int) -> Linear:
    """Terms at the knots, linear in (common, own); the last are the priors of the own."""
    jacobian, q = around.jacobian, around.q
    of_own = jnp.diag(1 / around.at.gain.widths(q[:owned]))
    of_priors = jnp.concatenate([jnp.zeros((q.size - owned, owned)), of_own])
    jacobian = jnp.concatenate([jacobian[owned:], jacobian[:owned]])
    jacobian = jnp.concatenate([jacobian, of_priors], axis=1)
    share = signal_share(around.x, known.variance_x)
    noise = excess(part, known.selected)[: share.size]
    means = around.mean(jnp.stack([share, noise]))
    return Linear(jacobian, *jnp.concatenate([means, jnp.ones((2, owned))], axis=1))


def _misfit(
    load: Loads, gain: Complex[Array, " harmonic"], part: Float[Array, " part"], owned: int
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """χ² and RRSE of a load, from its gain and the terms of its recording."""
    spectrum = load.spectrum
    squares = jnp.sum(part**2)
    freedom = 2 * jnp.sum(spectrum.selected, dtype=squares.dtype) - owned
    return squares / freedom, complex_rrse(gain * spectrum.x, spectrum.y, spectrum.selected)


def _is_another(
    seen: _Seen,
    load: Loads,
    own: LoadUnknowns,
    eliminated: _Eliminated,
    bread: Float[Array, "common common"],
    score: Float[Array, "common common"],
) -> Bool[Array, ""]:
    """Score test of one load; `bread` and `score` are those of `common` from all terms."""
    slope, linear = eliminated.slope, seen.linear
    covariance = jnp.block(
        [
            [bread, bread @ slope.T],
            [slope @ bread, eliminated.bread + slope @ bread @ slope.T],
        ]
    )
    spread = jnp.zeros_like(covariance).at[: bread.shape[0], : bread.shape[0]]
    found = other_circuit.scores(
        seen.changes,
        linear,
        seen.terms,
        # At the minimum the other terms have the opposite gradient.
        -linear.jacobian @ seen.terms,
        spread.set(score - eliminated.rest.score),
        covariance,
        slice(bread.shape[0], bread.shape[0] + own.log_elements.size),
    )
    other = other_circuit.Scores.of(found, gain=True)
    # A load that takes no part has its own verdict.
    return (other.seen() | other.has_other_gain()) & load.used


def _eliminated(linear: Linear, c: int) -> _Eliminated:
    """A load whose own parameters are eliminated; they follow the `c` common ones."""
    of = linear.curvature()
    bread = inverse(of.expected[c:, c:])
    slope = -bread @ of.expected[c:, :c]
    cov = bread @ of.score[c:, c:] @ bread
    return _Eliminated(of.eliminate(c), cov, slope, bread)


# --- Loads with one unloaded record --------------------------------------------------------------
#
# All of them have the same noise of V_th. The fit ignores this, but the standard errors account for
# the correlation of the terms. The noise of X has two unit numbers for each harmonic. Their effect
# on the terms is propagated to `common` and to every load.


def _influence(
    around: Around,
    known: Spectrum,
    gain: Complex[Array, " harmonic"],
    linear: Linear,
    eliminated: _Eliminated,
) -> _ByX:
    """Effect of unit noise in X on the score of `common`, and on the own parameters."""
    jacobian, g = linear.jacobian.T, around.slopes.gain
    size = knots(gain.size).at(jnp.sqrt(known.variance_x / variance(known, gain)))
    re, im = g.real * size, g.imag * size
    real, imaginary = jacobian[: g.size], jacobian[g.size : 2 * g.size]
    by_x = jnp.concatenate(
        [
            re[:, None] * real + im[:, None] * imaginary,
            re[:, None] * imaginary - im[:, None] * real,
        ]
    )
    c = jacobian.shape[1] - eliminated.bread.shape[0]
    return _ByX(by_x[:, :c] + by_x[:, c:] @ eliminated.slope, by_x[:, c:] @ eliminated.bread)


def _sums(loads: Loads, by_x: _ByX | None, records: int, common: int) -> _Sums:
    """Sum of the effects of each shared record on the score of `common`.

    The second result is the covariance of the score that this correlation adds.
    """
    if by_x is None:
        return jnp.zeros((0, 0, common)), jnp.zeros((common, common))
    takes_part = loads.used & (loads.unloaded >= 0)
    mine = jnp.where(takes_part[:, None, None], by_x.of_common, 0.0)
    sums = jnp.zeros((records, *mine.shape[1:])).at[loads.unloaded].add(mine)
    alone = jnp.einsum("lxc,lxd->cd", mine, mine)
    return sums, jnp.einsum("rxc,rxd->cd", sums, sums) - alone


def _by_x(
    load: Loads, by_x: _ByX, sums: Float[Array, "record x common"]
) -> tuple[Float[Array, "own own"], Float[Array, "own common"]]:
    """Covariance of the own parameters of a load by the noise of a shared X.

    The second result is their covariance with the effect of this noise on the score of `common`
    through the other loads.
    """
    others = sums[load.unloaded] - jnp.where(load.used, by_x.of_common, 0.0)
    several = load.unloaded >= 0
    return (
        jnp.where(several, by_x.of_own.T @ by_x.of_own, 0.0),
        jnp.where(several, by_x.of_own.T @ others, 0.0),
    )
