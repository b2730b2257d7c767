"""Declarations of the questions: what must agree with them, and cannot read them."""

import inspect
from importlib.resources import files
from typing import get_args

import pytest
import wire_sections
from solidcloud.schemas.wire.answers import Part
from solidcloud.schemas.wire.path_messages import PathOperation, PathRequest
from solidcloud.schemas.wire.question_table import QUESTIONS, path_questions, question_of
from solidcloud.server.cli.commands.query_command import query
from solidcloud.server.queries.engine_table import ENGINES
from solidcloud.server.scene_interface import QueryMethods

WIRE = (files("solidcloud.schemas") / "WIRE.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("question", QUESTIONS.values(), ids=lambda question: question.name)
def test_wire_md_describes_every_field(question):
    assert wire_sections.faults(question, WIRE) == []


@pytest.mark.parametrize("question", QUESTIONS.values(), ids=lambda question: question.name)
def test_a_question_has_a_method_an_engine_and_options(question):
    assert question.name in ENGINES
    assert question_of(question.answers) is question
    method = list(inspect.signature(getattr(QueryMethods, question.name)).parameters)[1:-1]
    assert [name.replace("name", "avatar") for name in method] == list(question.arguments)
    options = inspect.signature(query).parameters
    assert {*question.parameters, *question.options} <= set(options)


def test_paths_are_of_the_questions_with_parts():
    assert get_args(PathOperation) == tuple(path_questions())
    assert set(get_args(Part)) == {question.part for question in path_questions().values()}
    for question in path_questions().values():
        assert {*question.parameters, *question.options} <= set(PathRequest.__struct_fields__)
        assert issubclass(question.part, question.answers)


def test_defaults_of_parameters_are_those_of_the_methods():
    for question in QUESTIONS.values():
        parameters = inspect.signature(getattr(QueryMethods, question.name)).parameters
        for name in question.parameters:
            default = parameters[name].default
            assert (default is inspect.Parameter.empty) == (name in question.required)
            if name not in question.required:
                assert default == inspect.signature(question.request).parameters[name].default
