"""Compares the oracle with recorded streams: one line each."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from tests.oracle.compare import compare
from tests.oracle.trace import TraceError, read


def main(arguments: list[str] | None = None) -> int:
    """0: everything agrees; 1: something differs; 2: a file cannot be read."""
    parser = argparse.ArgumentParser(prog="python -m tests.oracle", description=__doc__)
    parser.add_argument("files", metavar="FILE.npz", nargs="+", type=Path)
    parser.add_argument(
        "--quirks",
        choices=("on", "off"),
        default="on",
        help="on: against the recorded reference; off: the quirk-free semantics against our engine",
    )
    chosen = parser.parse_args(arguments)
    worst = 0
    for path in chosen.files:
        try:
            trace = read(path)
        except TraceError as error:
            print(f"error: {error}", file=sys.stderr)
            worst = 2
            continue
        report = compare(trace)
        print(report.line(), flush=True)
        worst = max(worst, 0 if report.ok else 1)
    return worst


if __name__ == "__main__":
    sys.exit(main())
