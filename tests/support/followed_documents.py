"""A reader who follows a document: its commands, Python and files, from top to bottom, in one folder."""

import contextlib
import io
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

from solidcloud.schemas.wire.warming_parts import READY_LINE

ROOT = Path(__file__).resolve().parents[2]
DOCUMENTED_ENDPOINT = "tcp/127.0.0.1:7447"
# Option by which each command is told the endpoint of this reader's server, since the documented one may be in use.
ENDPOINT_OPTIONS = {"serve": "--listen", "query": "--connect", "reload": "--connect", "top": "--connect"}
READY_SECONDS, COMMAND_SECONDS, STOP_SECONDS = 400.0, 400.0, 20.0


class Block(NamedTuple):
    """Fenced block of a document. language: after the fence.  line: of its first line of text."""

    document: Path
    line: int
    language: str
    text: str

    @property
    def place(self) -> str:
        """Return the document and line, for messages."""
        return f"{self.document.name}:{self.line}"


def blocks(document: Path) -> list[Block]:
    """Return the fenced blocks of a document, in order."""
    text = document.read_text()
    return [
        Block(document, text.count("\n", 0, found.start(2)) + 1, found[1], found[2])
        for found in re.finditer(r"^```(\w*)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    ]


class Reader:
    """A reader in a folder, with the environment's commands on the path; a context manager.

    A command `solidcloud serve` runs until the document's next one, or until the end of the `with`.
    The scripts of the checkout are not run: they install the environment, and run this test.
    """

    def __init__(self, folder: Path, endpoint: str) -> None:
        self.folder, self.endpoint = folder, endpoint
        self._server: subprocess.Popen[str] | None = None
        path = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", os.defpath)])
        self._environment = {**os.environ, "PATH": path}

    def __enter__(self) -> "Reader":
        return self

    def __exit__(self, *_: object) -> None:
        self._stop_server()

    def follow(self, document: Path) -> None:
        """Do what a document's blocks say, in order.

        sh: commands, one per line.  python: in one namespace for the whole document.  toml whose
        first line is a comment with a file name: that file.  text after sh or python: what they
        print; `…` stands for anything.
        """
        names: dict[str, Any] = {"__name__": "__main__"}
        for block, after in pairwise([*blocks(document), None]):
            assert block is not None
            if block.language not in ("sh", "python"):
                self._write_file(block)
                continue
            printed = self._commands(block) if block.language == "sh" else self._python(block, names)
            if after is not None and after.language == "text":
                expected = re.escape(after.text.strip()).replace("…", ".*?")
                assert re.fullmatch(expected, printed.strip(), re.DOTALL), f"{after.place}: found\n{printed}"

    def _write_file(self, block: Block) -> None:
        """Write the file that a block of TOML shows."""
        name = re.match(r"# ([\w-]+\.toml)\n", block.text)
        if block.language == "toml" and name:
            (self.folder / name[1]).write_text(block.text)

    def _python(self, block: Block, names: dict[str, Any]) -> str:
        """Run a block of Python; return what it prints."""
        text = "\n" * (block.line - 1) + self._with_endpoint(block.text)
        printed = io.StringIO()
        with contextlib.chdir(self.folder), contextlib.redirect_stdout(printed):
            exec(compile(text, str(block.document), "exec"), names)
        return printed.getvalue()

    def _commands(self, block: Block) -> str:
        """Run a block of commands; return what they print."""
        return "".join(self._command(line, block.place) for line in _lines(block.text))

    def _command(self, line: str, place: str) -> str:
        """Run one command; return what it prints."""
        words = line.split()
        if words[0].startswith("scripts/"):
            assert os.access(ROOT / words[0], os.X_OK), f"{place}: {words[0]}: no such script"
            return ""
        if words[0] == "solidcloud" and words[1] in ENDPOINT_OPTIONS and DOCUMENTED_ENDPOINT not in line:
            line += f" {ENDPOINT_OPTIONS[words[1]]} {self.endpoint}"
        line = self._with_endpoint(line)
        if words[:2] == ["solidcloud", "serve"]:
            self._serve(line, place)
            return ""
        done = subprocess.run(
            ["sh", "-c", line],
            cwd=self.folder,
            env=self._environment,
            capture_output=True,
            text=True,
            timeout=COMMAND_SECONDS,
        )
        assert done.returncode == 0, f"{place}: {line}: exit code {done.returncode}\n{done.stderr}"
        return done.stdout

    def _with_endpoint(self, text: str) -> str:
        """Replace the documented endpoint by this reader's."""
        return text.replace(DOCUMENTED_ENDPOINT, self.endpoint)

    def _serve(self, line: str, place: str) -> None:
        """Start a server and wait until it serves."""
        self._stop_server()
        log = self.folder / "serve.log"
        with log.open("w") as errors:
            self._server = subprocess.Popen(
                ["sh", "-c", f"exec {line}"],
                cwd=self.folder,
                env=self._environment,
                stdout=subprocess.PIPE,
                stderr=errors,
                text=True,
            )
        assert self._server.stdout is not None
        first, second = _first_lines(self._server)
        assert first.startswith("serving "), f"{place}: {line}: found {first!r}\n{log.read_text()}"
        assert second.strip() == READY_LINE, f"{place}: {line}: found {second!r}\n{log.read_text()}"

    def _stop_server(self) -> None:
        """Stop the server, as Ctrl-C would."""
        server, self._server = self._server, None
        if server is None:
            return
        server.terminate()
        try:
            server.wait(STOP_SECONDS)
        finally:
            server.kill()
            server.communicate()


def _lines(text: str) -> Iterator[str]:
    """Yield the commands of a block without their comments."""
    for line in text.splitlines():
        command = re.sub(r"(^|\s)#.*", "", line).strip()
        if command:
            yield command


def _first_lines(process: "subprocess.Popen[str]") -> tuple[str, str]:
    """Return the first two lines that a process prints; "" for each that it does not print in time."""
    import threading

    timer = threading.Timer(READY_SECONDS, process.kill)
    timer.start()
    try:
        assert process.stdout is not None
        return process.stdout.readline(), process.stdout.readline()
    finally:
        timer.cancel()
