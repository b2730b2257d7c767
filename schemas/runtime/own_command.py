"""The command `solidcloud` as a shell can run it: `.venv/bin` is often not on the search path."""

import os
import re
import shlex
import shutil
import sys

NAME = "solidcloud"
# Subcommands, by which messages name the command; server/cli/main.py declares them.
VERBS = (
    *("accuracy", "add", "build", "doctor", "export", "info", "inspect", "loadtest", "make", "plan"),
    *("query", "reload", "remove", "replay", "scene", "serve", "top", "validate", "view"),
)
_MENTION = re.compile(rf"(?<![\w./-]){NAME} (?=(?:{'|'.join(VERBS)})\b|--)")


def own_command() -> str:
    """Return the words by which a shell in the working directory runs this installation.

    They are `solidcloud` if the search path has it, else the path of its script, else a call of
    Python.
    """
    script = _script()
    if script is None:
        return shlex.join([sys.executable or "python3", "-m", f"{NAME}.server.cli.main"])
    found = shutil.which(NAME)
    if found is not None and os.path.samefile(found, script):
        return NAME
    short = shown_path(script)
    return short if os.sep in short else os.path.join(os.curdir, short)


def shown_path(path: str | os.PathLike[str]) -> str:
    """Return a path as a word of a shell, relative if it is below the working directory."""
    short = os.path.relpath(path)
    return shlex.quote(os.path.abspath(path) if short.startswith(os.pardir) else short)


def with_own_command(text: str) -> str:
    """Return a text in which `solidcloud VERB` is written as a shell can run it."""
    return _MENTION.sub(lambda _: f"{own_command()} ", text)


def path_advice() -> str:
    """Return lines that say how to run the command, "" if the search path has it."""
    own = own_command()
    if own == NAME:
        return ""
    script = _script()
    advice = f"{NAME} is not on the search path. Run it as:\n  {own}"
    if script is not None:
        advice += f'\nor first:\n  export PATH={shlex.quote(os.path.dirname(script))}:"$PATH"'
    return advice


def _script() -> str | None:
    """Return the absolute path of this installation's script; None if it has none."""
    beside = os.path.join(os.path.dirname(sys.executable), NAME)
    for path in (sys.argv[0] if sys.argv else "", beside):
        if os.path.basename(path) == NAME and os.path.isfile(path):
            return os.path.abspath(path)
    return None
