"""The interface of all sources of readings, and sources in memory."""
