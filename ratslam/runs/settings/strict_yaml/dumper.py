"""Writes plain data as YAML that readers of YAML 1.1 and of YAML 1.2 read alike."""

from __future__ import annotations

from typing import Any

import yaml

from ratslam.runs.settings.strict_yaml.yaml_reader import read_word

_TEXT = "tag:yaml.org,2002:str"


class Dumper(yaml.SafeDumper):
    """Quotes texts that a reader of YAML 1.1 or ours would read as another type; flat lists take one line."""

    def resolve(self, kind: type, value: Any, implicit: Any) -> Any:
        """The tag that a reader gives a node: that of YAML 1.1, or a number if our reader finds one."""
        tag = super().resolve(kind, value, implicit)
        if kind is yaml.ScalarNode and implicit[0] and tag == _TEXT and not isinstance(read_word(value), str):
            return "tag:yaml.org,2002:float"
        return tag

    def ignore_aliases(self, data: Any) -> bool:
        """Always true: anchors are refused on reading, so a shared list is written twice."""
        return True


def _represent_list(dumper: Dumper, items: list[Any]) -> yaml.Node:
    flat = not any(isinstance(item, list | dict) for item in items)
    return dumper.represent_sequence("tag:yaml.org,2002:seq", items, flow_style=flat)


def _represent_text(dumper: Dumper, text: str) -> yaml.Node:
    # Unless escaped, the emitter folds U+0085 and similar characters like spaces.
    return dumper.represent_scalar(_TEXT, text, style=None if text.isprintable() else '"')


Dumper.add_representer(list, _represent_list)
Dumper.add_representer(str, _represent_text)
