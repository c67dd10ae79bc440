"""The paper's experiments: the statistics of its tables, and a demo that repeats the paper."""
