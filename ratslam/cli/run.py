"""The commands on one session: run, simulate, score, recover; and the schema of configurations."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from ratslam.cli.common import INTERRUPTED, Add, configured, prepare_jax


def add(command: Add) -> None:
    """Adds them to the program."""
    run = command("run", _run, "run a configuration and score what comes out")
    configured(run)
    run.add_argument(
        "-o", "--output", type=Path, metavar="DIR", help="new run directory (default runs/<config>)"
    )
    run.add_argument(
        "--continue", dest="resume", type=Path, metavar="NPZ",
        help="go on from an earlier run: where it stopped in the same recording, else from the start",
    )  # fmt: skip

    simulate = command(
        "simulate", _simulate, "write the session that a configuration simulates to a recording"
    )
    configured(simulate)
    simulate.add_argument("-o", "--output", type=Path, required=True, metavar="MCAP", help="the new file")
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

    recover = command("recover", _recover, "make a complete recording of one that was cut off")
    recover.add_argument("recording", type=Path, help="the .mcap file")
    recover.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="the new file")

    schema = command("schema", _schema, "print the JSON schema of configurations, for editors")
    schema.add_argument("-o", "--output", type=Path, metavar="FILE", help="write it there instead")


def _run(arguments: argparse.Namespace) -> int:
    prepare_jax()
    from evaluation.metrics.grid_score import GridScore
    from evaluation.metrics.grid_score import table as chart
    from evaluation.metrics.scorecard import table
    from ratslam.config.run_config import RunConfig
    from ratslam.config.strict_yaml import load, override, validate
    from ratslam.pipeline.run import run

    config = validate(override(load(arguments.config), arguments.set), RunConfig)
    directory = arguments.output or Path("runs") / Path(arguments.config).stem
    card, interrupted = run(config, Path(arguments.config).parent, directory, arguments.resume)
    print(table(card))
    if (directory / "gridscore.json").exists():
        told = (directory / "gridscore.json").read_text(encoding="utf-8")
        print("\n" + chart([GridScore.model_validate_json(told)]))
    print(f"\n{directory}/map.png shows the map, {directory}/trajectory.tum holds the path")
    return INTERRUPTED if interrupted else 0


def _simulate(arguments: argparse.Namespace) -> int:
    from ratslam.config.run_config import RunConfig
    from ratslam.config.strict_yaml import load, override, validate
    from ratslam.pipeline.run import simulate

    sets = [*arguments.set, *(["simulation.raw=true"] if arguments.raw else [])]
    config = validate(override(load(arguments.config), sets), RunConfig)
    count, interrupted = simulate(config, Path(arguments.config).parent, arguments.output)
    print(f"{arguments.output}: {count} whisks")
    return INTERRUPTED if interrupted else 0


def _score(arguments: argparse.Namespace) -> int:
    from evaluation.artifacts.run_directory import read_run
    from evaluation.metrics.energy_metric import read_relations
    from evaluation.metrics.experience_log import read_log
    from evaluation.metrics.experience_metric import ExmConfig
    from evaluation.metrics.scorecard import score, score_log, table

    exm = ExmConfig(mode=arguments.mode, base=arguments.base)
    if arguments.log.is_dir():
        relations = read_relations(arguments.relations) if arguments.relations else None
        card = score(read_run(arguments.log), arguments.log.name, exm=exm, relations=relations)
    else:
        card = score_log(read_log(arguments.log), arguments.log.stem, exm=exm)
    print(card.model_dump_json(indent=2) if arguments.json else table(card))
    return 0


def _recover(arguments: argparse.Namespace) -> int:
    from robot.recordings.mcap_reader import recover

    report = recover(arguments.recording, arguments.output)
    print(f"{arguments.output}: {report}")
    return 0


def _schema(arguments: argparse.Namespace) -> int:
    from ratslam.config.run_config import RunConfig
    from ratslam.config.strict_yaml import schema

    text = json.dumps(schema(RunConfig), indent=2) + "\n"
    if arguments.output:
        arguments.output.write_text(text, encoding="utf-8")
    else:
        print(text, end="")
    return 0
