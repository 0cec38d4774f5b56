"""What the README and the pages of ``docs/`` show can be run, and is there."""

import ast
import inspect
import re
import runpy
import shlex
import sys
from pathlib import Path
from typing import Any

import pytest
import rl_zoo3
from stable_baselines3 import PPO
from test_architecture import FOREIGN

from sb3_reinforce import REINFORCE, FiniteDifference
from sb3_reinforce.diagnostics.pitfalls import PITFALLS

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "ARCHITECTURE.md", *sorted((ROOT / "docs").glob("*.md"))]
TEXTS = {path.name: path.read_text(encoding="utf-8") for path in PAGES}
# Budgets of the pages' blocks, and how CI cuts them
SMALL = {
    r"learn\(\d[\d_]*": "learn(1_000",
    r"n_eval_episodes=\d+": "n_eval_episodes=2",
    r"n_episodes=100": "n_episodes=10",
    r"n_estimates=\d+": "n_estimates=3, n_episodes=10",
    r"compare_starts\(model\)": "compare_starts(model, n_starts=4)",
    # A rollout of PPO has 2048 steps of each environment
    r'"CartPole-v1", n_envs=8': '"CartPole-v1", n_envs=1',
}
# What CI appends to a command, by the script or the command of the Zoo, so that it takes seconds
BUDGETS = {
    "13_memory.py": "--timesteps 500",
    "common_random_numbers.py": "--n-delta 4 --n-gradients 2",
    "comparison_cost.py": "--timesteps 200 --repetitions 1",
    "enjoy": "--no-render -n 50",
    "images.py": "--n-envs 1 --timesteps 32 --rounds 1",
    "masks.py": "--seeds 0 --evaluate-at 256",
    "noise_scale.py": "--tasks CartPole-v1 --seeds 0 --timesteps 200 --output rows.csv",
    "peers.py": "--contenders REINFORCE --seeds 0 --timesteps 600",
    "pendulum_optimum.py": "--seeds 0 --gamma 1 --grid 11 9",
    "record_video": "-n 20",
    "scaling.py": "--n-envs 64 --timesteps 64 --rounds 1",
    "search_throughput.py": "--n-envs 2 --n-delta 2 --updates 1 --rounds 1",
    "search_vs_ars.py": "--env CartPole-v1 --seeds 0 --timesteps 100 --output rows.csv",
    "throughput.py": "--n-envs 64 --timesteps 64 --rounds 1",
    "train": "-n 200 --eval-freq -1",
    "variance_vs_episodes.py": "--timesteps 100 --batches 2 --output .",
}
# Why the other commands are not run here
ELSEWHERE = {
    r"-m venv|pip install|activate$": "`.ci/run` installs by the README's lines; the extras are looked up below",
    r"-m pytest$|make (check|docs|examples|wheel)$|^\.ci/run$|/1_reinforce\.py$": "`.ci/run` does it",
    r"compare(_plots)?\.py": "tests/zoo/test_compare.py runs both scripts",
    r"-optimize|--trial-id|-f agents$|zoo\.model_card|train --help$": "tests/zoo runs them with other settings",
    r"^make agents$": "minutes; tests/zoo/test_zoo.py runs its two commands",
    r"torch\.distributed\.run": "tests/common/test_process_ends.py and tests/zoo/test_zoo_processes.py start it",
    r"processes\.py": "minutes: it starts eight processes for each row",
    r"^make (format|tables|test-lowest)$|-m slow$": "it changes files, or takes many minutes: by hand, or at night",
    r"test_gpu\.py$": "it needs a GPU",
    r"^hf |^tensorboard |^python train\.py$|python -m sb3_reinforce\.zoo$": "a program of others, or no command",
}
IS_COMMAND = re.compile(r"(OMP_NUM_THREADS=1 )?(\S*python[\d.]*|\S*pip|make|hf|tensorboard|\.) \S|\.ci/run$")


def blocks(text: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)


def commands(text: str) -> list[str]:
    """The lines of the shell blocks, and the commands within sentences."""
    lines = [line for block in blocks(text, "sh") for line in block.splitlines()]
    spans = re.findall(r"`([^`]*)`", re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL))
    return [part.strip() for line in lines + spans for part in line.replace("\n", " ").split("&&")]


COMMANDS = {(name, command) for name, text in TEXTS.items() for command in commands(text)}
RUN = {
    name: [
        command
        for command in dict.fromkeys(commands(text))
        if IS_COMMAND.match(command) and not any(re.search(pattern, command) for pattern in ELSEWHERE)
    ]
    for name, text in TEXTS.items()
}
# Benchmarks take seconds even so; whether their options exist is checked below each time
SLOW = [name for name, found in RUN.items() if any("examples/benchmarks" in command for command in found)]
WITH_OPTIONS = re.compile(r"(sb3_reinforce\.zoo|sb3-reinforce-zoo)[ .]\w|\.py\b.* --")


@pytest.mark.parametrize("name", [path.name for path in PAGES[1:] if blocks(TEXTS[path.name], "python")])
@pytest.mark.filterwarnings("ignore")
def test_python_blocks_run(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In order, as one script, with small budgets. `.ci/wheel` runs the README's blocks as they stand."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    script = "\n".join(blocks(TEXTS[name], "python"))
    for budget, small in SMALL.items():
        script = re.sub(budget, small, script)
    exec(compile(script, name, "exec"), {"__name__": "__main__"})


def last_values(words: list[str]) -> frozenset[tuple[str, ...]]:
    """Each option with its values; where it is repeated, with the last ones."""
    options: dict[str, list[str]] = {}
    for word in words:
        if re.match("--?[a-zA-Z]", word):
            options[word] = values = [word]
        else:
            values.append(word)
    return frozenset(map(tuple, options.values()))


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[pytest.mark.slow] if name in SLOW else []) for name, found in RUN.items() if found],
)
@pytest.mark.filterwarnings("ignore")
def test_commands_run(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In order, with small budgets, in this process, which has imported PyTorch already."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    monkeypatch.syspath_prepend(str(ROOT / "examples" / "benchmarks"))
    runs: dict[Any, list[str]] = {}
    for command in RUN[name]:
        start, *words = shlex.split(command.removeprefix("OMP_NUM_THREADS=1 "))
        assert start == "python", f"{name}: {command} is not run, and ELSEWHERE does not say why"
        # A module of the Zoo and its command, or a script
        program = words[: 3 if words[0] == "-m" else 1]
        options = [*words[len(program) :], *shlex.split(BUDGETS[Path(program[-1]).name])]
        # Commands that differ only in what the budget replaces are one run, with the options of all
        runs.setdefault((*program, last_values(options)), [*program]).extend(options)
    for first, *words in runs.values():
        if first == "-m":
            monkeypatch.setattr(sys, "argv", words)
            runpy.run_module(words[0], run_name="__main__")
        else:
            monkeypatch.setattr(sys, "argv", [first, *words])
            runpy.run_path(str(ROOT / first), run_name="__main__")


def test_every_reason_not_to_run_a_command_is_needed() -> None:
    assert all(any(re.search(pattern, command) for _, command in COMMANDS) for pattern in ELSEWHERE)


def options_of(command: str) -> str:
    """The source that defines the options of a command that starts Python."""
    module = re.search(r"-m sb3_reinforce\.zoo\.(\w+)", command)
    if module:
        return (ROOT / "sb3_reinforce" / "zoo" / f"{module[1]}.py").read_text(encoding="utf-8")
    zoo = re.search(r"(?:-m sb3_reinforce\.zoo|sb3-reinforce-zoo) (\w+)", command)
    if zoo:
        return (Path(rl_zoo3.__file__).parent / f"{zoo[1]}.py").read_text(encoding="utf-8")
    script = re.search(r"python[\d.]* (\S+\.py)", command)
    return (ROOT / script[1]).read_text(encoding="utf-8") if script else ""


@pytest.mark.parametrize(("name", "command"), sorted(entry for entry in COMMANDS if WITH_OPTIONS.search(entry[1])))
def test_commands_have_these_options(name: str, command: str) -> None:
    source = options_of(command)
    for option in re.findall(r"(?<= )--?[a-z][\w-]*", command.split("sb3_reinforce.zoo")[-1]):
        assert option == "--help" or f'"{option}"' in source, f"{name}: {command} has no option {option}"


@pytest.mark.parametrize("name", TEXTS)
def test_files_extras_and_make_targets_exist(name: str) -> None:
    text = TEXTS[name]
    paths = re.findall(r"[`\s(]((?:tests|examples|docs|sb3_reinforce|\.ci|\.github)/[\w./-]*\w)", text)
    missing = [path for path in paths if not (ROOT / path).exists() and not path.startswith("docs/_build")]
    folders = "common|policies|envs|estimation|sampling|diagnostics|zoo"
    short = re.findall(rf"(?<![\w/-])((?:{folders})/[\w/]+\.(?:py|yml))", text)
    missing += [path for path in short if not (ROOT / "sb3_reinforce" / path).exists()]
    assert not missing
    folder = next(path.parent for path in PAGES if path.name == name)
    assert all((folder / path).exists() for path in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", text))
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    for extras in re.findall(r'pip install -e "\.\[([\w,]+)\]"', text):
        assert all(re.search(rf"^{extra} = \[", project, re.MULTILINE) for extra in extras.split(","))
    targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    assert {target for span in re.findall(r"`make ([\w -]+)`", text) for target in span.split()} <= {*targets}


def test_named_tests_exist() -> None:
    for text in TEXTS.values():
        for path, test in re.findall(r"(tests/[\w/]+\.py)::(\w+)", text):
            assert f"def {test}(" in (ROOT / path).read_text(encoding="utf-8"), f"{path}::{test}"


@pytest.mark.parametrize("name", [name for name, text in TEXTS.items() if "<!-- end -->" in text])
def test_tables_are_those_of_the_rows(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Otherwise run `make tables`."""
    monkeypatch.syspath_prepend(str(ROOT / "docs" / "_ext"))
    from fill_tables import filled

    assert filled(TEXTS[name]) == TEXTS[name]


def test_the_readme_is_short() -> None:
    assert len(TEXTS["README.md"].splitlines()) <= 130


def test_the_table_of_ppos_arguments_has_their_defaults():
    """Each cell has arguments with their default behind them, "`name` (default)", or calls with it."""
    table = TEXTS["start.md"].partition("| PPO (default) | REINFORCE (default) |")[2].partition("\n\n")[0]
    models = [algorithm("MlpPolicy", "CartPole-v1", device="cpu") for algorithm in (PPO, REINFORCE)]
    found = 0
    for line in table.strip().splitlines()[1:]:
        for cell, model in zip(line.strip("|").split("|"), models, strict=True):
            for name, default in re.findall(r"`(\w+)` \(([\d.e-]+|True|False)\)", cell):
                assert getattr(model, name) == ast.literal_eval(default), name
                found += 1
            for name, default in re.findall(r"`learn\((\w+)=(\d+)\)`", cell):
                assert inspect.signature(model.learn).parameters[name].default == int(default)
                found += 1
    assert found >= 16
    # start.md says so of those that are not in the table
    ours, theirs = (inspect.signature(algorithm).parameters for algorithm in (REINFORCE, PPO))
    others = {name for name in ours.keys() & theirs.keys() if f"`{name}`" not in table and name != "policy"}
    assert {"gamma", "ent_coef", "use_sde", "policy_kwargs", "max_grad_norm"} <= others
    assert {name: ours[name].default for name in others} == {name: theirs[name].default for name in others}
    assert inspect.signature(FiniteDifference.learn).parameters["log_interval"].default == 1


def test_the_tables_of_pitfalls_and_private_names_are_complete():
    rows = re.findall(r"^\| `(\w+)` \| ", TEXTS["gradient_lab.md"], re.MULTILINE)
    assert rows == list(PITFALLS)
    script = (ROOT / "examples" / "10_pitfalls.py").read_text(encoding="utf-8")
    assert re.findall(r'^    "(\w+)": \(', script, re.MULTILINE) == list(PITFALLS)
    table = TEXTS["ARCHITECTURE.md"].partition("| name | where | why |")[2]
    names = [name for line in table.splitlines() if line.startswith("| `") for name in re.findall(r"`(\S+)`", line)]
    assert {name.strip("*") for name in names if name.strip("*").startswith("_")} == FOREIGN.keys()
