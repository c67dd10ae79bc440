"""Numbers of fits as they were before, against changes of them that nobody meant.

`check(name, numbers)` compares with `tests/baseline/NAME.json`. Where this file is missing, the
test writes it and fails. Delete a file to make it anew, look at what has changed, and say in the
commit why it has.

Processors add numbers in different orders, and a fit stops within 0.01 standard errors of its
minimum. So tolerances are fractions of a standard error, a few times what this changes. A tolerance
that is not a number is an error of the test: it would compare nothing, or digits.
"""

import json
import pathlib
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest

from etid.results.driver import ContinuousDriver, Driver
from etid.results.fit import Fit

BASELINE = pathlib.Path(__file__).parent / "baseline"
SHIFT = 0.05  # of an estimate [standard errors]
ERRORS = 5e-3  # of a standard error, relative
TERMS = 1000  # degrees of freedom of χ² where a fit does not count its terms; a record has more
FREQUENCY = (120.0, 1e3, 5e3, 2e4, 6e4)  # [Hz] at which drivers are compared
DIGITS, WRITTEN = 10, 1e-8  # that are written, and their rounding, relative


class Number(NamedTuple):
    """Values, and what they may differ by.

    Attributes:
        value: Numbers or texts.
        relative: Tolerance relative to the value, one for all or one for each.
        absolute: Tolerance, one for all or one for each.
    """

    value: Any
    relative: Any = 0.0
    absolute: Any = 0.0


def of_spread(freedom: Any) -> Any:
    """Tolerance of a variance or χ² with this many degrees of freedom, relative."""
    return SHIFT * np.sqrt(2 / np.asarray(freedom, float))


def of_fit(fit: Fit, freedom: int = TERMS) -> dict[str, Number]:
    """Every field of a fit or of a batch of them; `freedom` is that of χ² if it has no support."""
    values, errors = np.asarray(fit.circuit.values()), np.asarray(fit.stderr.values())
    private = np.diagonal(np.asarray(fit.cov) - fit.shared_cov, axis1=-2, axis2=-1)
    change, change_stderr = fit.known_changes
    terms = freedom if fit.support is None else fit.support.terms
    of_chi2 = of_spread(np.where(np.isnan(terms), freedom, terms))
    # The curvature at a minimum that leaves a residual changes with the estimate, as its residual.
    wide = np.sqrt(np.maximum(fit.chi2, 1.0))
    of_each, of_cov = wide[..., None], wide[..., None, None]
    found = {
        "verdict": Number(np.asarray(fit.verdict)),
        "method": Number(fit.method.partition("(")[0]),  # without numbers
        "elements": Number(values, absolute=SHIFT * errors),
        "stderr": Number(errors, ERRORS * of_each),
        "correlation": Number(fit.correlation, absolute=4 * ERRORS * of_cov),
        "private": Number(private, 4 * ERRORS * of_each),
        "rrse": Number(fit.rrse, of_chi2 / 2),
        "chi2": Number(fit.chi2, of_chi2),
        "remarks": Number(fit.remarks),
        "change": Number(change, absolute=SHIFT * change_stderr),
        "change_stderr": Number(change_stderr, ERRORS),
    }
    if fit.support is not None:
        found |= {
            # It is a sum of as many squares as there are terms, up to a constant.
            "deviance": Number(fit.support.deviance, absolute=SHIFT * np.sqrt(2 * terms)),
            "terms": Number(fit.support.terms),
            "z": Number(fit.support.z, absolute=SHIFT * of_each),
            "spread_stderr": Number(fit.support.spread_stderr, 4 * ERRORS * wide),
            "spread_slope": Number(
                fit.support.spread_slope, 4 * ERRORS * of_each, 4 * ERRORS * of_each
            ),
            "layer_shows": Number(fit.support.layer_shows, 4 * ERRORS * wide),
        }
    return found


def of_driver(driver: Driver) -> dict[str, Number]:
    """What is known of a driver; parameters of Z_th may be exchanged, Z_th may not."""
    frequency = jnp.array(FREQUENCY)
    z_th = np.asarray(driver.response(frequency))
    errors = np.asarray(driver.log_response_stderr(frequency))
    found = {
        "verdict": Number(np.asarray(driver.verdict)),
        "order": Number(driver.order),
        "chi2": Number(driver.chi2, of_spread(TERMS)),
        "rrse": Number(driver.rrse, of_spread(TERMS) / 2),
        "log_size": Number(np.log(np.abs(z_th)), absolute=SHIFT * errors[0]),
        "phase": Number(np.angle(z_th), absolute=SHIFT * errors[1]),
        "errors": Number(errors, ERRORS),
        "remarks": Number(driver.remarks),
    }
    if isinstance(driver, ContinuousDriver):
        known = driver.calibration
        found |= {
            "delay": Number(known.delay_samples, absolute=SHIFT * known.delay_std_samples),
            "delay_std": Number(known.delay_std_samples, 4 * ERRORS),
        }
        if known.mismatch is not None:
            found["mismatch"] = Number(
                known.mismatch, 4 * ERRORS, SHIFT * np.asarray(known.mismatch)[1:]
            )
    return found


def check(name: str, numbers: Mapping[str, Number]) -> None:
    """Compare numbers with those of `tests/baseline/NAME.json`."""
    path = BASELINE / f"{name}.json"
    if not path.exists():
        content = {of: _written(np.asarray(one.value)) for of, one in numbers.items()}
        lines = ",\n".join(f'"{of}": {json.dumps(value)}' for of, value in content.items())
        path.write_text(f"{{\n{lines}\n}}\n", "utf-8")
        pytest.fail(f"{path} was missing and is written now; look at it")
    before = json.loads(path.read_text("utf-8"))
    assert list(before) == list(numbers)
    wrong = [of for of, one in numbers.items() if not _same(before[of], one)]
    assert not wrong, {of: (before[of], np.asarray(numbers[of].value).tolist()) for of in wrong}


def _written(value: np.ndarray) -> Any:
    if np.iscomplexobj(value):
        value = np.stack([np.real(value), np.imag(value)])
    if value.dtype.kind == "f":
        value = np.array([float(f"{x:.{DIGITS}g}") for x in value.ravel()]).reshape(value.shape)
    return value.tolist()


def _same(before: Any, now: Number) -> bool:
    was, value = np.array(before), np.asarray(now.value)
    if np.iscomplexobj(value):
        value = np.stack([np.real(value), np.imag(value)])
    if was.shape != value.shape:
        return False
    if value.dtype.kind != "f":
        return bool((was == value).all())
    finite = np.isfinite(was)
    number = np.where(finite, was, 0.0)
    allowed = np.where(finite, now.relative * np.abs(number) + now.absolute, 0.0)
    assert np.isfinite(allowed).all(), f"tolerances that are no numbers: {now}"
    # Where the tolerance is smaller, the digits of the file count.
    near = np.abs(value - number) <= np.maximum(allowed, WRITTEN * np.abs(number))
    return bool(((finite & near) | (value == was) | (np.isnan(was) & np.isnan(value))).all())
