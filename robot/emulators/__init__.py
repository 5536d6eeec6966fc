"""Emulated hardware: each a process of its own that the real client libraries cannot tell from the device."""
