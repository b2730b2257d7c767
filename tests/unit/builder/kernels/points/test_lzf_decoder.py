"""Test LZF code by code, with the input or the output ending at any byte."""

import numpy as np
import pytest
from solidcloud.builder.kernels.points.lzf_decoder import FARTHEST_BACK, LONGEST_COPY, decode

pytestmark = pytest.mark.interpreted

# A step: bytes as they are, or (so far back, so many bytes).
Step = bytes | tuple[int, int]


def coded(step: Step) -> bytes:
    """A step as LZF writes it [liblzf, lzf_c.c]."""
    if isinstance(step, bytes):
        return bytes([len(step) - 1]) + step
    back, count = step[0] - 1, step[1] - 2
    long = bytes([count - 7]) if count >= 7 else b""
    return bytes([min(count, 7) << 5 | back >> 8]) + long + bytes([back & 255])


def meant(out: bytes, step: Step) -> bytes:
    """What there is after a step."""
    if isinstance(step, bytes):
        return out + step
    for _ in range(step[1]):
        out += out[-step[0] :][:1]
    return out


def ask(source: bytes, before: bytes, limit: int, at: int = 0, past: int | None = None) -> tuple:
    """What `decode` makes of source[at:past]: (where it stands, all bytes there are, whether all was right)."""
    out = np.full(max(limit, len(before)) + LONGEST_COPY, 0xEE, np.uint8)
    out[: len(before)] = np.frombuffer(before, np.uint8)
    past = len(source) if past is None else past
    at, have, right = decode(np.frombuffer(source, np.uint8), at, past, out, len(before), limit)
    assert (out[have:] == 0xEE).all(), "written behind what is said to be there"
    return at, out[:have].tobytes(), right


def random_steps(rng: np.random.Generator, before: bytes, count: int) -> list[Step]:
    """Steps of every kind and length, none referring to before the first byte."""
    steps: list[Step] = []
    out = before
    for _ in range(count):
        if not out or rng.random() < 0.4:
            steps.append(rng.bytes(int(rng.choice([1, 2, 31, 32]))))
        else:
            far = int(rng.choice([1, 2, 255, 256, 257, len(out)]))
            steps.append((min(far, len(out), FARTHEST_BACK), int(rng.choice([3, 4, 8, 9, 10, 264]))))
        out = meant(out, steps[-1])
    return steps


@pytest.mark.parametrize("before", [b"", b"abcde", bytes(range(256)) * 33])
def test_steps_give_the_bytes_they_mean_whatever_they_end_in(before: bytes) -> None:
    rng = np.random.default_rng(len(before))
    steps = random_steps(rng, before, 12)
    source = b"".join(map(coded, steps))
    ends, outs = [0], [before]
    for step in steps:
        ends.append(ends[-1] + len(coded(step)))
        outs.append(meant(outs[-1], step))
    room = len(outs[-1])
    # Where the bytes end within a step, it stands before that step.
    for past in range(len(source) + 1):
        whole = max(k for k in range(len(ends)) if ends[k] <= past)
        assert ask(source, before, room, 0, past) == (ends[whole], outs[whole], True), f"past {past}"
        assert ask(source[:past], before, room) == (ends[whole], outs[whole], True), f"{past} bytes"
    # From within, after the steps before.
    for k in range(len(steps)):
        assert ask(source, outs[k], room, ends[k]) == (ends[-1], outs[-1], True)
    # As soon as there are enough, it stops.
    for limit in sorted({len(out) + more for out in outs for more in (-1, 0, 1)}):
        done = next((k for k in range(len(outs)) if len(outs[k]) >= limit), len(outs) - 1)
        assert ask(source, before, limit) == (ends[done], outs[done], True), f"limit {limit}"


@pytest.mark.parametrize("have", [0, 1, 255, 256, 257, FARTHEST_BACK - 2])
@pytest.mark.parametrize("count", [3, 9])
def test_a_reference_to_before_the_first_byte_is_wrong(have: int, count: int) -> None:
    before = np.random.default_rng(have).bytes(have)
    at = len(coded(b"x"))
    assert ask(coded(b"x") + coded((have + 2, count)), before, 1 << 14) == (at, before + b"x", False)
    right = coded(b"x") + coded((have + 1, count))
    assert ask(right, before, 1 << 14) == (len(right), meant(before + b"x", (have + 1, count)), True)
