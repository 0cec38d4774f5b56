"""A model is saved whole or not at all, a damaged file is named, and parameters are taken all or none."""

import io
import os
import pickle
import re
import signal
import subprocess
import sys
import threading
import warnings
import zipfile
from contextlib import nullcontext
from itertools import product
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
import torch as th
from environments import Corridor
from models import KINDS, both, make, plain
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.callbacks import CheckpointCallback, EvalCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.sb2_compat.rmsprop_tf_like import RMSpropTFLike

from sb3_reinforce import REINFORCE, FiniteDifference

NAN = float("nan")


FULL = OSError(28, "No space left on device")
SAVES = {
    "str": lambda model, folder: model.save(str(folder / "best_model")),
    "Path": lambda model, folder: model.save(folder / "best_model"),
    "EvalCallback": lambda model, folder: model.learn(
        64, EvalCallback(Monitor(Corridor()), eval_freq=4, best_model_save_path=folder, verbose=0, warn=False)
    ),
    "CheckpointCallback": lambda model, folder: model.learn(64, CheckpointCallback(4, folder, "best", verbose=0)),
}


@both
@pytest.mark.parametrize(
    ("place", "function", "error"),
    [(None, "", TypeError()), (th, "save", KeyboardInterrupt()), (os, "fsync", FULL), (os, "replace", FULL)],
)
@pytest.mark.parametrize("save", SAVES)
def test_a_save_that_fails_leaves_the_old_file_and_no_other(save, place, function, error, kind, tmp_path, monkeypatch):
    model = make(kind, Corridor())
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


@pytest.mark.parametrize("at", ["th.save", "os.fsync"])
def test_a_process_that_is_killed_while_it_saves_leaves_the_old_file(at, tmp_path):
    make("steps").save(tmp_path / "model")
    before = (tmp_path / "model.zip").read_bytes()
    code = f"""
import os, signal
import torch as th
from sb3_reinforce import REINFORCE
model = REINFORCE.load({str(tmp_path / "model")!r}, device="cpu")
{at} = lambda *args, **kwargs: os.kill(os.getpid(), signal.SIGKILL)
model.save({str(tmp_path / "model")!r})
"""
    assert subprocess.run([sys.executable, "-c", code]).returncode == -signal.SIGKILL
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


def optimizer_with(parameters, **changes):
    return {**parameters, "policy.optimizer": {**parameters["policy.optimizer"], **changes}}


def groups_with(parameters, **changes):
    groups = parameters["policy.optimizer"]["param_groups"]
    return optimizer_with(parameters, param_groups=[{**group, **changes} for group in groups])


def moments_with(parameters, change):
    state = parameters["policy.optimizer"]["state"]
    return optimizer_with(parameters, state={i: change(moments) for i, moments in state.items()})


def not_finite(state):
    return {key: value * NAN for key, value in state.items()}


WRONG = {
    "nothing": lambda p: {},
    "an unknown name": lambda p: {**p, "foo": {}},
    "a method's name": lambda p: {**p, "learn": {}},
    "no optimizer": lambda p: {"policy": p["policy"]},
    "no dict": lambda p: {**p, "policy.optimizer": 3},
    "another shape": lambda p: {**p, "policy": {**p["policy"], "action_net.bias": th.zeros(77)}},
    "a key less": lambda p: {**p, "policy": {k: v for k, v in p["policy"].items() if k != "action_net.bias"}},
    "not finite": lambda p: {**p, "policy": not_finite(p["policy"])},
    "no finite optimizer": lambda p: moments_with(p, not_finite),
    "no finite learning rate": lambda p: groups_with(p, lr=float("inf")),
    "another optimizer's setting": lambda p: groups_with(p, betas="x"),
    "another optimizer's groups": lambda p: optimizer_with(p, param_groups=[{"params": [0]}] * 2),
    "another optimizer's moments": lambda p: moments_with(p, lambda moments: {**moments, "exp_avg": th.zeros(3, 77)}),
    "another optimizer's missing moments": lambda p: moments_with(p, lambda moments: {"step": moments["step"]}),
}


@both
@pytest.mark.parametrize("wrong", WRONG)
@pytest.mark.parametrize("exact_match", [True, False])
def test_wrong_parameters_change_nothing_at_all(exact_match, wrong, kind):
    model, other = make(kind, Corridor()).learn(32), make(kind, Corridor(), seed=1).learn(64)
    before = plain(model.get_parameters())
    states = WRONG[wrong](other.get_parameters())
    is_partial = wrong in ("no optimizer", "a key less")
    if not exact_match and (is_partial or "another optimizer" in wrong):
        warned = pytest.warns(UserWarning, match=r"'policy.optimizer'.*It is left out")
        with nullcontext() if is_partial else warned:
            model.set_parameters(states, exact_match=False)
        after = model.get_parameters()
        assert all(th.equal(after["policy"][name], value) for name, value in states["policy"].items())
        assert is_partial or ("policy.optimizer", plain(after["policy.optimizer"])) in before
        return
    with pytest.raises((ValueError, TypeError, RuntimeError)):
        model.set_parameters(states, exact_match=exact_match)
    assert plain(model.get_parameters()) == before
    model.learn(64, reset_num_timesteps=False)


class ScaledAdam(th.optim.Adam):
    """Keeps a setting outside its groups, which copies of an optimizer lack."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.scale = 0.5

    def step(self, closure=None):
        for parameter in self.param_groups[0]["params"]:
            if parameter.grad is not None:
                parameter.grad *= self.scale
        return super().step(closure)


@both
@pytest.mark.parametrize("optimizer", [RMSpropTFLike, th.optim.Adafactor, th.optim.SGD, th.optim.AdamW, ScaledAdam])
def test_the_states_of_other_optimizers_are_loaded(optimizer, kind, tmp_path):
    model = make(kind, Corridor(), policy_kwargs={"net_arch": [4], "optimizer_class": optimizer}).learn(32)
    model.save(tmp_path / "model")
    loaded = type(model).load(tmp_path / "model", env=Corridor())
    assert plain(loaded.get_parameters()) == plain(model.get_parameters())
    loaded.learn(32)


@both
@pytest.mark.parametrize(
    ("own", "other"),
    [
        *product((th.optim.SGD, th.optim.Adagrad), (th.optim.Adam, th.optim.RMSprop, th.optim.Adamax)),
        *product((th.optim.Adam,), (th.optim.SGD, th.optim.Adagrad, th.optim.Adamax)),
    ],
)
def test_the_state_of_another_kind_of_optimizer_is_left_out(own, other, kind):
    def make_with(optimizer):
        return make(kind, Corridor(), policy_kwargs={"net_arch": [4], "optimizer_class": optimizer})

    states = make_with(other).learn(32).get_parameters()
    model = make_with(own)
    with pytest.raises(ValueError, match=r"another optimizer\. set_parameters with exact_match=False leaves it out"):
        model.set_parameters(states)
    with pytest.warns(UserWarning, match="It is left out"):
        model.set_parameters(states, exact_match=False)
    model.learn(32)


@both
def test_a_state_may_lack_flags_that_a_newer_pytorch_has(kind):
    model = make(kind, Corridor()).learn(32)
    states = groups_with(model.get_parameters())
    for group in states["policy.optimizer"]["param_groups"]:
        del group["decoupled_weight_decay"]
    other = make(kind, Corridor())
    other.set_parameters(states)
    assert plain(other.get_parameters()) == plain(model.get_parameters())
    other.learn(32)


@both
def test_parameters_of_another_model_are_copied(kind):
    """Also the moments of its optimizers, which PyTorch takes as they are."""
    first = make(kind, Corridor()).learn(32)
    second = make(kind, Corridor())
    second.set_parameters(first.get_parameters())
    before = plain(first.get_parameters())
    second.learn(64)
    assert plain(first.get_parameters()) == before


@both
def test_moments_of_another_shape_are_refused_before_the_first_step_too(kind):
    states = WRONG["another optimizer's moments"](make(kind, Corridor()).learn(32).get_parameters())
    with pytest.raises(ValueError, match=r"exp_avg of parameter 0 must have shape .* got \(3, 77\)"):
        make(kind, Corridor()).set_parameters(states)


@both
@pytest.mark.parametrize(("other", "same_optimizer"), [(A2C, False), (PPO, True)])
def test_parameters_of_other_algorithms(kind, other, same_optimizer, tmp_path):
    """The policy's in any case, an optimizer's where it is of the same kind, from a file and from a dictionary."""
    arguments = {"n_steps": 16} if other is A2C else {"n_steps": 16, "batch_size": 16}
    trained = other("MlpPolicy", Corridor(), device="cpu", **arguments).learn(16)
    trained.save(tmp_path / "other")
    for states in (trained.get_parameters(), tmp_path / "other"):
        model = make(kind, Corridor(), policy_kwargs={})
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            model.set_parameters(states, exact_match=False)
        assert plain(model.policy.state_dict()) == plain(trained.policy.state_dict())
        assert bool(model.policy.optimizer.state_dict()["state"]) == same_optimizer
        assert len(caught) == (0 if same_optimizer else 1)
        model.learn(32)


@pytest.mark.parametrize("kind", [*KINDS, "PPO"])
def test_the_file_of_another_algorithm_is_named_with_a_remedy(kind, tmp_path):
    (PPO("MlpPolicy", "CartPole-v1", device="cpu") if kind == "PPO" else make(kind)).save(tmp_path / "other")
    for algorithm in {REINFORCE, FiniteDifference} - {KINDS.get(kind, (None,))[0]}:
        with pytest.raises(ValueError, match=r"other was not saved by a .* set_parameters .* exact_match=False"):
            algorithm.load(tmp_path / "other")


class Masked(ActorCriticPolicy):
    """Holds an infinite mask, as a buffer and as a parameter that is not trained."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        mask = th.tensor([0.0, -float("inf")])
        self.register_buffer("mask", mask)
        self.frozen_mask = th.nn.Parameter(mask.clone(), requires_grad=False)


@both
def test_a_mask_may_be_infinite(kind, tmp_path):
    model = make(kind, Corridor(), Masked)
    model.save(tmp_path / "model")
    loaded = KINDS[kind][0].load(tmp_path / "model", device="cpu").policy
    assert loaded.mask[1] == loaded.frozen_mask[1] == -float("inf")
    for name, number in (("mask", NAN), ("frozen_mask", NAN), ("action_net.bias", float("inf"))):
        states = model.get_parameters()
        states["policy"][name] = th.tensor([0.0, number])
        with pytest.raises(ValueError, match="finite"):
            model.set_parameters(states)


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
