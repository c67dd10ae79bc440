"""What must hold at the end of the notebook."""

# The names are those of the notebook.
# pyright: reportUndefinedVariable=false

for name, skin in SKINS.items():
    selection = found[name]
    assert type(selection.fit.circuit) is type(skin), name
    assert selection.candidates[0].adequate
    off = np.asarray(selection.fit.circuit.values()) - np.asarray(skin.values())
    assert np.all(abs(off) < 5 * np.sqrt(np.diagonal(selection.fit.cov))), name
assert type(fits.circuit) is etid.SkinCole
assert ["SkinLayers" in note for note in fits.notes] == [False, False, False, True]
for selection in [*soldered.values(), *([model_cell] if model_cell else [])]:
    assert type(selection.fit.circuit) is etid.SkinRC
    assert selection.candidates[0].adequate
if model_cell:
    assert abs(float(model_cell.fit.circuit.r_p) / 500e6 - 1) < 0.01  # the maker's tolerance
    assert abs(float(model_cell.fit.circuit.c_p) / 33e-12 - 1) < 0.10
if relaxations is not None:
    assert relaxations.argmax() == joint.argmin() == 2
