"""Measured impedances without standard errors: good ones, and ones with a fault that must be told.

Every spectrum has 61 frequencies in 3 to 6 decades around the corners of a drawn circuit, with
white noise of 0.1 to 3 % of |Z|; good ones have 20, 61 and 100. A fit that is called successful is
*silent* if an element is wrong by more than five standard errors and by more than 2 %, or if the
spectrum is none (the sign of Im Z is wrong, or the phase is missing). Of a circuit that is fitted
to another one, the elements that both have are compared. An element that drifts during the sweep
has every value that it passes.

Circuit strings have drawn values, which their spectra may not determine: at 60 frequencies from 0.1
Hz to 1 MHz, with noise of 0.3 %.
"""

import argparse
import dataclasses
from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

import etid
from benchmarks.coverage import SILENT
from benchmarks.rates import COVERED, NORMAL_95, clopper_pearson
from benchmarks.runner import Target, at_most, option, report
from etid.circuits.branches import in_order
from etid.results.verdicts import counted

POINTS = 61
GOOD_POINTS = (20, POINTS, 100)
NOISE = (1e-3, 3e-2)  # of |Z|, in the real and in the imaginary part
NOTICED = 0.02  # relative error of an element that counts
TARGETS = {
    "silent": at_most(0),  # of spectra with and without a fault
    "refused, part of the good ones": at_most(1e-3),
    "covered": COVERED,
}
ACCEPTED = ("successful", "insensitive")  # layers that noise hides are not determined
STRINGS = (
    "R0-p(R1,C1)-Wo1",
    "R0-p(R1,C1)-Ws1",
    "R0-p(CPE1,R1-W1)",
    "R0-p(R1-W1,C1)",
    "L0-R0-p(R1-Wo1,CPE1)",
    "La0-R0-p(R1,CPE1)",
    "R0-G1",
    "R0-T1",
    "R0-p(R1,CPE1)-p(R2,CPE2)",
    "R0-p(CPE1,R1-p(R2,CPE2))",
    "R0-p(R1,C1)-p(R2,C2)-p(R3,C3)",
    "R0-p(R1,C1)-p(R2-Wo1,C2)",
    "p(C1,R1-p(CPE1,R2-Ws1))",
)
LAYERS = ("r_1", "c_1", "c_2", "r_2")  # the other way round are those of the other one


@dataclasses.dataclass(frozen=True)
class Spectrum:
    """A drawn spectrum."""

    frequency: Float[np.ndarray, " frequency"]  # from high to low, as instruments sweep [Hz]
    z: Complex[np.ndarray, " frequency"]  # with noise [Ω]
    circuit: etid.AbstractCircuit  # what is fitted
    # smallest and largest right value of each element that has one; empty if there is no right
    # answer
    truth: Mapping[str, tuple[float, float]]


def response(circuit: etid.AbstractCircuit, f: np.ndarray) -> Complex[np.ndarray, " frequency"]:
    """The impedance, by NumPy; elements may have one value for each frequency."""
    of, s = {name: np.asarray(getattr(circuit, name)) for name in circuit.names()}, 2j * np.pi * f
    if isinstance(circuit, etid.SkinCole):
        return of["r_s"] + of["r_p"] / (1 + (s * of["tau"]) ** of["alpha"])
    if isinstance(circuit, etid.SkinLayers):
        first, second = (of[f"r_{i}"] / (1 + s * of[f"r_{i}"] * of[f"c_{i}"]) for i in (1, 2))
        return of["r_s"] + first + second
    return of.get("r_s", np.zeros(())) + of["r_p"] / (1 + s * of["r_p"] * of["c_p"])


def one_rc(rng: np.random.Generator) -> etid.SkinRC:
    """Dry to damp skin."""
    total, share = np.exp(rng.uniform(np.log(2e4), np.log(6e5))), rng.uniform(0.05, 0.4)
    corner = np.exp(rng.uniform(np.log(2e3), np.log(3e4)))
    r_p = (1 - share) * total
    return etid.SkinRC(share * total, r_p, 1 / (2 * np.pi * corner * r_p))


def spread(rng: np.random.Generator, alpha: tuple[float, float] = (0.6, 0.95)) -> etid.SkinCole:
    """Skin with a spread of time constants."""
    skin = one_rc(rng)
    return etid.SkinCole(skin.r_s, skin.r_p, skin.r_p * skin.c_p, rng.uniform(*alpha))


def layers(rng: np.random.Generator) -> etid.SkinLayers:
    """Skin of two layers whose time constants differ by a factor of 5 to 20."""
    skin, part, times = one_rc(rng), rng.uniform(0.3, 0.7), np.exp(rng.uniform(1.6, 3.0))
    r_1, r_2 = part * skin.r_p, (1 - part) * skin.r_p
    tau = skin.r_p * skin.c_p
    return etid.SkinLayers(skin.r_s, r_1, tau / r_1, r_2, times * tau / r_2)


def frequencies(rng: np.random.Generator, points: int = POINTS) -> Float[np.ndarray, " frequency"]:
    """A sweep of 3 to 6 decades, from high to low, around the middle of the corners."""
    decades, middle = rng.uniform(3.0, 6.0), np.log10(8e3) + rng.uniform(-0.5, 0.5)
    return np.logspace(middle + decades / 2, middle - decades / 2, points)


def noisy(z: np.ndarray, rng: np.random.Generator) -> Complex[np.ndarray, " frequency"]:
    """With white noise, a part of |Z|."""
    size = np.exp(rng.uniform(*np.log(NOISE)))
    parts = rng.standard_normal((2, z.size))
    return z + size * np.abs(z) * (parts[0] + 1j * parts[1])


def exact(circuit: etid.AbstractCircuit) -> dict[str, tuple[float, float]]:
    """Elements that have one right value."""
    values = {name: float(getattr(circuit, name)) for name in circuit.names()}
    return {name: (value, value) for name, value in values.items()}


def good(rng: np.random.Generator, points: int = POINTS) -> Spectrum:
    """A spectrum without a fault, and its circuit."""
    kind = rng.integers(4)
    circuit = (one_rc, one_rc, spread, layers)[kind](rng)
    if kind == 1 and isinstance(circuit, etid.SkinRC):  # skin without R_s
        circuit = etid.ParallelRC(circuit.r_p, circuit.c_p)
    f = frequencies(rng, points)
    return Spectrum(f, noisy(response(circuit, f), rng), type(circuit)(), exact(circuit))


def no_answer(
    change: Callable[[np.ndarray], np.ndarray],
) -> Callable[[np.random.Generator], Spectrum]:
    """Impedances that are none of skin."""
    return lambda rng: dataclasses.replace(of := good(rng), z=change(of.z), truth={})


def wrong_unit(rng: np.random.Generator) -> Spectrum:
    """Ω for kΩ, or kΩ for Ω, from one frequency to another."""
    of = good(rng)
    first, last = np.sort(rng.choice(POINTS + 1, 2, replace=False))
    scale = np.ones(POINTS)
    scale[first:last] = 10.0 ** rng.choice([-3, 3])
    if last - first > POINTS // 2:  # most of the file is right
        scale /= scale[first]
    return dataclasses.replace(of, z=of.z * scale)


def wrong_circuit(rng: np.random.Generator) -> Spectrum:
    """Another circuit than the one that is fitted."""
    kind, f = rng.integers(5), frequencies(rng)
    if kind <= 1:
        of = spread(rng, (0.6, 1.0) if kind else (0.9, 1.0))
        c_p = float(of.tau / of.r_p)
        truth = {**exact(of), "c_p": (c_p, c_p)}
        return Spectrum(f, noisy(response(of, f), rng), etid.SkinRC(), truth)
    if kind == 2:
        of = layers(rng)
        total = float(of.r_1 + of.r_2)
        truth = {"r_s": exact(of)["r_s"], "r_p": (total, total)}
        return Spectrum(f, noisy(response(of, f), rng), etid.SkinRC(), truth)
    of = one_rc(rng)
    z, total = noisy(response(of, f), rng), float(of.r_s + of.r_p)
    if kind == 3:
        truth = {**exact(of), "r_p": (float(of.r_p), total)}
        return Spectrum(f, z, etid.ParallelRC(), truth)
    return Spectrum(f, z, etid.Resistor(), {"r": (total, total)})


def drift(rng: np.random.Generator) -> Spectrum:
    """Skin that changes during the sweep: both resistances by one factor, or R_p alone."""
    f, before = frequencies(rng), one_rc(rng)
    change, alone = np.exp(rng.uniform(-0.7, 0.7)), rng.random() < 0.5
    by = np.linspace(1.0, change, POINTS)
    during = etid.SkinRC(before.r_s * (1.0 if alone else by), before.r_p * by, before.c_p)
    values = {name: np.asarray(getattr(during, name)) for name in during.names()}
    truth = {name: (float(of.min()), float(of.max())) for name, of in values.items()}
    return Spectrum(f, noisy(response(during, f), rng), etid.SkinRC(), truth)


def outliers(rng: np.random.Generator) -> Spectrum:
    """One to six impedances that are wrong by 10 to 300 %."""
    of = good(rng)
    z, where = of.z.copy(), rng.choice(POINTS, rng.integers(1, 7), replace=False)
    size = np.exp(rng.uniform(np.log(0.1), np.log(3.0), where.size))
    z[where] *= 1 + size * np.exp(2j * np.pi * rng.random(where.size))
    return dataclasses.replace(of, z=z)


def beyond_range(rng: np.random.Generator) -> Spectrum:
    """A meter whose current is limited: |Z| does not fall further, its phase stays right."""
    of = good(rng)
    size = np.abs(of.z)
    least = size.min() * (size.max() / size.min()) ** rng.uniform(0.2, 0.8)
    return dataclasses.replace(of, z=of.z * np.hypot(size, least) / size)


FAULTS: Mapping[str, Callable[[np.random.Generator], Spectrum]] = {
    "wrong sign": no_answer(np.conj),  # -Im Z, as it is drawn, in place of Im Z
    "no phase": no_answer(lambda z: np.abs(z).astype(complex)),  # |Z| in place of Z
    "wrong unit": wrong_unit,
    "wrong circuit": wrong_circuit,
    "drift": drift,
    "outliers": outliers,
    "beyond range": beyond_range,
}


class Answer(NamedTuple):
    """What a fit says of a spectrum."""

    verdict: str  # of the fit
    # errors of the elements that have right values, in standard errors
    z: Float[np.ndarray, " element"]
    silent: bool  # whether the fit is called successful, and is wrong


def answer(of: Spectrum) -> Answer:
    """The answer of `identify_impedance` without standard errors."""
    fit = etid.identify_impedance(of.frequency, of.z, circuit=of.circuit, throw=False)
    found = {name: float(getattr(fit.circuit, name)) for name in fit.circuit.names()}
    names = {name: name for name in of.truth if name in found}
    if isinstance(fit.circuit, etid.SkinLayers) and names:  # the fit may exchange the two
        first, second = (found[f"r_{i}"] * found[f"c_{i}"] for i in (1, 2))
        names |= dict(zip(LAYERS, LAYERS[::-1], strict=True)) if first > second else {}
    value = np.array([found[name] for name in names.values()])
    stderr = np.array([float(getattr(fit.stderr, name)) for name in names.values()])
    right = np.clip(value, *np.reshape([of.truth[name] for name in names], (-1, 2)).T)
    with np.errstate(divide="ignore", invalid="ignore"):  # an element of 0 has no error
        z, relative = (value - right) / stderr, (value - right) / right
    wrong = ((np.abs(z) > SILENT) & (np.abs(relative) > NOTICED)).any() or not names
    return Answer(fit.verdict, z, fit.usable and bool(wrong))


OPTIONS = (
    option("--spectra", default=300, help="of each fault"),
    option("--good", default=1000, help="of each number of frequencies"),
    option("--drawn", default=60, help="of each circuit string"),
    option("--seed", default=0),
)


def with_fault(seed: int, spectra: int) -> Iterator[Target]:
    """Silent answers to spectra of each fault."""
    for fault, (name, draw) in enumerate(FAULTS.items()):
        seeds = [(seed, fault, number) for number in range(spectra)]
        answers = [answer(draw(np.random.default_rng(one))) for one in seeds]
        wrong = [one for one, said in zip(seeds, answers, strict=True) if said.silent]
        counts = counted(np.array([one.verdict for one in answers]))
        text = f"{len(wrong)} silent {wrong or ''}; {counts}"
        yield Target.of(TARGETS, "silent", len(wrong), f"{name}: ", text=text)


def without_fault(seed: int, spectra: int) -> Iterator[Target]:
    """Refused good spectra, and the coverage of the intervals."""
    for points in GOOD_POINTS:
        seeds = [(seed, points, number) for number in range(spectra)]
        answers = [answer(good(np.random.default_rng(one), points)) for one in seeds]
        verdicts = np.array([one.verdict for one in answers])
        z = np.concatenate([one.z for one in answers if one.verdict == "successful"])
        refused, silent = (~np.isin(verdicts, ACCEPTED)).sum(), sum(one.silent for one in answers)
        inside = np.abs(z) < NORMAL_95
        interval = clopper_pearson(int(inside.sum()), z.size)
        rms = f"rms z {np.sqrt(np.mean(z**2)):.3f}, max |z| {np.abs(z).max():.1f}"
        values = (
            (silent, str(silent), None),
            (refused / len(answers), f"{refused} of {len(answers)}; {counted(verdicts)}", None),
            (float(inside.mean()), f"{inside.mean():.4f}, {rms}", interval),
        )
        of = f"good, {points} frequencies: "
        for name, (value, text, scatter) in zip(TARGETS, values, strict=True):
            yield Target.of(TARGETS, name, value, of, text=text, interval=scatter)


def of_string(string: str, rng: np.random.Generator) -> Spectrum:
    """A spectrum of a circuit string whose elements are drawn."""
    typical = etid.circuit(string)
    level, duration = typical.scaling()
    logs = np.array(typical.log_values()) + rng.uniform(-9.0, 2.0) * level
    has_size = (level != 0) | (duration != 0)  # all but exponents
    logs = np.where(has_size, logs + 1.2 * rng.standard_normal(logs.size), logs)
    is_exponent = np.array([name.startswith("alpha") for name in typical.names()])
    values = np.where(is_exponent, rng.uniform(0.6, 0.97, logs.size), np.exp(logs))
    places = np.asarray(in_order(typical, np.log(values)))
    circuit, f = type(typical)(*values[places]), np.geomspace(1e6, 0.1, 60)
    z, parts = circuit.response(f), rng.standard_normal((2, f.size))
    z = z + 3e-3 * np.abs(z) * (parts[0] + 1j * parts[1])
    return Spectrum(f, z, typical, exact(circuit))


def of_strings(seed: int, spectra: int) -> Iterator[Target]:
    """Silent answers to spectra of circuit strings."""
    for number, string in enumerate(STRINGS):
        seeds = [(seed, len(FAULTS) + number, draw) for draw in range(spectra)]
        answers = [answer(of_string(string, np.random.default_rng(one))) for one in seeds]
        wrong, verdicts = sum(one.silent for one in answers), [one.verdict for one in answers]
        text = f"{wrong} silent; {counted(np.array(verdicts))}"
        yield Target.of(TARGETS, "silent", wrong, f"{string}: ", text=text)


def main(arguments: argparse.Namespace) -> bool:
    of = arguments
    found = [*with_fault(of.seed, of.spectra), *without_fault(of.seed, of.good)]
    return report([*found, *of_strings(of.seed, of.drawn)])
