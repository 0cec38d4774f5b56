"""Files that are written whole or not at all, and checked before they are read."""

import io
import json
import os
import shutil
import warnings
import zipfile
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeAlias

from stable_baselines3.common.save_util import open_path

PathOrFile: TypeAlias = str | Path | io.BufferedIOBase


def write_whole(target: PathOrFile, content: bytes) -> None:
    """Write to where Stable-Baselines3 saves; at each moment either the old file or the new one exists."""
    if not isinstance(target, (str, Path)):
        open_path(target, "w").write(content)
        return
    path = Path(target)
    path = path if path.suffix else path.with_name(f"{path.name}.zip")
    if path.is_dir():
        warnings.warn(f"{path} is a folder: the model is saved to {path}_2", stacklevel=3)
        path = path.with_name(f"{path.name}_2")
    # Behind a link, which stays one
    path = path.resolve()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(prefix=".", dir=path.parent) as folder:
            temporary = Path(folder, path.name)
            with open(temporary, "xb") as file:
                if path.exists():
                    shutil.copymode(path, temporary)
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            os.replace(temporary, path)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error


def check_archive(source: PathOrFile, needed: tuple[str, ...]) -> set[str]:
    """Check that a saved model has the needed parts and the right checksums, and return the names of its attributes."""
    file: Any = open_path(source, "r", suffix="zip")
    try:
        with zipfile.ZipFile(file) as archive:
            parts = archive.namelist()
            damaged = archive.testzip()
            if damaged is not None:
                raise zipfile.BadZipFile(f"the checksum of its part {damaged!r} is wrong")
            attributes = set(json.loads(archive.read("data"))) if "data" in parts else set()
    except Exception as error:
        # Bytes that have changed raise errors of many kinds
        raise ValueError(f"{source} is damaged, or not a saved model: {error}") from error
    finally:
        if isinstance(source, (str, Path)):
            file.close()
    missing = [name for name in needed if name not in parts]
    if missing:
        raise ValueError(f"{source} is not a saved model, or not a whole one: it has no {', '.join(missing)}")
    return attributes
