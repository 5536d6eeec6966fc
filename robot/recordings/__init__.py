"""Recordings: MCAP, CSV and npz traces, read and written."""
