"""What must hold at the end of the notebook."""

# The names are those of the notebook.
# pyright: reportUndefinedVariable=false

assert [(one.electrode, one.kind) for one in found] == [(1, "jump")]
assert (np.abs(delivered[3:12] / WANTED - 1) < 0.02).all()
assert (np.abs(delivered[13:] / WANTED - 1) < 0.02).all()
assert peak.max() < 5e-3
assert (reasons[0] == "fallback").all()
