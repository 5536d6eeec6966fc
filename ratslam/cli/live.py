"""The commands on robots: live, and emulate, which stands in for one."""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

from ratslam.cli.common import INTERRUPTED, MENDABLE, Add, configured, prepare_jax
from tactile.base.errors import InputError


def add(command: Add) -> None:
    """Adds them to the program."""
    live = command("live", _live, "map while an arm carries a whisker head about")
    configured(live)
    live.add_argument(
        "-o", "--output", type=Path, metavar="DIR", help="new run directory (default runs/<config>)"
    )
    live.add_argument("--ur-host", metavar="HOST", help="address of the arm's controller")
    live.add_argument(
        "--head", metavar="ADDRESS", help="usb, usb:VENDOR:PRODUCT[:SERIAL], or an emulator's HOST"
    )

    emulate = command("emulate", _emulate, "stand in for an arm's controller, or for a whisker head")
    emulate.add_argument(
        "what", choices=("ur10", "head"), help="the arm's controller, or the head in its maze"
    )
    configured(emulate)
    emulate.add_argument(
        "--host", metavar="HOST", help="loopback address to listen at (default: as configured)"
    )
    emulate.add_argument("--ur-host", metavar="HOST", help="of the arm that carries the head")


def _live(arguments: argparse.Namespace) -> int:
    prepare_jax()
    from evaluation.metrics.scorecard import table
    from ratslam.live.session import live
    from robot.drivers.outcome import Outcome

    config = _configured(arguments, arguments.ur_host, arguments.head)
    directory = arguments.output or Path("runs") / Path(arguments.config).stem
    with _Monitor() as monitor:
        ended, card = live(config, Path(arguments.config).parent, directory, _tell, armed=monitor.start)
    if card is not None:
        print(table(card))
        print(f"\n{directory}/map.png shows the map, `run {directory}/config.yaml` maps the recording again")
    _tell(str(ended))
    if ended.outcome is Outcome.INTERRUPTED:
        return INTERRUPTED
    return 0 if ended.outcome is Outcome.COMPLETE else MENDABLE


def _emulate(arguments: argparse.Namespace) -> int:
    config = _configured(arguments, arguments.ur_host, None)
    from robot.live.emulator_config import controller, whiskers

    session, head = config.live, config.touch.head
    try:
        if arguments.what == "ur10":
            from robot.emulators.ur10 import serve

            serve(controller(session, head, arguments.host))
        else:
            from robot.emulators.head import serve as serve_head

            serve_head(whiskers(session, head, arguments.host))
    except KeyboardInterrupt:
        return INTERRUPTED
    return 0


class _Monitor:
    """`ratslam watch` of the session, in a process of its own that gives way to all others."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None

    def start(self, directory: Path) -> None:
        """From now on."""
        command = [sys.executable, "-m", "ratslam", "watch", str(directory)]
        nice = ["nice", "-n", "10"] if shutil.which("nice") else []
        self._process = subprocess.Popen(
            [*nice, *command],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # Ctrl-C is not for it
        )
        _tell(f"{directory}/watch.png shows the map grow")

    def __enter__(self) -> _Monitor:
        return self

    def __exit__(self, *_: object) -> None:
        if self._process is not None:
            self._process.terminate()
            self._process.wait()


def _configured(arguments: argparse.Namespace, arm: str | None, head: str | None) -> Any:
    """The configuration with addresses from the command line.

    Raises:
        InputError: it is not one of a live session.
    """
    from ratslam.config.run_config import RunConfig
    from ratslam.config.strict_yaml import load, override, validate
    from ratslam.pipeline.run import located

    given = [f"live.arm.host={arm}"] if arm else []
    given += [f"live.head.address={head}"] if head else []
    config = validate(override(load(arguments.config), [*arguments.set, *given]), RunConfig)
    if config.live is None:
        cure = "configs/live_maze.yaml is an example; `run` maps recordings and simulations"
        raise InputError(f"{arguments.config}: live", "missing", "a session on a robot", cure)
    return located(config, Path(arguments.config).parent.resolve())


def _tell(line: str) -> None:
    print(f"ratslam: {line}", file=sys.stderr, flush=True)
