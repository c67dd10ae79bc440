"""The likelihood of a measured impedance, its starts, and what a passive circuit could leave.

With standard errors σ_k of the real and of the imaginary part the terms are

    (Z(jω_k) − Z_k) / σ_k.

Files of instruments have no standard errors. Then noise is taken to be a part s of |Z|, and the
terms are ln(Z(jω_k) / Z_k) / s: the relative error of the magnitude and the error of the phase.
They have no weights, which would come from noisy impedances. s is what the chain of the
Kramers-Kronig test leaves, or if there are too few frequencies for that, what the circuit leaves.

Priors of elements are further terms, as in `etid.estimators.element_prior`.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Bool, Complex, Float

from etid.circuits.circuit import AbstractCircuit, impedance_at, with_slopes
from etid.estimators.element_prior import FIXED, ElementPrior, Known
from etid.identify.kramers_kronig import KramersKronig, kramers_kronig
from etid.likelihood.linear import NormalEquations
from etid.results.data import MeasuredImpedance
from etid.signals.harmonics import real_parts

LACK = 1e-4  # by chance, if the chain is given; its choice makes it three times as likely
CORNERS = 5  # over the band
LEVELS = np.log(np.geomspace(0.1, 10.0, 5))  # around that of the data
SCATTERED, APART = 4, 3.0  # further starts of each, and their scatter in ln of each element
ROUNDING = 1e-13  # of Z, below which a residual is none


class PassiveFit(NamedTuple):
    """What the chain of the Kramers-Kronig test leaves; it can be any passive circuit.

    Attributes:
        square: Mean square residual per degree of freedom.
        most: Sum of squares of a right circuit, which chance exceeds in `LACK` (F test).
    """

    square: float
    most: float

    @classmethod
    def of(
        cls, chain: KramersKronig | None, z: Complex[np.ndarray, " frequency"], elements: int
    ) -> "PassiveFit":
        """What the chain leaves; without limit if there are too few frequencies for one."""
        if chain is None:
            return cls(np.inf, np.inf)
        missed = float(np.sum(np.abs(np.log(chain.fitted / z)) ** 2))
        free, more = 2 * z.size - chain.parameters, chain.parameters - elements
        if more <= 0:
            return cls(missed / free, np.inf)
        ratio = float(scipy.special.fdtri(more, free, 1 - LACK))
        return cls(missed / free, missed * (1 + ratio * more / free))


def chain_of(measured: MeasuredImpedance) -> KramersKronig | None:
    """The chain of a measured impedance; None if its noise is known, or frequencies are too few."""
    if measured.stderr is not None:
        return None
    try:
        return kramers_kronig(measured.frequency, measured.z)
    except ValueError:
        return None


@dataclasses.dataclass(frozen=True)
class Spectrum:
    """The terms of a spectrum, whose unknowns are the logarithms of the elements.

    Attributes:
        frequency: Frequencies [Hz].
        z: Impedance [Ω].
        sigma: Standard errors [Ω]; None if the noise is a part of |Z|.
        circuit: Structure of the circuit.
        centre: Prior means of the logarithms, and those of typical values without a prior.
        width: Prior standard deviations of the logarithms; infinite without a prior.
        noise: Size of the noise where `sigma` is not known, relative to |Z|.
    """

    frequency: Float[np.ndarray, " frequency"]
    z: Complex[np.ndarray, " frequency"]
    sigma: Float[np.ndarray, " frequency"] | None
    circuit: AbstractCircuit
    centre: Float[np.ndarray, " element"]
    width: Float[np.ndarray, " element"]
    noise: float = 1.0

    @classmethod
    def measured(cls, of: MeasuredImpedance, circuit: AbstractCircuit, known: Known) -> "Spectrum":
        """The terms of a measured impedance, by rising frequency: neighbours are compared."""
        typical, width = np.asarray(circuit.log_values()), np.full(len(circuit.names()), np.inf)
        prior = ElementPrior.of(known, circuit)
        if prior is not None:
            typical, width = prior.placed(typical), np.asarray(prior.width)
        rising = np.argsort(of.frequency, kind="stable")
        sigma = None if of.stderr is None else of.stderr[rising]
        return cls(of.frequency[rising], of.z[rising], sigma, circuit, typical, width)

    @property
    def free(self) -> Bool[np.ndarray, " element"]:
        """Whether each element is not fixed."""
        return self.width > FIXED

    def residual(
        self, z: Complex[np.ndarray, "row frequency"]
    ) -> tuple[Complex[np.ndarray, "row frequency"], Complex[np.ndarray, "..."]]:
        """What impedances of the circuit miss, and by what a change of them changes it."""
        if self.sigma is None:
            return np.log(z / self.z) / self.noise, 1 / (self.noise * z)
        return (z - self.z) / self.sigma, 1 / self.sigma + 0 * z

    def equations(self, q: Float[np.ndarray, "row element"]) -> NormalEquations:
        """The normal equations; their terms are those of the impedances alone."""
        z, slopes = with_slopes(self.circuit, q, self.frequency[None])
        missed, by_z = self.residual(z)
        found = NormalEquations.of(real_parts(missed), real_parts(slopes * by_z[:, None]))
        rest = (q - self.centre) / self.width
        return found._replace(
            objective=found.objective + 0.5 * (rest**2).sum(-1),
            gradient=found.gradient + rest / self.width,
            matrix=found.matrix + np.diag(1 / self.width**2),
        )

    def objective(self, q: Float[np.ndarray, "row element"]) -> Float[np.ndarray, " row"]:
        """½ Σ r² of all terms."""
        missed, _ = self.residual(impedance_at(self.circuit, q, self.frequency[None]))
        rest = (q - self.centre) / self.width
        return 0.5 * (np.abs(missed) ** 2).sum(-1) + 0.5 * (rest**2).sum(-1)

    def of(self, rows: np.ndarray) -> "Spectrum":
        """The terms of some rows: they are those of all."""
        del rows
        return self

    def starts(self) -> Float[np.ndarray, "start element"]:
        """Each corner frequency with each impedance level; known elements are at their means.

        If a circuit is scaled in impedance by g and in frequency by t, R becomes R·g, C becomes
        C/(g t).
        """
        typical, (of_level, of_time) = self.centre, self.circuit.scaling()
        slow = (of_time > 0) & (of_level <= 0)  # an inductor's time constant is not of a corner
        resistance = typical[np.argmax(np.where(of_time != 0, -np.inf, of_level))]
        corner = 1.0  # [Hz], roughly
        if slow.any():
            times = (typical - of_level * resistance)[slow] / of_time[slow]
            corner = 1 / (2 * np.pi * np.exp(times.min()))
        first, last = np.log(self.frequency[[0, -1]] / corner)
        faster = np.linspace(first, last, CORNERS)
        at_typical = impedance_at(self.circuit, typical[None], self.frequency[None])
        usual = np.median(np.abs(at_typical))
        levels = np.log(np.median(np.abs(self.z)) / usual) + LEVELS
        moved = levels[:, None] * of_level - faster[:, None, None] * of_time
        return np.where(np.isfinite(self.width), typical, typical + moved.reshape(-1, typical.size))

    def scattered(self) -> Float[np.ndarray, "start element"]:
        """Further starts, in which the elements have any relation to each other."""
        starts = np.repeat(self.starts(), SCATTERED, 0)
        moved = APART * np.random.default_rng(0).standard_normal(starts.shape)
        free = np.isinf(self.width) & np.any(self.circuit.scaling(), 0)  # but no exponent
        return np.where(free, starts + moved, starts)
