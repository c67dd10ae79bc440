"""Spectra fitted by impedance.py, lmfit and pyimpspec, as their users do.

All get the same starts and no standard errors. impedance.py weighs by |Z|; lmfit's model is written
by hand, positive elements, residuals relative to |Z|; pyimpspec gets one method and one weight, of
the 36 combinations that it tries by default.
"""

import time
import warnings

import numpy as np
import pyimpspec  # pyright: ignore[reportMissingImports]  # in its own environment
from impedance.models.circuits import (  # pyright: ignore[reportMissingImports]
    CustomCircuit,
)
from lmfit import Parameters, minimize  # pyright: ignore[reportMissingImports]

from benchmarks.rivals import serve


def _parallel(*z):
    return 1 / sum(1 / one for one in z)


def _phase(s, q, alpha):
    return 1 / (q * s**alpha)


def _warburg(s, a):
    return a * np.sqrt(2 / s)


MODELS = {
    "Boukamp TC-1": lambda s, r, r1, c1, r2, a: (
        r + _parallel(r1, 1 / (s * c1)) + _parallel(r2, _warburg(s, a))
    ),
    "pyimpspec 2": lambda s, r, r1, q, n: r + _parallel(r1, _phase(s, q, n)),
    "pyimpspec 3": lambda s, r, q, n, r1, a: r + _parallel(_phase(s, q, n), r1 + _warburg(s, a)),
    "pyimpspec 4": lambda s, inductance, n, r, r1, q1, n1, r2, q2, n2: (
        (s * inductance) ** n
        + r
        + _parallel(r1, _phase(s, q1, n1))
        + _parallel(r2, _phase(s, q2, n2))
    ),
    "pyimpspec 5": lambda s, r, r1, q1, n1, r2, q2, n2, r3, q3, n3: (
        r
        + _parallel(r1, _phase(s, q1, n1))
        + _parallel(r2, _phase(s, q2, n2))
        + _parallel(r3, _phase(s, q3, n3))
    ),
    "pyimpspec 13": lambda s, r, r1, c1, r2, c2, r3, inductance: (
        r
        + _parallel(r1, 1 / (s * c1))
        + _parallel(r2, 1 / (s * c2))
        + _parallel(r3, s * inductance)
    ),
    "pyimpspec 15": lambda s, c, r1, q, n, r2, d, tau: _parallel(
        1 / (s * c),
        r1 + _parallel(_phase(s, q, n), r2 + d * np.tanh(np.sqrt(s * tau)) / np.sqrt(s * tau)),
    ),
    "impedance.py's": lambda s, r, r1, c1, r2, z0, tau, c2: (
        r
        + _parallel(r1, 1 / (s * c1))
        + _parallel(r2 + z0 / (np.sqrt(s * tau) * np.tanh(np.sqrt(s * tau))), 1 / (s * c2))
    ),
}


def by_impedance_py(of, f, z, start):
    """`CustomCircuit`, weighted by |Z|."""
    circuit = CustomCircuit(str(of["string"]), initial_guess=list(start))
    circuit.fit(f, z, weight_by_modulus=True)
    return circuit.parameters_


def by_lmfit(of, f, z, start):
    """`minimize` (leastsq) of relative residuals."""
    unknown, s, model = Parameters(), 2j * np.pi * f, MODELS[str(of["name"])]
    for i, value in enumerate(start):
        unknown.add(f"p{i}", value=value, min=0.0)

    def residual(p):
        missed = (model(s, *(one.value for one in p.values())) - z) / np.abs(z)
        return np.concatenate([missed.real, missed.imag])

    found = minimize(residual, unknown, nan_policy="propagate")
    return [one.value for one in found.params.values()]


def by_pyimpspec(of, f, z, start):
    """`fit_circuit` by one method, weighted by |Z|."""
    code = str(of["code"]).format(*to_pyimpspec(of, start))
    data = pyimpspec.DataSet(f[::-1], z[::-1])
    found = pyimpspec.fit_circuit(
        pyimpspec.parse_cdc(code), data, method="least_squares", weight="boukamp", num_procs=1
    )
    values = []
    for element in found.circuit.get_elements(recursive=True):
        kept = {"W": ("Y",), "Ws": ("Y", "B"), "Wo": ("Y", "B")}.get(element.get_symbol())
        every = element.get_values()
        values += [every[name] for name in kept or every]
    return from_pyimpspec(of, np.array(values))


def to_pyimpspec(of, values):
    """Elements as pyimpspec has them: W by Y, Ws and Wo by Y and B, and La by L^α."""
    values, kinds = np.array(values, float), [str(kind) for kind in of["kinds"]]
    for i, kind in enumerate(kinds):
        if kind == "w":
            values[i] = 1 / (np.sqrt(2) * values[i])
        if kind in ("r_ws", "r_wo"):
            r, tau = values[i : i + 2]
            values[i : i + 2] = tau / r**2, tau
        if kind == "l_la":
            values[i] **= values[i + 1]
    return values


def from_pyimpspec(of, values):
    """The inverse."""
    kinds = [str(kind) for kind in of["kinds"]]
    for i, kind in enumerate(kinds):
        if kind == "w":
            values[i] = 1 / (np.sqrt(2) * values[i])
        if kind in ("r_ws", "r_wo"):
            y, b = values[i : i + 2]
            values[i : i + 2] = np.sqrt(b / y), b
        if kind == "l_la":
            values[i] **= 1 / values[i + 1]
    return values


TOOLS = {"impedance.py": by_impedance_py, "lmfit": by_lmfit, "pyimpspec": by_pyimpspec}


def solve(of):
    """Elements and seconds of each tool and draw; NaN where it raised an error."""
    warnings.simplefilter("ignore")
    shape = (len(TOOLS), *of["start"].shape)
    found, seconds = np.full(shape, np.nan), np.full(shape[:2], np.nan)
    for tool, fit in enumerate(TOOLS.values()):
        for draw, start in enumerate(of["start"]):
            begin = time.perf_counter()
            try:
                found[tool, draw] = fit(of, of["f"], of["z"][draw], start)
            except Exception:  # whatever a fit may raise is no answer
                continue
            seconds[tool, draw] = time.perf_counter() - begin
    return {"elements": found, "seconds": seconds}


if __name__ == "__main__":
    serve(solve)
