"""The comparison with stored texts: it fails where it should."""

import pytest

from tests.printed import differences


@pytest.mark.parametrize(
    ("before", "now"),
    [
        ("a 1.00 ± 0.10 kΩ", "a   1.05 ± 0.101 kΩ"),
        ("RRSE 0.0794 %", "RRSE 0.0795 %"),
        ("chi2 1.02", "chi2 1.03"),
        ("c_p -", "c_p -"),
    ],
)
def test_fits_may_differ_by_their_errors(before, now):
    assert differences(before, now, fitted=True) == []
    assert (before == now) == (differences(before, now, fitted=False) == [])


@pytest.mark.parametrize(
    ("before", "now"),
    [
        ("a 1.00 ± 0.10 kΩ", "a 1.15 ± 0.10 kΩ"),
        ("a 1.00 ± 0.10 kΩ", "a 1.00 ± 0.12 kΩ"),
        ("a 1.00 ± 0.10 kΩ", "a 1.00 ± 0.10 nF"),
        ("RRSE 1.02 %, chi2 7.0", "RRSE 7.0 %, chi2 1.02"),
        ("5 fits", "6 fits"),
        ("c_p -", "c_p nan"),
        ("one\ntwo", "one"),
        ("one", "one\ntwo"),
    ],
)
def test_another_word_number_or_line_is_told(before, now):
    assert differences(before, now, fitted=True)
