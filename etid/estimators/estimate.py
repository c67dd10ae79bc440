"""The estimate that a fit returns."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from etid.precision import Module
from etid.results.fit import Support
from etid.results.instrument import Effects

MAX_STEPS = 500


class Estimate(Module):
    """The result of a fit, without a verdict.

    Attributes:
        parameters: Estimated parameters.
        delay_samples: Trigger delay of each record [samples].
        cov: Covariance of `parameters`.
        chi2: Σ r²/s per degree of freedom.
        rrse: Root relative squared error of V_out; the largest of all records.
        result: Verdict of the solver.
        steps: Trial steps of the solver.
        start: Number of the start that led here, from 0 on; only fits of drivers tell it.
        shared_cov: Part of `cov` that comes from the driver; all skins identified with this driver
            share it.
        strain: Increase of the Σ r² of the calibrations in a joint fit; 0 for other fits.
        hum: Whether the residual shows mains hum; a fit in time does not test for it.
        falls: Whether a resistance that falls with its current explains most of the misfit.
        doubtful: Whether another gain is likely; `cov` contains its effect.
        support: How well the data support this circuit; None if the estimator does not compute it.
        by_tolerance: What errors of the instrument do to the parameters; None in the same case.
    """

    _: dataclasses.KW_ONLY
    parameters: Float[Array, " parameter"]
    delay_samples: Float[Array, " record"]
    cov: Float[Array, "parameter parameter"]
    chi2: Float[Array, ""]
    rrse: Float[Array, ""]
    result: optx.RESULTS
    steps: Int[Array, ""]
    shared_cov: Float[Array, "parameter parameter"]
    start: Int[Array, ""] = eqx.field(default_factory=lambda: jnp.zeros((), int))
    strain: Float[Array, ""] = eqx.field(default_factory=lambda: jnp.zeros(()))
    hum: Bool[Array, ""] = eqx.field(default_factory=lambda: jnp.zeros((), bool))
    falls: Bool[Array, ""] = eqx.field(default_factory=lambda: jnp.zeros((), bool))
    doubtful: Bool[Array, ""] = eqx.field(default_factory=lambda: jnp.zeros((), bool))
    support: Support | None = None
    by_tolerance: Effects | None = None
