"""What is claimed about accuracy and speed, measured: `python -m benchmarks --help`."""
