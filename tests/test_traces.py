"""Traced functions on disk: found again without tracing, never in the way."""

import collections
import json
import pathlib
import shutil
import subprocess
import sys
import threading
import time
import zlib
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import etid
from etid.identify import compiled as traces
from etid.identify import program_files, program_key
from etid.identify.compiled import stored_jit
from etid.results.verdicts import RESULTS, first_verdict, verdict

X = jnp.linspace(1.0, 2.0, 5)
FACTOR = 2.0
TABLE: dict[str, float] = {}
unpatched = program_key._sources.__wrapped__  # without its cache
SUCCESSFUL = verdict("successful")
executed = collections.deque()  # one entry for each trace; a list would be a constant in the key


class Scaled(eqx.Module):
    value: Any
    result: RESULTS
    method: str = eqx.field(static=True)


def scaled(x, method, bias=None):
    executed.append(method)
    value = FACTOR * jnp.sin(x) + (0.0 if bias is None else bias.value)
    # The field is annotated as an array elsewhere; here it may be a list of anything.
    result = first_verdict((value.sum() > 1e3, RESULTS.misfit), (value[0] > 0, RESULTS.flat))
    return Scaled([value, {"sum": value.sum()}, "as it is", None, 3], result, method)


def with_callback(x):
    shape = jax.ShapeDtypeStruct(x.shape, x.dtype)
    return jax.pure_callback(lambda x: np.asarray(x) + 1, shape, x)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A compilation cache of its own; code of this file counts as known."""
    known = {*program_files.KNOWN, __name__.partition(".")[0]}
    monkeypatch.setattr(program_files, "KNOWN", known)
    # Whoever edits a source while the tests run does not break them.
    monkeypatch.setattr(program_key, "_sources", lambda: "as they are")
    config: Any = jax.config
    before = config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    executed.clear()
    yield tmp_path / traces.FOLDER
    jax.config.update("jax_compilation_cache_dir", before)


def files(folder):
    return sorted(folder.iterdir()) if folder.exists() else []


def anew():
    """The function as a process that starts has it."""
    return stored_jit(scaled)


def same(one, other):
    return bool(eqx.tree_equal(one, other))


def test_a_later_process_traces_nothing_and_gets_the_same(folder):
    first = anew()(X, "a")
    assert len(executed) == 1
    assert len(files(folder)) == 1
    again = anew()(X, "a")
    assert len(executed) == 1
    assert same(first, again)
    assert same(eqx.filter_jit(scaled)(X, "a"), again)
    assert again.method == "a"
    assert again.value[2:] == ["as it is", None, 3]
    assert again.result == RESULTS.flat
    assert jax.tree.structure(first) == jax.tree.structure(again)


def test_repeated_calls_look_up_no_file(folder, monkeypatch):
    function = anew()
    function(X, "a")
    monkeypatch.setattr(traces, "_trace", None)
    assert same(function(X, "a"), eqx.filter_jit(scaled)(X, "a"))


@pytest.mark.parametrize("setting", ["jax_compilation_cache_dir", "jax_enable_compilation_cache"])
def test_without_the_compilation_cache_nothing_is_stored(folder, setting):
    before = getattr(jax.config, setting)
    jax.config.update(setting, None if isinstance(before, str) else False)
    try:
        anew()(X, "a")
        anew()(X + 1, "a")
    finally:
        jax.config.update(setting, before)
    assert not files(folder)


def test_settings_that_take_a_function_apart_get_the_function(folder, monkeypatch):
    monkeypatch.setattr(traces, "_trace", None)  # or it would be looked up
    for setting in (jax.disable_jit(), jax.debug_nans(True), jax.debug_infs(True)):
        with setting:
            assert anew()(X, "a").method == "a"


def test_the_key_holds_what_determines_the_trace(folder, monkeypatch):
    calls = [
        lambda: anew()(X, "a"),
        lambda: anew()(X, "b"),
        lambda: anew()(X[:3], "a"),
        lambda: anew()(X.astype(jnp.float32), "a"),
        lambda: anew()(X, "a", Scaled(1.0, SUCCESSFUL, "m")),
        lambda: anew()(X, "a", Scaled(True, SUCCESSFUL, "m")),  # equal to 1.0
        lambda: anew()(X, "a", Scaled(jnp.array(1.0), SUCCESSFUL, "m")),
        lambda: anew()(X, "a", Scaled(jnp.array(1.0), SUCCESSFUL, "n")),
    ]
    with jax.numpy_dtype_promotion("standard"):
        for count, call in enumerate(calls, 1):
            call()
            call()
            assert len(files(folder)) == count
        anew()(X + 1, "a")
        assert len(files(folder)) == len(calls)
        with jax.default_matmul_precision("float32"):
            anew()(X, "a")
        assert len(files(folder)) == len(calls) + 1
        monkeypatch.setattr(program_key, "_sources", lambda: "edited")
        anew()(X, "a")
        assert len(files(folder)) == len(calls) + 2


def test_a_constant_that_was_set_is_another_key(folder, monkeypatch):
    before = anew()(X, "a")
    monkeypatch.setattr(sys.modules[__name__], "FACTOR", 4.0)
    jax.clear_caches()
    after = anew()(X, "a")
    np.testing.assert_allclose(after.value[0], 2 * before.value[0], rtol=1e-15)
    assert len(files(folder)) == 2


def test_a_constant_that_was_changed_in_place_is_another_key(folder):
    """The key remembers what nobody can change; a table is looked at again."""
    anew()(X, "a")
    TABLE["changed"] = 1.0
    try:
        anew()(X, "a")
    finally:
        del TABLE["changed"]
    assert len(files(folder)) == 2
    anew()(X, "a")
    assert len(files(folder)) == 2


def test_a_function_replaced_from_elsewhere_is_not_stored(folder, monkeypatch):
    namespace: dict[str, Any] = {"__name__": "a_notebook"}
    exec("def first_verdict(*conditions):\n    return conditions[0][1]", namespace)
    monkeypatch.setattr(sys.modules[__name__], "first_verdict", namespace["first_verdict"])
    assert anew()(X, "a").result == RESULTS.misfit
    assert not files(folder)


def test_a_class_from_elsewhere_is_not_stored(folder, monkeypatch):
    monkeypatch.setattr(Scaled, "__module__", "__main__")
    bias = Scaled(jnp.array(1.0), SUCCESSFUL, "m")
    np.testing.assert_allclose(anew()(X, "a", bias).value[0], 2 * np.sin(X) + 1)
    assert not files(folder)


def test_sources_that_changed_after_they_were_loaded_are_in_no_key(folder, monkeypatch):
    newest = max(path.stat().st_mtime for path in pathlib.Path(etid.__file__).parent.rglob("*.py"))
    monkeypatch.setattr(program_key, "LOADED", newest + 1)
    assert unpatched() == unpatched()
    assert unpatched() is not None
    monkeypatch.setattr(program_key, "LOADED", newest - 3600)
    monkeypatch.setattr(program_key, "_sources", unpatched)
    anew()(X, "a")
    assert not files(folder)


def test_a_file_of_any_sub_package_is_in_the_key(tmp_path, monkeypatch):
    """A program that was traced before an edit, or a move, must not answer after it."""
    package = tmp_path / "etid"
    shutil.copytree(
        pathlib.Path(etid.__file__).parent, package, ignore=shutil.ignore_patterns("__pycache__")
    )
    monkeypatch.setattr(etid, "__file__", str(package / "__init__.py"))
    monkeypatch.setattr(program_key, "LOADED", time.time() + 3600)  # what is edited below is older
    folders = sorted({path.parent for path in package.rglob("*.py")})
    assert len(folders) > 1
    keys = [unpatched()]
    for folder in folders:
        edited = sorted(folder.glob("*.py"))[0]
        edited.write_text(edited.read_text("utf-8") + "# edited\n", "utf-8")
        keys.append(unpatched())
        edited.rename(edited.with_name("moved.py"))
        keys.append(unpatched())
    assert None not in keys
    assert len(set(keys)) == len(keys)


@pytest.mark.parametrize("damage", ["empty", "short", "changed", "foreign", "other", "directory"])
def test_a_damaged_file_is_ignored_and_written_anew(folder, damage):
    expected = anew()(X, "a")
    (path,) = files(folder)
    content = path.read_bytes()
    path.unlink()
    if damage == "directory":
        path.mkdir()
    elif damage == "other":
        anew()(X, "b")
        (other,) = files(folder)
        path.write_bytes(other.read_bytes())
    else:
        flipped = bytes([content[-1] ^ 1])
        path.write_bytes(
            {
                "empty": b"",
                "short": content[: len(content) // 2],
                "changed": content[:-1] + flipped,
                "foreign": b"not ours" * 100,
            }[damage]
        )
    before = len(executed)
    assert same(anew()(X, "a"), expected)
    assert len(executed) == before + 1
    if damage != "directory":  # whose place no file can take
        anew()(X, "a")
        assert len(executed) == before + 1
        assert path.read_bytes()[:32] == content[:32]


def test_a_file_is_json_and_a_module_and_names_no_class_from_elsewhere(folder, monkeypatch):
    anew()(X, "a")
    [path] = files(folder)
    header, _, module = zlib.decompress(path.read_bytes()[32:]).partition(b"\n")
    _, shell = json.loads(header)
    assert shell["object"][0] == f"{__name__}:Scaled"
    assert module.startswith(b"ML\xefR")  # bytecode of MLIR
    assert program_files.read(path) is not None
    monkeypatch.setattr(program_files, "KNOWN", {"etid"})
    assert program_files.read(path) is None
    for name in ("etid.cli:main", "os:system"):  # a function, and another package
        with pytest.raises(TypeError):
            program_files._class(name)


def test_a_folder_that_cannot_be_written_does_no_harm(folder):
    folder.parent.rmdir()
    folder.parent.write_text("a file where the cache should be")
    assert same(anew()(X, "a"), eqx.filter_jit(scaled)(X, "a"))
    folder.parent.unlink()
    folder.parent.mkdir()


# JAX writes its own compiled programs in place: another thread may find half of one. It says so,
# and compiles.
@pytest.mark.filterwarnings("ignore:Error reading persistent compilation cache entry")
def test_many_may_write_at_once(folder):
    failures = []

    def work():
        try:
            anew()(X, "a")
        except Exception as error:
            failures.append(error)

    threads = [threading.Thread(target=work) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not failures
    assert len(files(folder)) == 1  # and nothing half-written beside it


def test_transformations_get_the_function_itself(folder):
    function = anew()
    function(X, "a")
    plain = eqx.filter_jit(scaled)

    def total(function):
        return lambda x: function(x, "a").value[1]["sum"]

    rows = jnp.stack([X, X + 1])
    for transform, x in ((jax.grad, X), (jax.jit, X), (jax.hessian, X), (jax.vmap, rows)):
        np.testing.assert_array_equal(transform(total(function))(x), transform(total(plain))(x))
    # What is constant in someone's trace may come from the file.
    np.testing.assert_array_equal(jax.jit(lambda: function(X, "a").value[0])(), 2 * jnp.sin(X))


def test_constants_of_a_program_are_no_programs_of_their_own(caplog):
    def shifted(x):
        return x + 3.5 * jnp.arange(7.0)

    x = jnp.ones(7)
    with jax.log_compiles():
        stored_jit(shifted)(x)
    compiled = [line for line in caplog.messages if "XLA compilation of" in line]
    assert len(compiled) == 1, compiled


def test_what_cannot_be_exported_is_traced_as_ever(folder):
    np.testing.assert_array_equal(stored_jit(with_callback)(X), X + 1)
    assert not files(folder)


def test_errors_of_the_function_are_its_own(folder):
    missing: Any = anew()
    with pytest.raises(TypeError, match="missing a required argument"):
        missing(X)
    with pytest.raises(AttributeError, match="has no attribute 'value'"):
        anew()(X, "a", 1.0)


FITS = """
import sys, jax
jax.config.update("jax_enable_x64", True)
import numpy as np
import etid
from etid.identify import compiled as traces
if "warm" in sys.argv:
    # Everything is to be found. Another function would be another key.
    traces._export.__code__ = (lambda *arguments: __import__("os")._exit(3)).__code__
study = etid.scenes.paper_dry(snr_db=60.0).simulate(seed=0)
driver = etid.identify_driver(study["calibration/98k8"])
records = list(study.loaded.recordings())[:3]
fit = etid.identify_skin(records[0], driver)
fits = etid.identify_skins(records, driver)
f = np.geomspace(10.0, 1e5, 30)
direct = etid.identify_impedance(f, np.asarray(etid.SkinRC().response(f)), stderr=10.0)
leaves = jax.tree.leaves([driver, fit, direct, fits.fit])
found = [np.asarray(leaf) for leaf in leaves]
print(driver.verdict, driver.method, fit, fit.method, direct.verdict, fits.counts())
np.savez(sys.argv[1], *found)
"""


@pytest.mark.slow
def test_fits_of_another_process_have_the_same_bits(tmp_path):
    def run(name, *words, **environment):
        path = tmp_path / f"{name}.npz"
        done = subprocess.run(
            [sys.executable, "-c", FITS, str(path), *words],
            env={"PATH": "", "PYTHONPATH": str(pathlib.Path(etid.__file__).parents[1])}
            | environment,
            capture_output=True,
            text=True,
            check=True,
        )
        return done.stdout, list(np.load(path).values())

    cache = {"JAX_COMPILATION_CACHE_DIR": str(tmp_path / "cache")}
    said, cold = run("cold", **cache)
    kept = {path.name.rpartition("-")[0] for path in files(tmp_path / "cache" / traces.FOLDER)}
    named = {"_identified", "_response", "known_at", "skin_lane", "_chunk", "log_slopes", "_fit"}
    assert kept == named
    again, warm = run("warm", "warm", **cache)
    assert again == said
    assert [value.tobytes() for value in warm] == [value.tobytes() for value in cold]
    # XLA orders the operations of a stored program in another way: 1e-9 is far above rounding.
    without_cache, without = run("without")
    assert without_cache == said
    for one, other in zip(without, cold, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9)
