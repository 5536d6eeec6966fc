"""`python -m tests.robot.drivers.head.fuzz_decoder [-runs=N]`: libFuzzer looks for bytes that the decoder
gets wrong.

The first byte says how the rest is cut into pieces. Needs `pip install atheris`.
"""

from __future__ import annotations

import sys

import atheris

with atheris.instrument_imports(include=["robot.drivers.head"]):
    from robot.drivers.head.decoder import Decoder, DecoderCounts

from robot.drivers.head.protocol import pack_frames
from tests.robot.drivers.head.oracle import told

SHAPE = (2, 1)


def one(data: bytes) -> None:
    """One input: repaired frames, so that the fuzzer needs not guess a CRC, in pieces of one size."""
    if not data:
        return
    step, stream = data[0] % 64 + 1, repaired(data[1:])
    decoder, numbers = Decoder(*SHAPE), []
    for place in range(0, len(stream), step):
        numbers += decoder.feed(stream[place : place + step]).sequence.tolist()
    story = told(stream, *SHAPE)
    assert decoder.counts == DecoderCounts(*story.counts)
    assert numbers == [sample.sequence for sample in story.samples]
    assert decoder.pending == story.pending


def repaired(data: bytes) -> bytes:
    """The bytes with each `F`, number (4 bytes), time (4 bytes), flags replaced by the frame of these."""
    parts, place = [], 0
    while (found := data.find(b"F", place)) >= 0 and found + 10 <= len(data):
        number, time = (int.from_bytes(data[found + k : found + k + 4], "little") for k in (1, 5))
        parts += [data[place:found], pack_frames([number], [time], [data[found + 9]], [[[1], [2]]])]
        place = found + 10
    return b"".join([*parts, data[place:]])


if __name__ == "__main__":
    atheris.Setup(sys.argv, one)
    atheris.Fuzz()
