import numpy as np
import pytest

from etid import scenes
from etid.noise import noise_std


@pytest.mark.parametrize("snr_db", [40.0, 60.0])
def test_noise_of_a_pulse_record_is_found(snr_db):
    scene = scenes.paper_dry(snr_db=snr_db, bits=None)
    clean = scenes.paper_dry(snr_db=None, bits=None).simulate(seed=0)
    for path, recording in scene.simulate(seed=0).items():
        true = np.std(recording.v_out - clean[path].v_out)
        found = float(noise_std(recording.v_out))
        # The median of 10 000 correlated differences scatters by 2 %; the edges add a little.
        assert abs(found / true - 1) < 0.08


def test_converter_steps_are_a_floor():
    assert float(noise_std(np.zeros(100), 0.012)) == pytest.approx(0.012 / np.sqrt(12))


def test_a_smooth_curve_has_no_noise():
    assert float(noise_std(np.sin(np.arange(500) / 50.0))) < 1e-8
