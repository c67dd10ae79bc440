"""Least squares: Levenberg-Marquardt, its arrowhead form for joint fits, and propagation of errors.

What is fitted does not belong here: the solvers see residuals and normal equations only.
"""
