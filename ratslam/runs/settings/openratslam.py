"""Parameter files of OpenRatSLAM (INI) as configurations for `backend: classic`."""

from __future__ import annotations

import configparser
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ratslam.runs.settings.run_config import RunConfig
from ratslam.runs.settings.strict_yaml import open_path, validate
from ratslam.runs.settings.yaml_document import Document, Place
from robot.recordings.video import SUFFIXES as VIDEO_SUFFIXES
from robot.sources.input_files import raise_errors, read_bytes
from tactile.base.errors import InputError
from tactile.base.settings import KeyPath

Value = float | int | bool | str | None

IMAGE, VISUAL = "recording.image", "recording.visual_odometry"
TEMPLATES, CELLS, NETWORK, MAP = "templates", "pose_cells", "attractor", "experience.solver"


_Parameter = tuple[Value, tuple[str, ...]]
"""A parameter of OpenRatSLAM: the value of a missing key there, of the type of the parameter (None: there is
no default), and the dotted settings here that take it."""

RATSLAM: dict[str, _Parameter] = {
    "image_crop_x_min": (0, (f"{IMAGE}.crop.x_min",)),
    "image_crop_x_max": (-1, (f"{IMAGE}.crop.x_max",)),
    "image_crop_y_min": (0, (f"{IMAGE}.crop.y_min",)),
    "image_crop_y_max": (-1, (f"{IMAGE}.crop.y_max",)),
    "template_y_size": (1, (f"{IMAGE}.rows",)),
    "template_x_size": (1, (f"{IMAGE}.columns",)),
    "pc_dim_xy": (21, (f"{CELLS}.cells_xy",)),
    "pc_dim_th": (36, (f"{CELLS}.cells_heading",)),
    "pc_cell_x_size": (1.0, (f"{CELLS}.cell_size",)),
    "pc_w_e_dim": (7, (f"{NETWORK}.excite_width",)),
    "pc_w_e_var": (1.0, (f"{NETWORK}.excite_sigma",)),
    "pc_w_i_dim": (5, (f"{NETWORK}.inhibit_width",)),
    "pc_w_i_var": (2.0, (f"{NETWORK}.inhibit_sigma",)),
    "pc_global_inhib": (2e-5, (f"{NETWORK}.global_inhibition",)),
    "vt_match_threshold": (0.03, (f"{TEMPLATES}.threshold",)),
    "vt_shift_match": (25, (f"{TEMPLATES}.shift",)),
    "vt_step_match": (5, (f"{TEMPLATES}.shift_step",)),
    "vt_panoramic": (False, (f"{TEMPLATES}.panoramic",)),
    "vt_normalisation": (0.0, (f"{TEMPLATES}.normalise_mean",)),
    "vt_patch_normalise": (0, (f"{TEMPLATES}.patch",)),
    "vt_min_patch_normalisation_std": (0.0, (f"{TEMPLATES}.patch_sd",)),
    "pc_vt_inject_energy": (0.15, (f"{TEMPLATES}.energy",)),
    "vt_active_decay": (1.0, (f"{TEMPLATES}.habituation",)),
    "pc_vt_restore": (0.05, (f"{TEMPLATES}.recovery",)),
    "exp_delta_pc_threshold": (2.0, ("places.radius", "places.radius_heading")),
    "exp_loops": (10, (f"{MAP}.loops",)),
    "exp_correction": (0.5, (f"{MAP}.correction",)),
    "exp_initial_em_deg": (90.0, ()),
}
"""Parameters of the section [ratslam]."""

VISUAL_ODOMETRY: dict[str, _Parameter] = {
    "camera_fov_deg": (None, (f"{VISUAL}.fov_deg",)),
    "camera_hz": (10.0, ()),
    "vtrans_scaling": (None, (f"{VISUAL}.scaling",)),
    "vtrans_max": (None, (f"{VISUAL}.max_speed",)),
    **{
        f"{name}_image_{side}": (default, (f"{VISUAL}.{crop}.{side}",))
        for name, crop in (("vrot", "rotation"), ("vtrans", "translation"))
        for side, default in (("x_min", 0), ("x_max", -1), ("y_min", 0), ("y_max", -1))
    },
}
"""Parameters of the section [visual_odometry]."""

SECTIONS: Mapping[str, Mapping[str, _Parameter]] = {
    "general": {"topic_root": ("", ())},
    "ratslam": RATSLAM,
    "visual_odometry": VISUAL_ODOMETRY,
}
IGNORED = ("draw",)
"""Sections about windows."""


def convert_parameters(path: Path, recording: Path | None = None) -> tuple[dict[str, Any], list[str]]:
    """The configuration that corresponds to a parameter file of OpenRatSLAM.

    Args:
        recording: the bag or video to map, as it shall stand in the configuration; None: ROOT.bag.

    Returns:
        the settings, nested as in a configuration file; notes on what has no counterpart or needs the user.

    Raises:
        InputError: the file cannot be read, or values are impossible; with file and line.
    """
    lines, parser = _read_ini(path)
    values, notes = _read_values(path, lines, parser)
    root = str(values.get("topic_root") or "").strip("/")
    file = recording or Path(f"{root or 'recording'}.bag")
    places: dict[KeyPath, Place] = {(): Place(f"{path}:", f"{path}:")}
    settings: dict[str, Any] = {"recording": {"file": str(file)}, "backend": "classic"}
    settings["experience"] = {"solver": {"name": "relaxation"}}
    chosen = RATSLAM | (VISUAL_ODOMETRY if "camera_fov_deg" in values else {})
    for key, (default, paths) in chosen.items():
        value = values.get(key, default)
        if key.endswith("_max") and value == -1:
            value = None  # open: up to the edge of the image
        elif key == "vtrans_scaling" and isinstance(value, float):
            value /= _rate(values)  # there a speed, here a distance between frames
        section = "ratslam" if key in RATSLAM else "visual_odometry"
        for setting in paths:
            if value is not None:
                part, keys = open_path(settings, setting, key)
                part[keys[-1]] = value
            if key in values:
                at = f"{path}:{lines[section, key]}: {key}:"
                places[tuple(setting.split("."))] = Place(at, at)
    notes += _put_source(settings, file, root, values)
    notes += _notes(values, settings)
    validate(Document(settings, places), RunConfig)
    return settings, notes


def _read_values(
    path: Path, lines: Mapping[tuple[str, str], int], parser: configparser.ConfigParser
) -> tuple[dict[str, Value], list[str]]:
    """The values of the known parameters in a file, and notes about the others.

    Raises:
        InputError: the file has no section [ratslam], or values have the wrong type.
    """
    values: dict[str, Value] = {}
    notes, errors = [], []
    if not parser.has_section("ratslam"):
        raise InputError(str(path), "no section [ratslam]", "a parameter file of OpenRatSLAM")
    for section in (name for name in parser.sections() if name not in IGNORED):
        known = SECTIONS.get(section)
        if known is None:
            notes.append(f"[{section}] is unknown and ignored")
            continue
        for key, text in parser.items(section):
            where = f"{path}:{lines[section, key]}"
            if key not in known:
                notes.append(f"{where}: {key} in [{section}] is unknown and ignored")
                continue
            try:
                values[key] = _value(text, known[key][0])
                if key == "camera_hz" and _rate(values) <= 0:
                    raise ValueError("a rate above 0")
            except ValueError as error:
                errors.append(InputError(where, f"{key} = {text}", str(error)))
    raise_errors(errors)
    return values, notes


def _read_ini(path: Path) -> tuple[dict[tuple[str, str], int], configparser.ConfigParser]:
    """The line of each (section, key), and the parsed file."""
    try:
        text = read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(str(path), f"is not text (byte {error.start})", "a parameter file") from error
    parser = configparser.ConfigParser(
        interpolation=None, inline_comment_prefixes=("#", ";"), default_section=""
    )
    try:
        parser.read_string(text, str(path))
    except configparser.MissingSectionHeaderError as error:
        found = f"{error.line.strip()[:60]!r} stands before any section"
        raise InputError(f"{path}:{error.lineno}", found, "a section such as [ratslam]") from None
    except (configparser.DuplicateOptionError, configparser.DuplicateSectionError) as error:
        option = getattr(error, "option", None)
        found = f"{option} in [{error.section}]" if option else f"[{error.section}]"
        raise InputError(f"{path}:{error.lineno}", f"{found} stands twice", "every name once") from None
    except configparser.ParsingError as error:
        line, content = error.errors[0]
        raise InputError(f"{path}:{line}", f"{content[:60]}", "key = value") from None
    lines, section = {}, ""
    for number, content in enumerate(text.splitlines(), start=1):
        if header := re.match(r"\[([^]]+)\]", content):
            section = header[1]
        elif entry := re.match(r"\s*([^=:#;]+?)\s*[=:]", content):
            lines[section, parser.optionxform(entry[1])] = number
    return lines, parser


def _value(text: str, default: Value) -> Value:
    """The value of a parameter, of the type of its default; numbers without a default are float.

    Raises:
        ValueError: with the expected type.
    """
    if isinstance(default, str):
        return text
    if isinstance(default, bool):
        if text not in ("0", "1"):
            raise ValueError("0 or 1")
        return text == "1"
    kind, name = (int, "a whole number") if isinstance(default, int) else (float, "a number")
    try:
        value = kind(text)
    except ValueError:
        raise ValueError(name) from None
    if value != value or abs(value) == float("inf"):
        raise ValueError("a finite number")
    return value


def _rate(values: Mapping[str, Value]) -> float:
    rate = values.get("camera_hz", VISUAL_ODOMETRY["camera_hz"][0])
    assert isinstance(rate, float)  # as its default
    return rate


def _put_source(settings: dict[str, Any], file: Path, root: str, values: Mapping[str, Value]) -> list[str]:
    """Adds what tells how to read the recording, by its kind."""
    if file.suffix.lower() in VIDEO_SUFFIXES:
        if "camera_hz" in values:
            settings["recording"]["video"] = {"rate": _rate(values)}
            return []
        return [f"set recording.video.rate or recording.video.stamps: the times of {file}"]
    if not root:
        return ["[general] has no topic_root: set recording.topics to the topics of the bag"]
    settings["recording"]["topics"] = {"openratslam": root}
    return []


def _notes(values: Mapping[str, Value], settings: Mapping[str, Any]) -> list[str]:
    """What has no counterpart, or differs, among the values that were given."""
    notes = []
    columns, templates = settings["recording"]["image"]["columns"], settings["templates"]
    if not templates["panoramic"] and 2 * templates["shift"] >= columns:
        most = max((columns - 1) // 2, 0)
        notes.append(f"vt_shift_match {templates['shift']} leaves none of {columns} columns: {most} is set")
        templates["shift"], templates["shift_step"] = most, 1
    if "exp_initial_em_deg" in values:
        notes.append("exp_initial_em_deg has no counterpart: maps start at heading 0")
    if settings["recording"].get("visual_odometry") is not None:
        notes.append(
            "vtrans_scaling is divided by camera_hz, as distances here are per frame and not per second; "
            "profiles here have mean 1: calibrate recording.visual_odometry.scaling"
        )
    elif any(key in values for key in VISUAL_ODOMETRY):
        notes.append("[visual_odometry] has no camera_fov_deg and is left out")
    return notes
