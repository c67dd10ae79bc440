"""What must hold at the end of the notebook.

All trials of a session share the error of its driver, about a fifth of their variance. The
mean square over three sessions of twenty trials has a standard deviation of √(2/3 (1/5² + (1 −
1/5²)/20)), 0.24. The limit for each of the six numbers is three of them.
"""

# The names are those of the notebook.
# pyright: reportUndefinedVariable=false

assert set(verdicts) == {"successful"}
assert (abs(square - 1) < 3 * 0.24).all()
r_s = np.sqrt(np.mean(np.square(errors), axis=(0, 2)))[:, 0]
assert (r_s < 1.5 * GOAL).all(), r_s  # 1 %, as well as 60 trials can show
assert all(promised[f"{name}/000"].relative["r_s"] < 1.2 * GOAL for name in SKIN)
# The statements of the text.
assert excess[2, 4] < 1.1 < excess[1, 4]
assert excess[1, 16] < 1.1
assert all(ways["two resistors"][name] < 0.7 * ways["one resistor"][name] for name in SKIN)
assert (abs(single["damp"][2:] / single["damp"][-1] - 1) < 0.1).all()  # from 40 µs on
assert charge["damp"][2] < 0.1 * charge["damp"][-1]
assert 3.8 < fewer < 4.2
