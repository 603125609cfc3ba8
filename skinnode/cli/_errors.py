"""Runs a typer application and reports each error as one line on stderr, with exit status 2."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any, Literal, get_args, get_origin

import typer

from skinnode.cli._exit_status import COULD_NOT_RUN, FINE, closed_pipe
from skinnode.errors import ConfigError, SkinError
from skinnode.text.printable import PrintableStream

_UsageError: type[Exception] = typer.BadParameter.__mro__[1]  # from click, or from typer's own copy of click


def run(app: typer.Typer, argv: Sequence[str] | None = None) -> int:
    """Run ``app`` and return its exit status.

    A SkinError, a file error or an invalid argument is printed as one line on stderr; the status is 2.

    Args:
        app: The application.
        argv: Command-line arguments; default: the arguments of the process.
    """
    sys.stdout, sys.stderr = _printable(sys.stdout), _printable(sys.stderr)
    try:
        status = app(args=argv, standalone_mode=False)
    except _UsageError as error:
        return COULD_NOT_RUN if _wants_help(error) else _refused(usage_line(error))
    except typer.Abort:
        return _refused("not confirmed; nothing was changed")
    except BrokenPipeError:
        return closed_pipe()
    except SystemExit as ended:
        if isinstance(ended.__context__, BrokenPipeError):  # typer returns status 1 for a closed pipe
            return closed_pipe()
        raise
    except (SkinError, ValueError, OSError) as error:
        return _refused(_line_of(error))
    return status if isinstance(status, int) else FINE


def _printable(stream: Any) -> Any:
    """Wrap ``stream`` to escape control characters and characters that its encoding cannot represent."""
    if hasattr(stream, "reconfigure"):
        stream.reconfigure(errors="backslashreplace")
    return stream if stream is None or isinstance(stream, PrintableStream) else PrintableStream(stream)


def _line_of(error: Exception) -> str:
    if isinstance(error, OSError) and error.strerror and error.filename is not None:
        return str(ConfigError(error.strerror, str(error.filename), "an accessible file or folder"))
    return " ".join(str(error).split())


def _refused(line: str) -> int:
    print(f"error: {line}", file=sys.stderr)
    return COULD_NOT_RUN


def _wants_help(error: Any) -> bool:
    """Return whether a command group was called without a command; if so, print the group's help."""
    if type(error).__name__ != "NoArgsIsHelpError":
        return False
    text = error.ctx.get_help()  # if rich is in use, get_help() prints the help and returns no text
    if text:
        typer.echo(text, err=True)
    return True


def usage_line(error: Any) -> str:
    """Return a usage error as one line, such as ``skinnode scan: --bitrate: got 'x', allowed: an integer``.

    For a missing or invalid value, Typer's own message omits the meaning of the argument, the value given or
    the allowed range.
    """
    message = " ".join(error.format_message().split()).rstrip(".")
    param, kind = getattr(error, "param", None), type(error).__name__
    if param is not None and kind == "MissingParameter":
        message = f"{_name(param)}: got nothing, allowed: {_meaning(param)}"
    elif param is not None and kind == "BadParameter":
        got, _, allowed = message.rpartition(": ")[2].partition(" is not ")
        if error.__cause__ is not None and hasattr(error.__cause__, "errors"):  # typer converts with pydantic
            got, allowed = repr(error.__cause__.errors()[0]["input"]), ""
        message = f"{_name(param)}: got {got}, allowed: {allowed or _values(param)}"
    else:
        message = message[:1].lower() + message[1:]
    return f"{error.ctx.command_path}: {message}" if error.ctx is not None else message


def _name(param: Any) -> str:
    """Return the name of a parameter as shown to the user: the option, or the argument's name in the help."""
    if param.param_type_name == "option":
        return str(max(param.opts, key=len))
    return str(param.metavar or param.name.upper())


def _meaning(param: Any) -> str:
    """Return the first sentence of a parameter's help text."""
    help_text = str(getattr(param, "help", None) or "a value").split(". ")[0].rstrip(".")
    return help_text[:1].lower() + help_text[1:]


def _values(param: Any) -> str:
    """Return the allowed numbers or words of a parameter as text; empty if any value is allowed."""
    converter = getattr(param, "type", param)
    described = getattr(getattr(param, "type_descriptor", None), "annotation", None)
    if get_origin(described) is Literal:
        return " or ".join(map(str, get_args(described)))
    name = described.__name__ if isinstance(described, type) else getattr(converter, "name", "")
    number = {"int": "an integer", "float": "a number"}.get(name.partition(" ")[0].replace("integer", "int"))
    low, high = getattr(converter, "min", None), getattr(converter, "max", None)
    if number is None or low is None:
        return number or ""
    return f"{number} of at least {low}" if high is None else f"{number} from {low} to {high}"
