"""Emulated hardware: separate processes with the wire formats of the real devices."""
