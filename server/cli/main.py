"""The command `solidcloud`: its subcommands (verbs), its exit codes, and completion in a shell.

Every verb imports its dependencies inside its function: `--help` must print without loading numpy.
Exit codes: 0 success; 1 failure; 2 invalid request; 3 invalid data; 130 interrupted.
"""

import contextlib
import os
import signal
import sys
from collections.abc import Callable, Sequence
from typing import Annotated, Any

import typer

from ...schemas.errors import BadRequestError, SolidcloudError
from ...schemas.runtime.interrupts import deferring_interrupts
from ...schemas.runtime.os_errors import os_error_line
from ...schemas.runtime.own_command import NAME, path_advice
from ...schemas.runtime.visible_text import show_all_output
from .commands import accuracy_command as accuracy
from .commands import doctor_command as doctor
from .commands import loadtest_command as loadtest
from .commands import query_command as query
from .commands import replay_command as replay
from .commands import scene_command as scene
from .commands import serve_command as serve
from .commands import top_command as top
from .commands import view_command as view
from .commands.archives import add_remove_command as add_remove
from .commands.archives import build_command as build
from .commands.archives import export_command as export
from .commands.archives import info_validate_command as info_validate
from .commands.archives import inspect_command as inspect
from .commands.archives import make_command as make
from .commands.archives import plan_command as plan
from .commands.command_options import print_error
from .output.compile_notice import compile_notices

# Rich markup is off: importing it doubles the time of --help, to more than the 0.3 s allowed.
app = typer.Typer(
    help="Collision queries on scanned point clouds: build an archive, serve it, query it.",
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)
makers = typer.Typer(
    help="Generate test scans, avatars and walks. The ground truth of the scans is known.",
    rich_markup_mode=None,
)
app.add_typer(makers, name="make")
makers.command("facade")(make.make_facade)
makers.command("town")(make.make_town)
makers.command("office")(make.make_office)
makers.command("figure")(make.make_figure)
makers.command("walk")(make.make_walk)
scenes = typer.Typer(help="Create a scene file, or check one.", rich_markup_mode=None)
app.add_typer(scenes, name="scene")
scenes.command("new")(scene.new)
scenes.command("check")(scene.check)
verb: Callable[..., int | None]
for verb in (
    inspect.inspect,
    build.build,
    info_validate.info,
    info_validate.validate,
    serve.serve,
    accuracy.accuracy,
    query.query,
):
    app.command()(verb)
for verb in (
    export.export,
    add_remove.add,
    add_remove.remove,
    add_remove.reload,
    plan.plan,
    view.view,
    top.top,
    loadtest.loadtest,
    replay.replay,
    doctor.doctor,
):
    app.command()(verb)

# The variable by which a shell asks for completions; its name and content are typer's.
_COMPLETION = f"_{NAME.upper()}_COMPLETE"
# Verbs that wait for a server or for a user: an interrupt ends them immediately. All other verbs
# compute, and end at their next interrupt check.
WAITING = frozenset({"serve", "view", "query", "reload", "top", "loadtest"})


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib import metadata

        print(f"{NAME} {metadata.version(NAME)}")
        raise typer.Exit


@app.callback()
def _take_options(
    version: Annotated[
        bool,
        typer.Option("--version", help="Print the version and exit.", callback=_print_version, is_eager=True),
    ] = False,
) -> None:
    """Declare the options of `solidcloud` itself."""


def main() -> None:
    """Run the command and exit."""
    if _COMPLETION in os.environ:
        app(prog_name=NAME)  # prints the completions and exits
    arguments = sys.argv[1:]
    # `serve` reports compilation until it serves. With --log-json, programs read standard error.
    quiet = not arguments or arguments[0] in (*WAITING, "doctor") or {"--log-json", "--help"} & {*arguments}
    with contextlib.nullcontext() if quiet else compile_notices():
        code = run(arguments)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # all output is printed: only Python's shutdown remains
    sys.exit(code)


def run(arguments: Sequence[str]) -> int:
    """Run the command with these arguments and return its exit code.

    An error is printed as one line, not as a traceback.
    """
    show_all_output()
    try:
        command, name, rest = _find_verb(arguments or ["--help"])
        with contextlib.nullcontext() if name.split()[-1] in WAITING else deferring_interrupts():
            return _run(command, name, rest)
    except SolidcloudError as error:
        return print_error(str(error), error.exit_code)
    except typer.TyperException as error:
        context = getattr(error, "ctx", None)
        command = context.command_path if context else "solidcloud"
        return print_error(
            f"{error.format_message().rstrip('.')}: see {command} --help", BadRequestError.exit_code
        )
    except (KeyboardInterrupt, typer.Abort) as error:
        print(": ".join(filter(None, ("interrupted", str(error)))), file=sys.stderr)
        return 130
    except BrokenPipeError:
        # The reader of the output closed the pipe. Python would raise again when it flushes at
        # exit.
        sys.stdout = None
        return 1
    except OSError as error:
        return print_error(os_error_line(error), 1)
    except MemoryError as error:
        return print_error(f"out of memory{f' ({error})' if str(error) else ''}: close other programs", 1)


def _run(command: Any, name: str, arguments: list[str]) -> int:
    """Run one verb and return its exit code. typer's own `main` prints nothing on an interrupt."""
    try:
        with command.make_context(name, arguments) as context:
            code = command.invoke(context)
    except typer.Exit as left:
        code = left.exit_code
    return code if isinstance(code, int) else 0


def _find_verb(arguments: Sequence[str]) -> tuple[Any, str, list[str]]:
    """Return the command that the first arguments name, its full name, and the remaining arguments.

    typer would parse the options of `solidcloud` first and load pydantic for it, although there are
    none: half of the time that `solidcloud build --help` takes.
    """
    command: Any = typer.main.get_command(app)
    name, rest = "solidcloud", list(arguments)
    while rest and rest[0] in getattr(command, "commands", ()):
        command = command.commands[rest[0]]
        name += f" {rest.pop(0)}"
    if advice := path_advice():
        command.epilog = "\b\n" + advice  # \b: keep the lines
    return command, name, rest


if __name__ == "__main__":
    main()
