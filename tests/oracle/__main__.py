"""`python -m tests.oracle FILE.npz [FILE...] [--quirks on|off]`: one line per file."""

from __future__ import annotations

import argparse
import sys

from tests.oracle import compare
from tests.oracle.trace import TraceError, load


def main(arguments: list[str] | None = None) -> int:
    """0 if every file agrees, 1 if one does not, 2 if one cannot be read."""
    parser = argparse.ArgumentParser(prog="python -m tests.oracle", description=__doc__)
    parser.add_argument("files", nargs="+", metavar="FILE.npz")
    parser.add_argument("--quirks", choices=("on", "off"), default="on")
    options = parser.parse_args(arguments)
    status = 0
    for file in options.files:
        try:
            trace = load(file)
            if options.quirks == "on":
                report = compare.stock(trace)
            else:
                # The JAX engine takes seconds to import, which the stock comparison can do without.
                from tests.oracle import counterpart

                report = counterpart.plain(trace, file)
        except TraceError as error:
            print(f"error: {error}", file=sys.stderr)
            return 2
        print(report.line(), flush=True)
        status = status or int(not report.agrees)
    return status


if __name__ == "__main__":
    sys.exit(main())
