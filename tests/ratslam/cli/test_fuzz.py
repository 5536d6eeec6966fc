"""Spoilt configurations, recordings, maps and run folders through every command that reads them.

No traceback, no minute without a word, no more than 2 GB, no wrong map without a warning, no file left behind.
"""

from __future__ import annotations

import io
import re
import shutil
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import replace as altered
from pathlib import Path

import numpy as np
import pytest
import yaml

from evaluation.metrics.trajectory import ate, read_tum
from robot.recordings.recorder import Recorder
from tactile.base.se2 import integrate
from tests.helpers import scenes
from tests.helpers.command_worker import CommandWorker, Outcome
from tests.helpers.ros_bags import Entry, header, odometry, pose, scan, write_bag
from tests.helpers.spoilt_files import replace, spoil
from tests.helpers.square_run import ROOT, copy_square_run

SOAK = pytest.mark.soak
BAGS = ("ros1", "ros1-bz2", "ros1-lz4", "sqlite3", "sqlite3-message", "mcap", "mcap-storage")
EXPORTS = ("x.mcap", "x.tum", "x.g2o", "x.json", "x.graphml", "x.yaml", "bag")
REACH = 8.0
FLOOR = 0.05
"""m: an error below it is none."""


@pytest.fixture(scope="module")
def worker() -> Iterator[CommandWorker]:
    started = CommandWorker()
    yield started
    started.close()


@pytest.fixture(scope="module")
def square(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return copy_square_run(tmp_path_factory.mktemp("square") / "run")


def faults(outcome: Outcome, folder: Path, there: set[Path]) -> str:
    """What is wrong with the way in which a command ended, '' if nothing."""
    code, said = outcome
    if code is None or code not in (0, 1, 2, 130):
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
    worker: CommandWorker, folder: Path, seed: int, how: str, commands: list[list[object]],
    judge: Callable[[int, Outcome], str] = lambda at, outcome: "",
) -> list[str]:  # fmt: skip
    """Runs commands on a spoilt input; returns the faults found."""
    found = []
    for at, command in enumerate(commands):
        there = set(folder.rglob("*"))
        outcome = worker.run(folder, *command)
        fault = faults(outcome, folder, there) or judge(at, outcome)
        if fault:
            found.append(f"{seed} {how} {' '.join(map(str, command))[:300]}\n    {fault}")
    shutil.rmtree(folder)
    return found


def write_recordings(folder: Path) -> dict[Path, dict]:
    """One drive in every format, and the section `recording` that reads it but its file."""
    scene = scenes.square(3, laps=1)
    motion = scene.motion.copy()
    motion[:, 2] += 0.02 * (np.arange(len(motion)) > 0)
    path, truth, views = integrate(motion[:, :3]), scene.truth, scene.views.reshape(len(motion), 18)
    columns = [scene.time, *path.T, *truth.T, *views.T]
    names = ["t", "x", "y", "heading", "gx", "gy", "gh", *(f"r{k}" for k in range(18))]
    np.savetxt(
        folder / "drive.csv", np.column_stack(columns), "%.6g", ",", header=",".join(names), comments=""
    )
    truths = {"x": "gx", "y": "gy", "heading": "gh"}
    found = {folder / "drive.csv": {"table": {"pose": {}, "views": {}, "truth": truths}}}
    step = np.diff(scene.time, prepend=-0.5)
    params = '{"template_y_size": 3, "template_x_size": 6}'
    np.savez(
        folder / "drive.npz", in_t=scene.time, in_v=motion[:, 0] / step, in_w=motion[:, 2] / step,
        in_flags=np.full(len(step), 3), in_view=views, truth=truth, params_json=np.array(params),
    )  # fmt: skip
    with Recorder(folder / "drive.mcap", rate_hz=2.0, info=scene.info, chunk_s=10.0) as recorder:
        for sample in altered(scene, motion=motion):
            recorder.write(sample)
    found |= {folder / "drive.npz": {}, folder / "drive.mcap": {}}
    entries = list[Entry]()
    for k, time in enumerate((1_700_000_000_000_000_000 + scene.time * 1e9).astype(np.int64).tolist()):
        true = Entry(
            "/truth", "geometry_msgs/msg/PoseStamped", time, {"header": header(time), "pose": pose(*truth[k])}
        )
        entries += [odometry(time, *path[k]), true, scan(time, REACH * views[k], -np.pi, np.pi / 9)]
    topics = {
        "odometry": "/odom",
        "truth": "/truth",
        "views": {"topic": "/scan", "max_range": REACH, "yaw": 0.0},
    }
    for kind in BAGS:
        (folder / kind).mkdir()
        bag = write_bag(folder / kind, kind, entries)
        found[bag if bag.is_file() else next(bag.glob("*.[dm]*"))] = {"topics": topics}
    return found


@pytest.mark.parametrize("seeds", [range(8), pytest.param(range(300), marks=SOAK)], ids=["few", "many"])
def test_spoilt_recordings(seeds: range, worker: CommandWorker, square: Path, tmp_path: Path) -> None:
    (tmp_path / "whole").mkdir()
    recordings, wrong, clean = write_recordings(tmp_path / "whole"), list[str](), dict[Path, Path]()
    for seed in seeds:
        rng, folder = np.random.default_rng(seed), tmp_path / str(seed)
        original = list(recordings)[seed % len(recordings)]
        folder.mkdir()
        config, file = folder / "c.yaml", folder / original.name
        config.write_text(yaml.safe_dump({"recording": {"file": file.name} | recordings[original]}))
        shutil.copy(original, file)
        if original not in clean:
            done = worker.run(folder, "run", "c.yaml", "-o", tmp_path / f"clean-{len(clean)}", long=300.0)
            assert done.code == 0, done.said
            clean[original] = tmp_path / f"clean-{len(clean)}"
        how = f"{original.parent.name}/{original.name}: {spoil(file, rng, list(recordings))}"
        other = [
            ["fit", "c.yaml"], ["localise", square, file.name, "-o", "found"], ["run", "c.yaml", "--continue", square, "-o", "on"],
            ["tools", "recover", file.name, "-o", "whole.mcap"],
        ]  # fmt: skip
        commands = [
            ["doctor", file.name, "-o", "new.yaml"],
            ["run", "c.yaml", "-o", "run"],
            other[rng.integers(4)],
        ]

        def judge(at: int, outcome: Outcome, folder: Path = folder, whole: Path = clean[original]) -> str:
            if at != 1 or outcome.code != 0 or "warning" in outcome.said:
                return ""
            off, usual = (error(run, whole / "truth.tum") for run in (folder / "run", whole))
            return "" if off <= 1.5 * usual + FLOOR else f"in silence {off:.3f} m instead of {usual:.3f} m"

        wrong += run_all(worker, folder, seed, how, commands, judge)
    assert not wrong, f"{len(wrong)} faults\n" + "\n".join(wrong)


def error(run: Path, truth: Path) -> float:
    """Error (ATE, m) of a run at the times that the truth spans."""
    (time, found), (known, poses) = read_tum(run / "trajectory.tum"), read_tum(truth)
    inside = (time >= known[0]) & (time <= known[-1])
    there = np.stack([np.interp(time[inside], known, poses[:, k]) for k in range(2)], axis=1)
    return ate(found[inside], np.column_stack([there, 0 * there[:, 0]])) if inside.sum() > 1 else 0.0


CONFIGS = ("square", "whisker_maze", "create_arena", "rat_box", "live_maze")
SMALL = {
    "simulation": {"path": {"explore": 12.0}},
    "create_simulation": {"reports": 12},
    "rat_simulation": {"seconds": 4.0},
}


@pytest.mark.parametrize("seeds", [range(8), pytest.param(range(200), marks=SOAK)], ids=["few", "many"])
def test_spoilt_configurations(seeds: range, worker: CommandWorker, square: Path, tmp_path: Path) -> None:
    from ratslam.config.run_config import load_config

    wrong = list[str]()
    (tmp_path / "whole").mkdir()
    csv = next(iter(write_recordings(tmp_path / "whole").items()))
    for seed in seeds:
        rng, folder = np.random.default_rng(seed), tmp_path / str(seed)
        folder.mkdir()
        name = CONFIGS[seed % len(CONFIGS)]
        tree = load_config(ROOT / "configs" / f"{name}.yaml").model_dump(mode="json", exclude_none=True)
        for key, small in SMALL.items():
            if key in tree:
                tree[key] |= small
        if tree.get("recording"):
            tree["recording"] = {"file": str(csv[0]), "table": csv[1]["table"] | {"rows": 3, "columns": 6}}
        how = f"{name}: " + "; ".join(replace(tree, rng) for _ in range(rng.integers(1, 3)))
        config = folder / "c.yaml"
        config.write_text(yaml.safe_dump(tree, allow_unicode=True))
        if rng.random() < 0.2:
            how = spoil(config, rng, [])
        other = [
            ["simulate", "c.yaml", "-o", "s.mcap"], ["fit", "c.yaml"], ["localise", square, "c.yaml", "-o", "found"],
            ["doctor", "c.yaml", "--live"], ["live", "c.yaml", "-o", "live"],
        ]  # fmt: skip
        wrong += run_all(worker, folder, seed, how, [["run", "c.yaml", "-o", "run"], other[rng.integers(5)]])
    assert not wrong, f"{len(wrong)} faults\n" + "\n".join(wrong)


@pytest.mark.parametrize("seeds", [range(10), pytest.param(range(300), marks=SOAK)], ids=["few", "many"])
def test_spoilt_maps_and_runs(seeds: range, worker: CommandWorker, square: Path, tmp_path: Path) -> None:
    wrong, originals = list[str](), [square]
    if len(seeds) > 10:
        originals += other_folders(worker, square, tmp_path)
    for seed in seeds:
        rng, folder = np.random.default_rng(seed), tmp_path / str(seed)
        original = originals[seed % len(originals)]
        shutil.copytree(original, folder / "spoilt")
        files = sorted(path for path in (folder / "spoilt").iterdir() if path.suffix not in (".png", ".html"))
        file = folder / "spoilt" / "map.npz" if seed % 2 else files[rng.integers(len(files))]
        if not file.exists():
            file = files[0]
        if rng.random() < 0.1:
            file.unlink()
            how = "missing"
        else:
            how = spoil(file, rng, files)
        how = f"{original.name}/{file.name}: {how}"
        commands: list[list[object]] = [["map", "info", "spoilt"]]
        if file.name == "map.npz":
            recording = ROOT / "configs" / "square.yaml"
            commands += [
                ["path", "spoilt", "--to", "0.5,0.1"], ["map", "diff", square, "spoilt"],
                ["map", "crop", "spoilt", "--steps", "0:60", "-o", "part.npz"], ["map", "undo", "spoilt", "1", "-o", "undone.npz"],
                ["merge", square, "spoilt", "-o", "both.npz"], ["run", recording, "--continue", "spoilt/map.npz", "-o", "on"],
                ["localise", "spoilt", recording, "-o", "found"],
            ]  # fmt: skip
        commands += [["doctor", "spoilt"], ["score", "spoilt"], ["watch", "spoilt", "--once"]]
        commands += [
            ["report", "spoilt", "-o", "r.html"],
            ["export", "spoilt", "-o", EXPORTS[rng.integers(len(EXPORTS))]],
        ]

        def judge(at: int, outcome: Outcome, file: Path = file, original: Path = original) -> str:
            if at or outcome.code != 0 or file.name != "map.npz":
                return ""
            same = file.exists() and same_arrays(file, original / file.name)
            return "" if same else "a damaged map is accepted"

        wrong += run_all(worker, folder, seed, how, commands, judge)
    assert not wrong, f"{len(wrong)} faults\n" + "\n".join(wrong)


def same_arrays(file: Path, other: Path) -> bool:
    with np.load(file) as found, np.load(other) as known:
        return set(found) == set(known) and all(found[key].tobytes() == known[key].tobytes() for key in known)


def other_folders(worker: CommandWorker, square: Path, folder: Path) -> list[Path]:
    """Folders of a grid, of a method with cells, of a localised session, and of a merged map."""
    config = ROOT / "configs" / "square.yaml"
    with np.load(ROOT / "tests" / "golden" / "a_square3.npz") as found:
        np.savez(
            folder / "later.npz",
            **dict(found) | {"in_v": 1.001 * found["in_v"], "in_view": 0.999 * found["in_view"]},
        )
    commands = [
        ["run", "create_arena", "--set", "create_simulation.reports=40", "-o", "grid"],
        ["run", "rat_box", "--set", "rat_simulation.seconds=6", "--set", "cells={}", "-o", "cells"],
        ["run", "whisker_maze", "--set", "simulation.path.explore=30", "-o", "touch"],
        ["localise", square, config, "-o", "found"],
        ["run", config, "--set", f"recording.file={folder / 'later.npz'}", "-o", "later"],
        ["merge", square, "later", "-o", "merged"],
    ]
    for command in commands:
        done = worker.run(folder, *command, long=300.0)
        assert done.code == 0, done.said
    return [folder / str(command[-1]) for command in commands]


def bomb(folder: Path, name: str) -> Path:
    """A file that is small and expands to much, or nests deeply."""
    path = folder / name
    match path.suffix:
        case ".npz":
            with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
                for member in ("in_t", "in_v", "in_w", "in_flags", "in_view", "params_json"):
                    shape = (2**70,) if name == "long.npz" else (2**26,)
                    header = io.BytesIO()
                    np.lib.format.write_array_header_1_0(
                        header, {"descr": "<f8", "fortran_order": False, "shape": shape}
                    )
                    with archive.open(f"{member}.npy", "w") as file:
                        file.write(header.getvalue())
                        for _ in range(0 if name == "long.npz" else 2**26 * 8 >> 24):
                            file.write(bytes(1 << 24))
        case ".json":
            path.write_text("[" * 200_000)
        case ".yaml":
            levels = [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]" for k in range(1, 30)]
            path.write_text("a0: &a0 [1]\n" + "\n".join(levels) + "\nbackend: *a29\n")
        case ".csv":
            path.write_text(
                "t,id,x,y,theta\n" + "".join(f"{k},{k},0,0,0\n" for k in range(9)) + "9,1e20,0,0,0\n"
            )
    return path


SQUARE = str(ROOT / "configs" / "square.yaml")
TOO_LARGE: dict[str, tuple[list[str], int, str]] = {
    "npz": (["doctor", "bomb.npz"], 2, "256 MiB, or 32 times what is stored"),
    "npz run": (["run", SQUARE, "--set", "recording.file={}/bomb.npz", "-o", "run"], 2, "256 MiB, or 32 times what is stored"),
    "shape": (["doctor", "long.npz"], 2, "is not a plain array"),
    "ids": (["score", "ids.csv"], 2, "ids.csv:11: experience id 1e+20"),
    "yaml": (["run", "bomb.yaml"], 2, "anchor"),
    "reserve": (["run", SQUARE, "--set", "session.reserve=4194304", "-o", "run"], 2, "524288"),
    "network": (
        ["run", SQUARE, "--set", "pose_cells.cells_xy=1001", "--set", "pose_cells.cells_heading=720", "-o", "run"], 2, "1024 MiB",
    ),
    "particles": (
        ["run", "create_arena", "--set", "grid.particles=1000000", "-o", "run"], 2, "fewer particles",
    ),
}  # fmt: skip
"""Command, exit code and words of what is refused because it is too large."""


@pytest.mark.parametrize(("command", "code", "words"), TOO_LARGE.values(), ids=TOO_LARGE.keys())
def test_what_is_too_large_is_refused(
    command: list[str], code: int, words: str, worker: CommandWorker, tmp_path: Path
) -> None:
    for part in command:
        if part.rpartition("/")[2] in ("bomb.npz", "long.npz", "ids.csv", "bomb.yaml"):
            bomb(tmp_path, part.rpartition("/")[2])
    there = set(tmp_path.rglob("*"))
    done = worker.run(tmp_path, *(part.replace("{}", str(tmp_path)) for part in command))
    assert done.code == code, done.said
    assert words in done.said, done.said
    assert not faults(done, tmp_path, there)


@pytest.mark.parametrize("name", ["config.yaml", "map.json", "scorecard.json"])
def test_a_run_folder_with_a_bomb_is_refused_or_shown(
    name: str, worker: CommandWorker, square: Path, tmp_path: Path
) -> None:
    run = Path(shutil.copytree(square, tmp_path / "run"))
    bomb(run, name)
    for command in (["report", "run", "-o", "r.html"], ["doctor", "run"], ["export", "run", "-o", "x.json"]):
        there = set(tmp_path.rglob("*"))
        assert not faults(worker.run(tmp_path, *command), tmp_path, there)
