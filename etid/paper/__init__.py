"""The paper's experiments: its published tables, and the demonstration that repeats them."""
