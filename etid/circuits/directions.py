"""Ways in which a recording may depart from its model: one row of `DIRECTIONS` each.

A direction adds ε t to one place of the loop of V_th, Z_th and Z_L:

    impedance    Z_L + ε t
    admittance   1/Z_L + ε t
    source       Z_th + ε t
    factor       V_out (1 + ε t)
    output       V_out + ε t V_th

The same row makes a fault of any size in a simulation, gives its effect on a fit, states its
tolerance, and tests for it: Rao's score test asks whether ε = 0 (`etid.likelihood.scores`).

**A relaxation that is spread over time constants.** The most common model of skin that is not one
RC is that of Cole (1940). It replaces jω by (jω)^α; α = 1 is the circuit itself:

    ∂Z/∂α = s ln s dZ/ds.

At 40 dB, α = 0.9 changes R_s by a quarter of its value; χ² is 1.1 and z above 10. A circuit with
its own α can make this change itself. For such a circuit the test checks whether the spread is
symmetric. Cole's spread is symmetric; that of Davidson and Cole (1951) is not. ln s becomes
ln s + ε ln² (s/s₀) around the middle s₀ of the band, and

    ∂Z/∂ε = s ln² (s/s₀) dZ/ds.

**One more relaxation**, ΔZ = ε |Z(j/τ)| / (1 + sτ), for each τ of a grid that exceeds the band. It
also has power if dZ/ds = 0, as for a resistor.

**A layer through which charge diffuses**, tanh √(sτ) / √(sτ), is a slow relaxation, a ninth of it
that is nine times as fast, a 25th of it that is 25 times as fast, and so on. With Z(0) as it is,

    ∂Z/∂ε = Σ (Z(s/n²) − Z(s)) / n² / (1 + Σ 1/n²),      n = 3, 5, 7, …

**Another gain**: most gains of 1 % are not seen at 40 dB, and would change R_p of dry skin by 14 %.
Behind dry skin a gain, crosstalk and a resistance in series with the source change the outputs
alike.
"""

import dataclasses
import statistics
from collections.abc import Callable, Iterable, Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from etid.precision import namespace
from etid.signals.transfer import (
    AnyArray,
    as_complex,
    frequency_variable,
    from_parts,
    reciprocal,
)

FALSE_ALARMS = 1e-4  # probability that chance exceeds the limit of one test
SEEN = -statistics.NormalDist().inv_cdf(FALSE_ALARMS / 2)  # of a normal number
RELAXATIONS = 7  # time constants, two per decade; a relaxation is wider than that
BEYOND = 2.0  # factor by which they exceed the band
# Faster relaxations of a layer of diffusion, by √(τ₁/τ). The rest adds 3 % of R_p to R_s.
FASTER = np.arange(3.0, 17.0, 2.0)
STEP = 1e-5  # of ln f, for dZ/ds
ALIKE = 0.95  # of the largest score, from which on another fault may be the cause as well
# Part of the largest score from which on a spread is the cause: it makes several relaxations. That
# of Cole's skin is 0.45 to 1, that of two relaxations that are far apart 0.15.
SPREAD = 0.4

_Numbers = Complex[AnyArray, "*row bin"]
_Each = Complex[AnyArray, "*row output bin"]
NONE = np.zeros((1, 1), complex)


class At(NamedTuple):
    """A load in its loop at some frequencies.

    Attributes:
        frequency: The frequencies [Hz].
        z: Z_L [Ω].
        gains: Outputs per input, with their delays; the first is V_out.
        by_z: Their derivatives with respect to Z_L.
        by_source: Their derivatives with respect to Z_th.
        turn: e^(−jωτ) of each output.
        impedance: Z_L [Ω] at other frequencies [Hz].
        exponents: Whether the load has exponents α of its own.
    """

    frequency: Float[AnyArray, "*row bin"]
    z: _Numbers
    gains: _Each = NONE
    by_z: _Each = NONE
    by_source: _Each = NONE
    turn: _Each = NONE + 1
    impedance: Callable[[AnyArray], AnyArray] | None = None
    exponents: bool = False

    @property
    def s(self) -> _Numbers:
        """The variable of the Laplace transform [rad/s]."""
        return frequency_variable(self.frequency)

    @classmethod
    def behind(
        cls, frequency: AnyArray, z_th: _Numbers, impedance: Callable[[AnyArray], AnyArray]
    ) -> "At":
        """V_out of a load behind a source."""
        z = impedance(frequency)
        current = reciprocal(z + z_th)
        each = z * current, z_th * current * current, -z * current * current
        return cls(frequency, z, *(one[..., None, :] for one in each), impedance=impedance)


@dataclasses.dataclass(frozen=True)
class Direction:
    """A change of size ε.

    Attributes:
        place: What it adds to.
        term: t, with an axis of changes if there are several; None if it is no such change.
        unit: Of ε.
        usual: ε of which a laboratory should know, in a budget.
        largest: Tolerance from which on its unit is wrong; 0 if nobody can state one.
        records: Which recordings a tolerance acts on: all, loads or calibrations.
        in_words: An error of some size.
        deviation: Standard deviation of z of good recordings.
        least: ε that is also necessary for a finding.
        moves: Relative change of an element that is also necessary. A driver of too low order can
            imitate less.
        verdict: What a finding is; empty if nothing is found.
        looks: What the residual looks like.
        looks_back: What it looks like if ε is positive; empty if the same. For a single change.
        passive: Sign of ε that a passive load can have; 0 for both.
        of_circuit: Whether it makes another circuit.
        of_others: Whether it changes the factors of the outputs beside V_out.
    """

    place: str = ""
    term: Callable[[At], AnyArray] | None = None
    _: dataclasses.KW_ONLY
    unit: str = "relative"
    usual: float = 0.0
    largest: float = 0.0
    records: str = ""
    in_words: str = ""
    deviation: float = 1.0
    least: float = 0.0
    moves: float = 0.02
    verdict: str = ""
    looks: tuple[str, ...] = ()
    looks_back: str = ""
    passive: int = 0
    of_circuit: bool = False
    of_others: bool = False

    @property
    def count(self) -> int:
        """Number of changes."""
        return max(len(self.looks), 1)

    @property
    def on_load(self) -> bool:
        """Whether it changes Z_L."""
        return self.place in ("impedance", "admittance")

    @property
    def limit(self) -> float:
        """|z| that the largest of all changes exceeds in one good recording of 10 000."""
        chance = FALSE_ALARMS / 2 / self.count
        return -self.deviation * statistics.NormalDist().inv_cdf(chance)

    def relevant(self, z: AnyArray, size: AnyArray, moved: AnyArray) -> AnyArray:
        """z; 0 if the change is too small to matter, or if the circuit can make it itself.

        `size` is the estimate of ε, and `moved` the relative change of an element by it.
        """
        xp = namespace(z)
        matters = (xp.abs(size) > self.least) & (moved > self.moves)
        return xp.where(matters, xp.nan_to_num(z), 0.0)

    def seen(self, z: AnyArray, size: AnyArray, moved: AnyArray) -> AnyArray:
        """Whether the change is seen."""
        return namespace(z).abs(self.relevant(z, size, moved)) > self.limit

    def change(self, at: At) -> Complex[AnyArray, "*row change output bin"]:
        """Derivatives of the gains with respect to ε."""
        assert self.term is not None
        term = self.term(at)
        term = term[..., None, :] if term.ndim == at.z.ndim else term
        term = term[..., None, :]
        if self.place == "impedance":
            return term * at.by_z[..., None, :, :]
        if self.place == "admittance":
            return (-at.z * at.z)[..., None, None, :] * term * at.by_z[..., None, :, :]
        if self.place == "source":
            return term * at.by_source[..., None, :, :]
        own = np.eye(at.gains.shape[-2])[slice(1, None) if self.of_others else slice(1)][:, :, None]
        if self.place == "factor":
            return own * (term * at.gains[..., None, :, :])
        return own * (term * at.turn[..., None, :, :])

    def _added(self, at: At, size: AnyArray | float) -> AnyArray:
        """ε t; of several changes their sum."""
        assert self.term is not None
        term = self.term(at)
        if term.ndim == at.z.ndim:
            return size * term
        return (np.asarray(size)[..., None] * term).sum(-2)

    def of_load(self, at: At, size: AnyArray | float) -> tuple[_Numbers, _Numbers | float]:
        """Z_L with a fault of this size, and its derivative with respect to Z_L."""
        if self.place == "impedance":
            return at.z + self._added(at, size), 1.0
        if self.place == "admittance":
            share = reciprocal(1 + self._added(at, size) * at.z)
            return at.z * share, share * share
        return at.z, 1.0

    def of_source(self, at: At, size: AnyArray | float) -> _Numbers | float:
        """What a fault of this size adds to Z_th."""
        return self._added(at, size) if self.place == "source" else 0.0

    def factor(self, at: At, size: AnyArray | float) -> _Numbers | float:
        """By what a fault of this size multiplies V_out."""
        return 1 + self._added(at, size) if self.place == "factor" else 1.0

    def offset(self, at: At, size: AnyArray | float) -> _Numbers | float:
        """What a fault of this size adds to V_out for each unit of V_th."""
        return self._added(at, size) if self.place == "output" else 0.0


def _one(at: At) -> _Numbers:
    return namespace(at.z).ones_like(at.z)


def spread(at: At) -> _Numbers:
    """∂Z/∂α, or ∂Z/∂ε of a load that has an α [Ω]."""
    assert at.impedance is not None
    xp, f = namespace(at.z), at.frequency
    log_omega = xp.log(2 * np.pi * f)
    if at.exponents:
        log_omega = log_omega - 0.5 * (log_omega[..., :1] + log_omega[..., -1:])
    log_s = from_parts(log_omega, xp.full_like(f, np.pi / 2))
    slope = (at.impedance(f * (1 + STEP)) - at.impedance(f * (1 - STEP))) / (2 * STEP)
    return slope * (log_s * log_s if at.exponents else log_s)


def relaxations(
    impedance: Callable[[AnyArray], AnyArray], lowest: AnyArray, highest: AnyArray
) -> tuple[AnyArray, AnyArray]:
    """1/(2πτ) [Hz] and |Z(j/τ)| [Ω] of the relaxations for a band [Hz]."""
    lowest, highest = lowest / BEYOND, highest * BEYOND
    corner = lowest * (highest / lowest) ** np.linspace(0.0, 1.0, RELAXATIONS)
    return corner, namespace(corner).abs(impedance(corner))


def _relaxation(at: At) -> Complex[AnyArray, "*row change bin"]:
    assert at.impedance is not None
    f = at.frequency
    corner, level = relaxations(at.impedance, f[..., :1], f[..., -1:])
    return level[..., None] * reciprocal(1 + 1j * (f[..., None, :] / corner[..., None]))


def _layer(at: At) -> _Numbers:
    assert at.impedance is not None
    shares = FASTER**-2 / (1 + (FASTER**-2).sum())
    each = zip(shares, FASTER, strict=True)
    return sum(share * (at.impedance(at.frequency * n**-2.0) - at.z) for share, n in each)


def _slow(at: At) -> _Numbers:
    """What a pole at the end of the band takes away."""
    return at.s * reciprocal(at.s + as_complex(2 * np.pi * at.frequency[..., -1:]))


_SLOW = "one more slow relaxation, a slow tail after each pulse"
FAST = (
    "one more fast relaxation at the edges of each pulse, of the load or of the driver (a higher "
    "order)"
)
_MIDDLE = "one more relaxation in the middle of the band"

# The deviations are the largest of 2500 good recordings by noise, skin and scatter of the drivers,
# on 29 November 2026 (`python -m benchmarks directions`).
DIRECTIONS: Mapping[str, Direction] = {
    "spread": Direction(
        "impedance",
        spread,
        least=0.01,
        moves=0.0,
        verdict="misfit",
        looks=("a spread of time constants that the circuit cannot make",),
        passive=-1,
        of_circuit=True,
    ),
    "relaxation": Direction(
        "impedance",
        _relaxation,
        deviation=1.1,
        verdict="misfit",
        looks=(_SLOW, _SLOW, *[_MIDDLE] * (RELAXATIONS - 5), *[FAST] * 3),
        passive=1,
        of_circuit=True,
    ),
    "layer": Direction("impedance", _layer, of_circuit=True),
    "falling": Direction(verdict="misfit", looks=("a resistance that falls with its current",)),
    "gain": Direction(
        "factor",
        _one,
        usual=1e-3,
        largest=1.0,
        records="all",
        in_words="a gain that is {} off",
        verdict="misfit",
        looks=("another gain of v_out than of v_th",),
    ),
    "r_load": Direction(
        "impedance",
        lambda at: at.z,
        usual=1e-3,
        largest=1.0,
        records="calibrations",
        in_words="a known resistor that is {} off",
    ),
    "c_load": Direction(
        "admittance",
        lambda at: at.s,
        unit="F",
        usual=1e-12,
        largest=1e-7,
        records="calibrations",
        in_words="{} across the known resistor",
    ),
    "crosstalk": Direction(
        "output",
        _one,
        usual=1e-3,
        largest=1.0,
        records="all",
        in_words="{} of crosstalk",
        looks=("crosstalk of v_th into v_out",),
    ),
    "capacitance": Direction(
        "admittance",
        lambda at: at.s,
        unit="F",
        usual=1e-12,
        largest=1e-7,
        records="loads",
        in_words="{} across the skin",
        verdict="misfit",
        deviation=0.92,
        looks=("another capacitance across the load than across the resistor",),
    ),
    "drift": Direction(usual=1e-2, largest=1.0, in_words="a driver that drifts by {}"),
    "later gain": Direction(usual=1e-3, in_words="a gain that changes by {} after the calibration"),
    "delay": Direction(unit="s", largest=1e-3),
    "scale": Direction("factor", _one, moves=1e-3, verdict="inconsistent", of_others=True),
    "series": Direction(
        "source", _one, unit="ohm", looks=("a resistor in series with the source",)
    ),
    "inductance": Direction(
        "impedance",
        lambda at: at.s,
        unit="H",
        deviation=0.92,
        looks=("an inductance in series with the load",),
    ),
    # A pole at the end of the band in one channel; what it takes away to first order is a delay.
    "slow voltage": Direction(
        "factor",
        _slow,
        verdict="misfit",
        looks=("a low-pass of v_out (state it as v_out_filter)",),
        looks_back="a low-pass of the current (state it as current_filter) or of v_th",
    ),
    # Behind a measured current, amplifiers that show less of their peaks.
    "compressed current": Direction(verdict="misfit"),
    "compressed voltage": Direction(verdict="misfit"),
}

ON_LOADS = tuple(name for name, of in DIRECTIONS.items() if of.records in ("all", "loads"))
"""Errors of the instrument that act on a load."""


def scored() -> tuple[str, ...]:
    """Changes of a load that a fit tests for."""
    every = DIRECTIONS.items()
    return tuple(name for name, of in every if of.term and of.records != "calibrations")


def named() -> tuple[str, ...]:
    """Those that a residual may look like."""
    return tuple(name for name in scored() if DIRECTIONS[name].looks)


def simulated(
    at: At, z_th: _Numbers, faults: Iterable[tuple[str, AnyArray | float]]
) -> Complex[AnyArray, "*row bin"]:
    """V_out per V_th, without delays, with faults of these sizes."""
    source, factor, offset = z_th, _one(at), 0.0
    for name, size in faults:
        of = DIRECTIONS[name]
        factor, offset = factor * of.factor(at, size), offset + of.offset(at, size)
        source, at = source + of.of_source(at, size), at._replace(z=of.of_load(at, size)[0])
    return factor * at.z * reciprocal(at.z + source) + offset
