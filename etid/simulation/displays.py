"""A stream of pulses at a display, as `etid-live --file` plays it.

All pulses have the amplitude of the unloaded record. After a third of the stream the electrodes of
the fourth to sixth row become wet, after two thirds the last electrode loses contact.
"""

import dataclasses
import os

import numpy as np
from jaxtyping import Float

from etid.precision import in_float64
from etid.recordings.replacing import replacing_hdf5
from etid.simulation.electronics import Electronics
from etid.simulation.published import TYPICAL
from etid.simulation.scenes import Scene, Trial
from etid.simulation.transformer import OpenLoad, SkinLoad

ELECTRODES = 98  # of the paper's display
PARTS = 3  # of a stream: as it begins, with a wet spot, with an electrode that has lost contact
REPEATS = 20  # records of a scene in each part, which are whole periods
WET = slice(21, 42)  # three rows
SPREAD = 0.15  # standard deviation of the logarithms of the elements between electrodes


@in_float64
def write_stream(scene: Scene, path: str | os.PathLike[str], seed: int) -> int:
    """Write the dataset `v_out` (electrode, sample) [V] of a display behind the driver of a scene.

    Args:
        scene: Its skins are those of the electrodes, in turn, with a spread between electrodes. Its
            noise, filter and converter are those of the stream.
        path: HDF5 file to write; an existing file is replaced.
        seed: Seed of the skins, of the noise, and of the delay of each electrode.

    Returns:
        Number of pulses.

    Raises:
        ValueError: The scene has no skin.
    """
    skins = [trial.load for trial in scene.trials if isinstance(trial.load, SkinLoad)]
    if not skins:
        raise ValueError("this experiment has no skin for a stream; choose another one")
    rng = np.random.default_rng([seed, *b"stream"])
    elements = np.array([dataclasses.astuple(skins[at % len(skins)]) for at in range(ELECTRODES)])
    elements *= np.exp(SPREAD * rng.standard_normal(elements.shape))
    wet = elements.copy()
    dry, damp = (np.array(dataclasses.astuple(TYPICAL[of])) for of in ("dry", "damp"))
    wet[WET] *= damp / dry
    periods = [_periods(scene, of, seed) for of in (elements, wet)]
    open_load = Trial(f"{ELECTRODES - 1}", OpenLoad())
    periods.append(periods[-1].copy())
    periods[-1][-1] = _voltages(scene, (open_load,), seed)[0]

    step = scene.full_scale / 2 ** (scene.bits - 1) / scene.scale if scene.bits else 0.0
    samples = periods[0].shape[1]
    with replacing_hdf5(path) as file:
        shape = (ELECTRODES, PARTS * REPEATS * samples)
        v_out = file.create_dataset("v_out", shape, "f4", chunks=(ELECTRODES, 500))
        for at in range(PARTS * REPEATS):
            v = periods[at // REPEATS] + scene.noise(rng, periods[0].shape)
            v_out[:, at * samples : (at + 1) * samples] = step * np.rint(v / step) if step else v
    return round(PARTS * REPEATS * samples * scene.pulse_rate / scene.sample_rate)


def _periods(
    scene: Scene, elements: Float[np.ndarray, "electrode element"], seed: int
) -> Float[np.ndarray, "electrode time"]:
    trials = (Trial(f"{at}", SkinLoad(*map(float, of))) for at, of in enumerate(elements))
    return _voltages(scene, tuple(trials), seed)


def _voltages(
    scene: Scene, trials: tuple[Trial, ...], seed: int
) -> Float[np.ndarray, "electrode time"]:
    """Loaded voltages without noise and hum [V]."""
    of = scene.electronics
    filtering = None if of is None else Electronics(of.filter_type, of.filter_order)
    quiet = dataclasses.replace(
        scene,
        trials=trials,
        calibration=(),
        snr_db=None,
        bits=None,
        shared_v_th=True,
        electronics=filtering,
    )
    study = quiet.simulate(seed)
    return np.stack([study[trial.path].v_out for trial in trials])
