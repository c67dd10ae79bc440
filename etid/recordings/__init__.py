"""Recordings and studies: their fields, their HDF5 files, and what is checked before a fit.

Files of other programs are read in `etid.files`.
"""
