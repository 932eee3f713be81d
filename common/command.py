"""What the command lines have in common: settings from options, and an error of ours as one line."""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Callable, Mapping
from typing import Annotated, Any, NoReturn, TypeVar

import typer
from pydantic import BaseModel, ValidationError
from rich.console import Console
from rich.text import Text

from common.errors import ParameterError, SurfacelinkError
from common.problems import problem_of_fields
from common.version import product_version

Model = TypeVar("Model", bound=BaseModel)

NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""Errors of a full disk."""


def settings_from(model: type[Model], options: Mapping[str, Any]) -> Model:
    """Settings from the options that are not None, the rest from the environment.

    Raises ParameterError, which names the option or the variable that is wrong.
    """
    given = {name: value for name, value in options.items() if value is not None}

    def typed(name: str) -> str:
        return f"--{name.replace('_', '-')}" if name in given else _variable(model, name)

    try:
        return model(**given)
    except ValidationError as error:
        found = [{**each, "loc": (typed(str(each["loc"][0])),)} for each in error.errors()]
        raise ParameterError(problem_of_fields(found).detail) from error


def about(model: type[BaseModel], name: str) -> str:
    """What the command line says of a setting: the settings' own words, the variable and the default."""
    setting = model.model_fields[name]
    return f"{setting.description} ({_variable(model, name)}, {setting.default})"


def _variable(model: type[BaseModel], name: str) -> str:
    return f"{model.model_config.get('env_prefix', '')}{name}".upper()


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(product_version())
        raise typer.Exit


def command_line(name: str, purpose: str) -> typer.Typer:
    """A command line that has no command yet, and says what it is for and which version it is."""
    app = typer.Typer(
        name=name, help=purpose, no_args_is_help=True, pretty_exceptions_enable=False, add_completion=False
    )

    # Without it a command that is the only one would lose its name.
    @app.callback()
    def before_any_command(
        version: Annotated[
            bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and leave.")
        ] = False,
    ) -> None:
        pass

    return app


def run(command: Callable[[], object]) -> None:
    """Run a command line; an error of ours, and output that a disk has no room for, is one line on stderr and exit
    status 1. A pipe that is closed ends it without a word: rich and typer see to that."""
    try:
        command()
    except SurfacelinkError as error:
        _leave(str(error))
    except OSError as error:
        if error.errno not in NO_ROOM:
            raise
        # Python writes what is left in the buffer when it ends, and would complain once more.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        _leave(f"the output cannot be written: {error.strerror}")


def _leave(reason: str) -> NoReturn:
    Console(stderr=True).print(Text.assemble(("error: ", "bold red"), reason), soft_wrap=True)
    sys.exit(1)
