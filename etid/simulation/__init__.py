"""Recordings from a known circuit: the transformer, a laboratory's scenes, the Cramer-Rao bound."""
