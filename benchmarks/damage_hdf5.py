"""Damage the structure of HDF5 files. Seeded, and without limits."""

import contextlib
import pathlib
from collections.abc import Callable, Iterator
from typing import Any

import h5py
import numpy as np

from benchmarks.damage import Rng, damaged_json, odd_value, one_of

_NAMES = ("v_th", "v_out", "current", "kind", "unit", "conversion", "path", "cov", "verdict", "x")
_BOMB = 1 << 27  # numbers in a dataset that takes a few kilobytes of the file


def restructure(path: pathlib.Path, rng: Rng) -> None:
    """Change shapes, types, names, attributes and links of an HDF5 file, one to three times."""
    with h5py.File(path, "r+") as file:
        for _ in range(int(rng.integers(1, 4))):
            # What the library refuses to write is no file to read.
            with contextlib.suppress(Exception):
                one_of(rng, _STRUCTURE)(file, rng)


def _any(file: h5py.File, rng: Rng, kind: type) -> Any:
    return one_of(rng, [item for item in _items(file) if isinstance(item, kind)])


def _items(file: h5py.File) -> Iterator[h5py.HLObject]:
    """Each object once, parents first, then by name.

    `visititems` looks each of them up from the root: two seconds where 1500 groups are nested.
    """
    left: list[Any] = [file]
    seen: set[h5py.HLObject] = set()  # equal if they are the same object of the file
    while left:
        item = left.pop()
        if item in seen:
            continue
        seen.add(item)
        yield item
        if isinstance(item, h5py.Group):
            names = [one for one in item if isinstance(item.get(one, getlink=True), h5py.HardLink)]
            left += [item[one] for one in reversed(names)]


def _replaced(dataset: h5py.Dataset, **made: Any) -> None:
    """Another dataset of the same name with the same attributes."""
    parent: Any = dataset.parent
    name, attributes = dataset.name, dict(dataset.attrs)
    del parent[name]
    new = parent.create_dataset(name, **made)
    new.attrs.update(attributes)


def _shape(file: h5py.File, rng: Rng) -> None:
    dataset = _any(file, rng, h5py.Dataset)
    size = max(1, int(np.prod(dataset.shape or ())))
    shapes = [(), (0,), (1,), (size + 1,), (max(1, size - 1),), (size, 1), (1, size), (2, 3, 4),
              (1,) * 32, (0, size), (size, 0)]  # fmt: skip
    dtype = dataset.dtype
    if rng.random() < 0.4:  # declared, but not stored
        huge = [(2**20,), (2**31,), (2**40,), (2**31, 2**31), (2**40, 100), (10, 2**33), (2**21, 4)]
        shape = one_of(rng, huge)
        chunks = tuple(min(64, side) for side in shape)
        return _replaced(dataset, shape=shape, dtype=dtype, chunks=chunks)
    return _replaced(dataset, shape=one_of(rng, shapes), dtype=dtype)


def _dtype(file: h5py.File, rng: Rng) -> None:
    dataset = _any(file, rng, h5py.Dataset)
    texts = h5py.string_dtype()
    kinds = (
        "f2", "f4", ">f8", ">i2", "u1", "i8", "c16", "S5", "V7", texts, np.dtype("longdouble"),
        h5py.enum_dtype({"a": 1, "b": 2}), h5py.vlen_dtype("f8"), h5py.ref_dtype, "bool",
        np.dtype([("a", "i4"), ("b", "f8")]), h5py.string_dtype("utf-8", 3), ("f8", (4,)),
    )  # fmt: skip
    _replaced(dataset, shape=dataset.shape, dtype=one_of(rng, kinds))


def _values(file: h5py.File, rng: Rng) -> None:
    dataset = _any(file, rng, h5py.Dataset)
    if dataset.is_virtual:  # of itself: to read it ends the process
        return
    stored = dataset[()]
    if np.asarray(stored).dtype.kind in "fiu":
        odd = rng.choice([0.0, -1.0, 1e-300, 1e308, np.nan, np.inf, -np.inf])
        if stored.dtype.kind in "iu":
            odd = rng.choice([0, 1, np.iinfo(stored.dtype).max, np.iinfo(stored.dtype).min])
        stored[rng.random(stored.shape) < rng.choice([0.1, 1.0])] = odd
        dataset[...] = stored
    else:
        texts = ["", "x", "successful", "mixed", "{}", "[]", '{"calibrations": 1}', "loaded/0"]
        dataset[int(rng.integers(len(dataset)))] = one_of(rng, texts)


def _json(file: h5py.File, rng: Rng) -> None:
    """Change the text of drivers, or of any other dataset of texts."""
    datasets = [item for item in _items(file) if isinstance(item, h5py.Dataset)]
    texts = [item for item in datasets if h5py.check_string_dtype(item.dtype)]
    dataset = one_of(rng, [each for each in texts if each.name == "/drivers"] or texts)
    row = int(rng.integers(len(dataset)))
    dataset[row] = damaged_json(dataset.asstr()[row], rng)


def _remove(file: h5py.File, rng: Rng) -> None:
    item = _any(file, rng, h5py.Dataset)
    del item.parent[item.name]


def _rename(file: h5py.File, rng: Rng) -> None:
    item = _any(file, rng, h5py.Dataset if rng.random() < 0.5 else h5py.Group)
    item.parent.move(item.name, f"{item.parent.name}/{rng.choice(_NAMES)}")


def _attribute(file: h5py.File, rng: Rng) -> None:
    owner = _any(file, rng, h5py.HLObject)
    names = list(owner.attrs)
    name = one_of(rng, names) if names else "kind"
    what = rng.random()
    if what < 0.2:
        del owner.attrs[name]
    elif what < 0.3:
        owner.attrs[str(rng.choice(_NAMES))] = owner.attrs[name]
        del owner.attrs[name]
    elif what < 0.4:
        owner.attrs[str(rng.choice(_NAMES))] = odd_value(rng)
    elif what < 0.5:
        _odd_type(owner, name, rng)
    else:
        del owner.attrs[name]
        owner.attrs[name] = odd_value(rng)


def _odd_type(owner: Any, name: str, rng: Rng) -> None:
    """An attribute of a type that has no Python value."""
    del owner.attrs[name]
    if rng.random() < 0.5:
        owner.attrs.create(name, np.array([np.arange(3.0)], dtype=object), (1,),
                           h5py.vlen_dtype("f8"))  # fmt: skip
    else:
        owner.attrs.create(name, owner.ref, dtype=h5py.ref_dtype)


def _many_attributes(file: h5py.File, rng: Rng) -> None:
    owner = _any(file, rng, h5py.HLObject)
    for number in range(int(rng.choice([50, 400]))):
        owner.attrs[f"extra{number}"] = "x" * int(rng.choice([1, 200]))


def _deep(file: h5py.File, rng: Rng) -> None:
    group = _any(file, rng, h5py.Group)
    for _ in range(int(rng.choice([3, 40, 1500]))):
        group = group.create_group("g")


def _wide(file: h5py.File, rng: Rng) -> None:
    group = _any(file, rng, h5py.Group)
    for number in range(int(rng.choice([20, 1000]))):
        group.create_group(f"g{number}")


def _link(file: h5py.File, rng: Rng) -> None:
    group, item = _any(file, rng, h5py.Group), _any(file, rng, h5py.HLObject)
    name = str(rng.choice(_NAMES))
    if name in group:
        del group[name]
    links = (
        item,
        h5py.SoftLink(item.name),
        h5py.SoftLink(group.name + "/" + name),  # to itself
        h5py.SoftLink("/nowhere"),
        h5py.ExternalLink(file.filename, item.name),
        h5py.ExternalLink("/dev/zero", "/"),
        h5py.ExternalLink("/nowhere.h5", "/"),
    )
    group[name] = one_of(rng, links)


def _elsewhere(file: h5py.File, rng: Rng) -> None:
    """Samples that lie in another file, or in another dataset."""
    dataset = _any(file, rng, h5py.Dataset)
    shape, dtype = dataset.shape or (4,), dataset.dtype
    if rng.random() < 0.5:
        return _replaced(dataset, shape=shape, dtype=dtype, external=[("/dev/zero", 0, 2**40)])
    attributes = dict(dataset.attrs)
    parent, name = dataset.parent, dataset.name
    del parent[name]
    layout = h5py.VirtualLayout(shape, dtype)
    layout[...] = h5py.VirtualSource(".", name, shape, dtype)
    parent.create_virtual_dataset(name, layout).attrs.update(attributes)
    return None


def _bomb(file: h5py.File, rng: Rng) -> None:
    dataset = _any(file, rng, h5py.Dataset)
    rows = int(rng.choice([1, 64]))
    shape = (rows, _BOMB // rows) if rng.random() < 0.5 else (_BOMB,)
    _replaced(dataset, shape=shape, dtype=dataset.dtype, chunks=True, compression="gzip",
              fillvalue=1)  # fmt: skip


_STRUCTURE: tuple[Callable[[h5py.File, Rng], None], ...] = (
    _shape, _shape, _dtype, _dtype, _values, _json, _json, _remove, _rename, _attribute, _attribute,
    _attribute, _many_attributes, _deep, _wide, _link, _link, _elsewhere, _bomb,
)  # fmt: skip
