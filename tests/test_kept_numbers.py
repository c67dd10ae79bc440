"""The comparison with stored numbers: it fails where it should, and compares nothing with NaN."""

import json

import numpy as np
import pytest

from tests import kept_numbers
from tests.kept_numbers import Number


@pytest.fixture
def kept(tmp_path, monkeypatch):
    """Compare one number with a stored one."""
    monkeypatch.setattr(kept_numbers, "BASELINE", tmp_path)

    def compare(before, value, relative=0.0, absolute=0.0):
        (tmp_path / "a.json").write_text(json.dumps({"x": before}), "utf-8")
        kept_numbers.check("a", {"x": Number(np.array(value), relative, absolute)})

    return compare


def test_a_tolerance_that_is_not_a_number_is_an_error(kept):
    errors = np.array([0.1, np.nan])
    with pytest.raises(AssertionError, match="tolerances that are no numbers"):
        kept([1.0, 2.0], [1.0, 2.0], absolute=errors)
    with pytest.raises(AssertionError, match="tolerances that are no numbers"):
        kept([1.0, 2.0], [1.0, 2.0], relative=errors)
    kept([1.0, np.nan], [1.05, np.nan], absolute=errors)  # no number, so none is compared
    kept([1.0, np.inf], [1.01, np.inf], relative=0.02)  # infinite is a value, not a tolerance


@pytest.mark.parametrize(
    ("before", "value", "relative", "absolute"),
    [
        (1.0, 1.011, 0.01, 0.0),
        (1.0, 1.011, 0.0, 0.01),
        (1.0, np.nan, 0.01, 0.01),
        (np.nan, 1.0, 0.01, 0.01),
        (1.0, np.inf, 0.01, 0.01),
        (np.inf, 1.0, 0.01, 0.01),
        (np.inf, 0.0, 0.01, 0.01),
        (np.nan, 0.0, 0.01, 0.01),
        (np.inf, -np.inf, 0.01, 0.01),
        (np.inf, np.nan, 0.01, 0.01),
        (0.0, 1e-300, 0.01, 0.0),
        (1.0, 1.0 + 2e-8, 0.0, 0.0),
        ([1.0, 2.0], [1.0, 2.0, 3.0], 0.01, 0.0),
    ],
)
def test_a_number_beyond_its_tolerance_is_told(before, value, relative, absolute, kept):
    with pytest.raises(AssertionError):
        kept(before, value, relative, absolute)
