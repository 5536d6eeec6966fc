"""The configuration of a run. Each section is defined beside the code that it configures."""

from __future__ import annotations

import json
import os
from collections.abc import Container, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import BaseModel, Field, NonNegativeInt, ValidationError, ValidationInfo, field_validator

from evaluation.metrics.exm import ExmConfig
from evaluation.metrics.metric_registry import METRICS
from ratslam.classic.config import CellsConfig
from ratslam.methods.config import ClassicBackendConfig, GridBackendConfig, LocaliseBackendConfig
from ratslam.runs.settings.packaged import PresetName, find_config
from ratslam.runs.settings.strict_yaml import load, read_configuration, validate, with_moved_settings
from ratslam.runs.settings.yaml_document import Document
from robot.live.live_config import LiveConfig
from robot.recordings.recording_config import RecordingConfig
from robot.simulation.create.simulated_session import CreateSimulationConfig
from robot.simulation.head.simulated_session import SimulationConfig
from robot.simulation.rat.simulated_session import RatSimulationConfig
from robot.sources.source import SOURCES
from robot.touch_source import TOUCH
from tactile.base.errors import InputError, InputErrors
from tactile.base.plugins import PluginConfig, Registry, read_settings
from tactile.base.settings import KeyPath, Settings
from tactile.frontend import TouchConfig


class SessionConfig(Settings):
    """Precision, seed and memory of the session."""

    precision: Literal["float64", "float32"] = "float64"
    """Floating-point type of the kernel."""
    seed: NonNegativeInt = 0
    """Seed of all random streams."""
    reserve: Annotated[int, Field(ge=0, le=2**19)] = 0
    """Steps to allocate memory for at the start. 0: those of a source of known length of at most 4096 steps;
    for others memory grows as needed, and each power of two compiles the kernel again."""


class ScoreConfig(Settings):
    """How a run is scored."""

    experience_metric: ExmConfig = ExmConfig()
    """Settings of the Experience Metric."""
    metrics: tuple[PluginConfig, ...] = ()
    """Registered metrics (`ratslam.metrics`) to compute besides ours."""
    relations: Path | None = None
    """File of true relative poses (t1,t2,x,y,z,roll,pitch,yaw) for the Energy Metric; null: without it."""


SOURCE_SECTIONS = ("recording", "simulation", "create_simulation", "rat_simulation", "source", "live")


class SourceConfig(Settings):
    """The source of a run, exactly one of six, and the processing of whisker readings to views."""

    fewest_sources: ClassVar[int] = 1
    """Least number of sources: 0 where the caller brings the readings."""
    recording: RecordingConfig | None = None
    """A recording."""
    simulation: SimulationConfig | None = None
    """Or a simulated arm with a whisker head in a maze."""
    create_simulation: CreateSimulationConfig | None = None
    """Or a simulated Create with whiskers in an arena."""
    rat_simulation: RatSimulationConfig | None = None
    """Or a simulated rat in a box with cues."""
    source: PluginConfig | None = None
    """Or a registered source (`ratslam.sources`)."""
    live: Annotated[LiveConfig | None, Field(validate_default=True)] = None
    """Or a robot arm with a whisker head, for `python -m ratslam live`."""
    touch: TouchConfig = TouchConfig()
    """How whisker readings become views."""

    @field_validator("live", mode="after")
    @classmethod
    def _one_source(cls, live: LiveConfig | None, info: ValidationInfo) -> LiveConfig | None:
        names = SOURCE_SECTIONS[:-1]
        recording = info.data.get("recording")
        if recording is not None and recording.file is None:
            if live is not None and live.topics is not None:
                return live  # the recording assigns the topics
            if "recording" in info.data:
                raise ValueError("recording.file is missing: a recording, or the topics of `live.topics`")
        sources = {name: info.data.get(name) for name in names} | {"live": live}
        given = [name for name, source in sources.items() if source is not None]
        if all(name in info.data for name in names) and not cls.fewest_sources <= len(given) <= 1:
            there = " and ".join(given) if given else f"neither {', '.join(names)} nor live"
            raise ValueError(f"{there}; give one of these six, and null for the others")
        return live


class RunConfig(LocaliseBackendConfig, ClassicBackendConfig, GridBackendConfig, SourceConfig):
    """A run: `python -m ratslam run config.yaml`. `ratslam.methods.config` has the methods' sections."""

    include: tuple[Path, ...] = ()
    """Files of settings to use where this file leaves them open, such as `rig.yaml` of `fit` or
    `calibration.yaml` of a run; a later one comes before an earlier one."""
    backend: Annotated[str, Field(json_schema_extra={"examples": ["recall", "classic", "grid"]})] = "recall"
    """The method: `recall` is RatSLAM with Bayesian recall and a keyframe map, `classic` RatSLAM as
    published, `grid` a grid particle filter; or a registered one (`ratslam.backends`)."""
    backend_settings: dict[str, Any] = Field(default_factory=dict)
    """Settings of a registered method."""
    presets: tuple[PresetName, ...] | None = None
    """Presets for the settings that are left open (`ratslam.runs.settings.packaged`), the first before the
    others; null: those that suit the source. The file in the run directory names those that were used."""
    session: SessionConfig = SessionConfig()
    """Precision, seed and memory."""
    score: ScoreConfig = ScoreConfig()
    """How the result is scored."""
    cells: CellsConfig | None = None
    """Recording of the pose cells to `cells.npz`, for methods that have them; null: none."""

    def with_absolute_paths(self, folder: Path, here: Container[KeyPath] = ()) -> RunConfig:
        """The configuration with relative paths taken from `folder`, and those whose keys are in `here` from
        the working folder."""
        found = self.resolved(folder, here)  # all but the settings of plugins
        source, touch = self.source, found.touch
        if source:
            source = _resolved_plugin(source, SOURCES, folder, here, ("source",))
        if touch.frontend:
            frontend = _resolved_plugin(touch.frontend, TOUCH, folder, here, ("touch", "frontend"))
            touch = touch.model_copy(update={"frontend": frontend})
        return found.model_copy(update={"source": source, "touch": touch})


class LoopConfig(RunConfig):
    """The configuration of one's own loop (`ratslam.Slam`): that of a run, with or without a source."""

    fewest_sources = 0


def load_config(
    path: str | os.PathLike[str], assignments: Sequence[str] = (), *, source_required: bool = True
) -> RunConfig:
    """Reads a configuration file; its relative paths start at its folder, those of `assignments` at the
    working folder.

    Args:
        path: of the file, or the name of a packaged configuration.
        assignments: settings to replace, each `a.b=value`.
        source_required: whether a configuration without a source is an error; `ratslam.Slam` needs none.

    Raises:
        InputErrors: all errors in it, each with file, line and column.
    """
    path, model = find_config(path), RunConfig if source_required else LoopConfig
    document = read_configuration(path, assignments)
    _check_sources(document, assignments)
    config = validate(document, model)
    _check_plugins(document, config)
    here = {keys for keys, place in document.places.items() if place.value.startswith("--set")}
    return config.with_absolute_paths(path.parent.resolve(), here)


def _check_sources(document: Document, assignments: Sequence[str]) -> None:
    """Raises `InputError` if an assignment sets a part of a source that the configuration does not have."""
    there = {name for name in SOURCE_SECTIONS if document.data.get(name) is not None}
    own = {name for name in there if document.places[(name,)].key != "--set"}
    for assignment in assignments:
        name = assignment.partition("=")[0]
        if own and name.partition(".")[0] in there - own:
            found = f"a setting of another source: this configuration has {' and '.join(sorted(own))}"
            cure = "a seed belongs to simulated sessions" if name.endswith(".seed") else ""
            raise InputError(f"--set {name}", found, "settings of that", cure)


def _check_plugins(document: Document, config: RunConfig) -> None:
    """Checks the names and settings of all registered parts in a configuration."""
    from ratslam.methods.method_registry import BACKENDS  # loads JAX

    # Of each part: the path of its name, that of its settings, where it is registered, and its name.
    parts: list[tuple[KeyPath, KeyPath, Registry[Any], str]] = [
        (("backend",), ("backend_settings",), BACKENDS, config.backend)
    ]
    sections: list[tuple[KeyPath, Registry[Any], PluginConfig | None]] = [
        (("source",), SOURCES, config.source),
        (("touch", "frontend"), TOUCH, config.touch.frontend),
        *((("score", "metrics", k), METRICS, one) for k, one in enumerate(config.score.metrics)),
    ]
    parts += [
        ((*path, "plugin"), (*path, "settings"), registry, part.plugin)
        for path, registry, part in sections
        if part is not None
    ]
    errors: list[InputError] = []
    for name, settings, registry, plugin in parts:
        try:
            entry = registry.get(plugin, document.at_value(name))
            if plugin not in registry.builtin:
                validate(document.section(settings), entry.config_class)
            elif document.value(settings):
                found = f"settings of a registered {registry.noun}, but '{plugin}' is one of ours"
                raise InputError(document.at_key(settings), found)
        except InputError as error:
            errors += getattr(error, "errors", [error])  # of several together, or itself
    if errors:
        raise InputErrors(errors)


def _resolved_plugin(
    config: PluginConfig, registry: Registry[Any], folder: Path, here: Container[KeyPath], at: KeyPath
) -> PluginConfig:
    """The configuration of a part with the paths in its settings made absolute, see `Settings.resolved`."""
    model = registry.get(config.plugin, "plugin").config_class
    settings = read_settings(model, config.settings, "settings").resolved(folder, here, (*at, "settings"))
    given: dict[str, Any] = json.loads(settings.model_dump_json(exclude_unset=True))
    return config.model_copy(update={"settings": given})


def changed_settings(path: Path) -> list[tuple[str, str, str]]:
    """The settings in a configuration file that differ from the defaults, in the order of the file: of each
    its dotted path, and its value and default as JSON ('' for a setting without default).

    Of a path only the name is given. The file of a run directory is completed: values of its source and of
    presets are among them.

    Raises:
        InputErrors: the configuration has errors.
    """
    document = with_moved_settings(load(path))
    return list(_changes(validate(document, LoopConfig), LoopConfig(), ""))


def _changes(section: BaseModel, default: BaseModel | None, prefix: str) -> Iterator[tuple[str, str, str]]:
    """The changes in a section; a default of None: it has none, because some setting must be given."""
    values = section.model_dump(mode="json")
    for name, field in type(section).model_fields.items():
        value = getattr(section, name)
        usual = field.get_default(call_default_factory=True) if default is None else getattr(default, name)
        if isinstance(value, BaseModel):
            if not isinstance(usual, type(value)):
                try:
                    usual = type(value)()
                except ValidationError:
                    usual = None
            yield from _changes(value, usual, f"{prefix}{name}.")
        elif field.is_required() or value != usual:
            shown = value.name if isinstance(value, Path) else values[name]  # its folder is private
            yield prefix + name, _text(shown), "" if field.is_required() else _text(usual)


def _text(value: Any) -> str:
    return json.dumps(
        value,
        default=lambda part: part.model_dump(mode="json") if isinstance(part, BaseModel) else str(part),
        ensure_ascii=False,
    )
