"""The fit of one load that was recorded at several amplitudes."""

import numpy as np

from etid.likelihood.fit import Estimate
from etid.likelihood.linear import LevenbergMarquardt, State, inverse
from etid.nonlinear.amplitudes import Amplitudes
from etid.nonlinear.last_step import last_step
from etid.nonlinear.late import follows_late
from etid.nonlinear.starts import likeliest, starts
from etid.results.fit import Support, complex_rrse
from etid.results.instrument import Effects
from etid.signals.transfer import power

# Reductions of ½ Σ r² that are enough: first as a part of it; then that of 0.01 standard errors.
COARSE, FINE = 1e-3, 5e-5
DAMPING, STEPS = 1e-2, 200


def fit_amplitudes(of: Amplitudes) -> tuple[Estimate, bool]:
    """Identify one load from all its records.

    Returns:
        The estimate, as one row, whose χ² and RRSE are those of the worst record; and whether a
        resistance that follows its current late explains the residual.
    """
    alone = likeliest(of)
    of, every = of.weighted(alone), starts(of, alone)
    found = of.objective(every)
    q = every[[np.where(np.isfinite(found), found, np.inf).argmin()]]
    # First with Z_th fixed: from a distant start, a joint fit would distort Z_th.
    own = np.arange(q.size) < of.elements + of.count
    coarse = LevenbergMarquardt(DAMPING, STEPS, relative=COARSE, free=own)
    for _ in range(2):
        q = coarse(of, q, of.equations(q), 0.0).q
        of = of.weighted(of.own(q[0]))
    # For a load that is nearly linear, the valley is curved along R_s and I_0.
    fine = LevenbergMarquardt(DAMPING, STEPS, curved=True)
    state = fine(of, q, of.equations(q), FINE)
    return _estimate(of, state)


def _estimate(of: Amplitudes, state: State) -> tuple[Estimate, bool]:
    """The estimate one step from the minimum."""
    (q,), kept, source = state.q, of.elements, of.recorded.source
    step, predicted = last_step(of, q), of.at(q).predicted
    terms, selected = of.terms(predicted), of.spectra.selected
    late = follows_late(of, q, step.slopes, terms)
    freedom = 2.0 * selected.sum(-1) - (kept / of.count + 1)
    logs, delays, z = of.split(q + step.change)
    first = kept + of.count
    bread = inverse(step.curvature.expected)[:kept]
    of_driver = bread[:, first:] @ source.cov @ bread[:, first:].T
    own = np.where(np.arange(q.size) < first, 1 / of.width**2, 0.0)
    by_records = bread @ (step.curvature.score + np.diag(own)) @ bread.T
    change = z - source.mean
    chi2 = (power(terms).sum(-1) / freedom).max()
    none = np.zeros(1, bool)
    estimate = Estimate(
        logs=logs[None],
        delays=delays[None],
        z=z[None],
        cov=(by_records + of_driver)[None],
        shared_cov=of_driver[None],
        chi2=chi2[None],
        rrse=complex_rrse(predicted, of.spectra.y, selected).max()[None],
        settled=~state.moves,
        points=state.steps,
        strain=(change @ np.linalg.solve(source.cov, change))[None],
        hum=none,
        falls=none,
        doubtful=none,
        far=none,
        other=none,
        inconsistent=none,
        biased=none,
        support=Support.unknown(kept, 1),
        effects=Effects.unknown(kept, 1),
        approximate=none,
        tested={},
    )
    return estimate, late
