"""Files of settings that a configuration includes, such as the rig that `fit` writes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ratslam.runs.settings.strict_yaml import load
from ratslam.runs.settings.strict_yaml.document import Document, KeyPath, Place
from tactile.base.errors import InputError

KEY = "include"


def merge_includes(document: Document, folder: Path) -> Document:
    """The document with the settings of the files that it includes, for those that it leaves open.

    A value of the document comes before one of its files, and a later file before an earlier one. Sections
    are merged; lists are not. The key stays, without files.

    Args:
        folder: in which relative paths start, if not given by `--set`.

    Raises:
        InputError: a file cannot be read, is not strict YAML, or includes others.
    """
    names = document.data.get(KEY)
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        return document  # nothing, or an error that validation reports
    merged = Document({**document.data, KEY: []}, document.places)
    folder = Path() if document.places[KEY,].value.startswith("--set") else folder
    for name in reversed(names):
        if not (folder / name).is_file():
            where, cure = document.at_key((KEY,)), f"paths start at {folder.resolve()}"
            raise InputError(where, f"no file {folder / name}", "an existing file", cure)
        below = load(folder / name)
        if KEY in below.data:
            raise InputError(below.at_key((KEY,)), "files that an included file includes", "settings only")
        places: dict[KeyPath, Place] = {**below.places, **merged.places}
        merged = Document(merge_settings(below.data, merged.data), places)
    return merged


def merge_settings(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    """The settings of both; those of `above` where both have them."""
    merged = below | above
    for key in below.keys() & above.keys():
        if isinstance(below[key], dict) and isinstance(above[key], dict):
            merged[key] = merge_settings(below[key], above[key])
    return merged
