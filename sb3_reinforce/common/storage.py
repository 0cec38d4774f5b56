"""Files that are written whole or not at all, and checked before they are read."""

import io
import json
import os
import warnings
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeAlias
from uuid import uuid4

from stable_baselines3.common.save_util import open_path

Place: TypeAlias = str | Path | io.BufferedIOBase


@contextmanager
def whole_or_not_at_all(place: Place) -> Iterator[io.BytesIO]:
    """
    A buffer to write to, which replaces a file at the end of the block, in one step.

    If anything fails, within the block or with the disk, the file is as it was and nothing else is left. That holds for
    a killed process too, but where the system has no files without a name (O_TMPFILE, which Linux has): there a
    ``.*.tmp`` is left if the process is killed in the moment of writing.

    :param place: A path, to which ``.zip`` is added where it has no suffix, or a file opened for writing
    """
    buffer = io.BytesIO()
    if isinstance(place, (str, Path)):
        yield buffer
        replace(path_of(Path(place)), buffer.getvalue())
    else:
        file = open_path(place, "w")
        yield buffer
        file.write(buffer.getvalue())


def path_of(path: Path) -> Path:
    """
    Where a model is saved, as in Stable-Baselines3; folders that do not exist are made.

    :param path: What the user named
    :return: The file; where a link was named, what it points to
    """
    path = path if path.suffix else path.with_name(f"{path.name}.zip")
    if path.is_dir():
        warnings.warn(f"{path} is a folder: the model is saved to {path}_2", stacklevel=5)
        path = path.with_name(f"{path.name}_2")
    path.parent.mkdir(parents=True, exist_ok=True)
    return path.resolve()


def replace(path: Path, content: bytes) -> None:
    """
    Replace a file, so that at each moment either the old one or the new one is there, whole.

    :param path: The file; it need not exist. Its permissions are kept
    :param content: The new content
    :raises OSError: If it cannot be written; the old file is then still there
    """
    beside = path.with_name(f".{uuid4().hex}.tmp")
    try:
        try:
            # A file without a name vanishes with its process
            nameless = os.open(path.parent, os.O_TMPFILE | os.O_WRONLY, 0o666)
            with open(nameless, "wb") as file:
                write(file, content, path)
                # Only with a src_dir_fd, which it does not need, does this follow the link in /proc
                os.link(f"/proc/self/fd/{nameless}", beside, src_dir_fd=nameless)
        except (AttributeError, OSError):
            with open(beside, "xb") as file:
                write(file, content, path)
        os.replace(beside, path)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        beside.unlink(missing_ok=True)


def write(file: Any, content: bytes, path: Path) -> None:
    """
    Write a new file, onto the disk, with the permissions of the one that it is to replace.

    :param file: The new file
    :param content: Its content
    :param path: The old file; it need not exist
    """
    if path.exists() and hasattr(os, "fchmod"):
        os.fchmod(file.fileno(), path.stat().st_mode & 0o7777)
    file.write(content)
    file.flush()
    os.fsync(file.fileno())


def check_archive(place: Place, needed: tuple[str, ...]) -> set[str]:
    """
    Check a saved model before anything of it is used: every part is there, and each has the checksum it was saved with.

    :param place: A path or an open file
    :param needed: Names of parts that must be there
    :return: The names of the attributes in it
    :raises ValueError: If it is not a saved model, or a damaged one
    """
    file: Any = open_path(place, "r", suffix="zip")
    begin = file.tell()
    try:
        with zipfile.ZipFile(file) as archive:
            parts = archive.namelist()
            damaged = archive.testzip()
            attributes = set() if damaged or "data" not in parts else set(json.loads(archive.read("data")))
    # What zipfile raises where bytes that it relies on are others than they were
    except (zipfile.BadZipFile, NotImplementedError, RuntimeError, EOFError, OSError, ValueError, zlib.error) as error:
        raise ValueError(f"{place} is damaged, or not a saved model: {error}") from error
    finally:
        if isinstance(place, (str, Path)):
            file.close()
        else:
            file.seek(begin)
    if damaged is not None:
        raise ValueError(f"{place} is damaged: the checksum of its part {damaged!r} is wrong")
    missing = [name for name in needed if name not in parts]
    if missing:
        raise ValueError(f"{place} is not a saved model, or not a whole one: it has no {', '.join(missing)}")
    return attributes
