"""An independent referee: the transformer of a scene solved by ngspice, step by step in time.

`record(scene, seed)` stands in for `scene.simulate(seed)`: the waveform comes from ngspice (Debian
package `ngspice`), the recorder is the scene's own, with the same draws. One run per circuit and
load, kept in memory and in `CACHE`, serves all draws of noise.

ngspice chooses its own steps, which RELTOL bounds. With 1e-8 the largest deviation from
`Scene.waveform` is 6.2e-6 of the peak, which moves R_s, R_p and C_p at 60 dB by 0.003 % (22
circuits, elements spread by 30 %, no rounding to codes). With 1e-9 one of them ends with "timestep
too small". A 16-bit converter rounds a few of a hundred samples to the other code, which moves the
elements by a tenth of their standard errors.
"""

import functools
import hashlib
import io
import math
import pathlib
import shutil
import subprocess
import tempfile

import numpy as np
import scipy.interpolate
from jaxtyping import Complex, Float

import etid
from benchmarks.machine import ROOT
from benchmarks.spice import PARTS
from etid.circuits.circuit import AbstractCircuit
from etid.recordings.replacing import replacing
from etid.simulation import transformer
from etid.simulation.scenes import Scene, Trial
from etid.simulation.transformer import Impedance, TransformerDriver

CACHE = ROOT / "results" / "ngspice"
RELTOL = 1e-8
LONGEST_STEP = 2e-6  # [s]
SETTLING = 0.1  # [s] before the recorded periods; the slowest time constant is 4 ms
SETTLED = 1e-5  # largest difference between the last two periods, relative to the peak
FINE = 8  # points of the interpolated period per period of the highest harmonic asked for

OPTIONS = f".options method=trap trtol=1 reltol={RELTOL!r} abstol=1e-12 vntol=1e-9 chgtol=1e-11"

# Parts by their name in `PARTS`, from the source to the terminal o, with the nodes they connect.
NODES = {
    "Rsrc": "source p", "Cpri": "p 0", "Rpw": "p a", "Llp": "a m", "Lm": "m 0", "Rcore": "m 0",
    "Rsw": "w b", "Lls": "b s", "Csec": "s 0", "Cww": "p s",
    "Rprot": "s o", "Ccab": "o 0", "Rmeas": "o 0", "Cmeas": "o 0",
}  # fmt: skip


class NgspiceError(RuntimeError):
    """ngspice is absent, or could not solve a circuit; says what to do."""


def netlist(driver: TransformerDriver, load: Impedance | AbstractCircuit, pulse_rate: float) -> str:
    """The circuit of `etid.simulation.transformer` with its load, and a run into its steady state.

    The windings are an ideal transformer 1:n between m and w, with the leakage, magnetising and
    loss elements of each side around it.
    """
    if not 0 < driver.edge < driver.width:
        raise ValueError(
            f"edge is {driver.edge:g} s, width {driver.width:g} s; ngspice needs 0 < edge < width"
        )
    period = 1 / pulse_rate
    settled = math.ceil(SETTLING * pulse_rate) * period
    run = (LONGEST_STEP, settled + 2 * period, settled - 2 * LONGEST_STEP, LONGEST_STEP)
    lines = [*_circuit(driver, period), *_load(load), OPTIONS, ".save v(o)"]
    return "\n".join([*lines, f".tran {_text(*run)}", ".end", ""])


def single_pulse(driver: TransformerDriver, load: Impedance, duration: float) -> str:
    """The same circuit from rest, with one pulse; the current through the load is saved as well."""
    behind = (line.replace(" o ", " load ", 1) for line in _load(load))
    lines = [*_circuit(driver, 10 * duration), "Vload o load 0", *behind, OPTIONS]
    run = _text(LONGEST_STEP, duration, 0.0, LONGEST_STEP)
    return "\n".join([*lines, ".save v(o) i(Vload)", f".tran {run}", ".end", ""])


def _circuit(driver: TransformerDriver, period: float) -> list[str]:
    """Source and transformer, up to the terminal o."""
    pulse = (0.0, driver.amplitude, driver.lead_in, driver.edge, driver.edge)
    return [
        "Pulse transformer of etid.simulation.transformer with a load at node o",
        f"Vp source 0 PULSE({_text(*pulse, driver.width - driver.edge, period)})",
        *(f"{name} {nodes} {_text(getattr(driver, PARTS[name]))}" for name, nodes in NODES.items()),
        "* ideal transformer: w has n times the voltage of m, m carries n times the current of w",
        f"En turn 0 m 0 {_text(driver.turns)}",
        "Vi turn w 0",
        f"Fn m 0 Vi {_text(driver.turns)}",
    ]


def _load(load: Impedance | AbstractCircuit) -> list[str]:
    if isinstance(load, transformer.OpenLoad):
        return ["* no load"]
    if isinstance(load, transformer.ResistorLoad):
        return ["* known resistor", f"R o 0 {_text(load.r)}"]
    if isinstance(load, transformer.SkinLoad):
        parts = (f"Rs o x {_text(load.r_s)}", f"Rp x 0 {_text(load.r_p)}")
        return ["* skin", *parts, f"Cp x 0 {_text(load.c_p)}"]
    if isinstance(load, AbstractCircuit):
        return [*etid.netlist(load).splitlines(), "X1 o 0 load"]
    raise ValueError(
        f"ngspice has no netlist for the load {load!r}; use OpenLoad, ResistorLoad, SkinLoad or "
        "a circuit"
    )


def _text(*numbers: float) -> str:
    """All digits; numpy's numbers as well would be written with their type."""
    return " ".join(repr(float(number)) for number in numbers)


def record(scene: Scene, seed: int) -> etid.Study:
    """A draw of a scene as its `simulate` makes it, with waveforms of ngspice."""

    def voltage(trial: Trial, f: Float[np.ndarray, " f"]) -> Complex[np.ndarray, " f"]:
        pulse_rate = float(f[0])
        return harmonics(netlist(scene.driver, trial.load, pulse_rate), pulse_rate, f.size)

    return scene.record(seed, voltage)


@functools.lru_cache(maxsize=256)
def harmonics(netlist: str, pulse_rate: float, count: int) -> Complex[np.ndarray, " count"]:
    """Fourier coefficients [V] of the steady state at the first harmonics.

    The steps of ngspice are uneven: a cubic spline through them is sampled evenly.
    """
    time, v = solve(netlist)
    period = 1 / pulse_rate
    points = FINE * count
    last = time[-1] - period + period * np.arange(points) / points
    spline = scipy.interpolate.CubicSpline(time, v)
    wave = spline(last)
    change = np.abs(wave - spline(last - period)).max() / np.abs(wave).max()
    if change > SETTLED:
        raise NgspiceError(
            f"the last two periods differ by {change:.1e} of the peak after {SETTLING:g} s; "
            "raise benchmarks.ngspice.SETTLING"
        )
    return np.fft.rfft(wave)[1 : count + 1] / points


def solve(netlist: str) -> Float[np.ndarray, "row step"]:
    """Times [s] and what is saved, such as v(o) [V], at the steps of ngspice, or from `CACHE`."""
    name = hashlib.sha256(f"{_version()}\n{netlist}".encode()).hexdigest()[:32]
    kept = CACHE / f"{name}.npy"
    if kept.exists():
        return np.load(kept)
    with tempfile.TemporaryDirectory() as folder:
        circuit, raw = pathlib.Path(folder, "circuit.cir"), pathlib.Path(folder, "out.raw")
        circuit.write_text(netlist)
        said = _ngspice("-b", "-n", "-r", str(raw), str(circuit))
        if not raw.exists():
            raise NgspiceError(f"ngspice wrote no waveform; it says:\n{said}")
        found = waveform(raw.read_bytes())
    CACHE.mkdir(parents=True, exist_ok=True)
    with replacing(kept) as partial:
        np.save(partial, found)
    return found


def waveform(raw: bytes) -> Float[np.ndarray, "row step"]:
    """Time [s] and the voltages [V] or currents [A] of a binary raw file of ngspice."""
    head, mark, body = raw.partition(b"Binary:\n")
    fields = dict(
        line.split(":", 1) for line in io.StringIO(head.decode(errors="replace")) if ":" in line
    )
    points, variables = (int(fields.get(name, "0")) for name in ("No. Points", "No. Variables"))
    if not mark or variables < 2 or points < 2 or len(body) < 8 * variables * points:
        raise NgspiceError(
            f"the raw file has {points} points of {variables} variables in {len(body)} bytes; "
            "expected time and at least one more variable"
        )
    return np.frombuffer(body, count=variables * points).reshape(points, variables).T


@functools.cache
def _version() -> str:
    return next((line for line in _ngspice("--version").splitlines() if "ngspice-" in line), "")


def _ngspice(*arguments: str) -> str:
    """Run ngspice and return what it says."""
    program = shutil.which("ngspice")
    if program is None:
        raise NgspiceError("ngspice is not installed; on Debian: apt-get install ngspice")
    done = subprocess.run([program, *arguments], capture_output=True, text=True, check=False)
    said = done.stdout + done.stderr
    if done.returncode != 0:
        raise NgspiceError(f"ngspice ended with {done.returncode}; it says:\n{said}")
    return said
