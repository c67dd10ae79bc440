"""Tests of the assumptions of a fit: circuit, driver order, known resistors, unchanged driver.

Each test uses the residuals of a finished fit. No test fits again.

Each test is asked of every recording of a study, which may have 10⁶ of them. A study can bear that
one good recording in 10 000 is refused by one test: less than other faults of a laboratory refuse.
"""
