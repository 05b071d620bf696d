"""How a command ends: one message and an exit code for whatever a user can cause, a traceback for a fault of ours."""

import errno
import os
import sys
from typing import cast

import typer

from simpel_cli.errors import ConfigError, Interrupted, SimpelError
from simpel_cli.runs.interruption import never_lost

UsageError: type[Exception] = typer.BadParameter.__bases__[0]  # Typer exports the special case only


def run(app: typer.Typer) -> None:
    """Run the command line and end the process."""
    try:
        # not standalone: errors come to us, so that they are one line each and an interrupt has its exit code
        with never_lost():
            code = app(sys.argv[1:] or ["--help"], prog_name="simpel", standalone_mode=False)
        if code == Interrupted.exit_code:  # Typer makes this of Ctrl-C
            raise typer.Abort
        sys.exit(code)
    except SimpelError as error:
        _fail(str(error), error.exit_code)
    except typer.Abort:
        _fail("interrupted.", Interrupted.exit_code)
    except UsageError as error:
        message = cast(typer.BadParameter, error).format_message()
        end = "" if message.endswith((".", "?")) else "."
        _fail(f"{message}{end} See `{_command_path(error)} --help`.", ConfigError.exit_code)
    except BrokenPipeError:
        # the reader of `--cfg` went away: end quietly, as other tools do (a run goes on, see `Terminal`)
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except OSError as error:
        _fail(_of_the_disk(error), 1)


def _of_the_disk(error: OSError) -> str:
    """Say what the system does not allow; anything else is a fault of ours, and shows where."""
    if error.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EPERM, errno.EIO):
        raise error
    where = f"{error.filename}: " if error.filename else ""
    return (
        f"{where}{error.strerror}. What was complete before is kept; make room or give another place (hydra.run.dir=DIR), and "
        "go on with --resume where the run has begun."
    )


def _command_path(error: Exception) -> str:
    context = cast(typer.BadParameter, error).ctx
    return context.command_path if context is not None else "simpel"


def _fail(message: str, code: int) -> None:
    label = "stopped" if code == Interrupted.exit_code else "error"
    sys.stderr.write(f"{label}: {message}\n")
    sys.exit(code)
