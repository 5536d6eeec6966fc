"""Writes plain data as YAML that every reader takes for the same."""

from __future__ import annotations

from typing import Any

import yaml

from ratslam.config.strict_yaml.scalars import plain

_TEXT = "tag:yaml.org,2002:str"


class Dumper(yaml.SafeDumper):
    """Quotes what any reader, of YAML 1.1 or strict, would not take for text; short lists on one line."""

    def resolve(self, kind: type, value: Any, implicit: Any) -> Any:
        """The tag a reader would give a node: that of YAML 1.1, unless ours finds a number in its text."""
        tag = super().resolve(kind, value, implicit)
        if kind is yaml.ScalarNode and implicit[0] and tag == _TEXT and not isinstance(plain(value), str):
            return "tag:yaml.org,2002:float"
        return tag

    def ignore_aliases(self, data: Any) -> bool:
        """A list used twice is written twice, since anchors are refused."""
        return True


def _represent_list(dumper: Dumper, items: list[Any]) -> yaml.Node:
    flat = not any(isinstance(item, list | dict) for item in items)
    return dumper.represent_sequence("tag:yaml.org,2002:seq", items, flow_style=flat)


def _represent_text(dumper: Dumper, text: str) -> yaml.Node:
    # The emitter folds U+0085 and its like as if they were spaces, unless they are escaped.
    return dumper.represent_scalar(_TEXT, text, style=None if text.isprintable() else '"')


Dumper.add_representer(list, _represent_list)
Dumper.add_representer(str, _represent_text)
