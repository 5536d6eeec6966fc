"""The real client libraries in a process of their own, as they may crash: `python -m ... HOST`.

Each line of input is a call as JSON: the library's part (`PARTS`), the method, its arguments, and whether to
repeat it until the process is killed; `a.b` calls b of the result of a. Prints the result as JSON, or
{"error": text}.
"""

from __future__ import annotations

import importlib
import json
import os
import sys
import time
from typing import Any

PARTS = {
    "control": ("rtde_control", "RTDEControlInterface"),
    "receive": ("rtde_receive", "RTDEReceiveInterface"),
    "io": ("rtde_io", "RTDEIOInterface"),
    "dashboard": ("dashboard_client", "DashboardClient"),
}


def main(host: str) -> None:
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # the libraries print
    made: dict[str, Any] = {}
    for line in sys.stdin:
        part, name, arguments, repeat = json.loads(line)
        try:
            if part not in made:
                module, kind = PARTS[part]
                made[part] = getattr(importlib.import_module(module), kind)(host)
            first, *others = name.split(".")
            found = getattr(made[part], first)(*arguments)
            for other in others:
                found = getattr(found, other)()
        except Exception as error:  # the test checks the message
            found = {"error": str(error)}
        print(json.dumps(found), file=answers, flush=True)
        while repeat:
            time.sleep(0.02)
            getattr(made[part], name)(*arguments)


if __name__ == "__main__":
    main(sys.argv[1])
