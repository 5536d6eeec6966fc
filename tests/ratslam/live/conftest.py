"""Emulators for each module, reset before each test, and a server that starts sessions for all modules."""

from collections.abc import Iterator

import pytest

from tests.ratslam.live.bench import Bench, CreateBench
from tests.ratslam.live.live_session import SessionServer


@pytest.fixture(scope="session")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SessionServer]:
    server = SessionServer(tmp_path_factory.mktemp("sessions"))
    yield server
    server.close()


@pytest.fixture(scope="module")
def table(loopback: str, server: SessionServer, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    """Emulators of this worker; other modules need the address."""
    bench = Bench(loopback, server, tmp_path_factory.mktemp("bench"))
    yield bench
    bench.close()


@pytest.fixture
def bench(table: Bench) -> Bench:
    table.ready()
    return table


@pytest.fixture(scope="module")
def create_table(
    loopback: str, server: SessionServer, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[CreateBench]:
    bench = CreateBench(loopback, server, tmp_path_factory.mktemp("create"))
    yield bench
    bench.close()


@pytest.fixture
def robot(create_table: CreateBench) -> CreateBench:
    create_table.ready()
    return create_table
