"""The likelihood of recordings: arrays with any leading axes, in the namespace of these arrays.

NumPy runs the code as it stands on rows, recordings along the first axis; nothing is traced and
nothing is compiled. `jax.numpy` runs the same text, with rows or without.
"""
