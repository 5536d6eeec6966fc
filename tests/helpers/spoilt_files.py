"""Files spoilt at random: bytes, cells of tables, values of JSON, YAML and settings, arrays."""

import io
import json
import shutil
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import yaml

CELLS = ("nan", "inf", "-1", "0", "1e308", "1e20", "-" + "9" * 400, "", "x" * 9000, "\x1b[2J", "\0", "٣")
VALUES: tuple[Any, ...] = (
    None, True, -1, 0, 1, 0.5, 1e-300, 1e308, 1e20, 10**9, 2**63, 10**400, float("nan"), float("inf"), "",
    "\x1b[31m\0", "x" * 9000, "../..", [], {}, [[[]]], [1] * 3, [0.0, float("nan")], {"a": {"b": []}},
)  # fmt: skip
NUMBERS: dict[type, tuple[Any, ...]] = {
    int: (0, 1, 2, 7, 100, 1001, 10**4, 10**6, 2**24, 10**9, 2**31, 2**62),
    float: (0.0, 1e-300, 1e-9, 1e-3, 0.5, 1.0, 10.0, 1e3, 1e6, 1e20, 1e308),
}
"""What replaces a cell of a table, a value of JSON or YAML, and mostly a number, by its type."""


def spoil(path: Path, rng: np.random.Generator, others: list[Path]) -> str:
    """Spoils a file, or puts one of the others in its place; returns how."""
    if others and rng.random() < 0.05:
        other = others[rng.integers(len(others))]
        shutil.copy(other, path)
        return f"swapped for {other.name}"
    kinds = {".csv": _cells, ".tum": _cells, ".json": _tree, ".yaml": _tree, ".npz": _arrays}
    return kinds.get(path.suffix, _bytes)(path, rng) if rng.random() < 0.67 else _bytes(path, rng)


def _bytes(path: Path, rng: np.random.Generator) -> str:
    content = bytearray(path.read_bytes())
    a, b, c = (int(place) for place in np.sort(rng.integers(0, len(content) + 1, 3)))
    changes = {
        "cut": content[:b],
        "zeroed": content[:a] + bytes(len(content[a : a + 512])) + content[a + 512 :],
        "doubled": content[:b] + content[a:],
        "swapped": content[:a] + content[b:c] + content[a:b] + content[c:],
        "emptied": b"",
        "shortened": content[:a] + content[a + 64 :],
    }
    way = [*changes, "flipped", "inserted"][rng.integers(8)]
    if way == "flipped":
        for place in rng.integers(0, len(content), rng.integers(1, 20)):
            content[place] ^= 1 << int(rng.integers(8))
    elif way == "inserted":
        content[a:a] = (b"[" * 100_000, b"9" * 500, b"\xff\xfe", b"-" * 2_000_000)[rng.integers(4)]
    path.write_bytes(changes.get(way, content))
    return f"bytes {way}"


def _cells(path: Path, rng: np.random.Generator) -> str:
    lines = path.read_text(encoding="utf-8").splitlines()
    comma = "," if "," in lines[0] else " "
    rows = [line.split(comma) for line in lines]
    value, row = CELLS[rng.integers(len(CELLS))], int(rng.integers(len(rows)))
    column = int(rng.integers(len(rows[row])))
    way = ("cell", "column", "lost cell", "row again", "rows swapped", "wide")[rng.integers(6)]
    if way in ("cell", "column"):
        for cells in rows[1:] if way == "column" else [rows[row]]:
            cells[column : column + 1] = [value]
    elif way == "lost cell":
        del rows[row][column]
    elif way == "row again":
        rows.insert(row, rows[row])
    elif way == "rows swapped":
        rows[row:] = rows[row:][::-1]
    else:
        rows = [cells + ["0"] * 3000 for cells in rows]
    path.write_text("".join(comma.join(cells) + "\n" for cells in rows), encoding="utf-8")
    return f"{way} {value[:9]!r} in row {row}, column {column}"


def leaves(tree: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """The paths of all values of a tree of lists and mappings but itself."""
    items = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    return [found for key, value in items for found in ((*path, key), *leaves(value, (*path, key)))]


def replace(tree: Any, rng: np.random.Generator) -> str:
    """Replaces or removes a value of a tree; returns how."""
    paths = leaves(tree)
    *above, last = paths[rng.integers(len(paths))]
    for key in above:
        tree = tree[key]
    if rng.random() < 0.15:
        del tree[last]
        return f"without {above} {last}"
    values = NUMBERS.get(type(tree[last]), VALUES) if rng.random() < 0.7 else VALUES
    tree[last] = values[rng.integers(len(values))]
    return f"{above} {last} = {str(tree[last])[:20]!r}"


def _tree(path: Path, rng: np.random.Generator) -> str:
    read, write = (json.loads, json.dumps) if path.suffix == ".json" else (yaml.safe_load, yaml.safe_dump)
    tree = read(path.read_text(encoding="utf-8"))
    if not leaves(tree):
        return _bytes(path, rng)
    way = replace(tree, rng)
    path.write_text(write(tree), encoding="utf-8")
    return way


def _arrays(path: Path, rng: np.random.Generator) -> str:
    with np.load(path) as found:
        arrays = dict(found)
    name = list(arrays)[rng.integers(len(arrays))]
    array = arrays.pop(name)
    way = ("lost", "value", "values", "shape", "dtype", "longer", "header", "text")[rng.integers(8)]
    number = (np.nan, np.inf, -1.0, 1e308, 1e20, 0.0)[rng.integers(6)]
    if way in ("value", "values") and array.size and array.dtype.kind in "fi":
        where = rng.integers(array.size) if way == "value" else slice(None)
        with np.errstate(all="ignore"):
            array.flat[where] = np.array(number).astype(array.dtype)
    elif way == "shape":
        array = array[None]
    elif way == "dtype" and array.dtype.kind in "fi":
        array = np.nan_to_num(array).astype(("c16", "U9", "?")[rng.integers(3)])
    elif way == "longer" and array.ndim:
        array = np.concatenate([array, array])
    elif way == "text":
        array = np.array("x" * 9000)
    arrays |= {} if way == "lost" else {name: array}
    np.savez(path, **arrays)
    if way == "header":
        _rewrite_shape(path, name, (2 ** int(rng.integers(20, 90)),))
    return f"{way} {number} in {name}"


def _rewrite_shape(path: Path, name: str, shape: tuple[int, ...]) -> None:
    with zipfile.ZipFile(path) as archive:
        members = {info.filename: archive.read(info) for info in archive.infolist()}
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": shape})
    members[f"{name}.npy"] = header.getvalue() + members[f"{name}.npy"][128:]
    with zipfile.ZipFile(path, "w") as archive:
        for member, content in members.items():
            archive.writestr(member, content)
