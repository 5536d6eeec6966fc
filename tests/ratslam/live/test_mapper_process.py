"""The process that maps, at the end of a session: whoever is late is waited for, whoever is stuck is not."""

import time

import numpy as np
import pytest

from ratslam.live import mapper_process
from ratslam.live.mapper_process import MappedSample, Mapper
from robot.sources.source import Sample
from tests.helpers.live import until

EACH, COUNT = 0.4, 10
"""Time of the late process for a sample, s, and number of samples."""


def map_slowly(line, each=EACH):
    """Maps one sample in `EACH`."""
    line.send(line.recv() is None)
    for number in range(COUNT):
        line.recv()
        time.sleep(each)
        line.send(MappedSample(number, np.zeros(3), 0, each, 0.0, False, np.zeros((0, 2)), np.zeros(3)))


def hang(line):
    """Never maps a sample."""
    map_slowly(line, 3600.0)


@pytest.mark.parametrize(("process", "mapped"), [(map_slowly, COUNT), (hang, 0)])
def test_a_late_mapper_is_waited_for_and_a_stuck_one_is_given_up(process, mapped, monkeypatch):
    with Mapper(process) as mapper:
        until(mapper.prepare(None))
        began = time.monotonic()
        for number in range(COUNT):
            mapper.offer(Sample(float(number), None, None))
        assert mapper.behind() > 0
        monkeypatch.setattr(mapper_process, "FINISH_TIMEOUT", COUNT * EACH * 0.75)
        assert mapper.finish(False) is None  # neither sends a score
        assert len(mapper.mapped) == mapped
        assert time.monotonic() - began > COUNT * EACH * 0.75
