"""Published spectra fitted by etid, impedance.py, lmfit and pyimpspec: errors and times.

The circuits and frequencies are those of the documentation of pyimpspec 5.1 (its mock data, of
which circuit 1 is TC-1 of Boukamp, J. Electrochem. Soc. 142 (1995) 1885) and of impedance.py 1.7
(its example of a battery, with the elements of its fit), with 0.1 % of |Z| as noise. etid starts by
itself; the others at the truth times e^(±0.7), exponents at 0.8. No tool is told the noise.

An answer is right if no element that the spectrum determines is wrong by five standard errors of
the Cramer-Rao bound. A peer's time is that of the fit from a given start.
"""

import argparse
import time
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

import etid
from benchmarks.rivals import RivalError, exchange
from benchmarks.runner import Target, at_least, option, report
from etid.circuits.branches import in_order
from etid.circuits.circuit import with_slopes

NOISE = 1e-3  # of |Z|
RIGHT = 5.0  # standard errors of the bound
START = 0.7  # of the logarithms, up or down
TARGETS = {"right": at_least(1.0)}
PINNED = True
PEERS = ("impedance.py", "lmfit", "pyimpspec")


class Case(NamedTuple):
    """A published circuit."""

    string: str  # in the notation of impedance.py
    code: str  # in that of pyimpspec
    values: tuple[float, ...]  # [SI], in the order of the string
    decades: tuple[float, float]  # log10 of the least and of the largest frequency [Hz]


W, WS = 1 / (np.sqrt(2) * 4e-4), 1 / (np.sqrt(2) * 2.357e-3)  # impedance.py's A_W of pyimpspec's Y
CASES = {
    "Boukamp TC-1": Case(
        "R0-p(R1,C1)-p(R2,W1)",
        "R{{R={0}}}(R{{R={1}}}C{{C={2}}})(R{{R={3}}}W{{Y={4}}})",
        (100, 200, 0.8e-6, 500, W),
        (0.0, 4.0),
    ),
    "pyimpspec 2": Case(
        "R0-p(R1,CPE1)",
        "R{{R={0}}}(R{{R={1}}}Q{{Y={2},n={3}}})",
        (120, 430, 6.2e-5, 0.93),
        (-0.75, 2.25),
    ),
    "pyimpspec 3": Case(
        "R0-p(CPE1,R1-W1)",
        "R{{R={0}}}(Q{{Y={1},n={2}}}[R{{R={3}}}W{{Y={4}}}])",
        (20, 25e-6, 0.89, 100, WS),
        (-0.5, 3.0),
    ),
    "pyimpspec 4": Case(
        "La0-R0-p(R1,CPE1)-p(R2,CPE2)",
        "La{{L={0},n={1}}}R{{R={2}}}(R{{R={3}}}Q{{Y={4},n={5}}})(R{{R={6}}}Q{{Y={7},n={8}}})",
        (2e-6 ** (1 / 0.88), 0.88, 0.02, 0.01, 4.1, 0.47, 0.1, 530, 0.78),
        (-2.0, 3.5),
    ),
    "pyimpspec 5": Case(
        "R0-p(R1,CPE1)-p(R2,CPE2)-p(R3,CPE3)",
        "R{{R={0}}}(R{{R={1}}}Q{{Y={2},n={3}}})(R{{R={4}}}Q{{Y={5},n={6}}})"
        "(R{{R={7}}}Q{{Y={8},n={9}}})",
        (144, 240.7, 1.792e-7, 0.91, 830.1, 7.157e-7, 0.87, 490.3, 1.629e-5, 0.94),
        (0.5, 4.5),
    ),
    "pyimpspec 13": Case(
        "R0-p(R1,C1)-p(R2,C2)-p(R3,L3)",
        "R{{R={0}}}(R{{R={1}}}C{{C={2}}})(R{{R={3}}}C{{C={4}}})(R{{R={5}}}L{{L={6}}})",
        (70, 100, 1e-4, 200, 2.5e-3, 50, 300),
        (-2.0, 2.0),
    ),
    "pyimpspec 15": Case(
        "p(C1,R1-p(CPE1,R2-Ws1))",
        "(C{{C={0}}}[R{{R={1}}}(Q{{Y={2},n={3}}}[R{{R={4}}}Ws{{Y={5},B={6}}}])])",
        (2e-10, 1.5e3, 5e-5, 0.8, 500, np.sqrt(150 / 4e-5), 150),
        (-3.0, 6.0),
    ),
    "impedance.py's": Case(
        "R0-p(R1,C1)-p(R2-Wo1,C2)",
        "R{{R={0}}}(R{{R={1}}}C{{C={2}}})([R{{R={3}}}Wo{{Y={4},B={5}}}]C{{C={6}}})",
        (1.65e-2, 8.68e-3, 3.32, 5.39e-3, 6.31e-2, 2.37e2, 0.22),
        (-3.0, 4.0),
    ),
}
POINTS = 10  # per decade
OPTIONS = (
    option("--draws", default=20, help="of noise and start, of each circuit"),
    option("--seed", default=0),
)


class Drawn(NamedTuple):
    """Spectra of a case."""

    f: Float[np.ndarray, " frequency"]
    z: Complex[np.ndarray, "draw frequency"]
    start: Float[np.ndarray, "draw element"]
    bound: Float[np.ndarray, " element"]  # of the logarithms


def drawn(case: Case, draws: int, rng: np.random.Generator) -> Drawn:
    """Spectra with noise, starts of the others, and the Cramer-Rao bound."""
    kind = type(etid.circuit(case.string))
    circuit, logs = kind(*case.values), np.log(case.values)
    f = np.logspace(*case.decades, round(POINTS * np.ptp(case.decades)) + 1)
    z, slopes = (of[0] for of in with_slopes(circuit, logs[None], f[None]))
    rows = slopes / (NOISE * np.abs(z))
    bound = np.sqrt(np.diagonal(np.linalg.inv((rows @ rows.conj().T).real)))
    parts = rng.standard_normal((draws, 2, f.size))
    noisy = z + NOISE * np.abs(z) * (parts[:, 0] + 1j * parts[:, 1])
    start = np.array(case.values) * np.exp(START * rng.choice([-1, 1], (draws, logs.size)))
    is_exponent = np.array([name.startswith("alpha") for name in circuit.names()])
    return Drawn(f, noisy, np.where(is_exponent, 0.8, start), bound)


def by_etid(case: Case, of: Drawn) -> tuple[np.ndarray, np.ndarray]:
    """Elements and seconds of each draw."""
    found, seconds = np.full(of.start.shape, np.nan), np.full(len(of.z), np.nan)
    etid.identify_impedance(of.f, of.z[0], circuit=case.string, throw=False)
    for draw, z in enumerate(of.z):
        begin = time.perf_counter()
        fit = etid.identify_impedance(of.f, z, circuit=case.string, throw=False)
        seconds[draw] = time.perf_counter() - begin
        found[draw] = fit.circuit.values()
    return found, seconds


def ordered(case: Case, found: np.ndarray) -> np.ndarray:
    """The elements, with branches that can be exchanged in their order."""
    logs = np.log(np.where(found > 0, found, np.nan))
    return np.take_along_axis(found, np.asarray(in_order(etid.circuit(case.string), logs)), -1)


def by_peers(name: str, case: Case, of: Drawn) -> tuple[np.ndarray, np.ndarray]:
    """The same of each peer."""
    kinds = [name.rstrip("0123456789_") for name in etid.circuit(case.string).names()]
    told = {"string": case.string, "code": case.code, "name": name, "kinds": kinds}
    found = exchange("spectra", "spectrum_fits", **of._asdict(), **told)
    return found["elements"], found["seconds"]


def main(arguments: argparse.Namespace) -> bool:
    rows, missing = [], ""
    for number, (name, case) in enumerate(CASES.items()):
        of = drawn(case, arguments.draws, np.random.default_rng([arguments.seed, number]))
        tools = {"etid": by_etid(case, of)}
        try:
            elements, seconds = by_peers(name, case, of)
        except RivalError as error:
            missing = str(error)
        else:
            tools |= {tool: (elements[i], seconds[i]) for i, tool in enumerate(PEERS)}
        for tool, (found, seconds) in tools.items():
            with np.errstate(invalid="ignore", divide="ignore"):
                z = np.abs(np.log(ordered(case, found) / np.array(case.values))) / of.bound
            z = z[:, of.bound < 1]
            right = (z < RIGHT).all(axis=1)
            rms = np.sqrt(np.mean(z[right] ** 2)) if right.any() else np.nan
            text = (
                f"{right.sum()} of {right.size}, rms {rms:.2f} bounds, "
                f"{1e3 * np.nanmedian(seconds):.3g} ms"
            )
            limits = TARGETS if tool == "etid" else {"right": (np.nan, np.nan)}
            rows.append(Target.of(limits, "right", right.mean(), f"{name}, {tool}: ", text=text))
    if missing:
        print(f"{', '.join(PEERS)}: {missing}")
    return report(rows) and not missing
