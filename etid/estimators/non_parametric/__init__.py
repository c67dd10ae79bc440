"""Maximum likelihood without a model of Z_th: fit and estimator."""
