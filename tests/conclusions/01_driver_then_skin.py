"""What must hold at the end of the notebook."""

# The names are those of the notebook.
# pyright: reportUndefinedVariable=false

assert driver.verdict == "successful"
assert fits.counts() == {"successful": 6}
for name, error in errors(fits).items():
    relative = np.asarray(getattr(fits.stderr, name)) / np.asarray(getattr(fits.circuit, name))
    assert np.all(abs(error) < 5 * relative), name  # five standard errors: 1 in 10⁶ by chance
    assert np.all(relative < 0.05), name  # small enough to be useful
assert "successful" not in baseline.counts()  # the results are wrong, and the verdicts say so
assert abs(errors(baseline)["c_p"]).min() > abs(errors(fits)["c_p"]).max()
