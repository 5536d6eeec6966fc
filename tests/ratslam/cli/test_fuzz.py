"""Spoilt configurations, recordings, maps and run folders through every command that reads them.

No traceback, no minute without a word, at most 2 GB, no wrong map without a warning, no file left behind.
"""

import io
import json
import re
import shutil
import zipfile
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace as altered
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from evaluation.metrics.trajectory import ate, read_tum
from ratslam.runs.settings.run_config import load_config
from robot.recordings.mcap_writer import Recorder
from robot.sources.source import describe
from tactile.base.se2 import integrate
from tests.helpers import scenes
from tests.helpers.command_worker import CommandWorker, Outcome
from tests.helpers.commands import ROOT, SQUARE
from tests.helpers.ros_bags import Entry, header, odometry, pose, scan, write_bag

Judge = Callable[[str, Outcome], str]
BAGS = ("ros1", "ros1-bz2", "ros1-lz4", "sqlite3", "sqlite3-message", "mcap", "mcap-storage")
CONFIGS = ("square", "whisker_maze", "create_arena", "rat_box", "live_maze")
SMALL = {
    "simulation": {"path": {"explore": 12.0}},
    "create_simulation": {"reports": 12},
    "rat_simulation": {"seconds": 4.0},
}
EXPORTS = ("x.mcap", "x.tum", "x.g2o", "x.json", "x.graphml", "x.yaml", "bag")
REACH, FLOOR = 8.0, 0.05
"""Range that becomes 1; error of a map below which it is none: m."""

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


@pytest.fixture(scope="module")
def worker() -> Iterator[CommandWorker]:
    with closing(CommandWorker()) as started:
        yield started


def fault_of(outcome: Outcome, folder: Path, there: set[Path]) -> str:
    """What is wrong with the way in which a command ended, '' if nothing."""
    code, said = outcome
    if code not in (0, 1, 2, 130):
        return f"exit {code}: {said[-1500:]}"
    if found := re.search(r"Traceback|pydantic\.dev|\w+Warning: .*|[^\n\r\t -~\x80-\U0010ffff]", said):
        return f"{found[0]!r} in {said[:600]!r}"
    if long := [line for line in said.splitlines() if len(line) > 2000]:
        return f"a line of {len(long[0])} characters: {long[0][:200]}"
    left = [path.name for path in folder.rglob("*") if path not in there]
    if code == 2 and left:
        return f"left behind: {left[:5]} after {said[-300:]}"
    return "" if code != 2 or "error" in said else f"no error in {said!r}"


def run_all(
    worker: CommandWorker, folder: Path, how: str, commands: list[str], judge: Judge = lambda *_: ""
) -> list[str]:
    """Runs commands on a spoilt input, which is in the folder; returns the faults found."""
    found = []
    for command in commands:
        there = set(folder.rglob("*"))
        outcome = worker.run(folder, *command.split())
        if fault := fault_of(outcome, folder, there) or judge(command, outcome):
            found.append(f"{folder.name} {how} {command}\n    {fault}")
    shutil.rmtree(folder)
    return found


def write_recordings(folder: Path) -> dict[Path, dict[str, Any]]:
    """One drive in every format, and the section `recording` that reads it but its file."""
    folder.mkdir()
    scene = scenes.square(3, laps=1)
    motion = scene.motion.copy()
    motion[1:, 2] += 0.02
    path, truth, views = integrate(motion[:, :3]), scene.truth, scene.views.reshape(len(motion), 18)
    table, step = np.column_stack([scene.time, path, truth, views]), np.diff(scene.time, prepend=-0.5)
    names = "t,x,y,heading,gx,gy,gh," + ",".join(f"r{k}" for k in range(18))
    np.savetxt(folder / "drive.csv", table, "%.6g", ",", header=names, comments="")
    np.savez(
        folder / "drive.npz", in_t=scene.time, in_v=motion[:, 0] / step, in_w=motion[:, 2] / step,
        in_flags=np.full(len(step), 3), in_view=views, truth=truth,
        params_json=np.array('{"template_y_size": 3, "template_x_size": 6}'),
    )  # fmt: skip
    with Recorder(folder / "drive.mcap", altered(describe(scene), rate_hz=2.0), chunk_s=10.0) as recorder:
        for sample in altered(scene, motion=motion):
            recorder.write(sample)
    columns = {"pose": {}, "views": {}, "truth": {"x": "gx", "y": "gy", "heading": "gh"}}
    found: dict[Path, dict[str, Any]] = {folder / "drive.csv": {"table": columns}}
    found |= {folder / "drive.npz": {}, folder / "drive.mcap": {}}
    entries = list[Entry]()
    for k, time in enumerate((1_700_000_000_000_000_000 + scene.time * 1e9).astype(np.int64).tolist()):
        true = {"header": header(time), "pose": pose(*truth[k])}
        entries += [odometry(time, *path[k]), scan(time, REACH * views[k], -np.pi, np.pi / 9)]
        entries.append(Entry("/truth", "geometry_msgs/msg/PoseStamped", time, true))
    read = {"topic": "/scan", "max_range": REACH, "yaw": 0.0}
    topics = {"odometry": "/odom", "truth": "/truth", "views": read}
    for kind in BAGS:
        (folder / kind).mkdir()
        bag = write_bag(folder / kind, kind, entries)
        found[bag if bag.is_file() else next(bag.glob("*.[dm]*"))] = {"topics": topics}
    return found


def shares(few: int, many: int) -> Any:
    soak = pytest.param(range(many), marks=pytest.mark.soak)
    return pytest.mark.parametrize("seeds", [range(few), soak], ids=["few", "many"])


@shares(5, 300)
def test_spoilt_recordings(seeds: range, worker: CommandWorker, square: Path, tmp_path: Path) -> None:
    recordings, wrong = write_recordings(tmp_path / "whole"), list[str]()
    others = [f"localise {square} FILE -o found", f"run c.yaml --continue {square} -o on"]
    others += ["fit c.yaml", "tools recover FILE -o whole.mcap"]
    for seed in seeds:
        rng, folder = np.random.default_rng(seed), tmp_path / str(seed)
        original = list(recordings)[seed % len(recordings)]
        name, whole = original.name, tmp_path / f"clean-{original.parent.name}-{original.name}"
        folder.mkdir()
        (folder / "c.yaml").write_text(yaml.safe_dump({"recording": {"file": name} | recordings[original]}))
        shutil.copy(original, folder)
        if not whole.exists():
            done = worker.run(folder, "run", "c.yaml", "-o", whole, long=300.0)
            assert done.code == 0, done.said
            assert "warning:" not in done.said
        how = f"{original.parent.name}/{name}: {spoil(folder / name, rng, list(recordings))}"

        def judge(command: str, outcome: Outcome, run: Path = folder / "run", whole: Path = whole) -> str:
            if not command.endswith("-o run") or outcome.code != 0 or "warning:" in outcome.said:
                return ""
            off, usual = error(run, whole / "truth.tum"), error(whole, whole / "truth.tum")
            return "" if off <= 1.5 * usual + FLOOR else f"in silence {off:.3f} m instead of {usual:.3f} m"

        commands = ["doctor FILE -o new.yaml", "run c.yaml -o run", others[rng.integers(4)]]
        wrong += run_all(worker, folder, how, [command.replace("FILE", name) for command in commands], judge)
    assert not wrong, f"{len(wrong)} faults\n" + "\n".join(wrong)


def error(run: Path, truth: Path) -> float:
    """Error (ATE, m) of a run at the times that the truth spans."""
    (time, found), (known, poses) = read_tum(run / "trajectory.tum"), read_tum(truth)
    inside = (time >= known[0]) & (time <= known[-1])
    there = np.stack([np.interp(time[inside], known, column) for column in poses.T], axis=1)
    return ate(found[inside], there) if inside.sum() > 1 else 0.0


@shares(5, 200)
def test_spoilt_configurations(seeds: range, worker: CommandWorker, square: Path, tmp_path: Path) -> None:
    wrong, (csv, reading) = list[str](), next(iter(write_recordings(tmp_path / "whole").items()))
    others = ["simulate c.yaml -o s.mcap", "fit c.yaml", f"localise {square} c.yaml -o found"]
    others += ["doctor c.yaml --live", "live c.yaml -o live"]
    for seed in seeds:
        rng, folder, name = np.random.default_rng(seed), tmp_path / str(seed), CONFIGS[seed % len(CONFIGS)]
        tree = load_config(ROOT / "configs" / f"{name}.yaml").model_dump(mode="json", exclude_none=True)
        for key in SMALL.keys() & tree.keys():
            tree[key] |= SMALL[key]
        if "recording" in tree:
            tree["recording"] = {"file": str(csv)} | reading
        how = f"{name}: " + "; ".join(replace(tree, rng) for _ in range(rng.integers(1, 3)))
        folder.mkdir()
        (folder / "c.yaml").write_text(yaml.safe_dump(tree, allow_unicode=True))
        if rng.random() < 0.2:
            how = spoil(folder / "c.yaml", rng, [])
        wrong += run_all(worker, folder, how, ["run c.yaml -o run", others[rng.integers(5)]])
    assert not wrong, f"{len(wrong)} faults\n" + "\n".join(wrong)


@shares(6, 300)
def test_spoilt_maps_and_runs(seeds: range, worker: CommandWorker, square: Path, tmp_path: Path) -> None:
    wrong, originals = list[str](), [square]
    if len(seeds) > 10:
        originals += other_folders(worker, square, tmp_path)
    of_maps = ["path spoilt --to 0.5,0.1", f"map diff {square} spoilt", f"localise spoilt {SQUARE} -o found"]
    of_maps += ["map crop spoilt --steps 0:60 -o part.npz", "map undo spoilt 1 -o undone.npz"]
    of_maps += [f"merge {square} spoilt -o both.npz", f"run {SQUARE} --continue spoilt/map.npz -o on"]
    of_runs = ["doctor spoilt", "score spoilt", "watch spoilt --once", "report spoilt -o r.html"]
    for seed in seeds:
        rng, folder = np.random.default_rng(seed), tmp_path / str(seed)
        original = originals[seed // 2 % len(originals)]
        shutil.copytree(original, folder / "spoilt", ignore=shutil.ignore_patterns("*.png", "*.html"))
        files = sorted((folder / "spoilt").iterdir())
        file = folder / "spoilt" / "map.npz" if seed % 2 else files[rng.integers(len(files))]
        how = f"{original.name}/{file.name}: "
        if rng.random() < 0.1:
            file.unlink()
        else:
            how += spoil(file, rng, files)

        def judge(command: str, outcome: Outcome, file: Path = file, whole: Path = original) -> str:
            if command != "map info spoilt" or outcome.code != 0 or file.name != "map.npz":
                return ""
            return "" if same_arrays(file, whole / file.name) else "a damaged map is accepted"

        commands = ["map info spoilt", *(of_maps if file.name == "map.npz" else []), *of_runs]
        commands.append(f"export spoilt -o {EXPORTS[rng.integers(len(EXPORTS))]}")
        wrong += run_all(worker, folder, how, commands, judge)
    assert not wrong, f"{len(wrong)} faults\n" + "\n".join(wrong)


def same_arrays(file: Path, other: Path) -> bool:
    with np.load(file) as found, np.load(other) as known:
        return set(found) == set(known) and all(found[key].tobytes() == known[key].tobytes() for key in known)


def other_folders(worker: CommandWorker, square: Path, folder: Path) -> list[Path]:
    """Folders of a grid, of a method with cells, of touch, of a localised session, and of a merged map."""
    with np.load(ROOT / "tests" / "golden" / "a_square3.npz") as found:
        changed = {"in_v": 1.001 * found["in_v"], "in_view": 0.999 * found["in_view"]}
        np.savez(folder / "later.npz", **dict(found) | changed)
    commands = [
        "run create_arena --set create_simulation.reports=40 -o grid",
        "run rat_box --set rat_simulation.seconds=6 --set cells={} -o cells",
        "run whisker_maze --set simulation.path.explore=30 -o touch",
        f"localise {square} {SQUARE} -o found",
        f"run {SQUARE} --set recording.file={folder}/later.npz -o later",
        f"merge {square} later -o merged",
    ]
    for command in commands:
        done = worker.run(folder, *command.split(), long=300.0)
        assert done.code == 0, done.said
    return [folder / command.split()[-1] for command in commands]


def bomb(path: Path) -> None:
    """Writes a file that is small and expands to much, or nests deeply."""
    if path.suffix == ".npz":
        kind = {"descr": "<f8", "fortran_order": False, "shape": (2 ** (70 if path.stem == "long" else 26),)}
        start = io.BytesIO()
        np.lib.format.write_array_header_1_0(start, kind)
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
            for member in ("in_t", "in_v", "in_w", "in_flags", "in_view", "params_json"):
                with archive.open(f"{member}.npy", "w") as file:
                    file.write(start.getvalue())
                    for _ in range(0 if path.stem == "long" else 32):
                        file.write(bytes(1 << 24))
    elif path.suffix == ".yaml":
        levels = [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]\n" for k in range(1, 30)]
        path.write_text(f"a0: &a0 [1]\n{''.join(levels)}backend: *a29\n")
    else:
        log = "".join(f"{k},{k},0,0,0\n" for k in range(9))
        path.write_text("[" * 200_000 if path.suffix == ".json" else f"t,id,x,y,theta\n{log}9,1e20,0,0,0\n")


TOO_LARGE = {
    f"run {SQUARE} --set recording.file=HERE/bomb.npz": "256 MiB, or 32 times what is stored",
    "doctor long.npz": "is not a plain array",
    "score ids.csv": "ids.csv:11: experience id 1e+20",
    "run bomb.yaml": "anchor",
    f"run {SQUARE} --set session.reserve=4194304": "524288",
    f"run {SQUARE} --set pose_cells.cells_xy=1001 --set pose_cells.cells_heading=288": "1024 MiB",
    f"run {SQUARE} --set recall.shifts=1000000": "4096",
    f"run {SQUARE} --set keyframes.max_gap=4294967296": "2147483647",
    f"run {SQUARE} --set pose_cells.cell_size=1e-300": "0, or a number of 1e-30 to 1e+15",
    "run create_arena --set grid.particles=1000000": "fewer particles",
    "run create_arena --set grid.footprint.along=1e9": "smaller footprints",
    "run create_arena --set create_simulation.reports=1000000000": "100000",
    "run whisker_maze --set simulation.motion.speed=1e-9": "1000000",
    "run rat_box --set rat_simulation.rate_hz=1e9": "1000000",
}


@pytest.mark.parametrize(("command", "words"), TOO_LARGE.items())
def test_what_is_too_large_is_refused(
    command: str, words: str, worker: CommandWorker, tmp_path: Path
) -> None:
    for name in re.findall(r"\w+\.(?:npz|csv|yaml)", command.replace(SQUARE, "")):
        bomb(tmp_path / name)
    there = set(tmp_path.rglob("*"))
    done = worker.run(tmp_path, *command.replace("HERE", str(tmp_path)).split())
    assert done.code == 2, done.said
    assert words in done.said
    assert not fault_of(done, tmp_path, there)


@pytest.mark.parametrize("name", ["config.yaml", "map.json", "scorecard.json"])
def test_a_run_folder_with_a_bomb_is_refused_or_shown(
    name: str, worker: CommandWorker, square: Path, tmp_path: Path
) -> None:
    bomb(Path(shutil.copytree(square, tmp_path / "case" / "run")) / name)
    assert not run_all(
        worker, tmp_path / "case", name, ["report run -o r.html", "doctor run", "export run -o x.json"]
    )
