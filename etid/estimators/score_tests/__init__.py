"""Tests of the assumptions of a fit: circuit, driver order, known resistors, unchanged driver.

Each test uses the residuals of a finished fit. No test fits again.
"""
