"""Least squares: Levenberg-Marquardt, harmonic balance, and propagation of errors.

Models do not belong here: the solvers see only residuals and normal equations.
"""
