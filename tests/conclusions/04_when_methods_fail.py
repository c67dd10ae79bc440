"""What must hold at the end of the notebook.

Successful fits are right within five of their standard errors (exceeded 1 in 10⁶ by chance).
The verdict of a wrong fit is never `successful`.
"""

# The names are those of the notebook.
# pyright: reportUndefinedVariable=false

for name in ("default", "default, late trigger"):
    some = CASES[name]
    assert some.counts() == {"successful": TRIALS}, name
    assert (abs(errors(some)) < 5 * np.asarray(some.stderr.values()) / TRUTH).all(), name
for name, some in CASES.items():
    wrong = abs(errors(some)) > 0.2  # five standard errors of R_s
    assert not (wrong.any(axis=1) & (some.verdicts == "successful")).any(), name
assert abs(errors(paper)[:, 0].mean()) > 5 * errors(paper)[:, 0].std()  # bias, not spread
assert np.median(spread_fits.fit.rrse) < 1.1 * np.median(fits.fit.rrse)  # RRSE is blind
assert abs(errors(spread_fits)[:, 0]).min() > 5 * abs(errors(fits)[:, 0]).max()
assert "successful" not in paper.counts()
assert errors(late_paper)[:, 2].std() > 3 * errors(late_fits)[:, 2].std()
assert clipped.counts() == {"saturated": TRIALS}
assert "successful" not in spread_fits.counts()
assert np.median(spread_fits.fit.chi2) < 1.5
assert "successful" not in changed_fits.counts()
assert low_driver.verdict == "order_too_low"
assert float(low_driver.chi2) < 1.2
assert "successful" not in low_fits.counts()
assert (
    abs(errors(low_fits).mean(axis=0)) > 5 * np.asarray(low_fits.stderr.values())[0] / TRUTH
).all()
assert "successful" not in poor_fits.counts()
