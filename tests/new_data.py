"""Two kinds of data that etid does not have: all that one has to write for them.

- The current of a load is measured twice, before and behind it.
- Two loads are in series, and one is known: the voltage of both and that of the known one.

`fit` gives standard errors, score tests and a verdict, for any outputs.
"""

from collections.abc import Sequence
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

import etid
from etid.estimators.maximum_likelihood.gains import AbstractOutputs, Current
from etid.estimators.maximum_likelihood.given_driver import GivenDriver
from etid.estimators.maximum_likelihood.load import Load
from etid.estimators.maximum_likelihood.load_fit import fit_circuit
from etid.estimators.maximum_likelihood.profile import Records
from etid.results.verdicts import verdict
from etid.signals.harmonics import Spectrum


class TwoCurrents(AbstractOutputs):
    """V_out, and the current twice."""

    count: ClassVar[int] = 3

    def __call__(self, z_load: Complex[Array, " f"], current: Current) -> Complex[Array, "3 f"]:
        i = current(z_load)
        return jnp.stack([z_load * i, i, i])


class KnownInSeries(AbstractOutputs):
    """The voltage of a load and of a known resistor behind it [Ω], and that of the resistor."""

    count: ClassVar[int] = 2
    known: Float[Array, ""]

    def __call__(self, z_load: Complex[Array, " f"], current: Current) -> Complex[Array, "2 f"]:
        total = z_load + jax.lax.complex(self.known, 0.0)
        i = current(total)
        return jnp.stack([total, jnp.full_like(total, self.known)]) * i[None, :]


@eqx.filter_jit
def fit(
    outputs: AbstractOutputs,
    known: GivenDriver,
    spectrum: Spectrum,
    others: Sequence[tuple[Array, Array]],
    rate: Float[Array, ""],
) -> etid.Fit:
    """The skin of a recording, from V_th, V_out and `others` [coefficients and variances]."""
    load = Load.behind(known, etid.SkinRC(), Records.of(spectrum, *others), rate, None, outputs)
    found = fit_circuit(load, known.starts(spectrum, rate, etid.SkinRC()))
    return found.judged(etid.SkinRC(), verdict("successful"), "new data")
