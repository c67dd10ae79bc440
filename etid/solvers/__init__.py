"""Least squares: Levenberg-Marquardt, successive approximations, and propagation of errors.

Models do not belong here: the solvers see only residuals and normal equations.
"""
