"""A bench for a whole module, put right before each test, and sessions that end with it."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.live.bench import Bench


@pytest.fixture(scope="module")
def table(loopback: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    """Emulators of this worker."""
    bench = Bench(loopback, tmp_path_factory.mktemp("live"))
    yield bench
    bench.close()


@pytest.fixture
def bench(table: Bench) -> Bench:
    """They, in good order."""
    table.ready()
    return table
