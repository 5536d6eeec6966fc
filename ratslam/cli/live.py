"""The commands live, topics and emulate."""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from ratslam.cli.common import INPUT_ERROR, INTERRUPTED, Commands, add_config, prepare_jax, read_config
from ratslam.cli.doctor import FAULTY
from ratslam.cli.run import add_rerun, add_run_directory, open_target, run_directory
from robot.drivers.processes import put_last
from tactile.base.errors import InputError, tell
from tactile.base.files import make_new_file, require_new_file

if TYPE_CHECKING:
    from ratslam.runs.settings.run_config import RunConfig
    from robot.live.live_config import LiveConfig


def add_commands(commands: Commands) -> None:
    """Registers the commands of this module."""
    live = commands.add(
        "live", _live, "map with an arm, a Create, or the topics of a robot",
        "live live_create --set live.create.plan.minutes=1", "live",
    )  # fmt: skip
    add_config(live)
    add_run_directory(live)
    live.add_argument("--ur-host", metavar="HOST", help="address of the arm's controller")
    live.add_argument(
        "--head", metavar="ADDRESS",
        help="address of the whisker head: usb, usb:VENDOR:PRODUCT[:SERIAL] (hexadecimal ids), or "
        "HOST[:PORT] of an emulator",
    )  # fmt: skip
    live.add_argument(
        "--source", metavar="ADDRESS", help="robot that publishes topics, such as ws://robot:8765"
    )
    live.add_path("--localise", "MAP", "localise in this map instead of making one")
    live.add_path(
        "--continue", "MAP",
        "go on with this map: the session begins a piece of it, joined once its views place it",
        dest="resume",
    )  # fmt: skip
    add_rerun(live)

    topics = commands.add(
        "topics", _topics, "list a running robot's topics; write a configuration",
        "topics ws://robot:8765 -o robot.yaml", "live",
    )  # fmt: skip
    topics.add_argument(
        "address", metavar="ADDRESS", help="of the robot: ws://HOST:8765 or zenoh://HOST:7447"
    )
    topics.add_path("-o", "YAML", "write the configuration to a new file, for `live`")
    topics.add_argument(
        "--seconds", type=float, default=5.0, metavar="S", help="how long to listen (default 5)"
    )

    emulate = commands.add(
        "emulate", _emulate, "emulate the arm's controller, the head or a Create",
        "emulate create live_create", "live",
    )  # fmt: skip
    emulate.add_argument(
        "device", choices=("ur10", "head", "create"),
        help="the arm's controller, the whisker head in its maze, or a whiskered Create in its arena",
    )  # fmt: skip
    add_config(emulate)
    emulate.add_argument(
        "--host", metavar="HOST", help="address to listen on (default: from the configuration)"
    )
    emulate.add_flag(
        "--open-to-network",
        "listen on any address: anyone who reaches it may command, fault or stop the emulator",
    )
    emulate.add_argument("--ur-host", metavar="HOST", help="address of the arm that carries the head")


def _live(arguments: argparse.Namespace) -> int:
    prepare_jax()
    from evaluation.report.verdict import summarise
    from ratslam.live.live_session import run_live_session
    from ratslam.methods.method_registry import LOCALISING
    from ratslam.runs.localise import check_assignments, describe_localisation, localising
    from ratslam.runs.run import catch_interrupt
    from robot.drivers.outcome import SessionOutcome

    config, live = _read_live_config(arguments, arguments.head)
    if arguments.localise is not None and arguments.resume is not None:
        raise InputError("--continue", "given with --localise", "one of them: a map grows or stays as it is")
    if arguments.localise is not None:
        from ratslam.runs.saved_map import read_map

        saved = read_map(arguments.localise)
        check_assignments(arguments.set, saved)
        config = localising(config, saved)
    directory, target = run_directory(arguments), open_target(arguments)
    last_task = "stopping the robot" if live.topics is None else "ending the session"
    with catch_interrupt(last_task), monitor() as start_monitor:
        ended, card = run_live_session(
            config, directory, tell, armed=start_monitor, view=target, resume=arguments.resume
        )
    if card is not None:
        print(f"{directory}/map.png shows the map, `run {directory}/config.yaml` maps the recording again")
        if config.backend in LOCALISING.values():
            print(describe_localisation(directory))
        print(summarise(directory, card, config.backend))
    tell(str(ended))
    if ended.outcome is SessionOutcome.INTERRUPTED:
        return INTERRUPTED
    return 0 if ended.outcome.planned else INPUT_ERROR


def _topics(arguments: argparse.Namespace) -> int:
    from ratslam.runs.settings.strict_yaml import dump_data
    from ratslam.service.topics_check import diagnose_topics

    if not 0.5 <= arguments.seconds <= 600:
        raise InputError("--seconds", f"{arguments.seconds:g}", "0.5 to 600")
    if arguments.output is not None:
        require_new_file(arguments.output)
    diagnosis = diagnose_topics(arguments.address, arguments.seconds)
    output = arguments.output
    if output is not None and diagnosis.config:
        first = f"# Maps {arguments.address}; written by `python -m ratslam topics`.\n"
        text = first + dump_data(diagnosis.config)
        make_new_file(output, lambda file: file.write_text(text, encoding="utf-8"))
        diagnosis = diagnosis._replace(advice=(*diagnosis.advice, f"python -m ratslam live {output}"))
    print(diagnosis.render())
    return FAULTY if diagnosis.faults else 0


def _emulate(arguments: argparse.Namespace) -> int:
    config, session = _read_live_config(arguments, head_address=None)
    from robot.live.live_emulator_config import (
        arm_emulator_config,
        create_emulator_config,
        head_emulator_config,
    )

    head, opened = config.touch.head, {"open_to_network": arguments.open_to_network}
    if (arguments.device == "create") != (session.create is not None):
        found = "that of a Create" if session.create else "that of an arm"
        cure = "the packaged `live_create` is for `create`, `live_maze` for `ur10` and `head`"
        raise InputError(f"{arguments.config}: live", found, f"one for `{arguments.device}`", cure)
    if arguments.device == "head" and session.arm.touch == "force":
        found = "force: this arm has no head"
        raise InputError("live.arm.touch", found, "head", "emulate `ur10`, which feels the walls itself")
    try:
        if session.create is not None:
            from robot.emulators.create import serve as serve_create

            address = arguments.host or session.head.address
            serve_create(create_emulator_config(session.create, address, **opened))
        elif arguments.device == "ur10":
            from robot.emulators.ur10 import serve

            radius = config.touch.pokes.radius
            serve(arm_emulator_config(session, head, arguments.host, radius).model_copy(update=opened))
        else:
            from robot.emulators.head import serve as serve_head

            serve_head(head_emulator_config(session, head, arguments.host).model_copy(update=opened))
    except KeyboardInterrupt:
        return INTERRUPTED
    return 0


@contextmanager
def monitor() -> Iterator[Callable[[Path], None]]:
    """Yields a function that starts `ratslam watch` on a run directory, as a process of low priority.

    At the end of the block the process is ended, and `watch.png` is drawn once more with the final state.
    """
    from evaluation.monitor import watch_run

    processes: dict[Path, subprocess.Popen[bytes]] = {}

    def start(directory: Path) -> None:
        command = [sys.executable, "-m", "ratslam", "watch", str(directory)]
        quiet = subprocess.DEVNULL
        # A session of its own: it gets no Ctrl-C.
        processes[directory] = subprocess.Popen(command, stdout=quiet, stderr=quiet, start_new_session=True)
        put_last(processes[directory].pid)
        tell(f"{directory}/watch.png shows the map while it grows")

    try:
        yield start
    finally:
        for directory, process in processes.items():
            process.terminate()
            process.wait()
            with suppress(InputError):  # a full disk has been reported
                watch_run(directory, lambda line: None, once=True)


def _read_live_config(
    arguments: argparse.Namespace, head_address: str | None
) -> tuple[RunConfig, LiveConfig]:
    """The configuration with addresses from the command line, and its live part.

    Raises:
        InputError: it has no live part.
    """
    if arguments.ur_host:
        arguments.set.append(f"live.arm.host={arguments.ur_host}")
    if getattr(arguments, "source", None):
        arguments.set.append(f"live.topics.source={arguments.source}")
    if head_address:
        arguments.set.append(f"live.head.address={head_address}")
    config = read_config(arguments)
    if config.live is None:
        cure = "`live_maze` and `live_create` are examples; `run` maps recordings and simulations"
        raise InputError(f"{arguments.config}: live", "missing", "settings of a live session", cure)
    return config, config.live
