"""Work on a thread of its own whose result is taken up at a fixed keyframe, finished or not: the session then
waits for it. Live and replay so take up the same result at the same keyframe."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor, Future
from typing import Generic, TypeVar

import numpy as np

from ratslam.core.checkpoint import Checkpointed, with_prefix

Result = TypeVar("Result", bound=Checkpointed)


class DelayedJob(Checkpointed, Generic[Result]):
    """At most one job in progress; a checkpoint waits for it and holds its result.

    Args:
        thread: that does the work. blank: makes a result to restore.
    """

    VALUES = ("_due",)

    def __init__(self, thread: Executor, blank: Callable[[], Result]) -> None:
        self._thread, self._blank = thread, blank
        self._due = -1  # the keyframe at which the result is taken up
        self.result: Future[Result] | None = None

    @property
    def busy(self) -> bool:
        """Whether a job was begun and its result not taken up."""
        return self.result is not None

    def begin(self, due: int, work: Callable[[], Result]) -> None:
        """Begins a job whose result is taken up at keyframe `due`."""
        self._due, self.result = due, self._thread.submit(work)

    def take(self, now: int) -> Result | None:
        """The result if it is due at keyframe `now`, once."""
        if self.result is None or now < self._due:
            return None
        result, self.result, self._due = self.result.result(), None, -1
        return result

    def arrays(self) -> dict[str, np.ndarray]:
        """The state, with the job in progress as its result."""
        arrays = super().arrays()
        if self.result is not None:
            arrays |= {f"result/{name}": value for name, value in self.result.result().arrays().items()}
        return arrays

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """Replaces the whole state by that of `arrays`."""
        super().restore(arrays)
        self.result = None
        if self._due >= 0:
            result = self._blank()
            result.restore(with_prefix(arrays, "result/"))
            self.result = Future()
            self.result.set_result(result)
