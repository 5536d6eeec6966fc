"""An array that grows at its end."""

from __future__ import annotations

from typing import Any

import numpy as np


class GrowableArray:
    """Rows of one shape and dtype; room doubles when it is used up, so n appends cost O(n)."""

    def __init__(self, shape: tuple[int, ...], dtype: Any) -> None:
        self._room = np.zeros((16, *shape), dtype)
        self._count = 0

    @property
    def rows(self) -> np.ndarray:
        """[count, ...] a view: writing to it changes the array, appending may detach it."""
        return self._room[: self._count]

    def append(self, row: Any) -> None:
        """Adds one row."""
        if self._count == len(self._room):
            self._room = np.concatenate([self._room, np.zeros_like(self._room)])
        self._room[self._count] = row
        self._count += 1

    def replace(self, rows: np.ndarray) -> None:
        """Starts over with the given rows."""
        capacity = max(16, 1 << (len(rows) - 1).bit_length())
        self._room = np.zeros((capacity, *self._room.shape[1:]), self._room.dtype)
        self._room[: len(rows)] = rows
        self._count = len(rows)
