"""A metric of one's own: how far the path ends from where it began, against the truth.

`python -m ratslam.examples.own_metric` maps the square recording, scores it with the metric too and prints

    error of the way home: 0.02 m, odometry 0.9 m
"""

import numpy as np

import ratslam
from evaluation.metrics.metric import MISSING_TRUTH, Finding, Metric
from evaluation.metrics.metric_registry import METRICS, MetricEntry
from evaluation.metrics.run_metrics import RunData
from tactile.base.se2 import between
from tactile.base.settings import Settings


class Config(Settings):
    since: float = 0.0
    """Time at which the way begins, s."""


def build(config: Config) -> Metric:
    def way(path: np.ndarray, data: RunData) -> np.ndarray:
        rows = data.rows[data.run.time[data.rows] >= config.since]
        return np.asarray(between(path[rows[0]], path[rows[-1]])[:2])

    def compute(data: RunData) -> Finding:
        if data.run.truth is None:
            return MISSING_TRUTH
        true = way(data.run.truth, data)
        off, raw = (np.hypot(*(way(path, data) - true)) for path in (data.run.final, data.run.odometry))
        return Finding(float(off), float(raw))

    return Metric("way_home", "error of the way home", "m", "low", "Own", compute)


ENTRY = MetricEntry(Config, build)  # what an entry point names

if __name__ == "__main__":
    METRICS.register("way_home", ENTRY)
    result = ratslam.run(ratslam.load_config("square", ["score.metrics=[{plugin: way_home}]"]))
    found = result.scorecard.quantities["way_home"]
    print(f"{found.label}: {found.value:.1g} m, odometry {found.odometry:.1g} m")
