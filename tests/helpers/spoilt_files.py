"""Files spoilt at random: bytes, cells of tables, values of JSON, YAML and settings, arrays."""

from __future__ import annotations

import io
import json
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import yaml

CELLS = (
    "nan",
    "inf",
    "-1",
    "0",
    "1e308",
    "1e20",
    "-" + "9" * 400,
    "",
    "x" * 9000,
    "\x1b[2J",
    "\0",
    "1e-320",
    "٣",
)
VALUES: tuple[Any, ...] = (
    None, True, -1, 0, 1, 0.5, 1e-300, 1e308, 1e20, 10**9, 2**24, 2**63, 10**400, float("nan"), float("inf"), "",
    "\x1b[31m\0", "x" * 9000, "../..", [], {}, [[[]]], [1] * 3, [0.0, float("nan")], {"a": {"b": []}},
)  # fmt: skip
"""What replaces a cell of a table, and a value of JSON or YAML."""
NUMBERS: dict[type, tuple[Any, ...]] = {
    int: (0, 1, 2, 7, 100, 1001, 10**4, 10**6, 2**24, 10**9, 2**31, 2**62),
    float: (0.0, 1e-300, 1e-9, 1e-3, 0.5, 1.0, 10.0, 1e3, 1e6, 1e20, 1e308),
}
"""What replaces a number, of its own type, mostly."""


def spoil(path: Path, rng: np.random.Generator, others: list[Path]) -> str:
    """Spoils a file; returns how.

    Args:
        others: files that may be put in its place.
    """
    ways: list[Callable[..., str]] = [_bytes]
    kind = path.suffix
    ways += [_cells] * 2 * (kind in (".csv", ".tum", ".txt", ".g2o")) + [_tree] * 2 * (
        kind in (".json", ".yaml")
    )
    ways += [_arrays] * 2 * (kind == ".npz")
    if others and rng.random() < 0.05:
        other = others[rng.integers(len(others))]
        shutil.copy(other, path)
        return f"swapped for {other.name}"
    return ways[rng.integers(len(ways))](path, rng)


def _bytes(path: Path, rng: np.random.Generator) -> str:
    content = bytearray(path.read_bytes())
    a, b, c = (int(place) for place in np.sort(rng.integers(0, len(content) + 1, 3)))
    way = ("cut", "flipped", "zeroed", "doubled", "swapped", "inserted", "emptied", "shortened")[
        rng.integers(8)
    ]
    match way:
        case "cut":
            content = content[:b]
        case "flipped":
            for place in rng.integers(0, len(content), rng.integers(1, 20)):
                content[place] ^= 1 << int(rng.integers(8))
        case "zeroed":
            content[a : a + 512] = bytes(len(content[a : a + 512]))
        case "doubled":
            content = content[:b] + content[a:]
        case "swapped":
            content = content[:a] + content[b:c] + content[a:b] + content[c:]
        case "inserted":
            content[a:a] = (b"[" * 100_000, b"9" * 500, b"\xff\xfe", b"-" * 2_000_000)[rng.integers(4)]
        case "emptied":
            content.clear()
        case _:
            del content[a : a + 64]
    path.write_bytes(content)
    return f"bytes {way}"


def _cells(path: Path, rng: np.random.Generator) -> str:
    lines = path.read_text(encoding="utf-8").splitlines()
    comma = "," if "," in lines[0] else " "
    value, row = CELLS[rng.integers(len(CELLS))], int(rng.integers(len(lines)))
    cells = lines[row].split(comma)
    column = int(rng.integers(len(cells)))
    way = ("cell", "column", "lost cell", "row again", "rows swapped", "wide")[rng.integers(6)]
    match way:
        case "cell":
            lines[row] = comma.join([*cells[:column], value, *cells[column + 1 :]])
        case "column":
            split = [line.split(comma) for line in lines[1:]]
            lines[1:] = [comma.join([*line[:column], value, *line[column + 1 :]]) for line in split]
        case "lost cell":
            lines[row] = comma.join(cells[:column] + cells[column + 1 :])
        case "row again":
            lines.insert(row, lines[row])
        case "rows swapped":
            lines[row:] = lines[row:][::-1]
        case _:
            lines = [line + comma + comma.join("0" * 3000) for line in lines]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return f"{way} {value[:9]!r} in row {row}, column {column}"


def leaves(tree: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """The paths of all values of a tree of lists and mappings but itself."""
    items = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    return [found for key, value in items for found in ((*path, key), *leaves(value, (*path, key)))]


def replace(tree: Any, rng: np.random.Generator) -> str:
    """Replaces or removes a value of a tree."""
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
    text = path.read_text(encoding="utf-8")
    tree = json.loads(text) if path.suffix == ".json" else yaml.safe_load(text)
    if not leaves(tree):
        return _bytes(path, rng)
    way = replace(tree, rng)
    path.write_text(json.dumps(tree) if path.suffix == ".json" else yaml.safe_dump(tree), encoding="utf-8")
    return way


def _arrays(path: Path, rng: np.random.Generator) -> str:
    with np.load(path) as found:
        arrays = dict(found)
    name = list(arrays)[rng.integers(len(arrays))]
    array, header = arrays.pop(name), ""
    way = ("lost", "value", "values", "shape", "dtype", "longer", "header", "text")[rng.integers(8)]
    number = (np.nan, np.inf, -1.0, 1e308, 1e20, 0.0)[rng.integers(6)]
    with np.errstate(all="ignore"):
        match way:
            case "value" | "values" if array.size and array.dtype.kind in "fiu":
                number = number if array.dtype.kind == "f" else np.nan_to_num(number, nan=-1)
                low, high = (-1e308, 1e308) if array.dtype.kind == "f" else (-(2**30), 2**30)
                array = array.copy()
                array.flat[rng.integers(array.size) if way == "value" else slice(None)] = np.clip(
                    number, low, high
                )
            case "shape":
                array = array[None]
            case "dtype":
                array = (
                    array.astype(("c16", "U9", "i1", "f4", "?")[rng.integers(5)])
                    if array.dtype.kind in "fiu"
                    else array
                )
            case "longer" if array.ndim:
                array = np.concatenate([array, array, array])
            case "text":
                array = np.array("x" * 9000)
            case "header":
                header = str((2 ** int(rng.integers(20, 90)),) * max(1, array.ndim))
    if way != "lost":
        arrays[name] = array
    np.savez(path, **arrays)
    if header:
        _rewrite_shape(path, name, header)
    return f"{way} {number} in {name}"


def _rewrite_shape(path: Path, name: str, shape: str) -> None:
    """Another shape in the header of an array."""
    with zipfile.ZipFile(path) as archive:
        members = {info.filename: archive.read(info) for info in archive.infolist()}
    with io.BytesIO(members[f"{name}.npy"]) as file:
        np.lib.format.read_magic(file)
        _, _, dtype = np.lib.format.read_array_header_1_0(file)
        rest = file.read()
    text = (
        f"{{'descr': {np.lib.format.dtype_to_descr(dtype)!r}, 'fortran_order': False, 'shape': {shape}, }}\n"
    )
    members[f"{name}.npy"] = b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text.encode() + rest
    with zipfile.ZipFile(path, "w") as archive:
        for member, content in members.items():
            archive.writestr(member, content)
