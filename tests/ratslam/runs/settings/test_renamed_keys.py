"""Settings that were renamed: the error names the place of the old key and the new key."""

from __future__ import annotations

from pathlib import Path
from types import NoneType
from typing import Annotated, Any, ClassVar, get_args, get_origin

import numpy as np
import pytest
from pydantic import BaseModel

from ratslam.runs.settings.changed_settings import changed_settings
from ratslam.runs.settings.renamed_keys import MOVED, RENAMED
from ratslam.runs.settings.run_config import RunConfig, load_config
from ratslam.runs.settings.strict_yaml import override, parse, validate
from tactile.base.errors import InputError
from tactile.base.settings import Settings

WRITTEN = Path(__file__).parents[3] / "data" / "maps" / "ratslam-map-1.npz"
"""A map file, whose configuration was written when the settings of `MOVED` had their old names."""
PATHS = {old: new for old, new in RENAMED.items() if " " not in new}


class Inner(Settings):
    """A renamed section."""

    min_score: float = 1.0
    same: int = 1


class Outer(Settings):
    """A configuration with renamed keys."""

    renamed_keys: ClassVar = {
        "frames": "keyframes",
        "keyframes.score": "keyframes.min_score",
        "matcher": "write `backend`",
    }
    keyframes: Inner = Inner()
    seed: int = 0


def errors_of(document, model=Outer) -> list[str]:
    with pytest.raises(InputError) as refused:
        validate(document, model)
    return str(refused.value).splitlines()


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("seed: 1\nframes:\n  score: 2\n", {"3:3: frames.score": "keyframes.min_score"}),
        (
            "frames: {score: 3, other: 4}\n",
            {"1:10: frames.score": "keyframes.min_score", "1:20: frames.other": "keyframes.other"},
        ),
        ("frames: 3\n", {"1:1: frames": "keyframes"}),
        ("frames: {}\n", {"1:1: frames": "keyframes"}),
        ("keyframes: {score: 1}\n", {"1:13: keyframes.score": "keyframes.min_score"}),
    ],
    ids=["nested", "section", "scalar", "empty", "half renamed"],
)
def test_an_old_key_names_the_new_one(text: str, named: dict[str, str]) -> None:
    expected = [f"c.yaml:{at}: `{at.split()[-1]}` is now `{new}`" for at, new in named.items()]
    assert errors_of(parse(text, "c.yaml")) == expected


def test_an_old_key_without_a_new_one_says_what_to_write() -> None:
    assert errors_of(parse("matcher: 1\n", "c.yaml")) == ["c.yaml:1:1: matcher: write `backend`"]


def test_an_old_key_of_an_option_names_the_new_one() -> None:
    document = override(parse("seed: 1\n", "c.yaml"), ["frames.score=3"])
    assert errors_of(document) == ["--set frames.score: `frames.score` is now `keyframes.min_score`"]


def test_other_unknown_keys_are_reported_as_before() -> None:
    assert errors_of(parse("sed: 1\n", "c.yaml")) == ["c.yaml:1:1: sed: unknown key; did you mean 'seed'?"]


def members(kind: Any) -> list[type[BaseModel]]:
    """The models a setting of this type may hold."""
    if get_origin(kind) is Annotated:
        return members(get_args(kind)[0])
    if isinstance(kind, type) and get_origin(kind) is None:
        return [kind] if issubclass(kind, BaseModel) else []
    return [model for part in get_args(kind) if part is not NoneType for model in members(part)]


def exists(model: type[BaseModel], path: list[str]) -> bool:
    field = model.model_fields.get(path[0])
    if field is None:
        return False
    return len(path) == 1 or any(exists(inner, path[1:]) for inner in members(field.annotation))


@pytest.mark.parametrize("old", PATHS)
def test_every_new_key_exists_and_no_old_one(old: str) -> None:
    assert exists(RunConfig, PATHS[old].split("."))
    assert not exists(RunConfig, old.split("."))


@pytest.mark.parametrize("old", RENAMED)
def test_every_old_key_is_refused_with_the_new_one(old: str) -> None:
    document = override(parse("recording: {file: a.npz}\n", "c.yaml"), [f"{old}=1"])
    assert any(f"--set {old}: " in line and RENAMED[old] in line for line in errors_of(document, RunConfig))


@pytest.fixture
def written(tmp_path: Path) -> Path:
    """The configuration of an earlier version as the file of a run folder."""
    path = tmp_path / "config.yaml"
    with np.load(WRITTEN) as arrays:
        path.write_text(str(arrays["config"]))
    return path


def test_a_configuration_that_an_earlier_version_wrote_is_read_with_moved_settings(written: Path) -> None:
    old = parse(written.read_text(), "c.yaml").data["pose_cells"]
    config = load_config(written, source_required=False)
    now = {**dict(config.pose_cells), **dict(config.attractor)}
    assert now == old
    assert old["engine"] == "dense"
    assert {f"pose_cells.{name}" for name in config.attractor.model_fields_set} == set(MOVED)
    assert "attractor.engine" in [setting.path for setting in changed_settings(written)]


def test_options_for_it_have_the_new_names(written: Path) -> None:
    options = ["attractor.engine=window", "attractor.settle_steps=7"]
    network = load_config(written, options, source_required=False).attractor
    assert (network.engine, network.settle_steps, network.excite_sigma) == ("window", 7, 1.0)
    with pytest.raises(InputError, match=r"--set pose_cells\.engine: `.*` is now `attractor\.engine`"):
        load_config(written, ["pose_cells.engine=window"], source_required=False)


def test_wrong_values_in_it_are_reported_where_they_stand(written: Path) -> None:
    written.write_text(written.read_text().replace("excite_width: 7", "excite_width: 6"))
    line = 1 + written.read_text().splitlines().index("  excite_width: 6")
    with pytest.raises(InputError, match=rf"config.yaml:{line}:17: attractor.excite_width: 6: must be odd"):
        load_config(written, source_required=False)


def test_a_users_old_keys_are_not_moved() -> None:
    text = "pose_cells: {engine: dense, excite_sigma: 1.0}\nrecording: {file: a.npz}\n"
    assert len(errors_of(parse(text, "c.yaml"), RunConfig)) == 2
