"""Inverses and roots of matrices, and importance sampling.

Models do not belong here: the solvers see only numbers and functions.
"""
