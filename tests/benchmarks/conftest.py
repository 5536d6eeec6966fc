"""Benchmarks run with `make bench` and `make soak`, not with the test suite."""

import pytest


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if not config.getoption("--benchmark-only"):
        for item in items:
            if "tests/benchmarks" in item.path.as_posix():
                item.add_marker(pytest.mark.soak)
