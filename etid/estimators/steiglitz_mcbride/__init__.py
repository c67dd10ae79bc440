"""The paper's estimator in time: the iteration, and the estimators that use it."""
