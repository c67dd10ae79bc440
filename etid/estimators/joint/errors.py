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
        in_turn(lambda load, own: _eliminated(study, load, common, own), loads, own)
        for loads, own in zip(groups, owns, strict=True)
    ]
    total = model.calibrations.linear(common).curvature()
    for loads, eliminated in zip(groups, found, strict=True):
        used = jax.tree.map(
            lambda leaf, loads=loads: jnp.where(loads.used[:, None, None], leaf, 0.0).sum(0),
            eliminated.rest,
        )
        total = jax.tree.map(jnp.add, total, used)
    bread = inverse(total.expected)
    lanes = list(zip(groups, owns, found, several, strict=True))
    sums = [_sums(study, common, *lane) for lane in lanes]
    score = total.score + sum((more for _, more in sums), start=jnp.zeros_like(total.score))
    cov = bread @ score @ bread

    strain = model.calibrations.strain(common)
    judged = []
    for (loads, own, eliminated, records), (sums_of, _), (_, results) in zip(
        lanes, sums, fitted, strict=True
    ):

        def one(
            load: Loads,
            own: LoadUnknowns,
            eliminated: _Eliminated,
            result: optx.RESULTS,
            records: int = records,
            sums_of: Float[Array, "record x common"] = sums_of,
        ) -> tuple[Estimate, Bool[Array, ""], Delay]:
            seen = _seen(study, load, common, own)
            chi2, rrse = _misfit(study, load, seen)
            shared = eliminated.slope @ cov @ eliminated.slope.T
            private = eliminated.cov
            if records:
                by_x, cross = _by_x(study, common, load, own, eliminated, sums_of)
                cross = cross @ bread @ eliminated.slope.T
                shared = shared + by_x + cross + cross.T
                private = private - by_x
            whole = private + shared
            estimate = Estimate(
                parameters=own.log_elements,
                delay_samples=own.delay_samples[None],
                cov=_of_elements(whole),
                shared_cov=_of_elements(shared),
                chi2=chi2,
                rrse=rrse,
                result=optx.RESULTS.where(
                    result == optx.RESULTS.successful, solution.result, result
                ),
                steps=solution.stats["num_steps"],
                strain=strain,
            )
            delay = Delay(own.delay_samples, private[-1, -1], eliminated.slope[-1])
            other = _is_another(seen, load, own, eliminated, bread, total.score)
            return estimate, other, delay

        judged.append(in_turn(one, loads, own, eliminated, results))
    return cov, judged


def _of_elements(cov: Float[Array, "own own"]) -> Float[Array, "element element"]:
    """Covariance of the elements alone, without the delay."""
    return LoadUnknowns.of(LoadUnknowns.of(cov).log_elements.T).log_elements


class _Seen(NamedTuple):
    """A load at its minimum.

    Attributes:
        gain: Gain.
        known: The recording with the X that the calibrations estimate.
        part: Terms of the recording.
        around: The recording at the knots.
        linear: Terms at the knots, linear in (common, own); the last are the priors of the own.
    """

    gain: Complex[Array, " harmonic"]
    known: Spectrum
    part: Float[Array, " part"]
    around: Around
    linear: Linear


def _seen(
    study: DriverStudy, load: Loads, common: Float[Array, " common"], own: LoadUnknowns
) -> _Seen:
    """A load at its minimum; what the caller does not use is not computed."""
    driver = study.model.around(common, load.spectrum.frequency)
    q, o = jnp.concatenate([own.vector(), driver.mean]), study.owned
    lane = study.lane(driver, load)
    g, known = apart(lane.predicted, q)
    part = residual(known, g)
    around = Around.of(lane, q, (g, known))
    of_own = jnp.diag(1 / lane.gain.widths(q[:o]))
    of_priors = jnp.concatenate([jnp.zeros((common.size, o)), of_own])
    jacobian = jnp.concatenate([around.jacobian[o:], around.jacobian[:o]])
    jacobian = jnp.concatenate([jacobian, of_priors], axis=1)
    share = signal_share(around.x, known.variance_x)
    noise = excess(part, known.selected)[: g.size]
    means = around.mean(jnp.stack([share, noise]))
    linear = Linear(jacobian, *jnp.concatenate([means, jnp.ones((2, o))], axis=1))
    return _Seen(g, known, part, around, linear)


def _misfit(
    study: DriverStudy, load: Loads, seen: _Seen
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """χ² and RRSE of a load."""
    spectrum = load.spectrum
    squares = jnp.sum(seen.part**2)
    freedom = 2 * jnp.sum(spectrum.selected, dtype=squares.dtype) - study.owned
    error = complex_rrse(seen.gain * spectrum.x, spectrum.y, spectrum.selected)
    return squares / freedom, error


def _is_another(
    seen: _Seen,
    load: Loads,
    own: LoadUnknowns,
    eliminated: _Eliminated,
    bread: Float[Array, "common common"],
    score: Float[Array, "common common"],
) -> Bool[Array, ""]:
    """Score test of one load; `bread` and `score` are those of `common` from all terms."""
    slope, around = eliminated.slope, seen.around
    q, gain = own.vector(), around.at.gain
    terms = jnp.concatenate([around.part, (q - gain.centre(q)) / gain.widths(q)])
    rows = around.at.rows(around.by_changes())
    covariance = jnp.block(
        [
            [bread, bread @ slope.T],
            [slope @ bread, eliminated.bread + slope @ bread @ slope.T],
        ]
    )
    spread = jnp.zeros_like(covariance).at[: bread.shape[0], : bread.shape[0]]
    found = other_circuit.scores(
        jnp.pad(rows, ((0, 0), (0, q.size))),  # no change affects the priors
        seen.linear,
        terms,
        # At the minimum the other terms have the opposite gradient.
        -seen.linear.jacobian @ terms,
        spread.set(score - eliminated.rest.score),
        covariance,
        slice(bread.shape[0], bread.shape[0] + own.log_elements.size),
    )
    other = other_circuit.Scores.of(found, gain=True)
    # A load that takes no part has its own verdict.
    return (other.seen() | other.has_other_gain()) & load.used


def _eliminated(
    study: DriverStudy, load: Loads, common: Float[Array, " common"], own: LoadUnknowns
) -> _Eliminated:
    """A load whose own parameters are eliminated; they follow the `common` ones."""
    of, c = _seen(study, load, common, own).linear.curvature(), common.shape[0]
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
    study: DriverStudy,
    common: Float[Array, " common"],
    load: Loads,
    own: LoadUnknowns,
    eliminated: _Eliminated,
) -> tuple[Float[Array, "x common"], Float[Array, "x own"]]:
    """Effect of unit noise in X on the score of `common`, and on the own parameters."""
    seen = _seen(study, load, common, own)
    known, every = seen.known, knots(seen.gain.size)
    jacobian, g = seen.linear.jacobian.T, seen.around.slopes.gain
    size = every.at(jnp.sqrt(known.variance_x / variance(known, seen.gain)))
    re, im = g.real * size, g.imag * size
    real, imaginary = jacobian[: g.size], jacobian[g.size : 2 * g.size]
    by_x = jnp.concatenate(
        [
            re[:, None] * real + im[:, None] * imaginary,
            re[:, None] * imaginary - im[:, None] * real,
        ]
    )
    c = common.shape[0]
    return by_x[:, :c] + by_x[:, c:] @ eliminated.slope, by_x[:, c:] @ eliminated.bread


def _sums(
    study: DriverStudy,
    common: Float[Array, " common"],
    loads: Loads,
    owns: LoadUnknowns,
    found: _Eliminated,
    records: int,
) -> _Sums:
    """Sum of the effects of each shared record on the score of `common`.

    The second result is the covariance of the score that this correlation adds.
    """
    c = common.shape[0]
    start = (
        jnp.zeros((records, 2 * knots(loads.spectrum.x.shape[1]).index.size, c)),
        jnp.zeros((c, c)),
    )
    if not records:
        return start

    def add(carry: _Sums, lane: tuple[Loads, LoadUnknowns, _Eliminated]) -> tuple[_Sums, None]:
        load, own, eliminated = lane
        sums, alone = carry
        mine, _ = _influence(study, common, load, own, eliminated)
        mine = jnp.where(load.used & (load.unloaded >= 0), mine, 0.0)
        return (sums.at[load.unloaded].add(mine), alone + mine.T @ mine), None

    (sums, alone), _ = jax.lax.scan(add, start, (loads, owns, found))
    return sums, jnp.einsum("rxc,rxd->cd", sums, sums) - alone


def _by_x(
    study: DriverStudy,
    common: Float[Array, " common"],
    load: Loads,
    own: LoadUnknowns,
    eliminated: _Eliminated,
    sums: Float[Array, "record x common"],
) -> tuple[Float[Array, "own own"], Float[Array, "own common"]]:
    """Covariance of the own parameters of a load by the noise of a shared X.

    The second result is their covariance with the effect of this noise on the score of `common`
    through the other loads.
    """
    mine, of_own = _influence(study, common, load, own, eliminated)
    others = sums[load.unloaded] - jnp.where(load.used, mine, 0.0)
    several = load.unloaded >= 0
    return (
        jnp.where(several, of_own.T @ of_own, 0.0),
        jnp.where(several, of_own.T @ others, 0.0),
    )
