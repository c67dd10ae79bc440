"""Output error: the prediction in time, its fit by Levenberg-Marquardt, and its information."""
