"""Tests of what a fit assumes: its circuit, the driver's order, the resistors, an unchanged driver.

Each looks at the residuals of a fit that is done; none fits again.
"""
