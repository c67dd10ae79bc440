"""Predicted voltages, in NumPy and in JAX."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import etid
from benchmarks.ladder import CALIBRATION, rung
from tests.skins import DRY

COLE = etid.SkinCole(33.4e3, 186e3, 22e-6, 0.85)


@functools.cache
def recorded():
    """Three periods, and less than one, behind a driver; and the driver."""
    study = rung("dry").simulate(3)
    whole = study["skin/01"]
    short = whole.replace(v_th=whole.v_th[:1_500], v_out=whole.v_out[:1_500])
    return whole, short, etid.identify_driver(study[CALIBRATION])


def by_current():
    _, short, _ = recorded()
    return short.replace(current=short.v_th / 2e5)


@pytest.mark.parametrize("case", ["in time", "current", "whole periods"])
def test_jax_differentiates_a_prediction_by_the_elements(case):
    whole, short, driver = recorded()
    recording, driver, circuit = {
        "in time": (short, driver, DRY),
        "current": (by_current(), None, DRY),
        "whole periods": (whole, driver, COLE),
    }[case]
    kind, logs = type(circuit), np.log(circuit.values()) + 0.01

    def squares(logs):
        rest = etid.predict(recording, driver, kind().with_log_values(logs)) - recording.v_out
        return (jnp if isinstance(logs, jax.Array) else np).nansum(rest**2)

    value, slope = jax.jit(jax.value_and_grad(squares))(jnp.asarray(logs))
    np.testing.assert_allclose(value, squares(logs), rtol=1e-9)
    step = 1e-4  # leaves step² of the third derivative
    ways = step * np.eye(logs.size)
    numeric = [(squares(logs + way) - squares(logs - way)) / (2 * step) for way in ways]
    np.testing.assert_allclose(slope, numeric, rtol=0, atol=1e-5 * np.abs(slope).max())


@pytest.mark.parametrize("circuit", [DRY, COLE], ids=["in time", "whole periods"])
def test_jax_differentiates_a_prediction_by_the_driver(circuit):
    recording, _, driver = recorded()

    def squares(level):
        """Of the residual, with the logarithm of a resistance in the driver moved."""
        source = dataclasses.replace(driver.source, log_resistance=level)
        of = dataclasses.replace(driver, source=source)
        rest = etid.predict(recording, of, circuit) - recording.v_out
        return (jnp if isinstance(level, jax.Array) else np).nansum(rest**2)

    level = np.asarray(driver.source.log_resistance)
    ahead = jax.jit(lambda at: jax.jvp(squares, (at,), (jnp.ones_like(at),)))
    value, slope = ahead(jnp.asarray(level))
    np.testing.assert_allclose(value, squares(level), rtol=1e-9)
    step = 1e-4  # leaves step² of the third derivative
    numeric = (squares(level + step) - squares(level - step)) / (2 * step)
    np.testing.assert_allclose(slope, numeric, rtol=1e-4)
