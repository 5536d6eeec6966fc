"""A bench for a whole module, put right before each test, and sessions that wait for all of them."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.ratslam.live.bench import Bench, Queue


@pytest.fixture(scope="session")
def queue(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Queue]:
    """Sessions that have loaded everything."""
    queue = Queue(tmp_path_factory.mktemp("sessions"))
    yield queue
    queue.close()


@pytest.fixture(scope="module")
def table(loopback: str, queue: Queue, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    """Emulators of this worker; no longer than a module, for others need its address."""
    bench = Bench(loopback, queue, tmp_path_factory.mktemp("bench"))
    yield bench
    bench.close()


@pytest.fixture
def bench(table: Bench) -> Bench:
    """They, in good order."""
    table.ready()
    return table
