"""Steiglitz-McBride on the harmonics, without bias by noise: iteration and estimator."""
