"""Recordings of known circuits, what etid chooses for them, and the fits of all candidates."""

import dataclasses
from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import etid
from benchmarks.ladder import LOADS, recorded
from benchmarks.perturbed_study import PARTS, drawn_driver
from etid.circuits.circuit import AbstractCircuit, ParallelRC, Resistor, SkinCole, SkinRC
from etid.identify.arguments import fed
from etid.identify.options import Options
from etid.identify.study import choices as choices_of
from etid.results.fit import Fit
from etid.selection.search import usual_circuits
from etid.selection.selection import Selection
from etid.simulation.published import REFERENCE
from etid.simulation.scenes import Scene
from etid.simulation.transformer import TransformerDriver

SNR_DB = (20, 30, 40, 50, 60, 80)
RESISTORS = {"dry": 216.6e3, "damp": 21.62e3}  # [ohm], of the paper's Table I


def _layers(skin: SkinRC, share: float, slower: float) -> etid.SkinLayers:
    """R_p in two layers; the second has this share, and is slower by this factor."""
    r_p, tau = float(skin.r_p), float(skin.r_p * skin.c_p)
    r_1, r_2 = (1 - share) * r_p, share * r_p
    return etid.SkinLayers(skin.r_s, r_1, tau / r_1, r_2, slower * tau / r_2)


def _truths() -> dict[str, AbstractCircuit]:
    found: dict[str, AbstractCircuit] = {}
    for name, load in LOADS.items():
        skin = SkinRC(load.r_s, load.r_p, load.c_p)
        found[f"R, {name}"] = Resistor(RESISTORS[name])
        found[f"R‖C, {name}"] = ParallelRC(skin.r_p, skin.c_p)
        found[f"one RC, {name}"] = skin
        for alpha in (0.96, 0.9, 0.8):
            tau = skin.r_p * skin.c_p
            found[f"Cole {alpha}, {name}"] = SkinCole(skin.r_s, skin.r_p, tau, alpha)
        found[f"Warburg, {name}"] = etid.SkinWarburg(skin.r_s, skin.r_p, 3 * skin.r_p * skin.c_p)
        for share, slower in ((0.5, 2.0), (0.5, 4.5), (0.3, 10.0)):
            found[f"layers {share}, {slower:g}, {name}"] = _layers(skin, share, slower)
    simplest_first = Resistor, ParallelRC, SkinRC, SkinCole, etid.SkinWarburg, etid.SkinLayers
    order = [one.__name__ for one in simplest_first]
    return dict(sorted(found.items(), key=lambda item: order.index(type(item[1]).__name__)))


with jax.enable_x64(True):  # of a worker process
    TRUTHS: Mapping[str, AbstractCircuit] = _truths()


@dataclasses.dataclass(frozen=True)
class Drawn:
    """One recording."""

    truth: str  # which of `TRUTHS`
    snr_db: float  # of every record [dB]
    driver: int  # number of the driver
    selection: Selection  # what etid chose
    fits: Mapping[int, Fit]  # fits of every candidate, by number

    @property
    def chosen(self) -> type[AbstractCircuit]:
        """The chosen circuit."""
        return type(self.selection.fit.circuit)

    @property
    def is_right(self) -> bool:
        """Whether the true circuit was chosen."""
        return self.chosen is type(TRUTHS[self.truth])

    @property
    def is_richer(self) -> bool:
        """Whether a circuit with more elements than the truth was chosen."""
        return len(self.chosen.names()) > len(TRUTHS[self.truth].names())


def scene(snr_db: float, driver: int, names: Sequence[str] | None = None) -> Scene:
    """A calibration and one recording of each truth, or of these, behind a driver of its own."""
    behind = drawn_driver(driver, PARTS, TransformerDriver())
    loads = {name: TRUTHS[name] for name in names or TRUTHS}
    return recorded(loads, {"calibration": REFERENCE}, driver=behind, snr_db=snr_db)


def choices(records: Sequence[etid.Recording], driver: etid.Driver) -> list[Selection]:
    """What etid chooses for each recording alone, as `select_circuit` does, in batches."""
    found, _ = choices_of(
        len(records),
        lambda row: fed(records[row], driver),
        Options(usual_circuits()),
        progress=False,
        total=len(records),
    )
    return found


def draws(snr_db: float, number: int, names: Sequence[str] | None = None) -> list[Drawn]:
    """One recording of each truth behind a driver [dB]; none if the driver is not identified."""
    names = names or tuple(TRUTHS)
    study = scene(snr_db, number, names).simulate(number)
    driver = etid.identify_driver(study["calibration"], throw=False)
    if driver.verdict != "successful":
        return []
    records = [study[name] for name in names]
    chosen = choices(records, driver)
    fits = [dict(one.fits) for one in chosen]
    for candidate, circuit in enumerate(usual_circuits()):
        rows = [row for row, of in enumerate(fits) if candidate not in of]
        if rows:
            more = etid.identify_skins([records[row] for row in rows], driver, circuit=circuit)
            for place, row in enumerate(rows):
                fits[row][candidate] = more[place]
    of_all = zip(names, chosen, fits, strict=True)
    return [Drawn(name, snr_db, number, one, of) for name, one, of in of_all]


def quantities(circuit: AbstractCircuit) -> dict[str, tuple[float, np.ndarray]]:
    """R_s and Z(0) [ohm], and the logarithm of the corner frequency, where a circuit has them.

    Beside each stand its derivatives with respect to the elements.
    """
    names, units = circuit.names(), circuit.units()

    def found(values: Array) -> dict[str, Array]:
        of = dict(zip(names, values, strict=True))
        total = jnp.stack([of[name] for name in names if units[name] == "ohm"]).sum()
        wanted = {"Z(0)": total} | ({"R_s": of["r_s"]} if "r_s" in of else {})
        for elements in (("r_p", "c_p"), ("tau",)):
            if {*elements} <= {*names}:
                tau = jnp.stack([of[name] for name in elements]).prod()
                wanted["corner"] = -jnp.log(2 * np.pi * tau)
        return wanted

    values = jnp.asarray(circuit.values())
    slopes = jax.jacfwd(found)(values)
    return {of: (float(v), np.asarray(slopes[of])) for of, v in found(values).items()}


def errors(drawn: Drawn) -> dict[str, float]:
    """Errors of what the chosen circuit and the truth have in common, in standard errors.

    The standard errors are those of the chosen fit, by the delta method; for the corner frequency
    on a logarithmic scale.
    """
    fit, true = drawn.selection.fit, quantities(TRUTHS[drawn.truth])
    cov = np.asarray(fit.cov)
    return {
        name: (value - true[name][0]) / float(np.sqrt(slope @ cov @ slope))
        for name, (value, slope) in quantities(fit.circuit).items()
        if name in true
    }
