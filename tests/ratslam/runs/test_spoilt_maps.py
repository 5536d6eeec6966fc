"""Spoilt map files give one clear error each, and writing that is killed leaves the file that was there."""

from __future__ import annotations

import subprocess
import sys
import zipfile
from functools import cache
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest

from ratslam.core.session import Session
from ratslam.runs.saved_map import FORMAT, digest_of, read_map
from tactile.base.errors import InputError

FILE = Path(__file__).parents[2] / "data" / "maps" / f"{FORMAT}.npz"
FEW, MANY = 24, 200


@cache
def content() -> tuple[bytes, dict[str, np.ndarray]]:
    """The bytes and the arrays of a whole map file."""
    with np.load(FILE) as archive:
        return FILE.read_bytes(), {name: archive[name] for name in archive.files}


@cache
def session() -> Session:
    """A session with the configuration of the map."""
    return read_map(FILE).open_session()


def packed(arrays: dict[str, np.ndarray]) -> bytes:
    file = BytesIO()
    np.savez_compressed(file, **arrays)
    return file.getvalue()


def signed(arrays: dict[str, np.ndarray]) -> bytes:
    """A file whose digest is right, as of a program that writes maps wrongly."""
    return packed(arrays | {"sha256": np.array(digest_of(arrays))})


def flipped(stream: np.random.Generator) -> bytes:
    """One bit is wrong. Fields of a zip file that NumPy does not read, such as times, change nothing."""
    spoilt = bytearray(content()[0])
    spoilt[stream.integers(len(spoilt))] ^= 1 << int(stream.integers(8))
    return bytes(spoilt)


def scattered(stream: np.random.Generator) -> bytes:
    spoilt = bytearray(content()[0])
    for at in stream.integers(len(spoilt), size=64):
        spoilt[at] = int(stream.integers(256))
    return bytes(spoilt)


def cut(stream: np.random.Generator) -> bytes:
    whole = content()[0]
    return whole[: stream.integers(len(whole))]


def chosen(stream: np.random.Generator) -> tuple[str, dict[str, np.ndarray]]:
    arrays = dict(content()[1])
    names = [name for name in sorted(arrays) if not name.startswith("frontend/")]
    return names[stream.integers(len(names))], arrays


def left_out(stream: np.random.Generator) -> bytes:
    name, arrays = chosen(stream)
    del arrays[name]
    return signed(arrays) if name != "sha256" else packed(arrays)


def of_other_type(stream: np.random.Generator) -> bytes:
    name, arrays = chosen(stream)
    other = "U3" if arrays[name].dtype.kind != "U" else "f8"
    return signed(arrays | {name: np.zeros(arrays[name].shape, other)})


def of_other_shape(stream: np.random.Generator) -> bytes:
    name, arrays = chosen(stream)
    return signed(arrays | {name: np.stack([arrays[name], arrays[name]])[..., None]})


def of_other_version(stream: np.random.Generator) -> bytes:
    name = f"ratslam-map-{stream.integers(3, 99)}" if stream.random() < 0.5 else "\0" * 9
    return signed(content()[1] | {"format": np.array(name)})


def bomb(stream: np.random.Generator) -> bytes:
    """A small file that says it holds more than any memory, beside the arrays or as one of them."""
    name, arrays = chosen(stream)
    file, shape = BytesIO(packed(arrays)), 1 << int(stream.integers(41, 60))
    head = f"{{'descr': '<f8', 'fortran_order': False, 'shape': ({shape},), }}".ljust(117) + "\n"
    with zipfile.ZipFile(file, "a", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(f"more{name}.npy", b"\x93NUMPY\x01\x00v\x00" + head.encode() + bytes(1 << 20))
    return file.getvalue()


def nothing(stream: np.random.Generator) -> bytes:
    return b"" if stream.random() < 0.5 else bytes(stream.integers(256, size=200, dtype=np.uint8))


KINDS = (
    flipped, scattered, cut, left_out, of_other_type, of_other_shape, of_other_version, bomb, nothing,
)  # fmt: skip


def refusal(path: Path) -> str:
    """The error of opening a map; '' if it opens."""
    try:
        saved = read_map(path)
        saved.restore(session(), saved.config)
    except InputError as error:
        return str(error)
    return ""


def check_spoilt_files(folder: Path, count: int) -> None:
    for seed in range(count):
        stream, kind = np.random.default_rng([23, seed]), KINDS[seed % len(KINDS)]
        path = folder / f"{seed}.npz"
        path.write_bytes(kind(stream))
        said = refusal(path)
        if not said and kind is flipped:
            assert read_map(path).digest == read_map(FILE).digest, seed  # a byte that says nothing
            continue
        assert said.startswith(str(path)), (seed, kind.__name__, said)
        assert len(said) < 400 + len(str(path)), (seed, kind.__name__, said)
        path.unlink()


def test_spoilt_files_are_refused(tmp_path: Path) -> None:
    check_spoilt_files(tmp_path, FEW)
    assert refusal(FILE) == ""


@pytest.mark.soak
def test_two_hundred_spoilt_files_are_refused(tmp_path: Path) -> None:
    check_spoilt_files(tmp_path, MANY)


WRITER = """
import sys
from pathlib import Path
import numpy as np
from ratslam.runs.saved_map import read_map, write_map

saved = read_map(Path(sys.argv[1]))

class Session:
    def arrays(self):
        return dict(saved.arrays) | {"state/more": noise}

noise = np.zeros(0)
while True:
    write_map(Path(sys.argv[2]), Session(), saved.config, saved.source)
    print(len(noise), flush=True)
    noise = np.random.default_rng(0).normal(size=(len(noise) + 200_000) % 1_000_000)
"""


def check_killed_writing(folder: Path, kills: int) -> None:
    """Writes maps of 0 to 6 MB over each other until the process is killed, at different times."""
    path = folder / "map.npz"
    for delay in np.linspace(0.5, 0.0, kills):
        command = [sys.executable, "-c", WRITER, str(FILE), str(path)]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert process.stdout is not None
        process.stdout.readline()
        try:
            process.wait(timeout=delay)
        except subprocess.TimeoutExpired:
            process.kill()
        process.communicate()
        saved = read_map(path)
        assert saved.steps == read_map(FILE).steps
        assert len(saved.arrays["state/more"]) % 200_000 == 0


def test_a_killed_writer_leaves_a_whole_file(tmp_path: Path) -> None:
    check_killed_writing(tmp_path, 1)


@pytest.mark.soak
def test_twenty_killed_writers_leave_whole_files(tmp_path: Path) -> None:
    check_killed_writing(tmp_path, 20)
