"""Closed loop: the charge at 98 electrodes under a fingertip that changes, and the cap on it.

`control_hazards` counts the pulses above the cap, `control_loop` what is sent when the loop of a
display meets a hazard. The rest is the charge against ngspice (`control_plant`): some electrodes
stay dry, some become wet within 100 ms, some sweat, and one is lifted off and put back.

etid's rivals get the true charge Q of the last pulse, as from a perfect sensor. They regulate the
terminal voltage to that of a typical dry fingertip; keep an amplitude that is calibrated once, at
the tenth pulse; integrate the error, A += k (Q* − Q) / q₀ with q₀ of typical dry skin (k = 0.25 is
stable up to eight times this q₀); or adapt a feed-forward gain to a reference model by the
normalised MIT rule (Åström and Wittenmark 1995, chapter 5).

The targets count every pulse but those of a change and the two that follow it. Beside what misses
the charge stands how many normal errors would, by the sweating since the amplitude was given and
the standard error of the charge of the last pulse. They excuse none.
"""

import argparse
import math
import pathlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
import scipy.special
from jaxtyping import Array, Float

import etid
from benchmarks import ngspice
from benchmarks.charts import INK, new_figure, save
from benchmarks.display import control_hazards, control_loop
from benchmarks.display.control_plant import (
    KINDS,
    OLDER,
    STEP,
    Display,
    Fingertip,
    by_ngspice,
    closed_loop,
)
from benchmarks.ladder import BEFORE, TWO, WHITE
from benchmarks.machine import RESULTS, write_csv
from benchmarks.runner import Target, at_most, option, report, show
from etid.display import Controller, Tracker
from etid.display.state import ElectrodeState, TrackerState
from etid.estimators.unknowns import LoadUnknowns
from etid.plotting.style import BLUE, RED
from etid.simulation.scenes import Scene
from etid.solvers.matrices import inverse_of_few

WANTED = 80e-9  # [C] per phase
CAP = 5e-3  # [A]
FALLBACK = 0.3  # of the amplitude of the unloaded record
CHANGE = 6e-3  # random walk that the tracker expects [1/√pulse], about as fast as sweating
PART = 4  # of the pulses of hazards, with noise before the filter
NEAR = 0.02  # relative error of a charge that meets the target
TARGETS = {
    f"pulses that miss the charge by more than {NEAR:.0%}": at_most(0),
    "largest current [A]": at_most(CAP),
    "pulses above the cap but the first after an unseen change": at_most(0),
    "pulses above the worst case that the command states": at_most(0),
}
GAIN, REFERENCE_POLE, ADAPTATION = 0.25, 0.5, 0.5

# Dashes and colour of a line.
STYLES = {
    "etid": ("-", BLUE),
    "constant voltage": ("--", RED),
    "constant amplitude": ("-.", "#2e7d32"),
    "integral": (":", INK),
    "model reference": ((0, (4, 1)), "#8e44ad"),
}
NOISIER = "#f39c12"  # of etid with more noise

Command = Callable[[int, np.ndarray, np.ndarray, np.ndarray], np.ndarray]
OPTIONS = (
    option("--electrodes", default=98),
    option("--pulses", default=120),
    option("--snr", default=(60.0, 40.0), help="dB"),
    option("--hazard-electrodes", default=114),
    option("--hazard-pulses", default=4400),
    option("--loop-draws", default=6, help="runs of each hazard of the loop"),
    option("-o", "--output", default=RESULTS / "control", help="of the .csv and the .svg"),
)


def main(arguments: argparse.Namespace) -> bool:
    asked = [*loop(arguments), *hazards(arguments)]
    fingertip = Fingertip(arguments.electrodes, arguments.pulses)
    runs: dict[str, Run] = {}
    for snr in arguments.snr:
        scene = Scene((), TWO, samples=40_000, snr_db=snr, trigger_jitter_rms=100e-9)
        display = Display(scene, fingertip.loads, 1, by_ngspice)
        found = {"etid": identifying(scene, display, fingertip.load)}
        if not runs:
            found |= {
                name: blind(display, fingertip.load, one) for name, one in rivals(display).items()
            }
        for name, run in found.items():
            print(f"{snr:g} dB  {name:<20}{run.text(fingertip.counts)}", flush=True)
        asked += found["etid"].targets(fingertip.counts, f"{snr:g} dB: ")
        runs |= {f"{name}, {snr:g} dB": run for name, run in found.items()}
    draw(runs, fingertip, arguments.output.with_suffix(".svg"))
    return report(asked)


def loop(arguments: argparse.Namespace) -> Sequence[Target]:
    """Print and write what the loop that runs a display sends; the targets of all cells."""
    met = control_hazards.Hazards(arguments.snr[0], 0)
    rows = []
    for row in control_loop.rows(met, arguments.loop_draws):
        show(row)
        rows.append(row)
    write_csv(arguments.output.with_name(f"{arguments.output.stem}_loop.csv"), rows)
    return list(control_loop.targets(rows))


def hazards(arguments: argparse.Namespace) -> Iterator[Target]:
    """Print and write the pulses above the cap; the targets of all cells together."""
    rows, most = [], arguments.hazard_pulses
    runs = [(snr, WHITE, most) for snr in arguments.snr]
    runs.append((arguments.snr[0], BEFORE, math.ceil(most / PART)))
    for seed, (snr, noise, pulses) in enumerate(runs):
        found = control_hazards.Hazards(snr, seed, electronics=noise)
        controller = found.controller(arguments.hazard_electrodes)
        given = found.given(controller, control_hazards.CELLS, pulses)
        rows += [of.row(snr, cell, noise) for cell, of in given.items()]
    for row in rows:
        show(row)
    write_csv(arguments.output.with_suffix(".csv"), rows)
    names = list(TARGETS)[2:]
    for name, column in zip(names, ("above_otherwise", "above_stated_worst"), strict=True):
        yield Target.of(TARGETS, name, sum(row[column] for row in rows))


class Run(NamedTuple):
    """What a controller has delivered; all are (pulse, electrode)."""

    charge: np.ndarray  # charge in the phase [C]
    peak: np.ndarray  # largest current [A]
    fallback: np.ndarray  # whether the amplitude was the fallback
    allowed: np.ndarray  # probability that noise alone misses the target

    @classmethod
    def of(cls, rows: Sequence[tuple]) -> "Run":
        return cls(*map(np.array, zip(*rows, strict=True)))

    def errors(self, counts: np.ndarray) -> np.ndarray:
        """Relative errors of the charge of the pulses that count."""
        return np.abs(self.charge / WANTED - 1)[counts]

    def text(self, counts: np.ndarray) -> str:
        """One line: errors, the largest current, commands from a failed fit."""
        error = self.errors(counts)
        return (
            f"median {np.median(error):7.2%}  p99 {np.percentile(error, 99):7.2%}  worst "
            f"{error.max():7.2%}  within {NEAR:.0%}: {np.mean(error <= NEAR):6.1%}  missed "
            f"{np.sum(error > NEAR)} of {error.size} (noise alone "
            f"{self.allowed[counts].sum():.1f})  largest charge "
            f"{self.charge.max() / WANTED:.1f} times the wanted, current "
            f"{1e3 * self.peak.max():.2f} mA  fallback {np.mean(self.fallback & counts):.2%}"
        )

    def targets(self, counts: np.ndarray, at: str) -> Iterator[Target]:
        """Whether every charge that counts is near, and the cap on the current holds."""
        near, largest = list(TARGETS)[:2]
        missed = int(np.sum(self.errors(counts) > NEAR))
        text = f"{missed} of {counts.sum()} ({self.allowed[counts].sum():.1f} by noise alone)"
        yield Target.of(TARGETS, near, missed, at, text=text)
        yield Target.of(TARGETS, largest, float(self.peak.max()), at)


def identifying(scene: Scene, display: Display, load: np.ndarray) -> Run:
    """The tracker and the controller of etid, with a driver that is identified from ngspice."""
    records = list(ngspice.record(scene, 0).calibrations.recordings())
    driver, lanes = etid.identify_driver(records), load.shape[1]
    tracker = Tracker.of(driver, records[0], electrodes=lanes, change=CHANGE)
    limits = {"current_cap": CAP, "fallback": FALLBACK, "amplitude_step": STEP}
    controller = Controller.of(tracker, **limits)
    last, rows = np.full(lanes, np.nan), []  # charge per unit of amplitude, at the pulse before
    loop = closed_loop(display, controller, load, WANTED)
    for of, (state, command, amplitude) in zip(load, loop, strict=True):
        now = display.charge[of, 0]
        allowed = missing(now / last - 1, stderr(controller, state))
        peak = display.peak[of] * command.amplitude
        rows.append((display.charges(of, amplitude), peak, command.reason == "fallback", allowed))
        last = now
    return Run.of(rows)


def blind(display: Display, load: np.ndarray, command: Command) -> Run:
    """A controller that sees charge and voltage of the last pulse, without noise."""
    lanes = load.shape[1]
    amplitude, rows = np.zeros((OLDER, lanes)), []
    new = np.full(lanes, FALLBACK)
    for pulse, of in enumerate(load):
        amplitude = np.concatenate([new[None], amplitude[:-1]])
        charge = display.charges(of, amplitude)
        rows.append((charge, display.peak[of] * new, np.zeros(lanes, bool), np.zeros(lanes)))
        new = command(pulse, new, charge, display.mean[of] * new)
    return Run.of(rows)


def rivals(display: Display) -> dict[str, Command]:
    """The controllers that identify nothing."""
    typical = display.charge[0, 0]  # of dry skin
    nominal = WANTED / typical
    held = display.mean[0] * nominal
    gain, model = np.asarray(nominal / WANTED), 0.0

    def adaptive(_: int, amplitude: np.ndarray, charge: np.ndarray, v: Any) -> np.ndarray:
        nonlocal gain, model
        model = REFERENCE_POLE * model + (1 - REFERENCE_POLE) * WANTED
        normal = ADAPTATION * model / (WANTED**2 + charge**2)
        gain = np.maximum(gain - normal * (charge - model) * nominal / WANTED, 0.0)
        return gain * WANTED

    return {
        "constant voltage": lambda _, amplitude, charge, v: amplitude * held / v,
        "constant amplitude": lambda pulse, amplitude, charge, _: (
            amplitude * WANTED / charge if pulse == 9 else amplitude
        ),
        "integral": lambda _, amplitude, charge, v: np.maximum(
            amplitude + GAIN * (WANTED - charge) / typical, 0.0
        ),
        "model reference": adaptive,
    }


@eqx.filter_jit
def stderr(controller: Controller, state: TrackerState) -> Float[Array, " lane"]:
    """Relative standard error of the charge of the last pulse."""
    circuit = controller.tracker.model.circuit

    def of(lane: ElectrodeState) -> Float[Array, ""]:
        logs = LoadUnknowns.of(lane.own).log_elements
        found = controller.model.current(circuit, logs, inverse_of_few(lane.information))
        return found.charge_stderr / found.charge

    return jax.vmap(of)(state.electrodes)


def missing(
    mean: Float[np.ndarray, " lane"], sigma: Float[Array, " lane"]
) -> Float[np.ndarray, " lane"]:
    """Probability that a normal error misses the target; 0 where there is no estimate."""
    tails = (-NEAR - mean) / np.asarray(sigma), (mean - NEAR) / np.asarray(sigma)
    return np.nan_to_num(sum(scipy.special.ndtr(tail) for tail in tails))


def draw(runs: dict[str, Run], fingertip: Fingertip, path: pathlib.Path) -> None:
    """Charge against pulse: one panel for each kind of skin, one line for each controller."""
    figure, grid = new_figure(len(KINDS), 1, (7.2, 8.0), sharex=True)
    panels = grid[:, 0]
    for panel, (kind, title) in zip(panels, KINDS.items(), strict=True):
        at = fingertip.kind.index(kind)
        for name, run in runs.items():
            plain = name.split(",", maxsplit=1)[0]
            own, first = plain == "etid", run is runs[next(iter(runs))]
            dashes, colour = STYLES[plain]
            panel.semilogy(
                np.maximum(run.charge[:, at] / WANTED, 1e-3),
                linestyle=dashes,
                color=colour if first or not own else NOISIER,
                linewidth=2.4 if own and first else 1.2,
                zorder=2 if own and first else 3,
                label=name if own else plain,
            )
        panel.axhspan(1 - NEAR, 1 + NEAR, color="0.85", zorder=0)
        panel.set_ylim(0.2, 15)
        panel.set_yticks([0.5, 1, 2, 5, 10], ["0.5", "1", "2", "5", "10"])
        panel.minorticks_off()
        panel.set_title(title, loc="left", fontsize="medium")
        panel.set_ylabel("charge / wanted")
    panels[-1].set_xlabel("pulse")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=3, frameon=False)
    save(figure, path)
