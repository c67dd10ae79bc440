"""What must hold at the end of the notebook."""

# The names are those of the notebook.
# pyright: reportUndefinedVariable=false

assert all(with_current.relative[name] < 0.3 * with_driver.relative[name] for name in SKIN.names())
off = np.asarray(fit.circuit.values()) - np.asarray(SKIN.values())
assert np.all(abs(off) < 5 * np.sqrt(np.diagonal(fit.cov)))
assert fixed.stderr.c_p < fit.stderr.c_p
if cell is not None:
    assert abs(float(cell.circuit.r_p) / 500e6 - 1) < 0.01  # the maker's tolerances
    assert abs(float(cell.circuit.c_p) / 33e-12 - 1) < 0.10
    assert cell.usable
    assert cell.rrse < 0.002
for selection in tissue.values():
    assert type(selection.fit.circuit) is etid.SkinCole
    assert selection.fit.verdict == "approximate"
    # Least squares in time leave 0.7 to 1.4 %, weights of the noise by frequency 0.8 to 1.8 %.
    assert selection.fit.rrse < 0.02
