"""Settings that were renamed, so that the error for an old configuration can name the new key."""

from __future__ import annotations

RENAMED: dict[str, str] = {"matcher": "write backend: recall or backend: classic"}
"""Old dotted path of a setting to the new one, or to a sentence that says what to write instead."""
