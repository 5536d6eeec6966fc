"""Golden touch sessions: recordings, with their noise, and the decisions of the recall backend on them.

`python -m tests.golden.touch` stores the decisions again after an intended change; it does not simulate the
sessions again.
"""

import json
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from evaluation.metrics.exm import experience_metric
from ratslam.core.estimates import Action
from ratslam.runs.build_session import build_session, open_observations, read_observations
from ratslam.runs.settings.run_config import RunConfig
from tactile.base.types import Observation

FOLDER = Path(__file__).parent
SESSIONS = {"touch_circuits": {}, "touch_kidnap": {"may_be_carried": True}}
"""The settings `keyframes` of each session."""
ROWS = 1024
"""Rows reserved for a session, so that its kernel is compiled once."""


def decisions(name: str) -> dict[str, Any]:
    """The decisions on a session: experiences as [id, steps] in order, counts of actions, closures as
    [later, earlier] steps, counts of the Experience Metric."""
    settings = {"recording": {"file": FOLDER / f"{name}.mcap"}, "session": {"reserve": ROWS}}
    config = RunConfig.model_validate(settings | {"keyframes": SESSIONS[name]})
    with open_observations(config) as (config, source):
        session = build_session(config, source)
        rows: list[tuple[Any, Observation]] = list(read_observations(source))
        steps = list(session.replay([reading for _, reading in rows]))
    place = [int(step.estimate.place) for step in steps]
    actions = [Action(int(step.estimate.action)).name.lower() for step in steps]
    metric = experience_metric(np.array(place), np.array([sample.truth for sample, _ in rows]))
    return {
        "places": [[key, len(list(group))] for key, group in groupby(place)],
        "actions": {name: actions.count(name) for name in sorted(set(actions))},
        "closures": session.map.closures().tolist(),
        "relocalisations": metric.relocalisations,
        "correct": metric.correct,
    }


if __name__ == "__main__":
    import jax

    jax.config.update("jax_enable_x64", True)
    for session in SESSIONS:
        text = json.dumps(decisions(session))
        (FOLDER / f"{session}.json").write_text(text + "\n", encoding="utf-8")
