"""The program: `python -m ratslam COMMAND`."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable
from pathlib import Path

# Only what parsing arguments needs is imported here: `--help` answers before jax would have loaded.
from tactile.errors import InputError

MENDABLE = 2
"""Exit code after an error the user can mend."""
INTERRUPTED = 130
"""Exit code after an interrupt; what was done by then is on disk."""


def main(argv: list[str] | None = None) -> int:
    """Parses the arguments and runs one command; the exit code."""
    arguments = _parser().parse_args(argv)
    try:
        return arguments.command(arguments)
    except InputError as error:
        print("\n".join(f"ratslam: error: {line}" for line in str(error).splitlines()), file=sys.stderr)
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        print(
            f"ratslam: error: {where}{error.strerror or error}; what was written so far is complete; "
            "make room or choose another folder with -o",
            file=sys.stderr,
        )
    except KeyboardInterrupt:
        print("ratslam: interrupted", file=sys.stderr)
        return INTERRUPTED
    return MENDABLE


def _run(arguments: argparse.Namespace) -> int:
    _prepare_jax()
    from evaluation.scorecard import table
    from ratslam.config import RunConfig
    from ratslam.run import run
    from ratslam.yamlfile import load, override, validate

    config = validate(override(load(arguments.config), arguments.set), RunConfig)
    directory = arguments.output or Path("runs") / Path(arguments.config).stem
    card, interrupted = run(config, Path(arguments.config).parent, directory, arguments.resume)
    print(table(card))
    print(f"\n{directory}/map.png shows the map, {directory}/trajectory.tum holds the path")
    return INTERRUPTED if interrupted else 0


def _score(arguments: argparse.Namespace) -> int:
    from evaluation.energy import read_relations
    from evaluation.exm import ExmConfig
    from evaluation.log import read_log
    from evaluation.rundirectory import read_run
    from evaluation.scorecard import score, score_log, table

    exm = ExmConfig(mode=arguments.mode, base=arguments.base)
    if arguments.log.is_dir():
        relations = read_relations(arguments.relations) if arguments.relations else None
        card = score(read_run(arguments.log), arguments.log.name, exm=exm, relations=relations)
    else:
        card = score_log(read_log(arguments.log), arguments.log.stem, exm=exm)
    print(card.model_dump_json(indent=2) if arguments.json else table(card))
    return 0


def _recover(arguments: argparse.Namespace) -> int:
    from robot.recording import recover

    report = recover(arguments.recording, arguments.output)
    print(f"{arguments.output}: {report}")
    return 0


def _schema(arguments: argparse.Namespace) -> int:
    from ratslam.config import RunConfig
    from ratslam.yamlfile import schema

    text = json.dumps(schema(RunConfig), indent=2) + "\n"
    if arguments.output:
        arguments.output.write_text(text, encoding="utf-8")
    else:
        print(text, end="")
    return 0


def _prepare_jax() -> None:
    """What must be settled before jax loads: one thread (more double the latency) and a lasting cache."""
    flag = "--xla_cpu_multi_thread_eigen=false"
    if flag not in os.environ.get("XLA_FLAGS", ""):
        os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {flag}".strip()
    import jax

    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    jax.config.update("jax_compilation_cache_dir", str(Path(home) / "ratslam" / "jax"))
    # The defaults keep nothing that compiles as fast as our kernels do on a CPU.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="ratslam",
        description="Maps and localises by view or whisker: pose cells, templates, experience map.",
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    def command(name: str, does: Callable[[argparse.Namespace], int], help: str) -> argparse.ArgumentParser:
        added = commands.add_parser(name, help=help, description=help)
        added.set_defaults(command=does)
        return added

    run = command("run", _run, "run a configuration and score what comes out")
    run.add_argument("config", help="the YAML file")
    run.add_argument(
        "-o", "--output", type=Path, metavar="DIR", help="new run directory (default runs/<config>)"
    )
    run.add_argument(
        "--set", action="append", default=[], metavar="a.b=value", help="override a setting; may be repeated"
    )
    run.add_argument(
        "--continue", dest="resume", type=Path, metavar="NPZ",
        help="go on from an earlier run: where it stopped in the same recording, else from the start",
    )  # fmt: skip

    score = command(
        "score", _score, "score a run directory, or any log: a CSV of time, experience id, true pose"
    )
    score.add_argument("log", type=Path, help="run directory or CSV (t, id, x, y, theta)")
    score.add_argument(
        "--mode", choices=("strict", "paper", "or", "literal"), default="strict", help="of the ExM"
    )
    score.add_argument("--base", type=int, help="last step of the base set (default: the first return)")
    score.add_argument(
        "--relations", type=Path, help="file of true relative poses (t1,t2,x,y,z,roll,pitch,yaw)"
    )
    score.add_argument("--json", action="store_true", help="print JSON instead of a table")

    recover = command("recover", _recover, "make a complete recording of one that was cut off")
    recover.add_argument("recording", type=Path, help="the .mcap file")
    recover.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="the new file")

    schema = command("schema", _schema, "print the JSON schema of configurations, for editors")
    schema.add_argument("-o", "--output", type=Path, metavar="FILE", help="write it there instead")
    return parser
