"""Settings that were renamed, so that the error for an old configuration can name the new key."""

from __future__ import annotations

RENAMED: dict[str, str] = {}
"""Old dotted path of a setting to the new one, or to a sentence that says what to write instead."""
