"""A model is saved whole or not at all, a damaged file is named."""

import io
import os
import pickle
import re
import signal
import threading
import zipfile
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
import torch as th
from environments import Corridor
from models import KINDS, both, make
from processes import in_processes
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import CheckpointCallback, EvalCallback
from stable_baselines3.common.monitor import Monitor

from sb3_reinforce import REINFORCE, FiniteDifference

FULL = OSError(28, "No space left on device")
SAVES = {
    "str": lambda model, folder: model.save(str(folder / "best_model")),
    "Path": lambda model, folder: model.save(folder / "best_model"),
    "EvalCallback": lambda model, folder: model.learn(
        64, EvalCallback(Monitor(Corridor()), eval_freq=4, best_model_save_path=folder, verbose=0, warn=False)
    ),
    "CheckpointCallback": lambda model, folder: model.learn(64, CheckpointCallback(4, folder, "best", verbose=0)),
}


@pytest.mark.parametrize(
    ("place", "function", "error"),
    [(None, "", TypeError()), (th, "save", KeyboardInterrupt()), (os, "fsync", FULL), (os, "replace", FULL)],
)
@pytest.mark.parametrize("save", SAVES)
def test_a_save_that_fails_leaves_the_old_file_and_no_other(save, place, function, error, tmp_path, monkeypatch):
    model = make("search" if save == "Path" else "steps", Corridor())
    model.save(tmp_path / "best_model.zip")
    before = (tmp_path / "best_model.zip").read_bytes()
    if place is None:
        model.lock = threading.Lock()
    else:
        monkeypatch.setattr(place, function, mock.Mock(side_effect=error))
    with pytest.raises(type(error)):
        SAVES[save](model, tmp_path)
    monkeypatch.undo()
    assert os.listdir(tmp_path) == ["best_model.zip"] and (tmp_path / "best_model.zip").read_bytes() == before


def test_a_process_that_is_killed_while_it_saves_leaves_the_old_file(tmp_path):
    model = make("steps")
    model.save(tmp_path / "model")
    before = (tmp_path / "model.zip").read_bytes()

    def save_and_die(rank):
        os.fsync = lambda file: os.kill(os.getpid(), signal.SIGKILL)
        model.save(tmp_path / "model")
        return "saved"

    # None of a process that has died
    assert in_processes(1, save_and_die, tmp_path) == [None]
    assert (tmp_path / "model.zip").read_bytes() == before


def test_the_longest_name_and_the_permissions_of_the_file_before(tmp_path):
    path = tmp_path / f"{'x' * 251}.zip"
    model = make("steps")
    model.save(path)
    for mode in (0o600, 0o640, 0o664):
        path.chmod(mode)
        model.save(path)
        assert path.stat().st_mode & 0o777 == mode and os.listdir(tmp_path) == [path.name]


def test_where_it_saves(tmp_path, monkeypatch):
    """As Stable-Baselines3: .zip where there is no suffix, folders are made, a folder of that name is left alone."""
    model = make("steps")
    model.save(tmp_path / "new" / "folder" / "model")
    model.save(str(tmp_path / "model.pkl"))
    (tmp_path / "taken.zip").mkdir()
    with pytest.warns(UserWarning, match="is a folder"):
        model.save(tmp_path / "taken")
    monkeypatch.chdir(tmp_path)
    model.save("here")
    os.symlink(tmp_path / "here.zip", tmp_path / "link.zip")
    model.save("link")
    assert (tmp_path / "link.zip").is_symlink()
    names = {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file()}
    assert names == {"new/folder/model.zip", "model.pkl", "taken.zip_2", "here.zip", "link.zip"}
    for name in names:
        KINDS["steps"][0].load(tmp_path / name, device="cpu")
    assert (tmp_path / "here.zip").stat().st_mode == (tmp_path / "new").stat().st_mode & 0o666 | 0o100000


def test_a_parent_that_is_a_file(tmp_path):
    (tmp_path / "file").write_text("mine")
    for path in (tmp_path / "file" / "model", tmp_path / "file" / "folder" / "model"):
        with pytest.raises(OSError, match=re.escape(f"{path}.zip")):
            make("steps").save(path)
    assert (tmp_path / "file").read_text() == "mine"


@both
def test_files_that_are_open(kind, tmp_path):
    model, buffer = make(kind), io.BytesIO()
    model.save(buffer)
    buffer.seek(0)
    loaded = KINDS[kind][0].load(buffer, device="cpu")
    assert all(map(th.equal, model.policy.parameters(), loaded.policy.parameters()))
    with open(tmp_path / "model", "wb") as file:
        model.save(file)
    KINDS[kind][0].load(tmp_path / "model", device="cpu")
    with pytest.raises(TypeError, match="invalid type"):
        model.save(3)
    model.lock = threading.Lock()
    empty = io.BytesIO()
    with pytest.raises(TypeError, match="pickle"):
        model.save(empty)
    assert empty.getvalue() == b""


def flip(content, i):
    return content[:i] + bytes([content[i] ^ 0xFF]) + content[i + 1 :]


@both
def test_a_damaged_file_is_named(kind, tmp_path):
    model, path = make(kind), tmp_path / "model.zip"
    model.save(path)
    content, parts = path.read_bytes(), zipfile.ZipFile(path).namelist()
    damaged = [b"", b"x" * 1000, content[: len(content) // 2], content[:-1]]
    with zipfile.ZipFile(path) as archive:
        for part in parts:
            # A zip file repeats the name before the content
            middle = content.index(part.encode(), archive.getinfo(part).header_offset) + len(part) + 40
            damaged.append(flip(content, middle))
    for each in damaged:
        path.write_bytes(each)
        for load in (KINDS[kind][0].load, model.set_parameters):
            with pytest.raises(ValueError, match=r"model\.zip is damaged"):
                load(path)


def test_no_flipped_byte_changes_a_parameter_unnoticed(tmp_path):
    model, path = make("steps"), tmp_path / "model.zip"
    model.save(path)
    content, other = path.read_bytes(), make("steps")
    start = model.get_parameters()["policy"]
    noticed = 0
    for i in np.random.default_rng(0).integers(len(content), size=150):
        path.write_bytes(flip(content, i))
        try:
            other.set_parameters(path)
        except ValueError:
            noticed += 1
        else:
            assert all(th.equal(value, start[name]) for name, value in other.get_parameters()["policy"].items())
    assert noticed > 75


def copy_zip(source, target, changes):
    """Copy a zip file with other contents of some parts, or without those whose content is None."""
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w") as new:
        for name in old.namelist():
            content = changes.get(name, old.read(name))
            if content is not None:
                new.writestr(name, content)


@both
@pytest.mark.parametrize("part", ["data", "policy.pth"])
def test_a_file_without_one_of_its_parts(part, kind, tmp_path):
    make(kind).save(tmp_path / "whole")
    copy_zip(tmp_path / "whole.zip", tmp_path / "part.zip", {part: None})
    with pytest.raises(ValueError, match=rf"part is not a saved model, or not a whole one: it has no {part}"):
        KINDS[kind][0].load(tmp_path / "part")
    with pytest.raises(FileNotFoundError):
        KINDS[kind][0].load(tmp_path / "nothing")


@pytest.mark.parametrize("kind", [*KINDS, "PPO"])
def test_the_file_of_another_algorithm_is_named_with_a_remedy(kind, tmp_path):
    (PPO("MlpPolicy", "CartPole-v1", device="cpu") if kind == "PPO" else make(kind)).save(tmp_path / "other")
    for algorithm in {REINFORCE, FiniteDifference} - {KINDS.get(kind, (None,))[0]}:
        with pytest.raises(ValueError, match=r"other was not saved by a .* set_parameters .* exact_match=False"):
            algorithm.load(tmp_path / "other")


class Malicious:
    """Writes a file when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


@both
def test_parameters_are_read_without_running_code(kind, tmp_path):
    """``load`` runs pickled code, as in Stable-Baselines3; ``set_parameters`` reads tensors alone."""
    model = make(kind)
    model.trap = Malicious(tmp_path / "ran")
    model.save(tmp_path / "model")
    fresh = make(kind)
    fresh.set_parameters(tmp_path / "model")
    assert not (tmp_path / "ran").exists()
    assert all(map(th.equal, model.policy.parameters(), fresh.policy.parameters()))
    pickled = io.BytesIO()
    th.save(model.trap, pickled)
    copy_zip(tmp_path / "model.zip", tmp_path / "trap.zip", {"policy.pth": pickled.getvalue()})
    with pytest.raises(pickle.UnpicklingError):
        fresh.set_parameters(tmp_path / "trap")
    assert not (tmp_path / "ran").exists()
    KINDS[kind][0].load(tmp_path / "model", device="cpu")
    assert (tmp_path / "ran").exists()
