"""`python -m tests.ratslam.live.waiting_session`: a session that waits, with everything loaded, for what
it is to do.

A line of JSON on its standard input tells the `arguments` of `python -m ratslam`, how long the stub in the
mapper's place takes for a sample (`mapper`, s), and how long the self-test listens (`listened`, s).
"""

from __future__ import annotations

import json
import sys
from functools import partial
from typing import Any


def main() -> int:
    import ratslam.live.session
    from ratslam.cli import main as program
    from ratslam.live.session import run_live_session
    from robot.live import selftest
    from tests.ratslam.live import stub_mapper

    print("waiting", flush=True)
    told: dict[str, Any] = json.loads(sys.stdin.readline())
    arguments = told["arguments"]
    directory = arguments[arguments.index("-o") + 1]
    ratslam.live.session.run_live_session = partial(
        run_live_session, mapping=partial(stub_mapper.mapping, directory, told["mapper"])
    )
    selftest.LISTEN_TIME = told["listened"]
    return program(arguments)


if __name__ == "__main__":
    sys.exit(main())
