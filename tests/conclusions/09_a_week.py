"""What must hold at the end of the notebook.

Elements are compared with those that were drawn. All fits of a day share its driver, so their
errors are not independent, but the largest of 1 163 errors is below six standard errors. A verdict
refuses few good recordings. The variance between electrodes is that of what was drawn, but for the
error of a driver: it grows with R_p, and so stretches all differences of a day alike.
"""

# The names are those of the notebook.
# pyright: reportUndefinedVariable=false

keys = [
    tuple(str(fits.labels[name][row]) for name in ("subject", "site", "session", "electrode"))
    for row in range(len(fits))
]
lost = fits.labels["electrode"] == "E15"
assert len(fits) == len(true) == len(SUBJECTS) * len(SITES) * len(DAYS) * 98
assert set(fits.verdicts[lost]) == {"unconnected"}
good = ~lost & (fits.verdicts == "successful")
assert np.sum(~lost & ~good) <= 3
errors = np.log([fits.circuit.r_p[row] / true[keys[row]] for row in np.flatnonzero(good)])
stderr = (np.asarray(fits.stderr.r_p) / np.asarray(fits.circuit.r_p))[good]
assert np.abs(errors / stderr).max() < 6
assert drivers["d2"].moved < 4
drawn = np.log([true[keys[row]] for row in np.flatnonzero(~lost)])
groups = {key[:3] for key in keys}
of = [key[:3] for row, key in enumerate(keys) if not lost[row]]
within = [np.var(drawn[[one == group for one in of]], ddof=1) for group in groups]
part = variation.between["recordings"]
stretched = 3 * variation.driver_error  # three standard deviations of the driver's relative error
assert part.low / (1 + stretched) < np.sqrt(np.mean(within)) < part.high * (1 + stretched)
assert part.std > 4 * variation.error
