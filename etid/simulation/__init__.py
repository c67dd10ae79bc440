"""Recordings of a known circuit: the transformer driver, scenes, and the Cramer-Rao bound."""

from etid.simulation import scenes as scenes
