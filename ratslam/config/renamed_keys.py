"""Settings that were renamed: the error for an old configuration names the new key."""

from __future__ import annotations

RENAMED: dict[str, str] = {"matcher": "write backend: recall or backend: classic"}
"""Old dotted path of a setting to the new one, or to a sentence that says what to write instead.

A renamed section maps the keys in it as well; only those with new names of their own need a line."""
