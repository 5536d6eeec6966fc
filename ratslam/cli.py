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
    prepare_jax()
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


def _simulate(arguments: argparse.Namespace) -> int:
    from ratslam.config import RunConfig
    from ratslam.run import simulate
    from ratslam.yamlfile import load, override, validate

    sets = [*arguments.set, *(["simulation.raw=true"] if arguments.raw else [])]
    config = validate(override(load(arguments.config), sets), RunConfig)
    count, interrupted = simulate(config, Path(arguments.config).parent, arguments.output)
    print(f"{arguments.output}: {count} whisks")
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


def _ablate(arguments: argparse.Namespace) -> int:
    prepare_jax()
    from ratslam.trials import PARTS

    _table(arguments, list(PARTS.items()))
    return 0


def _vary(arguments: argparse.Namespace) -> int:
    prepare_jax()
    from ratslam.trials import variations
    from ratslam.yamlfile import load, override

    if not 0 < arguments.by < 1:
        raise InputError("--by", str(arguments.by), "a share between 0 and 1")
    document = override(load(arguments.config), arguments.set)
    lines = [
        (f"{name} = {value:.4g}", (f"{name}={value!r}",))
        for name, value in variations(document, arguments.by)
    ]
    finals = _table(arguments, [("as configured", ()), *lines])
    limit = 1.25 * finals[0] if arguments.limit is None else arguments.limit
    if finals[0] != finals[0]:
        print("the recording has no truth, so nothing can be said of what is kept")
        return 0
    kept = sum(final <= limit for final in finals[1:])
    print(f"{kept} of {len(lines)} variations ({kept / len(lines):.0%}) end at {limit:.3g} m or less")
    return 0


def _spread(arguments: argparse.Namespace) -> int:
    prepare_jax()
    from ratslam.trials import HEADER, compare, row

    print(HEADER)
    variants = [((), seed) for seed in range(arguments.runs + 1)]
    trials = []
    for seed, trial in enumerate(compare(Path(arguments.config), arguments.set, variants, arguments.workers)):
        print(row(f"perturbed, seed {seed}" if seed else "as it is", [trial]), flush=True)
        trials.append(trial)
    print(row("all perturbed", trials[1:]))
    return 0


def _table(arguments: argparse.Namespace, lines: list[tuple[str, tuple[str, ...]]]) -> list[float]:
    """Prints a row as soon as all of its trials are done; returns the final errors."""
    from ratslam.trials import HEADER, compare, row

    seeds = range(1, arguments.perturbed + 1) if arguments.perturbed else (0,)
    variants = [(sets, seed) for _, sets in lines for seed in seeds]
    trials = compare(Path(arguments.config), arguments.set, variants, arguments.workers)
    print(HEADER)
    finals = []
    for name, _ in lines:
        these = [next(trials) for _ in seeds]
        print(row(name, these), flush=True)
        finals.append(max(trial.final for trial in these))
    return finals


def _schema(arguments: argparse.Namespace) -> int:
    from ratslam.config import RunConfig
    from ratslam.yamlfile import schema

    text = json.dumps(schema(RunConfig), indent=2) + "\n"
    if arguments.output:
        arguments.output.write_text(text, encoding="utf-8")
    else:
        print(text, end="")
    return 0


def _count(text: str) -> int:
    """A whole number from 1 on, for argparse."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is no whole number from 1 on")
    return int(text)


def prepare_jax() -> None:
    """What must be settled before jax loads: one thread (more double the latency) and a lasting cache."""
    flag = "--xla_cpu_multi_thread_eigen=false"
    if flag not in os.environ.get("XLA_FLAGS", ""):
        os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {flag}".strip()
    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    wanted = {
        "jax_compilation_cache_dir": str(Path(home) / "ratslam" / "jax"),
        # The defaults keep nothing that compiles as fast as our kernels do on a CPU.
        "jax_persistent_cache_min_compile_time_secs": 0,
        "jax_persistent_cache_min_entry_size_bytes": -1,
    }
    os.environ.update({name.upper(): str(value) for name, value in wanted.items()})  # for child processes
    import jax

    for name, value in wanted.items():
        jax.config.update(name, value)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="ratslam",
        description="Maps and localises by view or whisker: pose cells, recall, experience map.",
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

    simulate = command(
        "simulate", _simulate, "write the session that a configuration simulates to a recording"
    )
    simulate.add_argument("config", help="the YAML file")
    simulate.add_argument("-o", "--output", type=Path, required=True, metavar="MCAP", help="the new file")
    simulate.add_argument(
        "--set", action="append", default=[], metavar="a.b=value", help="override a setting; may be repeated"
    )
    simulate.add_argument(
        "--raw", action="store_true", help="every sample, 2000 a second, not what they tell"
    )

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

    ablate = command(
        "ablate", _ablate, "turn each part of recall and map off in turn and see what it carries"
    )
    vary = command("vary", _vary, "vary every number of recall and map, one at a time, up and down")
    vary.add_argument("--by", type=float, default=0.2, metavar="SHARE", help="by this share (default 0.2)")
    vary.add_argument(
        "--limit", type=float, metavar="M", help="final ATE that counts as kept (default 1.25 of the first)"
    )
    spread = command("spread", _spread, "run perturbed copies of the recording: what was luck?")
    spread.add_argument("-n", dest="runs", type=_count, default=10, metavar="N", help="copies (default 10)")
    for several in (ablate, vary, spread):
        several.add_argument("config", help="the YAML file")
        several.add_argument(
            "--set", action="append", default=[], metavar="a.b=value", help="override a setting"
        )
        several.add_argument(
            "--workers", type=_count, default=0, metavar="N", help="processes (default: cores)"
        )
    for several in (ablate, vary):
        several.add_argument(
            "--perturbed", type=_count, default=0, metavar="N", help="run on N perturbed copies instead"
        )

    recover = command("recover", _recover, "make a complete recording of one that was cut off")
    recover.add_argument("recording", type=Path, help="the .mcap file")
    recover.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="the new file")

    schema = command("schema", _schema, "print the JSON schema of configurations, for editors")
    schema.add_argument("-o", "--output", type=Path, metavar="FILE", help="write it there instead")
    return parser
