"""Least squares: Levenberg-Marquardt, its arrowhead form for joint fits, and propagation of errors.

Models do not belong here: the solvers see only residuals and normal equations.
"""
