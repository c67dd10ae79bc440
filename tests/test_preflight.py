"""Pre-flight refuses what is broken, and nothing else. No fit is made here."""

import json
import re
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.spice import imported
from etid.identify.planning import explained
from etid.recordings.causes import why_misaligned
from etid.recordings.faults import SHORTEST
from etid.recordings.preflight import Inspected
from etid.recordings.preflight import preflight as of_inspected
from etid.simulation.scenes import Scene, Trial
from etid.simulation.transformer import OpenLoad, ResistorLoad, SkinLoad

LENGTH = 3334
DAMP = SkinLoad(r_s=6.1e3, r_p=17.4e3, c_p=0.66e-9)


def preflight(recording):
    return of_inspected(Inspected.of(recording))


def simulate(load: Any = DAMP, seed=0, samples=LENGTH, **options):
    scene = Scene((Trial("loaded", load),), samples=samples, **options)
    return scene.simulate(seed=seed)["loaded"]


@pytest.fixture(scope="module")
def recording():
    return simulate()


@pytest.mark.parametrize("bits", [8, 12, None])
@pytest.mark.parametrize("sample_rate", [100e3, 500e3])
def test_coarse_converters_and_every_rate_pass(bits, sample_rate):
    """The top of a pulse falls on few codes of a coarse converter, and is no clipping."""
    for snr_db in (None, 60.0):
        one = simulate(bits=bits, sample_rate=sample_rate, samples=8334, snr_db=snr_db)
        assert preflight(one) is None
        assert preflight(one.replace(adc_range=None)) is None


@settings(max_examples=15)
@given(
    load=st.one_of(
        st.builds(SkinLoad, st.floats(1e3, 1e5), st.floats(1e4, 1e6), st.floats(30e-12, 2e-9)),
        st.builds(ResistorLoad, st.floats(1e3, 1e6)),
    ),
    jitter=st.sampled_from([0.0, 1e-6]),
    snr_db=st.sampled_from([None, 60.0, 30.0]),
    seed=st.integers(0, 99),
)
def test_any_load_passes(load, jitter, snr_db, seed):
    """Wider than the paper's ten subjects, dry and damp, with a sloppy trigger."""
    assert preflight(simulate(load, seed, snr_db=snr_db, trigger_jitter_rms=jitter)) is None


def test_reference_recordings_pass_but_the_clipped_ones(reference_data):
    folder = reference_data("spice_recordings")
    refused = {}
    for name in json.loads((folder / "truth.json").read_text())["scenes"]:
        with imported(folder / f"{name}.npz") as study:
            names = {preflight(study[path]) for path in study} - {None}
        if names:
            refused[name] = names
    assert refused == {"clipped_dry": {"saturated"}}


@pytest.mark.parametrize("which", ["v_th", "v_out"])
@pytest.mark.parametrize(
    ("change", "name"),
    [
        (lambda v: np.full_like(v, 3.0), "flat"),
        (lambda v: np.random.default_rng(1).normal(size=v.size), "flat"),
        (lambda v: np.where(np.arange(v.size) == 5, np.nan, v), "nonfinite_samples"),
        (lambda v: np.where(np.arange(v.size) == 5, -np.inf, v), "nonfinite_samples"),
        (lambda v: np.where(np.arange(v.size) < 5, np.inf, v), "nonfinite_samples"),
        (lambda v: np.minimum(v, 0.7 * v.max()), "saturated"),
        (lambda v: np.roll(v, 450), "misaligned"),  # 2.25 ms, an eighth of a period
        (lambda v: -v, "misaligned"),
    ],
)  # fmt: skip
def test_what_is_broken_is_named(recording, which, change, name):
    broken = recording.replace(**{which: change(getattr(recording, which))}, adc_range=None)
    assert preflight(broken) == name


def test_a_single_sample_at_the_known_rail_is_saturated(recording):
    v = recording.v_out
    assert preflight(recording.replace(v_out=v, adc_range=(-200.0, v.max()))) == "saturated"
    assert preflight(recording.replace(v_out=v, adc_range=(v.min(), 200.0))) == "saturated"
    assert preflight(recording.replace(v_out=v, adc_range=(-200.0, 200.0))) is None


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda v: 1e3 * v, "times as large as v_th. .* is one of them in mV"),
        (lambda v: -v, "polarity of one record is reversed"),
        (lambda v: np.roll(v, 450), "^$"),
    ],
)
def test_the_cause_of_misaligned_records_is_named(recording, change, words):
    changed = recording.replace(v_out=change(recording.v_out), adc_range=None)
    assert preflight(changed) == "misaligned"
    why = why_misaligned(Inspected.of(changed))
    assert re.search(words, why)
    assert explained(Inspected.of(changed), "misaligned").startswith(why)


def test_the_shortest_record_is_named_before_anything_else():
    one = simulate(samples=SHORTEST)
    assert preflight(one) is None
    nothing = np.full(SHORTEST - 1, np.nan)
    assert preflight(one.replace(v_th=nothing, v_out=nothing)) == "too_short"


@pytest.mark.parametrize("snr_db", [None, 60.0, 20.0])
@pytest.mark.parametrize("jitter", [0.0, 500e-9])
def test_a_record_without_a_load_is_unconnected(snr_db, jitter):
    options = {"snr_db": snr_db, "trigger_jitter_rms": jitter, "offset_rms": 0.01}
    assert preflight(simulate(OpenLoad(), **options)) == "unconnected"
    one = simulate(**options)
    assert preflight(one.replace(v_out=one.v_th)) == "unconnected"
