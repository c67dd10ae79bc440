"""Signals without a circuit: transfer functions, filters, pulse trains, harmonics, hum and noise.

Code that depends on a recording, a circuit or a driver does not belong here.
"""
