"""Recordings and studies: their fields, their HDF5 files, and the checks before a fit.

Code for files of other programs belongs to `etid.files`.
"""
