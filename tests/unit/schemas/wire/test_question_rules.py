"""Answers of all kinds: unknown, joined, checked, in parts; and how their arrays travel, infinities included."""

from itertools import pairwise

import msgspec
import numpy as np
import pytest
from solidcloud.schemas.errors import InternalError
from solidcloud.schemas.wire.answers import (
    CollideAnswers,
    ContactsAnswers,
    DistanceAnswers,
    ObjectsAnswers,
    Verdict,
)
from solidcloud.schemas.wire.arrays import array_fields
from solidcloud.schemas.wire.encoding import JSON, MSGPACK, decode_answer, encode
from solidcloud.schemas.wire.path_messages import answers_to_part, part_to_answers, split_answers
from solidcloud.schemas.wire.question_table import (
    QUESTIONS,
    check_answers,
    join_answers,
    make_unknown,
    path_questions,
)

KINDS = [question.answers for question in QUESTIONS.values()]


def some(kind, k, seed=1, pairs=(2, 0, 3)):
    """Answers of one kind with something else in every place. pairs: of contacts, a pose's in turn."""
    rng = np.random.default_rng([seed, k])
    starts = np.concatenate([[0], np.cumsum([pairs[i % len(pairs)] for i in range(k)])]).astype(np.int64)
    columns = {}
    for name, (dtype, tail, _) in array_fields(kind).items():
        rows = k
        if kind is ContactsAnswers and not len(getattr(make_unknown(kind, 1), name)):
            rows = int(starts[-1])
        if name in ("pairs", "pair_verdict"):
            rows = 3 if k else 0
        if dtype.kind == "f":
            columns[name] = rng.normal(size=(rows, *tail))
        elif name.endswith("verdict") or dtype.kind == "b":
            columns[name] = rng.integers(0, 2, rows).astype(dtype)
        else:
            columns[name] = rng.integers(0, max(k, 1), (rows, *tail)).astype(dtype)
    if kind is ContactsAnswers:
        columns |= {"pair_starts": starts, "cluster_starts": starts.copy()}
    return kind(**columns, engine_seconds=0.5, hits=3, faults=("voxel 7: checksum",))


def same(one, other):
    assert type(one) is type(other)
    for name in array_fields(type(one)):
        a, b = getattr(one, name), getattr(other, name)
        assert (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes()), name


@pytest.mark.parametrize("encoding", [MSGPACK, JSON])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("k", [0, 1, 5])
def test_answers_of_all_kinds_arrive_as_sent(kind, k, encoding):
    for sent in (some(kind, k), make_unknown(kind, k)):
        got = check_answers(decode_answer(kind, encode(sent, encoding), encoding), k)
        same(got, sent)
        assert (got.engine_seconds, got.hits, got.faults) == (sent.engine_seconds, sent.hits, sent.faults)


@pytest.mark.parametrize("kind", KINDS)
def test_what_nobody_answered_is_never_clear(kind):
    answers = make_unknown(kind, 3)
    assert answers.verdict.tolist() == [Verdict.UNKNOWN] * 3
    assert not any(getattr(answers, "exact", []))
    if kind not in (ContactsAnswers, ObjectsAnswers):
        assert np.isinf(answers.upper).all() and (answers.lower <= 0).all()
    assert len(make_unknown(CollideAnswers, 3, bounded=False).lower) == 0


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind is not ObjectsAnswers])
def test_joined_answers_are_those_of_all(kind):
    parts = [some(kind, k, seed) for seed, k in enumerate((3, 0, 5, 1))]
    whole = check_answers(join_answers(parts), 9)
    for name in array_fields(kind):
        if not name.endswith("_starts"):
            assert np.array_equal(
                getattr(whole, name), np.concatenate([getattr(part, name) for part in parts])
            )
    assert (whole.engine_seconds, whole.hits, whole.faults) == (2.0, 12, ("voxel 7: checksum",))
    if kind is ContactsAnswers:
        counts = np.concatenate([np.diff(part.pair_starts) for part in parts])
        assert np.diff(whole.pair_starts).tolist() == counts.tolist()


@pytest.mark.parametrize("question", path_questions().values(), ids=lambda question: question.name)
def test_a_part_says_where_it_belongs(question):
    kind = question.answers
    answers = some(kind, 4)
    part = answers_to_part(answers, 7, 20)
    for encoding in (MSGPACK, JSON):
        got = decode_answer(question.part, encode(part, encoding), encoding)
        assert (got.first, got.total, len(check_answers(got, 4))) == (7, 20, 4)
        same(got, part)
    assert isinstance(part, kind)
    same(part_to_answers(part), answers)


@pytest.mark.parametrize("kind", KINDS)
def test_a_column_of_the_wrong_length_is_an_internal_error(kind):
    good = some(kind, 4)
    with pytest.raises(InternalError, match="for 5 requested"):
        check_answers(good, 5)
    for name in array_fields(kind):
        column = getattr(good, name)
        for bad in (column[:-1], np.concatenate([column, column[-1:]])):
            with pytest.raises(InternalError, match="expected"):
                check_answers(msgspec.structs.replace(good, **{name: bad}), 4)
    with pytest.raises(InternalError, match="verdict 3"):
        check_answers(msgspec.structs.replace(good, verdict=np.full(4, 3, np.uint8)), 4)


def test_pairs_of_objects_that_were_not_asked_about_are_an_internal_error():
    good = some(ObjectsAnswers, 4)
    for bad in (4, -1):
        with pytest.raises(InternalError, match="not requested, of 4"):
            check_answers(msgspec.structs.replace(good, pairs=np.full((3, 2), bad, np.int32)), 4)
    with pytest.raises(InternalError, match="verdict 3"):
        check_answers(msgspec.structs.replace(good, pair_verdict=np.full(3, 3, np.uint8)), 4)


def test_null_says_least_in_json():
    text = encode(make_unknown(DistanceAnswers, 1), JSON)
    assert text.count(b"null") == 12 and b"NaN" not in text and b"Infinity" not in text
    got = decode_answer(DistanceAnswers, text, JSON)
    assert (got.lower[0], got.upper[0], got.signed_distance[0]) == (-np.inf, np.inf, np.inf)
    assert np.isnan([got.witness_avatar, got.witness_cloud, got.normal]).all()
    mixed = text.replace(b'"normal":[[null,null,null]]', b'"normal":[[1,null,0.5]]')
    assert np.array_equal(
        decode_answer(DistanceAnswers, mixed, JSON).normal, [[1, np.nan, 0.5]], equal_nan=True
    )


@pytest.mark.parametrize(
    "old, new",
    [
        (b'"lower":[null]', b'"lower":["x"]'),
        (b'"lower":[null]', b'"lower":[[null]]'),
        (b'"lower":[null]', b'"lower":[true,null]'),
        (b'"lower":[null]', b'"lower":null'),
        (b'"normal":[[null,null,null]]', b'"normal":[[null,null]]'),
        (b'"normal":[[null,null,null]]', b'"normal":[[null,null,null],null]'),
        (b'"node_visits":[0]', b'"node_visits":[null]'),
        (b'"outside":[false]', b'"outside":[null]'),
        (b'"verdict":[2]', b'"verdict":[2.0]'),
    ],
)
def test_what_is_no_column_in_json_is_an_internal_error(old, new):
    text = encode(make_unknown(DistanceAnswers, 1), JSON)
    assert old in text
    with pytest.raises(InternalError):
        decode_answer(DistanceAnswers, text.replace(old, new), JSON)


@pytest.mark.parametrize("k", [0, 1, 2, 9])
@pytest.mark.parametrize("most", [0, 2 * 184, 5 * 184 + 100, 1 << 20])
def test_contacts_in_pieces_are_joined_again(k, most):
    whole = some(ContactsAnswers, k)
    pieces = list(split_answers(whole, most))
    for piece in pieces:
        check_answers(piece, len(piece))
        assert len(piece) == 1 or 184 * int(piece.pair_starts[-1]) <= most or not k
    same(join_answers(pieces), whole)
    # None could have taken the next one's first pose.
    for piece, following in pairwise(pieces):
        assert 184 * int(piece.pair_starts[-1] + following.pair_starts[1]) > most
    assert [p.engine_seconds for p in pieces] == [0.5] + [0.0] * (len(pieces) - 1)
    assert {p.faults for p in pieces} == {whole.faults}
