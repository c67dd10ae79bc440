"""The paper's estimator in time: its iteration, and the estimators made of it."""
