"""The terms of one driver and its many loads.

All loads share Z_th and the delays of the calibrations, `common`. The elements and the delay of a
load, `own`, appear only in the terms of this load.
"""

import itertools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from etid.estimators.maximum_likelihood.driver import Joint
from etid.estimators.unknowns import LoadUnknowns
from etid.signals.harmonics import Spectrum
from etid.solvers.arrowhead import join, split

SIDE_BY_SIDE = 8  # loads in one vectorised step


class Loads(eqx.Module):
    """Recordings of one length with one driver, stacked along a leading axis.

    Attributes:
        spectrum: Harmonics of the recordings.
        sample_rate: Sampling rates of the recordings [Hz].
        own: Unknowns of each load, identified alone.
        used: Whether the recording takes part. The others are fitted, but do not affect Z_th.
        unloaded: Index of the unloaded record among those that several loads share; −1 if no other
            load has it.
    """

    spectrum: Spectrum
    sample_rate: Float[Array, "*load"]
    own: LoadUnknowns
    used: Bool[Array, "*load"]
    unloaded: Int[Array, "*load"]


class DriverStudy(eqx.Module):
    """All data of the fit of a driver and its loads."""

    model: Joint
    groups: list[Loads]

    def __call__(self, y: Float[Array, " parameter"]) -> list[Float[Array, "..."]]:
        """Terms of the calibrations, and of each group."""
        common, parts = self.split(y)

        def one(load: Loads, own: LoadUnknowns) -> Float[Array, " term"]:
            return jnp.where(load.used, self.of_load(load, common, own), 0.0)

        loaded = [jax.vmap(one)(loads, own) for loads, own in zip(self.groups, parts, strict=True)]
        return [self.of_calibrations(common), *loaded]

    def of_load(
        self, load: Loads, common: Float[Array, " common"], own: LoadUnknowns
    ) -> Float[Array, " term"]:
        """Terms of one load."""
        records = self.model.calibrations.records
        return self.model.of_load(own, common, load.spectrum, load.sample_rate, records)

    def of_calibrations(self, common: Float[Array, " common"]) -> Float[Array, " term"]:
        """Terms of the calibrations."""
        return self.model.calibrations.terms(common, self.model.calibrations.records)

    def start(self) -> Float[Array, " parameter"]:
        """The start: the driver of the calibrations, and each load identified alone."""
        own = jnp.concatenate([loads.own.vector() for loads in self.groups])
        return join(self.model.calibrations.start(), own)

    def split(
        self, y: Float[Array, " parameter"]
    ) -> tuple[Float[Array, " common"], list[LoadUnknowns]]:
        """The common parameters, and the unknowns of the loads of each group."""
        counts = [loads.used.size for loads in self.groups]
        common, own = split(y, sum(counts), self.owned)
        ends = itertools.accumulate(counts)
        return common, [
            LoadUnknowns.of(own[end - count : end]) for end, count in zip(ends, counts, strict=True)
        ]

    @property
    def owned(self) -> int:
        """Number of own parameters of a load."""
        return len(self.model.circuit.names()) + 1


def over(one: Callable, *lanes: Any) -> Any:
    """`one` over the leading axis of `lanes`, a few at a time."""
    count = jax.tree.leaves(lanes)[0].shape[0]
    return jax.lax.map(lambda lane: one(*lane), lanes, batch_size=min(SIDE_BY_SIDE, count))
