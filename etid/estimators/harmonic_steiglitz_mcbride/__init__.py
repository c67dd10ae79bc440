"""The same iteration on the harmonics, without bias by noise, and its estimator."""
