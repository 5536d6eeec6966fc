"""Installed packages made on the fly: a module and its metadata in a folder for `sys.path`."""

from collections.abc import Mapping
from pathlib import Path


def install(folder: Path, name: str, module: str, entry_points: Mapping[str, str]) -> None:
    """Installs a package of version 1.0 with one module; entry points: object by `group:name`."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.py").write_text(module, encoding="utf-8")
    metadata = folder / f"{name}-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    groups: dict[str, list[str]] = {}
    for key, target in entry_points.items():
        group, point = key.split(":")
        groups.setdefault(group, []).append(f"{point} = {target}")
    lines = [line for group, points in groups.items() for line in (f"[{group}]", *points)]
    (metadata / "entry_points.txt").write_text("\n".join(lines) + "\n")
