"""The Cramer-Rao bound of a scene: the smallest standard errors of any unbiased estimator.

At every harmonic the records are an input X and outputs G_m e^(−jωτ_m) X: V_out of the trial with
G = Z_L / (Z_L + Z_th), the current with 1 / (Z_L + Z_th) if it is recorded, and V_out of each
calibration. All records have the noise of the scene, which is white or has passed its filter. The
rounding error of a coarse converter is not white (`etid.signals.rounding`): where the signal is
slow, it is the same in each period. X and Z_th are unknown complex numbers at every harmonic, so
the bound holds for every kind of driver.
Without a calibration V_th tells nothing about the load, and the bound is that of the input I and
the output Z_L e^(−jωτ) I. The information about the gains is (Pintelon and Schoukens, System
Identification, 2012, ch. 9 and 16; `etid.likelihood.profile`)

    P = 2 |X|² (diag(w) − (w G)(w G)ᴴ / τ),      τ = w_x + Σ w |G|²,      w = 1/σ²,

and that about the elements and the delays, with Z_th projected out,

    F = Re Σ_k (Aᴴ P A − Aᴴ P B Bᴴ P A / Bᴴ P B),      A = ∂G/∂q,      B = ∂G/∂Z_th.

All of it is a function of the numbers of the driver and of the loads, in the namespace of these: a
pulse or a resistor can be designed by the gradient of a bound.
"""

import dataclasses
import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from etid.circuits.circuit import AbstractCircuit, Resistor, SkinRC, with_slopes
from etid.identify.arguments import require
from etid.precision import array_function, in_float64, namespace
from etid.printing import Overview, Overviewed, element_rows, per_cent
from etid.signals.harmonics import whole_periods
from etid.signals.rounding import COARSE, is_coarse, rounding_variance
from etid.signals.transfer import AnyArray, power
from etid.simulation.scenes import Scene, Trial, Waveform
from etid.simulation.transformer import Number, ResistorLoad, SkinLoad
from etid.solvers.matrices import inverse


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Bound(Overviewed):
    """The smallest standard errors for one trial of a scene.

    Attributes:
        path: Path of the trial.
        circuit: True elements of its load [SI].
        log_cov: Bound of the covariance of the logarithms of the elements.

    Its numbers are arrays of JAX if it traces the scene.
    """

    path: str
    circuit: AbstractCircuit
    log_cov: Float[AnyArray, "element element"]

    @property
    def cov(self) -> Float[AnyArray, "element element"]:
        """Bound of the covariance of the elements [SI], as that of a fit."""
        values = self.circuit.values()
        return self.log_cov * values[:, None] * values

    @property
    def relative(self) -> dict[str, Number]:
        """Bound of the relative standard error of each element."""
        errors = namespace(self.log_cov).sqrt(self.log_cov.diagonal())
        return dict(zip(self.circuit.names(), _numbers(errors), strict=True))

    @property
    def stderr(self) -> dict[str, Number]:
        """Bound of the standard error of each element [SI]."""
        errors = namespace(self.log_cov).sqrt(self.cov.diagonal())
        return dict(zip(self.circuit.names(), _numbers(errors), strict=True))

    @property
    def undetermined(self) -> tuple[str, ...]:
        """Elements whose bound exceeds their value."""
        return tuple(name for name, error in self.relative.items() if not error < 1)

    def _rows(self) -> list[tuple[str, ...]]:
        elements = element_rows(self.circuit.units(), np.asarray(self.circuit.values()))
        return [(*row, f"± {per_cent(self.relative[row[0]])}") for row in elements]

    def _overview(self) -> Overview:
        rows = self._rows()
        notes = []
        if self.undetermined:
            notes.append(
                f"The records do not determine {' and '.join(self.undetermined)}: record more "
                "periods, with less noise or a higher sample rate, or identify a simpler circuit."
            )
        title = f"{type(self.circuit).__name__} {self.path!r}, smallest standard errors:"
        return Overview(title, rows, notes=notes)


def _numbers(of: Float[AnyArray, " element"]) -> list[Number]:
    """Numbers of Python, or of JAX."""
    return of.tolist() if namespace(of) is np else list(of)


class Bounds(Overviewed, dict[str, Bound]):
    """The bound of each trial of a scene, by path."""

    def _overview(self) -> Overview:
        elements = [
            [" ".join(" ".join(row).split()) for row in one._rows()] for one in self.values()
        ]
        most = max(map(len, elements))
        rows = [
            (path, type(one.circuit).__name__, *texts, *[""] * (most - len(texts)))
            for (path, one), texts in zip(self.items(), elements, strict=True)
        ]
        return Overview("Smallest standard errors of each trial:", rows)


@in_float64
@array_function
def bound(scene: Scene, *, delays: bool = True, known_driver: bool = False) -> Bounds:
    """Predict the smallest standard errors of each trial of a scene before it is recorded.

    The bound of a trial uses this trial and all calibrations of the scene, but no other trial. If
    the scene records the current, the bound uses it too, and the scene needs no calibration. The
    information is proportional to the length of a record: half a period has half the information of
    a whole period.

    JAX differentiates and maps it by the numbers of the driver, of the loads, and by `snr_db`, as
    `examples/design.py` does. Rates and lengths are numbers: the harmonics depend on them. The
    rounding of a coarse converter counts as white noise then.

    Args:
        scene: Driver, loads, noise and converter. The loads are circuits, resistors or skin.
        delays: Whether the trigger delays of all loaded records are unknown.
        known_driver: Whether Z_th is known exactly, so that no calibration is needed.

    Returns:
        The bound of each trial, by path.

    Raises:
        ValueError: The load of a trial has no elements. Or the scene has neither noise nor a
            converter. Or it has neither a calibration nor a current, and the driver is not known.
    """
    require(
        "scene", scene, Scene, "Make one with etid.scenes.Scene, or use a preset of etid.scenes"
    )
    measured = scene.current_snr_db is not None
    if not (scene.calibration or known_driver or measured):
        raise ValueError(
            "the scene has no calibration; its driver would have to be known, or the current "
            "recorded (current_snr_db)"
        )
    waveform = scene.waveform()
    traced = namespace(waveform.sigma, waveform.v_th) is not np
    if not traced and waveform.sigma == 0:
        raise ValueError("the scene has neither noise nor a converter; every bound is zero")
    inside = waveform.f < scene.sample_rate / 2
    f, z_th = waveform.f[inside], waveform.z_th[inside]
    x = waveform.v_th[inside] * (math.sqrt(scene.samples) / waveform.noise[inside])
    known = [] if known_driver else [_circuit(trial) for trial in scene.calibration]
    found: dict[int, Float[AnyArray, "n n"]] = {}  # trials with the same load share a bound
    bounds = Bounds()
    for trial in scene.trials:
        circuit = _circuit(trial)
        key = id(trial.load)
        if key not in found:
            noise = np.ones((2 + 2 * len(scene.calibration), f.size))
            if not traced:
                noise = _noise(scene, trial, waveform, f.size)
            current = _current_noise(scene, circuit, waveform)[inside] if measured else None
            signals = _Signals(f, x, z_th, noise, current)
            found[key] = _covariance(
                circuit, known, signals, delays, known_driver, scene.shared_v_th
            )
        bounds[trial.path] = Bound(trial.path, circuit, found[key])
    return bounds


def _circuit(trial: Trial) -> AbstractCircuit:
    if isinstance(trial.load, AbstractCircuit):
        return trial.load
    if isinstance(trial.load, SkinLoad):
        return SkinRC(trial.load.r_s, trial.load.r_p, trial.load.c_p)
    if isinstance(trial.load, ResistorLoad):
        return Resistor(trial.load.r)
    raise ValueError(
        f"the load of {trial.path!r} is {trial.load!r}, which has no elements to identify; use a "
        "circuit, a SkinLoad or a ResistorLoad"
    )


def _noise(
    scene: Scene, trial: Trial, waveform: Waveform, harmonics: int
) -> Float[np.ndarray, "row harmonic"]:
    """Standard deviations of the coefficients of a trial and its calibrations.

    Args:
        scene: The scene.
        trial: One of its trials.
        waveform: Its harmonics and their noise.
        harmonics: Number of harmonics that count.

    Returns:
        Standard deviations relative to those of `waveform.noise`: of V_out and then of V_th of the
        trial and of each calibration.
    """
    records = 1 + len(scene.calibration)
    relative = np.ones((2 * records, harmonics))
    step = 0.0 if scene.bits is None else scene.full_scale / 2 ** (scene.bits - 1) / scene.scale
    periods = whole_periods(scene.samples, scene.sample_rate, scene.pulse_rate)
    if waveform.sigma**2 - step**2 / 12 >= (step / COARSE) ** 2 or periods[0] == 0:
        return relative
    study = dataclasses.replace(scene, trials=(trial,)).simulate(0)
    recordings = [study[one.path] for one in (trial, *scene.calibration)]
    voltages = [one.v_out for one in recordings] + [one.v_th for one in recordings]
    for row, v in zip(relative, voltages, strict=True):
        if is_coarse(v, step):
            found = np.sqrt(rounding_variance(v, step, *periods) * periods[1])[:harmonics]
            row[: found.size] = found / waveform.noise[: found.size]
    return relative


def _current_noise(
    scene: Scene, circuit: AbstractCircuit, waveform: Waveform
) -> Float[AnyArray, " f"]:
    """Standard deviations of the recorded current [A] relative to those of a voltage [V]."""
    load = circuit.response(waveform.f)
    sigma = scene.current_noise(waveform.v_th / (load + waveform.z_th))
    return sigma * scene.colour(waveform.f) / waveform.noise


class _Signals(NamedTuple):
    """What the records of a trial and of its calibrations contain.

    Attributes:
        f: Harmonics [Hz].
        x: V_th at these, in standard deviations of a coefficient with the noise of the scene.
        z_th: Source impedance [Ω].
        noise: From `_noise`.
        current: From `_current_noise`; None if the current is not recorded.
    """

    f: Float[np.ndarray, " f"]
    x: Complex[AnyArray, " f"]
    z_th: Complex[AnyArray, " f"]
    noise: Float[np.ndarray, "row f"]
    current: Float[AnyArray, " f"] | None


def _covariance(
    circuit: AbstractCircuit,
    known: list[AbstractCircuit],
    signals: _Signals,
    delays: bool,
    known_driver: bool,
    shared_v_th: bool,
) -> Float[AnyArray, "element element"]:
    """Bound of the covariance of the elements' logarithms."""
    f, x, z_th, noise, current = signals
    loads = [circuit, *known]
    z = [load.response(f) for load in loads]
    xp = namespace(x, z_th, *z)
    slope = with_slopes(circuit, xp.asarray(circuit.log_values()), f)[1]  # by each element
    of_v_out, of_v_th = noise[: len(loads)], noise[len(loads) :]
    if known_driver or known:
        loop = 1 / (z[0] + z_th)
        outputs = [(z[0] * loop, z_th * loop**2, of_v_out[0])]
        if current is not None:
            outputs.append((loop, -(loop**2), current))
        gains, by_load, of_y = (xp.stack(of) for of in zip(*outputs, strict=True))
        record = np.append(np.zeros(len(outputs), int), np.arange(1, len(loads)))
        total = xp.stack([*[z[0]] * len(outputs), *z[1:]]) + z_th
        gains = xp.stack([*gains, *(of / (of + z_th) for of in z[1:])])
        of_y, by_z_th = xp.stack([*of_y, *of_v_out[1:]]), -gains / total
        record, of_x = (0 * record, of_v_th[:1]) if shared_v_th else (record, of_v_th)
    else:
        x, gains, by_z_th = x / (z[0] + z_th), xp.stack(z[:1]), None
        by_load = np.ones((1, f.size))
        assert current is not None  # there is a calibration, or the current is recorded
        of_y, record, of_x = of_v_out[:1], np.zeros(1), current[None]
    count, elements = gains.shape[0], slope.shape[0]
    of_load = xp.zeros((count - len(by_load), elements, f.size))
    a = xp.concatenate([by_load[:, None] * slope, of_load])
    if delays:
        turn = 2j * np.pi * f * 1e-6  # delays in microseconds
        own = np.eye(count)[:, :, None] * (-turn * gains)[:, None]
        a = xp.concatenate([a, own], 1)
    p = xp.zeros((count, count, f.size), complex)
    for number, deviation in enumerate(of_x):
        w = (record == number)[:, None] / of_y**2
        tau = 1 / deviation**2 + xp.sum(w * power(gains), axis=0)
        p = p + np.eye(count)[:, :, None] * w
        p = p - (w * gains)[:, None] * xp.conj(w * gains) / tau
    p = p * (2 * power(x))
    by_p = xp.einsum("mnk,nqk->mqk", p, a)
    information = xp.einsum("mpk,mqk->pq", xp.conj(a), by_p).real
    if by_z_th is not None and not known_driver:
        cross = xp.einsum("mk,mqk->qk", xp.conj(by_z_th), by_p)
        of_z_th = xp.einsum("mk,mnk,nk->k", xp.conj(by_z_th), p, by_z_th).real
        information = information - xp.einsum("pk,qk->pq", xp.conj(cross), cross / of_z_th).real
    return inverse(information)[:elements, :elements]
