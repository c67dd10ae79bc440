"""Recordings of a known circuit: the transformer driver, scenes, and the Cramer-Rao bound."""
