"""Files that are written whole or not at all, and checked before they are read."""

import io
import json
import os
import shutil
import warnings
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeAlias
from uuid import uuid4

from stable_baselines3.common.save_util import open_path

PathOrFile: TypeAlias = str | Path | io.BufferedIOBase

# What zipfile raises for bytes that have changed
READ_ERRORS = (zipfile.BadZipFile, NotImplementedError, RuntimeError, EOFError, OSError, ValueError, zlib.error)


@contextmanager
def atomic_write(target: PathOrFile) -> Iterator[io.BytesIO]:
    """Yield a buffer that replaces a file at the end of the block; if the block fails, the file stays as it was."""
    buffer = io.BytesIO()
    if isinstance(target, (str, Path)):
        yield buffer
        replace(save_path(Path(target)), buffer.getvalue())
    else:
        file = open_path(target, "w")
        yield buffer
        file.write(buffer.getvalue())


def save_path(path: Path) -> Path:
    """Return where Stable-Baselines3 saves to: with a suffix, beside a folder of that name, behind a link."""
    path = path if path.suffix else path.with_name(f"{path.name}.zip")
    if path.is_dir():
        warnings.warn(f"{path} is a folder: the model is saved to {path}_2", stacklevel=5)
        path = path.with_name(f"{path.name}_2")
    return path.resolve()


def replace(path: Path, content: bytes) -> None:
    """Replace a file in one step and keep its permissions; at each moment either the old file or the new one exists."""
    temporary = path.with_name(f".{uuid4().hex}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with open(temporary, "xb") as file:
                if path.exists():
                    shutil.copymode(path, temporary)
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error


def check_archive(source: PathOrFile, needed: tuple[str, ...]) -> set[str]:
    """Check that a saved model has the needed parts and the right checksums, and return the names of its attributes."""
    file: Any = open_path(source, "r", suffix="zip")
    start = file.tell()
    try:
        with zipfile.ZipFile(file) as archive:
            parts = archive.namelist()
            damaged = archive.testzip()
            attributes = set() if damaged or "data" not in parts else set(json.loads(archive.read("data")))
    except READ_ERRORS as error:
        raise ValueError(f"{source} is damaged, or not a saved model: {error}") from error
    finally:
        if isinstance(source, (str, Path)):
            file.close()
        else:
            file.seek(start)
    if damaged is not None:
        raise ValueError(f"{source} is damaged: the checksum of its part {damaged!r} is wrong")
    missing = [name for name in needed if name not in parts]
    if missing:
        raise ValueError(f"{source} is not a saved model, or not a whole one: it has no {', '.join(missing)}")
    return attributes
