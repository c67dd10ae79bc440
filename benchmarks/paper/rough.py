"""A laboratory whose driver and skin are not as the fits assume.

The paper leaves 4 to 13 % of its voltages unexplained, and says neither why nor what its skin is.
In this laboratory much is a little wrong at once:

- Eddy currents shield the core and the wires of the transformer: no filter has its Z_th.
- Fingertips have a second layer, and the resistance of the first one falls with its voltage.
- The converter has 10 bits. Noise and trigger delays are those of the laboratory `noisy`.

**Truth.** R_s, R_p and C_p of such a fingertip are those of the nearest circuit: behind the same
driver its voltage differs least from that of the fingertip (least squares of the harmonics up to
the corner of the filter, without noise, with a free delay). The built circuit and the resistors are
exact.
"""

import dataclasses
import functools
from typing import Any

import numpy as np
import scipy.optimize
from jaxtyping import Complex, Float

from etid.recordings.study import Study
from etid.simulation.falling import FallingResistance
from etid.simulation.scenes import Scene, Trial, paper
from etid.simulation.transformer import SkinLoad, TransformerDriver, loading

SECOND = 0.1  # of R_p that the second layer has
FASTER = 6.0  # R_p C_p, relative to the time constant of the second layer
FALL = 0.2  # of the resistance of the first layer, at the peak of its voltage

_Numbers = Float[np.ndarray, " f"]
_Coefficients = Complex[np.ndarray, " f"]


@dataclasses.dataclass(frozen=True)
class Eddies(TransformerDriver):
    """A transformer with eddy currents: L_m / √(1 + jf/f_core), R_1 and R_2 · √(1 + jf/f_wire).

    Args:
        f_core: Frequency from which on the inside of the laminations has no flux [Hz].
        f_wire: Frequency from which on the inside of the wires has no current [Hz].
    """

    f_core: float = 2e3
    f_wire: float = 20e3

    def branches(self, f: _Numbers) -> tuple[_Coefficients, _Coefficients, _Coefficients]:
        """z_1, z_m and z_2 of the T circuit, referred to the secondary.

        Args:
            f: Frequencies [Hz].

        Returns:
            Three impedances [ohm].
        """
        s, turns = 2j * np.pi * f, self.turns**2
        wire = np.sqrt(1 + 1j * f / self.f_wire)
        core = s * self.l_magnetising / np.sqrt(1 + 1j * f / self.f_core)
        return (
            turns * (self.r_primary * wire + s * self.l_primary),
            turns * core * self.r_core / (core + self.r_core),
            self.r_secondary * wire + s * self.l_secondary,
        )


@dataclasses.dataclass(frozen=True)
class RoughScene(Scene):
    """A scene of this laboratory. Trials with a subject are fingertips; other loads are exact."""

    driver: TransformerDriver = dataclasses.field(default_factory=Eddies)
    bits: int | None = 10

    def simulate(self, seed: int) -> Study:
        """Make the recordings.

        Args:
            seed: Seed of noise, delays and offsets.

        Returns:
            A study with one recording for each calibration and trial.
        """
        f = self.waveform().f
        loaded = functools.cache(lambda load: self._loaded(load, f))
        return self.record(
            seed, lambda trial, _: loaded(_layers(skin) if (skin := _skin(trial)) else trial.load)
        )

    def truth(self) -> dict[str, dict[str, float]]:
        """Elements of each load by path [SI]: of a fingertip, those of the nearest circuit."""
        nearest = functools.cache(self._nearest)
        return super().truth() | {
            trial.path: nearest(skin) for trial in self.trials if (skin := _skin(trial))
        }

    def _loaded(self, load: Any, f: _Numbers) -> _Coefficients:
        """Fourier coefficients of the terminal voltage [V] at the harmonics of the pulse rate."""
        if isinstance(load, FallingResistance):
            return load.voltage(self.driver, f)
        v_th = f[0] * self.driver.v_th_spectrum(f)
        return v_th * loading(load(f), self.driver.z_th(f))

    def _nearest(self, skin: SkinLoad) -> dict[str, float]:
        """The circuit that is nearest to such a fingertip, up to the corner of the filter."""
        f = self.waveform().f
        voltage = self._loaded(_layers(skin), f)
        f, voltage = (of[f < self.antialias * self.sample_rate] for of in (f, voltage))

        def circuit(q: Float[np.ndarray, " q"]) -> SkinLoad:
            return SkinLoad(*np.exp(q[:3]).tolist())

        def missed(q: Float[np.ndarray, " q"]) -> Float[np.ndarray, " part"]:
            left = self._loaded(circuit(q), f) * np.exp(2e-6j * np.pi * f * q[3]) - voltage
            return np.concatenate([left.real, left.imag])

        first = np.append(np.log(dataclasses.astuple(skin)), 0.0)
        found = scipy.optimize.least_squares(missed, first, x_scale="jac")
        return dataclasses.asdict(circuit(found.x))


def rough(**settings: Any) -> RoughScene:
    """All experiments of the paper in this laboratory. Keywords are fields of `Scene`."""
    whole = paper(**settings)
    return RoughScene(whole.trials, whole.calibration, **settings)


def _skin(trial: Trial) -> SkinLoad | None:
    """The elements of a fingertip; None if the load is exact."""
    return trial.load if trial.subject and isinstance(trial.load, SkinLoad) else None


def _layers(skin: SkinLoad) -> FallingResistance:
    """A fingertip with these elements, the second layer aside, at small voltages."""
    second = SkinLoad(skin.r_s, SECOND * skin.r_p, skin.c_p / SECOND / FASTER)
    return FallingResistance((1 - SECOND) * skin.r_p, skin.c_p, second, FALL)
