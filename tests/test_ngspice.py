"""Recordings by ngspice are those of a scene, where it is installed."""

import shutil

import numpy as np
import pytest

from benchmarks import ngspice
from etid.simulation.scenes import Scene, Trial
from etid.simulation.transformer import OpenLoad, ResistorLoad, SkinLoad

DRY = SkinLoad(33.4e3, 186e3, 0.12e-9)
# Relative to the peak, measured on circuits with elements spread by 30 %: at most 7e-6.
DEVIATION = 1e-5


@pytest.fixture(autouse=True)
def _empty_cache(tmp_path, monkeypatch):
    monkeypatch.setattr(ngspice, "CACHE", tmp_path / "cache")
    ngspice.harmonics.cache_clear()
    yield
    ngspice.harmonics.cache_clear()


@pytest.mark.slow
@pytest.mark.skipif(
    shutil.which("ngspice") is None, reason="ngspice is not installed; Debian package ngspice"
)
@pytest.mark.parametrize("sample_rate", [200e3, 1e6])
def test_records_of_ngspice_are_those_of_the_scene(sample_rate):
    scene = Scene(
        (Trial("skin", DRY), Trial("open", OpenLoad())),
        (Trial("calibration", ResistorLoad(21.62e3)),),
        sample_rate=sample_rate,
        snr_db=None,
        bits=None,
        trigger_jitter_rms=1e-6,
    )
    ours, exact = ngspice.record(scene, 3), scene.simulate(3)
    for path in exact:
        for name in ("v_th", "v_out"):
            found, expected = getattr(ours[path], name), getattr(exact[path], name)
            assert np.abs(found - expected).max() < DEVIATION * np.abs(expected).max()
