"""The process that forks sessions."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tests.helpers.live import ROOT
from tests.ratslam.live.forked_process import Forked, raise_priority
from tests.ratslam.live.live_session import Session


class SessionServer:
    """A process that has loaded all modules and forks sessions."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._count = folder, 0
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tests.ratslam.live.session_server"],
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            bufsize=1,
        )
        assert self._process.stdout is not None
        assert self._process.stdout.readline() == "ready\n"

    def start(
        self,
        config: dict[str, Any],
        mapper: float | None = 0.0,
        without: Sequence[str] = (),
        rate_check: bool = False,
        options: Sequence[str] = (),
    ) -> Session:
        """Starts a session.

        Args:
            config: its configuration. mapper: s that the stub takes for each sample; None: no stub, the
                mapper itself. without: libraries that it cannot import. rate_check: whether it checks the
                head's rate. options: more of `live`.
        """
        self._count += 1
        folder = self._folder / str(self._count)
        folder.mkdir()
        file, log, code = folder / "config.yaml", folder / "log", folder / "code"
        file.write_text(json.dumps(config))
        log.touch()
        order = {
            "arguments": ["live", str(file), "-o", str(folder / "run"), *options],
            "log": str(log),
            "code": str(code),
            "mapper": mapper,
            "rate_check": rate_check,
            "without": list(without),
        }
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps(order) + "\n")
        session = Session(folder, Forked(int(self._process.stdout.readline()), code))
        raise_priority(session.process.pid)
        return session

    def close(self) -> None:
        self._process.kill()
        self._process.communicate()
