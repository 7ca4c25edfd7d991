"""The command line: ``sim2gp COMMAND``; each command loads what it needs when it runs.

Exit codes: 0 done, 1 a bug of ours (or a fit that failed), 2 the user's input, 74 the
disk, 75 the run is another process's, 130 and 143 interrupted. Results go to stdout,
everything else to stderr; an error is one line, and ``--debug`` shows its traceback.
"""

import contextlib
import os
import shlex
import sys
import traceback
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NoReturn

from sim2gp.cli.arguments import parse_command
from sim2gp.cli.commands import COMMANDS
from sim2gp.cli.interrupts import DONE, interruptible, leave
from sim2gp.cli.kept_programs import keep_programs
from sim2gp.cli.late import Call
from sim2gp.errors import InputError, Sim2GPError, Sim2GPWarning, error
from sim2gp.runs import DiskError, Progress, RunOwned
from sim2gp.runs.plain import to_json
from sim2gp.runs.show import print_summary
from sim2gp.runs.store import disk_error

OK, BUG, INPUT, DISK, OWNED = 0, 1, 2, 74, 75


def entry() -> NoReturn:
    """The command of the process itself, which ends with it."""
    leave(main())


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code.

    Without ``argv`` the command is the process's own: a signal then ends the process
    within seconds, even where compiled code runs (`sim2gp.cli.interrupts`).
    """
    # LAPACK's threads wait for each other where cores are busy: an elimination of ten
    # windows took 54 to 840 ms in place of 2 to 4, next to four other processes (idle,
    # 1.2 in place of 1.9). It is SciPy's, loaded when JAX first asks, later than here.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    args = list(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in args
    with interruptible(entry=argv is None) as signals:
        try:
            code = _run_command(args)
            sys.stdout.flush()  # a closed pipe is no error here; at exit it is one
            return code
        except BaseException as error:
            # What a signal raises may arrive as an error of a library on its way.
            if signals.number is None and not isinstance(error, KeyboardInterrupt):
                return _failed(error, debug)
            print(DONE, file=sys.stderr)
            return signals.exit_code


def _failed(caught: BaseException, debug: bool) -> int:
    """Say in one line what went wrong; returns the exit code."""
    if isinstance(caught, BrokenPipeError):
        # The reader of our output has gone: the interpreter must not flush into it.
        with open(os.devnull, "w") as nowhere:
            os.dup2(nowhere.fileno(), sys.stdout.fileno())
        return OK
    if isinstance(caught, Sim2GPError):
        return _print_error(caught, _exit_code(caught), debug)
    if isinstance(caught, OSError):
        typed = disk_error(Path(caught.filename or "."), caught)
        return _print_error(typed, _exit_code(typed), debug)
    if isinstance(caught, Exception):
        what = f"{type(caught).__name__}: {caught}".split("\n")[0][:200]
        return _print_error(error("fault_of_sim2gp", Sim2GPError, got=what), BUG, debug)
    raise caught


def _run_command(args: list[str]) -> int:
    if args == ["--version"]:
        from sim2gp import __version__

        print(f"sim2gp {__version__}")
        return OK
    command = parse_command(args or ["--help"], COMMANDS)
    if command is None:
        return OK if args else INPUT
    if not command.no_cache:
        keep_programs(os.environ)
    progress = Progress(quiet=command.quiet)
    with warnings.catch_warnings():
        warnings.simplefilter("always", Sim2GPWarning)
        warnings.showwarning = _warner(progress, warnings.showwarning)
        # What a library prints must not mix with the summary.
        with contextlib.redirect_stdout(sys.stderr):
            call = Call(progress, shlex.join(["sim2gp", *args]))
            summary = command.run(call)  # type: ignore[attr-defined]
    for note in summary.get("warnings", ()):
        progress.say(str(note))
    name = args[0]
    if command.json:
        sys.stdout.write(to_json(summary))
    else:
        run = call.run
        print_summary(
            summary,
            f"sim2gp {name}",
            answers=_answers(summary, run) if run else None,
            files=(*call.files, str(run / "report.html")) if run else (),
            verbose=command.verbose,
        )
    sys.stdout.flush()
    return BUG if summary.get("passed") is False else OK


def _answers(summary: dict[str, Any], run: Path) -> dict[str, str]:
    """What the report says first, with the run's own folder in its commands."""
    if summary.get("command") != "identify":
        return {}
    from sim2gp.reports.glance import glance

    place = shlex.quote(str(run))
    return {q: text.replace("RUN", place) for q, text in glance(summary).items()}


def _warner(progress: Progress, other: Callable[..., None]) -> Callable[..., None]:
    """Our own warnings as one line; everybody else's as ever."""

    def show(message: Any, category: type[Warning], *place: Any, **more: Any) -> None:
        if issubclass(category, Sim2GPWarning):
            progress.say(str(message))
        else:
            other(message, category, *place, **more)

    return show


def _exit_code(error: Sim2GPError) -> int:
    if isinstance(error, RunOwned):
        return OWNED
    if isinstance(error, DiskError):
        return DISK
    return INPUT if isinstance(error, InputError) or error.code == "E146" else BUG


def _print_error(error: Exception, code: int, debug: bool) -> int:
    if debug:
        traceback.print_exc()
    print(str(error), file=sys.stderr)
    return code
