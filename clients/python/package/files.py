"""Files of the programs `adopt` and `plot`, and data sets: what is wrong with a file becomes one line."""

from __future__ import annotations

import contextlib
import os
import sys
from typing import Iterator, Union

Path = Union[str, "os.PathLike[str]"]


class BadFile(ValueError):
    """A file is not what it should be. The message names it."""


@contextlib.contextmanager
def reading(path: Path, fault: str) -> Iterator[None]:
    """Makes a BadFile of whatever a library raises about the content of a file. An OSError that names a file stays."""
    try:
        yield
    except Exception as error:
        if isinstance(error, BadFile) or (isinstance(error, OSError) and error.filename):
            raise
        said = f"it has no {error}" if isinstance(error, KeyError) else str(error).partition("\n")[0]
        raise BadFile(f"{os.fspath(path)}: {fault}: {said or type(error).__name__}") from error


@contextlib.contextmanager
def ending(out: Path) -> Iterator[None]:
    """Ends a program that writes the file `out` with one line, if a file cannot be read or written."""
    try:
        yield
    except FileExistsError as error:
        sys.exit(f"{error.filename}: it exists already: name another file with --out")
    except OSError as error:
        sys.exit(f"{error.filename or os.fspath(out)}: {error.strerror or error}")
    except BadFile as error:
        sys.exit(str(error))


def save(path: Path, content: bytes, mode: str = "xb") -> None:
    """Writes a file. Removes what it made if that fails."""
    is_new = not os.path.lexists(path)
    file = open(path, mode)
    try:
        with file:
            file.write(content)
    except BaseException:
        if is_new:
            os.remove(path)
        raise
