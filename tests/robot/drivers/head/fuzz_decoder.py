"""`python -m tests.robot.drivers.head.fuzz_decoder [-runs=N]`: libFuzzer compares the
decoder with the reference decoder.

The first byte sets the size of the pieces. Needs `pip install atheris`.
"""

from __future__ import annotations

import sys

import atheris

with atheris.instrument_imports(include=["robot.drivers.head"]):
    from robot.drivers.head.decoder import Decoder, DecoderCounts

from robot.drivers.head.usb_protocol import pack_frames
from tests.robot.drivers.head.oracle import decode_reference

SHAPE = (2, 1)


def fuzz_one(data: bytes) -> None:
    """Decodes one input in pieces of one size; frames get valid CRCs, which a fuzzer would not find."""
    if not data:
        return
    step, stream = data[0] % 64 + 1, insert_frames(data[1:])
    decoder, numbers = Decoder(*SHAPE), []
    for place in range(0, len(stream), step):
        numbers += decoder.feed(stream[place : place + step]).sequence.tolist()
    expected = decode_reference(stream, *SHAPE)
    assert decoder.counts == DecoderCounts(*expected.counts)
    assert numbers == [sample.sequence for sample in expected.samples]
    assert decoder.pending == expected.pending


def insert_frames(data: bytes) -> bytes:
    """The bytes, with each `F`, number (4 bytes), time (4 bytes), flags replaced by their frame."""
    parts, place = [], 0
    while (found := data.find(b"F", place)) >= 0 and found + 10 <= len(data):
        number, time = (int.from_bytes(data[found + k : found + k + 4], "little") for k in (1, 5))
        parts += [data[place:found], pack_frames([number], [time], [data[found + 9]], [[[1], [2]]])]
        place = found + 10
    return b"".join([*parts, data[place:]])


if __name__ == "__main__":
    atheris.Setup(sys.argv, fuzz_one)
    atheris.Fuzz()
