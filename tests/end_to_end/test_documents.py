"""Test the documents as a reader would: every command and snippet of README, SCENE and WIRE, in order."""

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
import typer
from followed_documents import ROOT, Reader, blocks
from solidcloud.server.cli.main import app

README, SCENE, WIRE = (ROOT / name for name in ("README.md", "schemas/SCENE.md", "schemas/WIRE.md"))


@pytest.fixture(scope="module")
def reader(tmp_path_factory: pytest.TempPathFactory, free_endpoint) -> Iterator[Reader]:
    """Return a reader who has followed README.md, and whose server still runs."""
    with Reader(tmp_path_factory.mktemp("reader"), free_endpoint()) as found:
        found.follow(README)
        yield found


@pytest.mark.slow
@pytest.mark.timeout(900)  # the first start compiles everything if no kernels are kept
def test_readme_runs_from_top_to_bottom(reader: Reader) -> None:
    assert {"scans", "hall", "visitor.obj", "poses.csv"} <= {path.name for path in reader.folder.iterdir()}


@pytest.mark.slow
@pytest.mark.timeout(900)  # the first start compiles everything if no kernels are kept
def test_wire_runs_from_top_to_bottom_beside_the_readmes_server(reader: Reader) -> None:
    reader.follow(WIRE)


@pytest.mark.slow
@pytest.mark.timeout(900)  # the first start compiles everything if no kernels are kept
def test_scene_runs_from_top_to_bottom_in_the_readmes_folder(reader: Reader) -> None:
    reader.follow(SCENE)


def test_wire_begins_with_a_client_in_40_lines() -> None:
    client = blocks(WIRE)[0]
    assert client.language == "python" and client.line < 40
    assert len(client.text.splitlines()) <= 40
    assert "import zenoh" in client.text and "solidcloud import" not in client.text
    assert "import solidcloud" not in client.text and "import numpy" not in client.text


def test_every_command_that_the_readme_names_exists() -> None:
    named = set(re.findall(r"`solidcloud ([a-z]+(?: [a-z]+)?)", README.read_text()))
    assert len(named) >= 8
    for name in named:
        command = typer.main.get_command(app)
        for word in name.split():
            command = command.commands[word]


@pytest.mark.parametrize(
    "document",
    [each for pattern in ("server/*/*.md", "*/*.md", "*.md") for each in sorted(ROOT.glob(pattern))],
    ids=lambda path: str(path.relative_to(ROOT)),
)
def test_links_of_a_document_lead_somewhere(document: Path) -> None:
    text = re.sub(r"```.*?```", "", document.read_text(), flags=re.DOTALL)
    targets = re.findall(r"\]\(([^)\s]+)\)", text)
    for target in targets:
        path, _, heading = target.partition("#")
        if "://" in target:
            continue
        found = (document.parent / path).resolve() if path else document
        assert found.exists(), f"{document.name}: {target}"
        if heading:
            titles = re.findall(r"^#+ (.*)$", found.read_text(), re.MULTILINE)
            assert heading in {_anchor(title) for title in titles}, f"{document.name}: {target}"


def _anchor(title: str) -> str:
    """Return the anchor of a heading, as the pages of a repository name it."""
    return re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-")
