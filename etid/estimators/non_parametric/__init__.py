"""Maximum likelihood with Z_th as it is at each harmonic: its fit and its estimator."""
