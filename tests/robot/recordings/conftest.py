"""A small recording."""

from __future__ import annotations

import pytest

from robot.sources.source import Sample
from tests.robot.recordings.mcap_samples import (
    some_samples,
    write_recording,
)


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> tuple[bytes, list[Sample]]:
    """A small recording of several chunks: its bytes and its samples."""
    samples = some_samples(9)
    path = write_recording(tmp_path_factory.mktemp("small") / "small.mcap", samples, chunk_s=1.5)
    return path.read_bytes(), samples
