"""What must hold at the end of the notebook."""

import numpy as np

# The names are those of the notebook.
# pyright: reportUndefinedVariable=false

for name, fit in {"two layers": layers, "Cole": spread}.items():
    true, stderr = np.asarray(truth[name].values()), np.asarray(fit.stderr.values())
    assert np.all(abs(np.asarray(fit.circuit.values()) - true) < 5 * stderr), name  # 1 in 10⁶
    smallest = np.array(list(bounds[name].stderr.values()))
    assert np.all(stderr < 1.3 * smallest), name
assert {fit.verdict for fit in small.values()} <= {"misfit", "inconsistent"}
assert large.verdict == "insensitive"
assert abs(float(one.circuit.alpha) - 1) < 5 * float(one.stderr.alpha)
assert sum(line[0] in "RC" for line in netlist.splitlines()) == 5
assert string == "R0-p(R1,CPE1)"
assert values[-1] == float(spread.circuit.alpha)
