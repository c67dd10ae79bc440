"""The terms of one load that was recorded at several amplitudes, and their derivatives.

All records have the same elements and the same driver; each has its own trigger delay τ. Those of
a record are

    Y_k − V_k(X) e^(−jω_k τ),      V_k(X) = Z_L / (Z_L + Z_th) X_k for a linear load.

The weights are constant: a fit gets the variances of the terms from earlier estimates. If they
followed the parameters, elements with a large gain would explain any residual by the noise of X,
because a saturated V(X) hardly changes with them. The terms are treated as independent, which the
last step corrects (`etid.nonlinear.last_step`).
"""

import dataclasses

import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from etid.circuits.circuit import AbstractCircuit
from etid.estimators.element_prior import ElementPrior
from etid.likelihood.linear import DIFFERENCE, NormalEquations, bend
from etid.nonlinear.response import AbstractResponse, Recorded
from etid.signals.harmonics import Spectrum, real_parts
from etid.signals.transfer import power

_Row = Float[np.ndarray, "*row q"]


@dataclasses.dataclass(frozen=True)
class Amplitudes:
    """Records of one load, with all data that their terms need.

    The unknowns are the logarithms of the elements, the delays, and z; a solver may have several
    points of them, along leading axes.

    Attributes:
        recorded: The feed of the records.
        spectra: The records.
        prior: Prior of the elements; None without one.
        expected: Variances of the terms by the noise; None before the first estimate.
    """

    recorded: Recorded
    spectra: Spectrum
    prior: ElementPrior | None = None
    expected: Float[np.ndarray, "record harmonic"] | None = None

    @property
    def circuit(self) -> AbstractCircuit:
        """Structure of the load and its typical values."""
        return self.recorded.circuit

    @property
    def count(self) -> int:
        """Number of records."""
        return len(self.spectra.x)

    @property
    def elements(self) -> int:
        """Number of elements."""
        return len(self.circuit.names())

    def split(self, q: _Row) -> tuple[np.ndarray, ...]:
        """Logarithms of the elements, delays and z."""
        first, last = self.elements, self.elements + self.count
        return q[..., :first], q[..., first:last], q[..., last:]

    def start(self, logs: Float[np.ndarray, "*row element"]) -> _Row:
        """Unknowns without delays, and with the mean of z."""
        rest = np.append(np.zeros(self.count), self.recorded.source.mean)
        rest = np.broadcast_to(rest, (*logs.shape[:-1], rest.size))
        return np.concatenate([logs, rest], -1)

    @property
    def centre(self) -> Float[np.ndarray, " q"]:
        """Prior means of the unknowns."""
        own = self.circuit.log_values()
        return self.start(own if self.prior is None else self.prior.placed(own))

    @property
    def width(self) -> Float[np.ndarray, " q"]:
        """Prior standard deviations of the unknowns."""
        # A linear load has an infinite I_0. A prior of a factor of 150 keeps it finite.
        own, source = np.where(currents(self.circuit), 5.0, np.inf), self.recorded.source
        own = own if self.prior is None else np.minimum(own, self.prior.width)
        delays = np.full(self.count, float(source.delay_width))
        return np.concatenate([own, delays, np.ones(source.mean.size)])

    def priors(self, q: _Row) -> _Row:
        """Terms of the priors."""
        return (q - self.centre) / self.width

    def places(self, record: int) -> Int[np.ndarray, " own"]:
        """Places of the unknowns of a record, in the order of `Gains`."""
        size, last = self.centre.size, self.elements + self.count
        return np.r_[: self.elements, self.elements + record, last:size]

    def own(self, q: _Row) -> Float[np.ndarray, "*row record own"]:
        """The unknowns of each record."""
        return np.stack([q[..., self.places(number)] for number in range(self.count)], -2)

    def at(self, q: _Row) -> AbstractResponse:
        """The response at these unknowns."""
        return self.recorded.at(self.own(q), self.spectra.x)

    def variance(
        self, own: Float[np.ndarray, "record own"]
    ) -> Float[np.ndarray, "record harmonic"]:
        """Variances of the terms, by the linear gain at small currents.

        That gain is right for most of a period: there is little current between the pulses.
        """
        gain = self.recorded.gains(own)[..., 0, :]
        return self.spectra.variance_y + power(gain) * self.spectra.variance_x

    def weighted(self, own: Float[np.ndarray, "record own"]) -> "Amplitudes":
        """The same with the variances at these unknowns of each record."""
        return dataclasses.replace(self, expected=self.variance(own))

    @property
    def weight(self) -> Float[np.ndarray, "record harmonic"]:
        """1/σ of both parts of each term; 0 where a harmonic is not used."""
        assert self.expected is not None
        return np.where(self.spectra.selected, np.sqrt(2 / self.expected), 0.0)

    def terms(
        self, predicted: Complex[np.ndarray, "*row record harmonic"]
    ) -> Complex[np.ndarray, "*row record harmonic"]:
        """The terms of all records, whose real and imaginary parts are terms of a fit."""
        return (self.spectra.y - predicted) * self.weight

    def real_terms(self, q: _Row, response: AbstractResponse) -> Float[np.ndarray, "*row term"]:
        """All terms, of the records and of the priors."""
        terms = real_parts(self.terms(response.predicted)).reshape(*q.shape[:-1], -1)
        return np.concatenate([terms, self.priors(q)], -1)

    def objective(self, q: _Row) -> Float[np.ndarray, "*row"]:
        """½ Σ r² of all terms."""
        return 0.5 * (self.real_terms(q, self.at(q)) ** 2).sum(-1)

    def equations(self, q: Float[np.ndarray, "row q"]) -> NormalEquations:
        """The normal equations at each point.

        The effect of an element that the data hardly show is proportional to e^q or e^−q, and has
        second derivatives of its size. Without them steps would turn back and forth.
        """
        response, width = self.at(q), self.width
        slopes = self.by_q(response.slopes() * self.weight)
        rows = np.moveaxis(real_parts(slopes), 0, -3).reshape(*q.shape, -1)
        priors = np.broadcast_to(np.diag(1 / width), (*q.shape, width.size))
        terms = self.real_terms(q, response)
        found = NormalEquations.of(terms, np.concatenate([-rows, priors], -1))
        by_data = np.abs(found.gradient - self.priors(q) / width)
        more = np.where(np.arange(width.size) < self.elements, by_data, 0.0)
        return found._replace(matrix=found.matrix + more[..., None] * np.eye(width.size))

    def bend(
        self,
        q: Float[np.ndarray, "row q"],
        at: NormalEquations,
        move: Float[np.ndarray, "row q"],
    ) -> Float[np.ndarray, "row q"]:
        """Jᵀ r″ of a step, as `etid.likelihood.linear.Curved` has it."""
        ahead = q + DIFFERENCE * move
        return bend(at, self.real_terms(ahead, self.at(ahead)), move)

    def by_q(
        self, by_own: Complex[np.ndarray, "own *row record harmonic"]
    ) -> Complex[np.ndarray, "q *row record harmonic"]:
        """Derivatives by the unknowns of all records, from those of each."""
        found = np.zeros((self.centre.size, *by_own.shape[1:]), complex)
        for number in range(self.count):
            found[self.places(number), ..., number, :] = by_own[..., number, :]
        return found

    def of(self, rows: Int[np.ndarray, " some"]) -> "Amplitudes":
        """Some of the points: they have the same terms."""
        del rows
        return self


def currents(circuit: AbstractCircuit) -> Bool[np.ndarray, " element"]:
    """Which elements of a circuit are currents."""
    return np.array([unit == "ampere" for unit in circuit.units().values()])
