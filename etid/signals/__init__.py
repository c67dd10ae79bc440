"""Signals without a circuit: transfer functions, filters, pulse trains, harmonics, hum and noise.

What knows of a recording, a circuit or a driver does not belong here.
"""
