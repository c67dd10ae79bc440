"""What was told of elements before a fit is said in words, with units."""

import math

import etid
from etid.identify.arguments import bounds_of
from etid.results.method_options import without_known


def test_what_was_told_of_elements_is_said_with_its_units():
    method = (
        "maximum_likelihood(known_elements=(('r_s', 33400.0, 0.0), ('c_p', 1e-10, 2e-12)), "
        "bounds=(('r_p', 0.0, 2e5),), max_steps=7)"
    )
    plain, told = without_known(method, etid.SkinRC().units())
    assert plain == "maximum_likelihood(max_steps=7)"
    assert told == (
        "Told before the fit: r_s = 33.4 kΩ (fixed), c_p = 0.1000 ± 0.0020 nF (prior), "
        "r_p below 200 kΩ (bounds)."
    )
    assert without_known("output_error, amplitudes", {}) == ("output_error, amplitudes", "")


def test_a_bound_that_is_left_out_excludes_no_element():
    told = {"r_s": (None, 1e3), "r_p": (100.0, None), "c_p": (None, 1e-9)}
    assert bounds_of(told) == (
        ("r_s", 0.0, 1e3), ("r_p", 100.0, math.inf), ("c_p", 0.0, 1e-9),
    )  # fmt: skip
