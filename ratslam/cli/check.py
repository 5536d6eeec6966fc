"""The command check: conformance checks of registered parts."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import TYPE_CHECKING

from ratslam.cli.common import Commands, positive_integer, prepare_jax
from tactile.base.errors import tell

if TYPE_CHECKING:
    from ratslam.service.checks.check_results import Result

FAILED = 1
"""Exit code if a check failed."""


def add_commands(commands: Commands) -> None:
    """Registers `check` with a command for each kind of part."""
    check = commands.add(
        "check", None, "check a backend, source, touch front end or metric", "check backend recall", "files"
    )
    kinds = Commands(check)
    backend = kinds.add("backend", _backend, "check a SLAM method", "check backend recall")
    source = kinds.add("source", _source, "check a source or recording format", "check source my_robot")
    touch = kinds.add("touch", _touch, "check a touch front end", "check touch my_taxels --source my_array")
    metric = kinds.add("metric", _metric, "check a metric", "check metric my_error")
    for parser in (backend, source, touch, metric):
        parser.add_argument("name", metavar="NAME", help="name under which it is registered")
        parser.add_argument(
            "--set", action="append", default=[], metavar="settings.a=value",
            help="replace a setting of it; may be repeated",
        )  # fmt: skip
    source.add_argument(
        "--touch", metavar="NAME",
        help="front end for readings that are not observations; its settings by --set touch.a=value",
    )  # fmt: skip
    source.add_argument(
        "--samples", type=positive_integer, metavar="N", help="samples to examine (default 4096)"
    )
    touch.add_argument(
        "--source", metavar="NAME",
        help="registered source of its readings, its settings by --set source.a=value (default: a simulated "
        "whisker head)",
    )  # fmt: skip


def _backend(arguments: argparse.Namespace) -> int:
    prepare_jax()
    from ratslam.service.checks.backend_checks import check_backend

    tell("the checks take a minute or two, and several on a busy machine")

    return _report(arguments, check_backend(arguments.name, arguments.set))


def _source(arguments: argparse.Namespace) -> int:
    from ratslam.service.checks.source_checks import check_source
    from ratslam.service.checks.source_trial import SAMPLES

    most = arguments.samples or SAMPLES
    return _report(arguments, check_source(arguments.name, arguments.set, arguments.touch, most))


def _touch(arguments: argparse.Namespace) -> int:
    from ratslam.service.checks.touch_checks import check_touch

    return _report(arguments, check_touch(arguments.name, arguments.set, arguments.source))


def _metric(arguments: argparse.Namespace) -> int:
    from ratslam.service.checks.metric_checks import check_metric

    return _report(arguments, check_metric(arguments.name, arguments.set))


def _report(arguments: argparse.Namespace, results: Iterator[Result]) -> int:
    statuses = []
    for result in results:
        statuses.append(result.status)
        print(result.line(), flush=True)
    failed, skipped = statuses.count("FAIL"), statuses.count("-")
    rest = f", {skipped} not run" if skipped else ""
    print(f"{arguments.name}: {len(statuses)} checks, {failed} failed{rest}")
    return FAILED if failed else 0
