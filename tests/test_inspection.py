"""Recordings that are inspected together: nothing of one depends on the others."""

import numpy as np
import pytest

import etid
from etid.recordings.preflight import Inspected, inspected, preflight
from etid.recordings.recording import Recording
from etid.recordings.repeats import repeats
from etid.simulation.scenes import Scene, Trial
from tests.skins import DAMP, DRY

TOTAL = 20_000
ROUNDING = 1e-14  # of the largest coefficient: sums of 20 000 samples


def skins(trials=1, **settings):
    scene = etid.scenes.paper_dry(snr_db=60.0, samples=TOTAL, **settings)
    return list(scene.simulate(seed=5).loaded.recordings())[:trials]


@pytest.fixture(scope="module")
def mixed():
    """Good recordings, some without a filter behind another clock, and one for each fault."""
    usual, other = skins(2), skins(2, antialias=3.5, pulse_rate_ppm=15.0)
    good, v_th, v_out = usual[0], usual[0].v_th, usual[0].v_out
    time, spike = good.time, np.zeros(TOTAL)
    spike[12_000:12_200] = 10.0 * np.sin(np.pi * np.arange(200) / 200)
    damaged = v_out.copy()
    damaged[4_000] = np.nan
    hum = 0.5 * np.sin(2 * np.pi * 50.1 * time)
    rounded = 2.0 * np.rint(v_out / 2.0)
    faults = {
        "late": {"v_out": np.roll(v_out, 7)},
        "spiked": {"v_out": v_out + spike},
        "hum": {"v_th": v_th + hum, "v_out": v_out + hum},
        "coarse": {"v_out": rounded},
        "nan": {"v_out": damaged},
        "flat": {"v_out": 1e-3 * np.random.default_rng(0).standard_normal(TOTAL)},
        "reversed": {"v_out": -v_out},
        "unconnected": {"v_out": v_th.copy()},
        "clipped": {"v_out": np.minimum(v_out, 0.8 * v_out.max()), "adc_range": None},
        "mixed up": {"v_th": v_out, "v_out": v_th},
    }
    changed = {name: good.replace(**fields) for name, fields in faults.items()}
    [slow] = skins(1, pulse_rate_ppm=-1000.0)  # it holds one whole period less
    named = {"usual": usual[0], "second": usual[1], "slow": slow}
    return {**named, "unfiltered": other[0], "another": other[1], **changed}


def test_each_recording_is_found_as_it_is_alone(mixed: dict[str, Recording]):
    together = dict(zip(mixed, inspected(list(mixed.values())), strict=True))
    names = {name: preflight(one, periodic=True) for name, one in together.items()}
    assert names == {
        **dict.fromkeys(("usual", "second", "unfiltered", "another", "late", "hum", "slow")),
        **dict.fromkeys(("spiked", "coarse")),
        "nan": "nonfinite_samples",
        "flat": "flat",
        "reversed": "misaligned",
        "unconnected": "unconnected",
        "clipped": "saturated",
        "mixed up": "misaligned",
    }
    used = [one for name, one in together.items() if names[name] is None]
    differences = dict(zip(map(id, used), repeats(used), strict=True))
    for name, one in together.items():
        alone = Inspected.of(mixed[name])
        assert preflight(alone, periodic=True) == names[name]
        if names[name] is not None:
            continue
        assert alone.remarks == one.remarks
        assert alone.lag == one.lag
        assert alone.periods == one.periods
        assert (alone.kept is None) == (one.kept is None) == (name != "spiked")
        assert (alone.aliases is None) == (one.aliases is None)
        assert (alone.aliases is not None) == (name in ("unfiltered", "another", "slow"))
        for field, again in zip(alone.spectrum, one.spectrum, strict=True):
            size = np.abs(field).max()
            np.testing.assert_allclose(again, field, rtol=1e-12, atol=ROUNDING * size)
        [expected], found = repeats([alone]), differences[id(one)]
        assert (expected is None) == (found is None) == (name == "coarse")
        if expected is not None and found is not None:
            # In single precision, and the noise is a thousandth of the signal.
            np.testing.assert_allclose(found.gain, expected.gain, rtol=0, atol=1e-6)
            np.testing.assert_allclose(found.variance, expected.variance, rtol=1e-3)


def test_currents_beside_both_voltages_are_found_as_they_are_alone():
    trials = [Trial(f"loaded/{at}", circuit) for at, circuit in enumerate((DRY, DAMP))]
    scene = Scene(tuple(trials), (), current_snr_db=40.0)
    records = list(scene.simulate(seed=2).recordings())
    current = records[1].current
    assert current is not None
    spike = np.zeros(current.size)
    spike[4_500:4_600] = 1e-3 * np.sin(np.pi * np.arange(100) / 100)
    records += [records[0].replace(current=current + spike), records[0].replace(current=None)]
    for record, together in zip(records, inspected(records), strict=True):
        alone, found = Inspected.of(record).by_current, together.by_current
        assert (alone is None) == (found is None) == (record.current is None)
        if alone is None or found is None:
            continue
        assert "v_th" not in found.recording.samples
        assert (found.kept is not None) == (alone.kept is not None) == (record is records[2])
        assert found.periods == alone.periods
        assert preflight(found, periodic=True) == preflight(alone, periodic=True)
        for field, again in zip(alone.spectrum, found.spectrum, strict=True):
            np.testing.assert_allclose(again, field, rtol=1e-12, atol=ROUNDING * abs(field).max())
