"""The paper's experiments: statistics of its tables, causes of its errors, and a demo."""
