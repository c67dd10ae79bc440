"""Standard errors of many loads with one driver: the own part of each load, and the shared part.

    cov = H⁻¹ (Jᵀ C J) H⁻¹

is that of `etid.likelihood.sandwich`. For `common` the own parameters of the loads are eliminated.
A load inherits K cov Kᵀ with its slope K = −A⁻¹ B.

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
from etid.estimators.joint.terms import Joint, Loads, in_turn
from etid.estimators.maximum_likelihood import load_fit
from etid.estimators.maximum_likelihood.condensed import means
from etid.estimators.maximum_likelihood.given_driver import GivenDriver
from etid.estimators.maximum_likelihood.load import changes
from etid.estimators.score_tests import other_circuit
from etid.estimators.unknowns import LoadUnknowns
from etid.likelihood.sandwich import Curvature, Linear
from etid.signals.harmonics import signal_share
from etid.signals.transfer import as_complex
from etid.solvers.matrices import inverse
from etid.solvers.successive import Minimum


class _AtMinimum(NamedTuple):
    """A load at its minimum; the derivatives are those with respect to (common, own).

    Attributes:
        chi2: χ² per degree of freedom.
        rrse: RRSE; with a current that of the record that is predicted worse.
        terms: Condensed terms of the records.
        linear: The same, linear in the parameters.
        changes: Derivatives of the terms with respect to changes of the circuit, to a gain of
            V_out, and to a gain of the current if there is one.
    """

    chi2: Float[Array, "*load"]
    rrse: Float[Array, "*load"]
    terms: Float[Array, "*load term"]
    linear: Linear
    changes: Float[Array, "*load change term"]


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


class _ByX(NamedTuple):
    """Effect of unit noise in the X of a load, which has two numbers at each of its places.

    Attributes:
        of_common: On the score of `common`.
        of_own: On the own parameters.
    """

    of_common: Float[Array, "*load x common"]
    of_own: Float[Array, "*load x own"]


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


class Found(NamedTuple):
    """What is found of a load; several can be stacked.

    Attributes:
        estimate: The estimate.
        other: Whether the data show another circuit or another gain of V_out.
        scale: Whether they show another scale of the current, or contradict the tolerances of the
            instrument.
        delay: Its trigger delay.
        by_error: Changes of the logarithms of the elements with the prior mean of each error of the
            instrument.
    """

    estimate: Estimate
    other: Bool[Array, "*load"]
    scale: Bool[Array, "*load"]
    delay: Delay
    by_error: Float[Array, "*load element error"]


def estimates(
    model: Joint,
    groups: Sequence[Loads],
    common: Float[Array, " common"],
    fitted: Sequence[tuple[LoadUnknowns, optx.RESULTS]],
    several: Sequence[int],
    least: Minimum,
) -> tuple[Float[Array, "common common"], list[Found]]:
    """Covariance of `common`, and the estimates of each group with their covariances.

    `fitted` has the unknowns of the loads of each group and the results of their solvers, `several`
    the number of unloaded records in each group that several loads share.
    """
    owns = [own for own, _ in fitted]
    found = [
        _of_group(model, loads, common, own, several=count > 0)
        for loads, own, count in zip(groups, owns, several, strict=True)
    ]
    of = model.calibrations
    total = of.linear(of.near(common)).curvature()
    for loads, (eliminated, *_) in zip(groups, found, strict=True):
        used = jax.tree.map(
            lambda leaf, loads=loads: jnp.where(loads.used[:, None, None], leaf, 0.0).sum(0),
            eliminated.rest,
        )
        total = jax.tree.map(jnp.add, total, used)
    bread = inverse(total.expected)
    score = total.score
    for loads, (*_, by_x), count in zip(groups, found, several, strict=True):
        if by_x is not None:
            score = score + _correlated(loads, by_x, count)
    cov = bread @ score @ bread

    strain = of.strain(common)
    beyond = load_fit.beyond(of.errors(common), of.errors(jnp.diagonal(bread)))
    judged = []
    for loads, (own, results), each in zip(groups, fitted, found, strict=True):

        def one(
            load: Loads,
            own: LoadUnknowns,
            eliminated: _Eliminated,
            at: _AtMinimum,
            by_x: _ByX | None,
            result: optx.RESULTS,
        ) -> Found:
            private, shared = eliminated.cov, eliminated.slope @ cov @ eliminated.slope.T
            whole = private + shared
            if by_x is not None:  # its correlation with `common` makes less than 3 % of an error
                of_x = jnp.where(load.unloaded >= 0, by_x.of_own.T @ by_x.of_own, 0.0)
                private, shared = private - of_x, shared + of_x
            other = _scores(at, load, own, eliminated, bread, total.score)
            likely, doubt = other.doubt()
            e = own.log_elements.size
            estimate = Estimate(
                parameters=own.log_elements,
                delay_samples=own.vector()[e:],
                cov=whole[:e, :e] + doubt,
                shared_cov=shared[:e, :e] + doubt,
                chi2=at.chi2,
                rrse=at.rrse,
                result=optx.RESULTS.where(result == optx.RESULTS.successful, least.result, result),
                steps=least.points,
                strain=strain,
                doubtful=likely,
            )
            delay = Delay(own.delay_samples, private[e, e], eliminated.slope[e])
            width = of.delay_width
            late = load_fit.beyond(own.delay_samples / width, whole[e, e] / width**2)
            by_error = of.errors(eliminated.slope[:e] @ bread)
            # A load that takes no part has its own verdict.
            wrong = other.misfit & load.used
            inconsistent = beyond | ((other.inconsistent | late) & load.used)
            return Found(estimate, wrong, inconsistent, delay, by_error)

        judged.append(in_turn(one, loads, own, *each, results))
    return cov, judged


def _of_group(
    model: Joint,
    loads: Loads,
    common: Float[Array, " common"],
    owns: LoadUnknowns,
    several: bool,
) -> tuple[_Eliminated, _AtMinimum, _ByX | None]:
    """Each load of a group at its minimum, evaluated once."""
    driver = model.around(common, loads.frequency[0])

    def one(load: Loads, own: LoadUnknowns) -> tuple[_Eliminated, _AtMinimum, _ByX | None]:
        at, by_x = _at_minimum(model, driver, load, own)
        eliminated = _eliminated(at, common.size)
        return eliminated, at, _influence(by_x, eliminated) if several else None

    return in_turn(one, loads, owns)


def _at_minimum(
    model: Joint, driver: GivenDriver, load: Loads, own: LoadUnknowns
) -> tuple[_AtMinimum, Float[Array, "x parameter"]]:
    """A load at its minimum, and the effect of unit noise in its X on the gradient.

    The noise has two numbers at each knot. A caller that does not use its effect does not compute
    it.
    """
    lane, q = load.behind(driver, model), jnp.concatenate([own.vector(), driver.mean])
    near, records, owned = lane.near(q), lane.known(q), lane.gains.owned
    profile, condensed = near.profile, near.condensed
    noise = profile.excess(records)
    share = jnp.broadcast_to(signal_share(profile.x, records.variance_x), noise.shape)
    weights = means([profile], lane.knots, jnp.stack([share, noise]))
    priors = jnp.eye(q.size, owned, owned - q.size) / lane.gains.widths(q[:owned])[None]
    jacobian = jnp.concatenate([near.jacobian[owned:], near.jacobian[:owned]])
    linear = Linear(jacobian, *weights, priors=priors)
    at = _AtMinimum(
        chi2=2 * profile.objective / (lane.terms - owned),
        rrse=profile.rrse(records, load.spectrum.x),
        terms=condensed.part,
        linear=linear,
        changes=condensed.rows(jnp.concatenate(list(changes(lane, near).values()))),
    )
    brought = profile.whitened(profile.gains * as_complex(jnp.sqrt(records.variance_x))[None, :])
    brought = brought * as_complex(1 / jnp.sqrt(profile.expected))
    return at, _by_noise(linear, lane.knots.at(brought))


def _by_noise(linear: Linear, gains: Complex[Array, "output x"]) -> Float[Array, "both parameter"]:
    """Effect of unit noise on the gradient, if `gains` bring it into the terms of each output."""
    outputs, size = gains.shape
    jacobian = linear.jacobian.reshape(-1, 2, outputs, size)
    real, imaginary = jacobian[:, 0], jacobian[:, 1]
    re, im = gains.real[None], gains.imag[None]
    both = re * real + im * imaginary, re * imaginary - im * real
    return jnp.concatenate([of.sum(1).T for of in both])


def _scores(
    at: _AtMinimum,
    load: Loads,
    own: LoadUnknowns,
    eliminated: _Eliminated,
    bread: Float[Array, "common common"],
    score: Float[Array, "common common"],
) -> other_circuit.Scores:
    """What a load shows of another circuit, and of faults of its outputs.

    `bread` and `score` are those of `common` from all terms.
    """
    slope, linear = eliminated.slope, at.linear
    covariance = jnp.block(
        [
            [bread, bread @ slope.T],
            [slope @ bread, eliminated.bread + slope @ bread @ slope.T],
        ]
    )
    spread = jnp.zeros_like(covariance).at[: bread.shape[0], : bread.shape[0]]
    fitted = other_circuit.Fitted(
        # At the minimum the other terms have the opposite gradient.
        -linear.jacobian @ at.terms,
        spread.set(score - eliminated.rest.score) + linear.precision,
        covariance,
        slice(bread.shape[0], bread.shape[0] + own.log_elements.size),
    )
    found = other_circuit.scores(at.changes, linear, at.terms, fitted)
    return other_circuit.Scores.of(found, 0 if load.current is None else 1)


def _eliminated(at: _AtMinimum, c: int) -> _Eliminated:
    """A load whose own parameters are eliminated; they follow the `c` common ones."""
    of = at.linear.curvature()
    bread = inverse(of.expected[c:, c:])
    slope = -bread @ of.expected[c:, :c]
    cov = bread @ of.score[c:, c:] @ bread
    return _Eliminated(of.eliminate(c), cov, slope, bread)


# --- Loads with one unloaded record --------------------------------------------------------------
#
# All of them have the same noise of V_th. The fit ignores this, but the standard errors account for
# the correlation of the terms. The noise of X has two unit numbers for each harmonic. Their effect
# on the terms is propagated to `common` and to every load.


def _influence(by_x: Float[Array, "x parameter"], eliminated: _Eliminated) -> _ByX:
    """Effect of unit noise in X on the score of `common`, and on the own parameters."""
    c = by_x.shape[1] - eliminated.bread.shape[0]
    return _ByX(by_x[:, :c] + by_x[:, c:] @ eliminated.slope, by_x[:, c:] @ eliminated.bread)


def _correlated(loads: Loads, by_x: _ByX, records: int) -> Float[Array, "common common"]:
    """Covariance of the score of `common` that several loads with one X add."""
    takes_part = loads.used & (loads.unloaded >= 0)
    mine = jnp.where(takes_part[:, None, None], by_x.of_common, 0.0)
    sums = jnp.zeros((records, *mine.shape[1:])).at[loads.unloaded].add(mine)
    alone = jnp.einsum("lxc,lxd->cd", mine, mine)
    return jnp.einsum("rxc,rxd->cd", sums, sums) - alone
