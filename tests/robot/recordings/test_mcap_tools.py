"""Recordings as other tools read them: mcap, rosbags, mcap_ros2."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from robot.recordings.cdr import CYCLE, OBSERVATION, REPORT, TRUTH, WHISK, decode, encode
from robot.sources.source import Sample
from tactile.base.types import Observation, Report, Whisk
from tests.robot.recordings.mcap_samples import (
    SHAPE,
    WHISKERS,
    same_bits,
    some_samples,
    write_recording,
)


def test_the_mcap_library_reads_a_recording(small: tuple[bytes, list[Sample]], tmp_path: Path) -> None:
    from mcap.reader import make_reader

    content, samples = small
    (tmp_path / "a.mcap").write_bytes(content)
    with (tmp_path / "a.mcap").open("rb") as file:
        reader = make_reader(file)
        assert [m.metadata["view_shape"] for m in reader.iter_metadata() if m.name == "ratslam"] == ["2,3,2"]
        found = [(schema.encoding, channel.topic) for schema, channel, _ in reader.iter_messages()]
    topics = ("observation", "cycle", "whisk", "report", "truth")
    assert set(found) == {("ros2msg", f"/ratslam/{name}") for name in topics}
    assert len(found) == len(samples) + sum(sample.truth is not None for sample in samples)


def test_rosbags_reads_every_message_bit_for_bit(tmp_path: Path) -> None:
    from rosbags.highlevel import AnyReader

    samples = some_samples(10)
    with AnyReader([write_recording(tmp_path / "a.mcap", samples)]) as reader:
        read = [(connection.msgtype, data, reader.deserialize(data, connection.msgtype))
                for connection, _, data in reader.messages()]  # fmt: skip
        for name, data, message in read:
            assert bytes(reader.typestore.serialize_cdr(message, name)) == data
    readings = [part for part in read if part[0] != TRUTH]
    assert [data for _, data, _ in readings] == [encode(sample, SHAPE, WHISKERS)[2] for sample in samples]
    for sample, (name, data, message) in zip(samples, readings, strict=True):
        check_fields(sample, name, message)
        assert same_bits([Sample(*decode(name, data, SHAPE, WHISKERS), sample.truth)], [sample])


def test_mcap_ros2_reads_every_message(tmp_path: Path) -> None:
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    samples = some_samples(10)
    with write_recording(tmp_path / "a.mcap", samples).open("rb") as file:
        read = list(make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages())
    readings = [part for part in read if part.schema.name != TRUTH]
    for sample, part in zip(samples, readings, strict=True):
        check_fields(sample, part.schema.name, part.decoded_message)


def check_fields(sample: Sample, name: str, message: Any) -> None:
    """A ROS tool's message has the values of the sample."""
    reading = sample.reading
    assert (message.time, message.dtheta) == (sample.time, reading.odometry.dtheta)
    if isinstance(reading, Observation):
        assert name == OBSERVATION
        assert (np.reshape(message.view, SHAPE) == reading.view).all()
        assert (np.array(list(message.flags)) == reading.contact + 2 * ~reading.alive).all()
    elif isinstance(reading, Whisk):
        assert name == WHISK
        features = np.stack([reading.touched, reading.highest, reading.reach], 1)
        assert (np.reshape(message.felt, (WHISKERS, 3)) == features).all()
        flags = reading.alive + 2 * reading.contact + 4 * reading.held
        assert (np.array(list(message.flags)) == flags).all()
    elif isinstance(reading, Report):
        assert name == REPORT
        assert (message.motion, message.moment) == (reading.motion, reading.moment)
        assert (np.reshape(message.strain, (-1, WHISKERS, 2)) == reading.strain).all()
    else:
        assert name == CYCLE
        assert (np.reshape(message.deflection, (2, WHISKERS, 2)) == reading.deflection).all()
